"""The commands of `fleet-slip` as one program: its options, and how it ends."""

import inspect
import logging
import os
import signal
import sys
from collections.abc import Mapping
from functools import cache, partial
from importlib import import_module
from importlib.abc import InspectLoader
from importlib.util import find_spec
from types import CodeType, FunctionType
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_group

import fleet_slip
from fleet_slip.cli.output import say
from fleet_slip.cli.streams import Streams, configure_remarks
from fleet_slip.errors import (
    INTERRUPTED,
    FleetSlipError,
    QueryGoesOnError,
    StorageError,
    UsageError,
    is_lack_of_memory,
)
from fleet_slip.limits import memory_bytes

if TYPE_CHECKING:
    from fleet_slip.api.fleet import Fleet


# All commands: which module has each. A module is imported when one of its commands is called.
#
# So `--help` and shell completion wait for none of them, and a command waits for what it needs
# itself. What the list of commands says of one is its docstring's, which Python finds in the
# module's compiled code without running it. Help is plain text: boxes and colours took longer than
# all else.

GROUPS = {
    "Start here": {
        "run": "begin",
        "mapping": "data",
        "ingest": "data",
        "learn": "begin",
        "sql": "sql",
        "show": "models",
        "evaluate": "accuracy",
        "export": "models",
    },
    "Data": {
        "simulate": "data",
        "gram": "grams",
        "features": "grams",
    },
    "Models": {
        "select": "begin",
        "publish": "begin",
        "models": "models",
        "promote": "models",
        "pin": "models",
        "diff": "models",
    },
    "Accuracy": {
        "score": "accuracy",
        "identify": "accuracy",
        "report": "accuracy",
        "watch": "accuracy",
        "explore": "accuracy",
        "diagnose": "accuracy",
    },
    "Operations": {
        "nightly": "operations",
        "status": "operations",
        "quality": "operations",
        "calibrate": "operations",
        "monitor": "operations",
        "verify": "operations",
        "compact": "operations",
        "forget": "operations",
        "migrate": "operations",
    },
}
"""The commands in the groups and the order of `--help`, and the module of `fleet_slip.cli` that has
each as a function."""

COMMANDS = {name: module for group in GROUPS.values() for name, module in group.items()}


class CommandGroup(TyperGroup):
    """The commands, listed from their docstrings; the one that is called is loaded."""

    def __init__(self, **settings: Any) -> None:
        """Add a command that has nothing but its docstring for each of `COMMANDS`."""
        super().__init__(**settings)
        for name, module in COMMANDS.items():
            self.add_command(TyperCommand(name, help=docstrings(module)[name]))

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ARG002 - of the base
        """Write the commands, group by group."""
        wide = max(map(len, COMMANDS))
        left = formatter.width - wide - 6
        for group, names in GROUPS.items():
            with formatter.section(group):
                rows = [(name, self.commands[name].get_short_help_str(2 * left)) for name in names]
                formatter.write_dl([(f"{name:<{wide}}", text) for name, text in rows])

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Put the command that is called in the place of its docstring."""
        if args[0] in COMMANDS:
            self.commands[args[0]] = load_command(args[0])
        return super().resolve_command(ctx, args)


def load_command(name: str) -> Any:
    """Return a command, with its options."""
    module = import_module(f"fleet_slip.cli.{COMMANDS[name]}")
    app = typer.Typer(rich_markup_mode=None)
    app.command(name)(getattr(module, name))
    return get_group(app).commands[name]


@cache
def docstrings(module: str) -> Mapping[str, str]:
    """Return the docstrings of a module's functions by name; the module is not imported."""
    name = f"fleet_slip.cli.{module}"
    spec = find_spec(name)
    loader = spec.loader if spec else None
    compiled = loader.get_code(name) if isinstance(loader, InspectLoader) else None
    codes = [one for one in compiled.co_consts if isinstance(one, CodeType)] if compiled else []
    return {
        code.co_name: inspect.cleandoc(FunctionType(code, {}).__doc__ or "")
        for code in codes
        if not code.co_freevars
    }


