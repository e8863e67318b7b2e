"""The commands of `fleet-slip` as one program: its options, and how it ends."""

import inspect
import logging
import os
import signal
import sys
from collections.abc import Mapping
from functools import cache, partial
from importlib import import_module
from importlib.util import find_spec
from types import CodeType, FunctionType
from typing import Annotated, Any

import typer
from typer import Context, Option
from typer.core import TyperCommand, TyperGroup
from typer.main import get_group

import fleet_slip
from fleet_slip.cli.options import recorded
from fleet_slip.cli.output import Streams, configure_remarks, say
from fleet_slip.errors import (
    INTERRUPTED,
    FleetSlipError,
    QueryGoesOnError,
    StorageError,
    UsageError,
    is_lack_of_memory,
)
from fleet_slip.resources import memory_bytes

# A module is imported when one of its commands runs: --help and shell completion import none. The
# list of commands takes their docstrings from the module's compiled code. Help is plain text: boxes
# and colours took longer than everything else.

GROUPS = {
    "Start here": "demo run mapping ingest learn sql show evaluate export",
    "Data": "simulate gram features",
    "Models": "select publish models promote rollback pin unpin diff",
    "Accuracy": "score predict identify report watch explore diagnose",
    "Operations": "nightly status contract quality calibrate monitor verify compact forget migrate",
}
"""The commands by group, in the order of `--help`."""

MODULES = {
    "pipeline_commands": "demo run learn nightly",
    "data_commands": "mapping ingest simulate gram features",
    "sql_command": "sql",
    "model_commands": "select publish diagnose show export models promote rollback pin unpin diff",
    "accuracy_commands": "evaluate score predict identify report watch explore",
    "operation_commands": "status contract quality calibrate monitor verify compact forget migrate",
}
"""The modules of `fleet_slip.cli` that define the commands, each as a function."""

RECORDED = (
    "run learn nightly ingest simulate gram publish promote rollback pin unpin evaluate watch "
    "compact forget migrate"
)
"""The commands whose runs are in the view `runs`."""

COMMANDS = {name: module for module, names in MODULES.items() for name in names.split()}


class CommandGroup(TyperGroup):
    """The commands, listed by their docstrings; a command is loaded when it runs."""

    def __init__(self, **settings: Any) -> None:
        """Add a command without options for each of `COMMANDS`."""
        super().__init__(**settings)
        for name, module in COMMANDS.items():
            self.add_command(TyperCommand(name, help=docstrings(module)[name]))

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ARG002 - of the base
        """Write the commands, group by group."""
        width = max(map(len, COMMANDS))
        text_width = formatter.width - width - 6
        for group, names in GROUPS.items():
            commands = [self.commands[name] for name in names.split()]
            helps = [(f"{c.name:<{width}}", c.get_short_help_str(2 * text_width)) for c in commands]
            with formatter.section(group):
                formatter.write_dl(helps)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Load the command that runs."""
        if args[0] in COMMANDS:
            self.commands[args[0]] = load_command(args[0])
        return super().resolve_command(ctx, args)


def load_command(name: str) -> Any:
    """Return a command with its options, or a group of commands."""
    module = import_module(f"fleet_slip.cli.{COMMANDS[name]}")
    app = typer.Typer(rich_markup_mode=None)
    if group := getattr(module, f"{name}_app", None):
        app.add_typer(group, name=name)
    else:
        function = getattr(module, name)
        app.command(name)(recorded(function) if name in RECORDED.split() else function)
    return get_group(app).commands[name]


@cache
def docstrings(module: str) -> Mapping[str, str]:
    """Return the docstrings of a module's functions by name, without importing the module."""
    name = f"fleet_slip.cli.{module}"
    spec: Any = find_spec(name)
    compiled = spec.loader.get_code(name)
    codes = [code for code in compiled.co_consts if isinstance(code, CodeType)]
    functions = [FunctionType(code, {}) for code in codes if not code.co_freevars]
    return {f.__name__: inspect.cleandoc(f.__doc__ or "") for f in functions}


EXIT_CODES = {
    0: "done",
    1: "a bug",
    2: "wrong usage",
    3: "a config file",
    4: "input data",
    5: "the data cannot answer",
    6: "storage",
    7: "refused",
    8: "a conflict with another process",
    9: "damage",
    10: "something needs attention",
    11: "a cluster",
    12: "not finished yet",
    13: "a package of an extra is missing",
    15: "a recording is in the logs already",
    16: "sensors are not checked",
    INTERRUPTED: "interrupted",
}
"""The exit codes of the classes of `errors.py`, as `--help` lists them."""

