"""The standard streams, which may be closed, full, or a pipe that nobody reads any more.

None of these stops a job: the work is done, what cannot be written is not, and the exit code tells.
"""

import io
import json
import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from enum import StrEnum
from typing import TYPE_CHECKING, Any, TextIO

from fleet_slip.cli.early_exit import for_machines
from fleet_slip.errors import hide_passwords, printable
from fleet_slip.rendering import wrap_lines
from fleet_slip.storage.runs import LOGGER, current_run_id

if TYPE_CHECKING:
    from rich.console import Console


class _Lasting(io.FileIO):
    """A stream that goes on where a write fails, and remembers why it did."""

    error: OSError | None = None

    def write(self, content: Any) -> int:
        """Write as much as the system takes, or, once a write has failed, nothing."""
        if self.error is None:
            try:
                return super().write(content)
            except OSError as error:
                self.error = error
        return len(content)


class Streams:
    """Standard output and standard error of a command, from its start to its end."""

    def __init__(self) -> None:
        """Take the place of Python's streams.

        A closed descriptor is opened first, or else the next file that anybody opens takes its
        number, and what is printed goes there. It is opened for reading, as gnulib's stdopen()
        does, so that writing fails.
        """
        for descriptor in range(3):
            try:
                os.fstat(descriptor)
            except OSError:
                os.open(os.devnull, os.O_RDONLY)
        if sys.stdin is None:
            sys.stdin = open(0, encoding="utf-8", closefd=False)  # noqa: SIM115 - a descriptor
        self._out = _Lasting(1, "w", closefd=False)
        sys.stdout = _as_text(self._out, sys.stdout)
        sys.stderr = _as_text(_Lasting(2, "w", closefd=False), sys.stderr, "backslashreplace")

    def unprinted(self) -> str | None:
        """Return why results were not printed to the end; None if they were.

        None as well if they went into a pipe whose reader had enough, such as `head`.
        """
        sys.stdout.flush()
        error = self._out.error
        if error is None or isinstance(error, BrokenPipeError):
            return None
        return error.strerror


def _as_text(raw: io.FileIO, like: TextIO | None, errors: str = "surrogateescape") -> TextIO:
    """Return a text stream that writes whole lines, in the encoding of the one it replaces."""
    return io.TextIOWrapper(
        io.BufferedWriter(raw),
        encoding=like.encoding if like else "utf-8",
        errors=like.errors if like else errors,
        line_buffering=like is None or like.isatty() or raw.fileno() == 2,
    )


# Remarks and events on stderr: text for people, or one JSON object a line for machines.


class LogFormat(StrEnum):
    """How remarks are written: `auto` is text, but JSON with `--json` and in journals."""

    AUTO = "auto"
    TEXT = "text"
    JSON = "json"


_drawn_on: "list[Console]" = []


def stderr() -> "Console":
    """Return a console for progress and remarks: that on which a bar is drawn, if there is one."""
    if _drawn_on:
        return _drawn_on[-1]
    from rich.console import Console  # noqa: PLC0415 - a command without a remark waits for none

    return Console(stderr=True, highlight=False, emoji=False, soft_wrap=True)


@contextmanager
def drawing_on(console: "Console") -> Iterator[None]:
    """Print remarks above what is drawn on a console, not into it."""
    _drawn_on.append(console)
    try:
        yield
    finally:
        _drawn_on.remove(console)


class PeopleHandler(logging.Handler):
    """Prints remarks, on a terminal in lines that it can show.

    Events, which have figures and no sentence, are left out.
    """

    def emit(self, record: logging.LogRecord) -> None:
        """Print a remark."""
        if not hasattr(record, "event"):
            text = printable(hide_passwords(record.getMessage()))
            if not (_drawn_on or sys.stderr.isatty()):
                print(text, file=sys.stderr, flush=True)  # noqa: T201 - a remark
                return
            console = stderr()
            shown = wrap_lines(text, console.width) if console.is_terminal else text
            console.print(shown, markup=False)


class JsonFormatter(logging.Formatter):
    """Makes a record a line of JSON: time, level, run_id, event, and what is particular to it."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        known = {"event": getattr(record, "event", "message"), **getattr(record, "fields", {})}
        if known["event"] == "message":
            known["message"] = hide_passwords(record.getMessage())
        time = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")
        level = record.levelname.lower()
        head = {"time": time, "level": level, "run_id": current_run_id()}
        return json.dumps(head | known, default=str)


def configure_logs(chosen: LogFormat) -> None:
    """Send the program's log to stderr in a format."""
    handler: logging.Handler = PeopleHandler()
    if for_machines(chosen):
        handler = logging.StreamHandler()
        handler.setFormatter(JsonFormatter())
    LOGGER.handlers[:] = [handler]
    LOGGER.setLevel(logging.INFO)
    LOGGER.propagate = False


def for_people() -> bool:
    """Whether a person reads stderr: then progress may be drawn there."""
    return any(isinstance(handler, PeopleHandler) for handler in LOGGER.handlers)
