"""The commands of `fleet-slip` as one program: its options, and how it ends."""

import logging
import os
import signal
import sys
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import fleet_slip
from fleet_slip.cli.commands import CommandGroup
from fleet_slip.cli.early_exit import LOG_VARIABLE, leave
from fleet_slip.cli.logs import LogFormat, configure_logs
from fleet_slip.cli.output import say
from fleet_slip.cli.streams import Streams
from fleet_slip.errors import (
    INTERRUPTED,
    FleetSlipError,
    QueryGoesOnError,
    StorageError,
    is_lack_of_memory,
)
from fleet_slip.files.data_root import ROOT_VARIABLE
from fleet_slip.limits import memory_bytes
from fleet_slip.resources import CONFIG_VARIABLE, own_configs

if TYPE_CHECKING:
    from fleet_slip.api.fleet import Fleet

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


class LaterOpened:
    """The fleet of a command, opened when it is first asked for: help waits for no table."""

    def __init__(self, root: str | None) -> None:
        """Take the root that was named."""
        self._root = root

    @cached_property
    def _fleet(self) -> "Fleet":
        return fleet_slip.open(self._root)

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the fleet."""
        return getattr(self._fleet, name)


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
            f"Default: ${ROOT_VARIABLE}, else ./data.",
            show_default=False,
        ),
    ] = None,
    log: Annotated[
        LogFormat,
        typer.Option(
            envvar=LOG_VARIABLE,
            help="Remarks on stderr: text, json (one object a line), or auto: json in a systemd "
            "journal and, unless on a terminal, with --json; else text.",
        ),
    ] = LogFormat.AUTO,
    config: Annotated[
        str | None,
        typer.Option(
            help="A folder of configs laid over the shipped ones (docs/configuration.md). "
            f"Default: ${CONFIG_VARIABLE}.",
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

    Start with: **fleet-slip run --campaign smoke**
    """
    configure_logs(log)
    if config is not None:
        os.environ[CONFIG_VARIABLE] = str(Path(config).absolute())
    own_configs()
    context.obj = LaterOpened(root)


def run_app() -> int:
    """Run the command line; an expected error becomes one line on stderr and the exit code."""
    streams = Streams()
    configure_logs(LogFormat.AUTO)
    _choose_font_folder()
    exit_code = _exit_code_of_app()
    if reason := streams.unprinted():
        say(
            f"error: standard output: {reason}. What was asked for is done, not all printed.",
            logging.ERROR,
        )
        exit_code = exit_code or StorageError.exit_code
    return exit_code


def _exit_code_of_app() -> int:
    try:
        if signal.getsignal(signal.SIGINT) is leave:
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
            f"error: out of memory: this process may have {mebibytes:,} MiB for data. Ask for less "
            "at once, or give it more.",
            logging.ERROR,
        )
        return StorageError.exit_code
    except KeyboardInterrupt as error:
        return _end_interrupted(error)
    except SystemExit as ended:
        if ended.code == INTERRUPTED:  # typer makes it of a KeyboardInterrupt
            return _end_interrupted(ended)
        return ended.code if isinstance(ended.code, int) else 0
    return 0


def _end_interrupted(error: BaseException | None) -> int:
    """Say that Ctrl-C was pressed; end the process at once if a query cannot be stopped."""
    say(
        "interrupted: what was committed is kept, and nothing is half written. Give the same "
        "command again to go on.",
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
