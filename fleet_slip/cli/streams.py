"""The standard streams, which may be closed, full, or a pipe that nobody reads any more.

None of these stops a job: the work is done, what cannot be written is not, and the exit code tells.
"""

import io
import os
import sys
from typing import Any, TextIO


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
