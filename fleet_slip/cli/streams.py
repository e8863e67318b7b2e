"""The standard streams, which may be closed, full, or a pipe that nobody reads any more.

None of these stops a job: the work is done, what cannot be written is not, and the exit code tells.
"""

import io
import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TextIO

from fleet_slip.errors import hide_passwords, printable
from fleet_slip.rendering import wrap_lines
from fleet_slip.storage.runs import LOGGER

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


# Remarks on stderr.


_drawn_on: "list[Console]" = []


def stderr() -> "Console":
    """Return a console for progress and remarks: that on which a bar is drawn, if there is one."""
    if _drawn_on:
        return _drawn_on[-1]
    from rich.console import Console

    return Console(stderr=True, highlight=False, emoji=False, soft_wrap=True)


@contextmanager
def drawing_on(console: "Console") -> Iterator[None]:
    """Print remarks above what is drawn on a console, not into it."""
    _drawn_on.append(console)
    try:
        yield
    finally:
        _drawn_on.remove(console)


class _RemarkHandler(logging.Handler):
    """Prints remarks, on a terminal in lines that it can show."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print a remark."""
        text = printable(hide_passwords(record.getMessage()))
        if not (_drawn_on or sys.stderr.isatty()):
            print(text, file=sys.stderr, flush=True)  # noqa: T201 - a remark
            return
        console = stderr()
        shown = wrap_lines(text, console.width) if console.is_terminal else text
        console.print(shown, markup=False)


def configure_remarks() -> None:
    """Send the program's remarks to stderr."""
    LOGGER.handlers[:] = [_RemarkHandler()]
    LOGGER.setLevel(logging.INFO)
    LOGGER.propagate = False
