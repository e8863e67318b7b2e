"""Output of commands: JSON for machines, texts and tables for people, remarks on stderr."""

import json
import logging
import os
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from fleet_slip.base import document_of
from fleet_slip.cli.streams import drawing_on, stderr
from fleet_slip.errors import printable
from fleet_slip.rendering import FILE_WIDTH, Answer, Part, Remark, TextTable, wrap_lines
from fleet_slip.storage.runs import LOGGER


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


def print_answer(answer: Answer, json: bool, **options: Any) -> None:
    """Print the answer to a command, with options of its parts; then raise its problem."""
    if json:
        print_json(answer)
    else:
        print_parts(answer.parts(**options))
    if answer.problem:
        raise answer.problem


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
    from rich.progress import (
        BarColumn,
        Progress,
        TaskID,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    console = stderr()
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f}%"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal or bool(os.environ.get("CI")),
    )
    tasks: dict[str, TaskID] = {}

    def show(task: str, done: int, total: int | None) -> None:
        if task not in tasks:
            tasks[task] = bar.add_task(task, total=None)
        bar.update(tasks[task], completed=done, total=total)

    with drawing_on(console), bar:
        yield show
