"""Output of commands: JSON for machines, texts and tables for people, remarks on stderr.

The standard streams may be closed, full, or a pipe without a reader. None of these stops a job: it
completes its work, and the exit code reports a failed output.
"""

import io
import json
import logging
import os
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from fleet_slip.base import document_of
from fleet_slip.errors import StorageError, hide_passwords, printable
from fleet_slip.rendering import FILE_WIDTH, Answer, Part, Remark, TextTable, wrap_lines
from fleet_slip.storage.folder import storage_errors
from fleet_slip.storage.runs import LOGGER

if TYPE_CHECKING:
    from rich.console import Console


def say(text: str, level: int = logging.INFO) -> None:
    """Print a remark on stderr, as it is; in JSON if the log is."""
    LOGGER.log(level, text)


def print_json(content: Any) -> None:
    """Print results as a JSON document; see `document_of`."""
    sys.stdout.write(json_text(content))


def json_text(content: Any) -> str:
    """Return a JSON document as `print_json` prints it."""
    return json.dumps(document_of(content), indent=2, default=str, allow_nan=False) + "\n"


def print_parts(parts: Iterable[Part]) -> None:
    """Print what people are shown of a result; a terminal gets lines that it can show."""
    terminal = sys.stdout.isatty()
    width = shutil.get_terminal_size().columns if terminal else FILE_WIDTH
    for part in parts:
        if isinstance(part, Remark):
            say(part)
        elif isinstance(part, TextTable):
            if part.title:
                print_parts([part.title])
            _print(part.text(width, bold=terminal and os.environ.get("TERM") != "dumb"))
        else:
            _print(wrap_lines(printable_lines(part), width) if terminal else part)


def print_text(text: str) -> None:
    """Print a text as it is, on a terminal without what the terminal would execute."""
    _print(printable_lines(text) if sys.stdout.isatty() else text)


def printable_lines(text: str) -> str:
    """Return a text with escapes in place of unprintable characters, but with its lines."""
    return "\n".join(map(printable, text.split("\n")))


def print_answer(answer: Answer | Sequence[Answer], json: bool, **options: Any) -> None:
    """Print the answer to a command, with options of its parts; then raise its first problem."""
    answers = answer if isinstance(answer, Sequence) else (answer,)
    if json:
        print_json(answer)
    else:
        print_parts(part for answer in answers for part in answer.parts(**options))
    for problem in (answer.problem for answer in answers):
        if problem:
            raise problem


def print_table(content: Any, json: bool, *tables: TextTable) -> None:
    """Print tables, or a content as JSON."""
    if json:
        print_json(content)
    else:
        print_parts(tables)


def write_text(file: Path, text: str, remark: str = "") -> None:
    """Write a file, and print a remark on it. Raises `StorageError`."""
    if not file.parent.is_dir():
        raise StorageError(f"{file}: no such folder. Create it, or choose another path.")
    with storage_errors(file):
        file.write_text(text, encoding="utf-8")
    if remark:
        say(f"written to {file}{remark}")


def _print(text: str) -> None:
    print(text, flush=True)  # noqa: T201 - this is the one place that prints


# Progress of long work on stderr.


@contextmanager
def progress(task: str) -> Iterator[Callable[[int, int], None]]:
    """Show a bar for one task; see `progress_of_steps`."""
    with progress_of_steps() as show:
        show(task, 0, None)
        yield partial(show, task)


@contextmanager
def progress_of_steps() -> Iterator[Callable[[str, int, int | None], None]]:
    """Show bars with the remaining time on stderr, if it is a terminal.

    Yields the callback. Its arguments are the task, the units done and, if known, their total.
    """
    if not sys.stderr.isatty() or os.environ.get("CI"):
        yield lambda *_: None
        return
    from rich.progress import (
        BarColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    percentage = TextColumn("{task.percentage:>3.0f}%")
    columns = ("{task.description}", BarColumn(), percentage)
    tasks: dict[str, Any] = {}
    with Progress(
        *columns, TimeElapsedColumn(), TimeRemainingColumn(), console=stderr(), transient=True
    ) as bar:

        def show(task: str, done: int, total: int | None) -> None:
            if task not in tasks:
                tasks[task] = bar.add_task(task, total=None)
            bar.update(tasks[task], completed=done, total=total)

        yield show


# Standard streams, and remarks on stderr.


class _Lasting(io.FileIO):
    """A stream that continues after a failed write, and stores the reason."""

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

        A closed descriptor is opened first; otherwise the next opened file gets its number, and
        receives the output. It is opened for reading, as by stdopen() of gnulib, so that writing
        fails.
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


@cache
def stderr() -> "Console":
    """Return the console for progress and remarks, which it prints above the bars."""
    from rich.console import Console

    return Console(stderr=True, highlight=False, emoji=False, soft_wrap=True)


class _RemarkHandler(logging.Handler):
    """Prints remarks, on a terminal in lines that it can show."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print a remark."""
        text = printable(hide_passwords(record.getMessage()))
        if not sys.stderr.isatty():
            print(text, file=sys.stderr, flush=True)  # noqa: T201 - a remark
            return
        console = stderr()
        console.print(wrap_lines(text, console.width), markup=False)


def configure_remarks() -> None:
    """Send the program's remarks to stderr."""
    LOGGER.handlers[:] = [_RemarkHandler()]
    LOGGER.setLevel(logging.INFO)
    LOGGER.propagate = False