app = typer.Typer(
    cls=CommandGroup,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog=(
        "Exit codes: 0 done, 1 a bug, 2 wrong usage, 3 a config file, 4 input data, 5 the data "
        "cannot answer, 6 storage, 7 refused, 8 a conflict with another process, 9 damage "
        "found, 10 something calls for attention, 11 a cluster, 12 not all done yet, 13 a "
        "package of an extra is missing, 14 too few cars for an answer, 15 a recording that is in "
        "already, 16 not examined, 130 interrupted."
    ),
)


def _open(root: str | None, config: str | None) -> "Fleet":
    """Return the fleet of a command, when it runs: its help waits for no table."""
    fleet = fleet_slip.open(root, config)
    _leave_pandas()
    return fleet


def _leave_pandas() -> None:
    """Let pyarrow find no pandas when it looks for it, at its first array of Python's values.

    Importing it takes a quarter of a small command. What asks for a data frame still gets one.
    """
    import pyarrow as pa  # noqa: PLC0415 - help needs no table

    sys.meta_path.insert(0, _WithoutPandas)
    pa.array([])
    sys.meta_path.remove(_WithoutPandas)


class _WithoutPandas:
    @staticmethod
    def find_spec(name: str, _path: Any = None, _target: Any = None) -> None:
        if name == "pandas":
            raise ModuleNotFoundError(name, name=name)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version  # noqa: PLC0415 - every start would wait for it

        typer.echo(f"fleet-slip {version('fleet-slip')}")
        raise typer.Exit


@app.callback()
def options(
    context: typer.Context,
    root: Annotated[
        str | None,
        typer.Option(
            help="Data root: a folder, or the URL of an object store such as s3://BUCKET/PATH. "
            "Default: $FLEET_SLIP_ROOT, else ./data.",
            show_default=False,
        ),
    ] = None,
    config: Annotated[
        str | None,
        typer.Option(
            help="A folder of configs laid over the shipped ones (docs/configuration.md). "
            "Default: $FLEET_SLIP_CONFIG.",
            show_default=False,
        ),
    ] = None,
    _version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print it.")
    ] = False,
) -> None:
    """Side-slip angle estimation from fleet logs.

    Logs of many cars become exact Gram matrices; from these every model, cohort and fold follows
    without reading a row again; the winner becomes a numbered model version.

    Without logs: fleet-slip run --campaign smoke

    With logs of your own: fleet-slip mapping suggest LOG, then fleet-slip learn
    """
    configure_remarks()
    context.obj = partial(_open, root, config)


def run_app() -> int:
    """Run the command line; an expected error becomes one line on stderr and the exit code."""
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
        if callable(signal.getsignal(signal.SIGINT)):  # not that of the start any more
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
    except SystemExit as ended:
        if ended.code == INTERRUPTED:  # typer makes it of a KeyboardInterrupt
            return _end_interrupted(ended)
        _explain_late_options(sys.argv[1:], ended.code)
        return ended.code if isinstance(ended.code, int) else 0
    return 0


def _explain_late_options(given: list[str], code: object) -> None:
    """Say where the options of all commands stand, if a command did not know them."""
    early = "--root", "--config"
    while given and given[0] in early:
        given = given[2:]
    late = [option for option in early if option in given]
    if late and code == UsageError.exit_code:
        say(f"{late[0]} stands before the command: fleet-slip {late[0]} … {given[0]} …")


def _end_interrupted(error: BaseException | None) -> int:
    """Say that Ctrl-C was pressed; end the process at once if a query cannot be stopped."""
    say(
        "interrupted: committed work is kept, nothing is half written. Repeat the command to "
        "continue.",
        logging.WARNING,
    )
    while error is not None:
        if isinstance(error, QueryGoesOnError):
            sys.stdout.flush()
            os._exit(INTERRUPTED)  # the usual end would wait for the query
        error = error.__cause__ or error.__context__
    return INTERRUPTED


def _choose_font_folder() -> None:
    """Keep what matplotlib knows of fonts in the cache folder of a service, which has no home."""
    folder = os.environ.get("CACHE_DIRECTORY", "").partition(":")[0]
    if folder:
        os.environ.setdefault("MPLCONFIGDIR", folder)