app = typer.Typer(
    cls=CommandGroup,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog=f"Exit codes: {', '.join(f'{code} {text}' for code, text in EXIT_CODES.items())}.",
)


def _print_version(requested: bool) -> None:
    if requested:
        from importlib.metadata import version

        typer.echo(f"fleet-slip {version('fleet-slip')}")
        raise typer.Exit


@app.callback()
def options(
    context: Context,
    root: Annotated[
        str | None,
        Option(
            help="Data root: a folder, or the URL of an object store, such as s3://BUCKET/PATH. "
            "Default: $FLEET_SLIP_ROOT, else ./data."
        ),
    ] = None,
    config: Annotated[
        str | None,
        Option(
            help="Folder of configs that override the shipped ones (docs/configuration.md). "
            "Default: $FLEET_SLIP_CONFIG."
        ),
    ] = None,
    lineage: Annotated[  # noqa: ARG001 - read by `recorded`
        str | None,
        Option(
            envvar="FLEET_SLIP_LINEAGE",
            help="File or URL (http://HOST:PORT) for OpenLineage events of commands that change "
            "the data root.",
        ),
    ] = None,
    _version: Annotated[
        bool, Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Side-slip angle estimation from fleet logs.

    Logs of many cars become exact Gram matrices; from these every model, cohort and fold follows
    without reading a row again; the winner becomes a numbered model version.

    Without logs: fleet-slip demo

    With logs of your own: fleet-slip mapping suggest LOG, then fleet-slip learn
    """
    configure_remarks()
    context.obj = cache(partial(fleet_slip.open, root, config))


def run_app() -> int:
    """Run the command line; return its exit code. An expected error is one line on stderr."""
    streams = Streams()
    configure_remarks()
    _choose_font_folder()
    exit_code = _exit_code_of_app()
    if reason := streams.unprinted():
        say(
            f"error: standard output: {reason}. The command finished, but its output "
            "is incomplete.",
            logging.ERROR,
        )
        exit_code = exit_code or StorageError.exit_code
    return exit_code


def _exit_code_of_app() -> int:
    try:
        if callable(signal.getsignal(signal.SIGINT)):  # replace the handler of the imports
            signal.signal(signal.SIGINT, signal.default_int_handler)
        app()
    except FleetSlipError as error:
        say(f"error: {error.headline or error}", logging.ERROR)
        return error.exit_code
    except (MemoryError, ImportError, OSError, RuntimeError) as error:
        if not is_lack_of_memory(error):
            raise
        mebibytes = memory_bytes() // 2**20
        say(
            f"error: out of memory: the limit of this process is {mebibytes:,} MiB. Reduce the "
            "request, or raise the limit.",
            logging.ERROR,
        )
        return StorageError.exit_code
    except KeyboardInterrupt as error:
        return _end_interrupted(error)
    except SystemExit as end:
        if end.code == INTERRUPTED:  # typer converts a KeyboardInterrupt
            return _end_interrupted(end)
        _explain_late_options(sys.argv[1:], end.code)
        return end.code if isinstance(end.code, int) else 0
    return 0


def _explain_late_options(arguments: list[str], code: object) -> None:
    """Explain the place of --root, --config and --lineage if they follow the command."""
    early = "--root", "--config", "--lineage"
    while arguments and arguments[0] in early:
        arguments = arguments[2:]
    late = [option for option in early if option in arguments]
    if late and code == UsageError.exit_code:
        say(f"{late[0]} stands before the command: fleet-slip {late[0]} … {arguments[0]} …")


def _end_interrupted(error: BaseException | None) -> int:
    """Report the interrupt; end the process at once if a query cannot be stopped."""
    say(
        "interrupted: committed work is kept, nothing is half written. Repeat the command to "
        "continue.",
        logging.WARNING,
    )
    while error is not None:
        if isinstance(error, QueryGoesOnError):
            sys.stdout.flush()
            os._exit(INTERRUPTED)  # a normal exit would wait for the query
        error = error.__cause__ or error.__context__
    return INTERRUPTED


def _choose_font_folder() -> None:
    """Set the font cache of matplotlib to the cache folder of a service, which has no home."""
    folder = os.environ.get("CACHE_DIRECTORY", "").partition(":")[0]
    if folder:
        os.environ.setdefault("MPLCONFIGDIR", folder)
