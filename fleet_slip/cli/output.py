"""What commands print: JSON for machines, tables for people, progress on stderr."""

import json
import logging
import math
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from decimal import Decimal
from functools import partial
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

from fleet_slip.cli.logs import for_people, stderr
from fleet_slip.errors import printable
from fleet_slip.runs.log import LOGGER, log_event
from fleet_slip.words import number_of

TOLD_EVERY_S = 30.0
"""How often the log tells the progress of a job."""

Json = Annotated[bool, typer.Option("--json", help="Print machine-readable JSON on stdout.")]


def stdout() -> Console:
    """Return a console for results. Piped, it keeps to 200 columns and never wraps in mid-word."""
    return Console(width=None if sys.stdout.isatty() else 200, highlight=False, emoji=False)


def say(text: str, level: int = logging.INFO) -> None:
    """Print a remark on stderr, as it is; in JSON if the log is."""
    LOGGER.log(level, text)


def print_json(content: Any) -> None:
    """Print a JSON document; numbers that JSON does not know (NaN, infinity) become null."""
    text = json.dumps(_for_json(content), indent=2, default=str, allow_nan=False)
    sys.stdout.write(text + "\n")


def _for_json(value: Any) -> Any:
    match value:
        case dict():
            return {key: _for_json(item) for key, item in value.items()}
        case list() | tuple():
            return [_for_json(item) for item in value]
        case float() if not math.isfinite(value):
            return None
        case Decimal():
            return int(value) if value == value.to_integral_value() else float(value)
        case _:
            return value


def print_text(text: str) -> None:
    """Print a line for people on stdout, as it is."""
    print(text, flush=True)  # noqa: T201 - this is the one place that prints


def print_table(
    title: str, header: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1
) -> None:
    """Print a table; the first `left` columns are text, the others are numbers."""
    table = Table(box=None, pad_edge=False, header_style="bold", show_header=any(header))
    for i, name in enumerate(header):
        table.add_column(name, justify="left" if i < left else "right", overflow="fold")
    for row in rows:
        table.add_row(*(Text(printable(cell)) for cell in row))
    if title:
        print_text(title)
    console = stdout()
    with console.capture() as captured:
        console.print(table)
    print_text("\n".join(line.rstrip() for line in captured.get().splitlines()))


class _Rate(ProgressColumn):
    """Speed of a task in its unit."""

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        unit = task.fields.get("unit", "")
        return Text(f"{_short(speed)} {unit}/s" if speed else "")


class _Workers(ProgressColumn):
    """How many workers a cluster has at the moment."""

    def render(self, task: Task) -> Text:
        number = getattr(task.fields.get("executor"), "workers", None)
        return Text("" if number is None else f"{number_of(number, 'worker')}")


def _short(value: float) -> str:
    for limit, suffix in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= limit:
            return f"{value / limit:.1f}{suffix}"
    return f"{value:.0f}"


@contextmanager
def progress(
    doing: str, unit: str, executor: Executor | None = None
) -> Iterator[Callable[[int, int], None]]:
    """Show a bar while one thing is done; see `progress_of_steps`."""
    with progress_of_steps(unit, executor, doing) as show:
        yield partial(show, doing)


@contextmanager
def progress_of_steps(
    unit: str, executor: Executor | None = None, first: str | None = None
) -> Iterator[Callable[[str, int, int], None]]:
    """Show bars with rate and time left on stderr while steps are done, if a person watches.

    And the number of workers, if the executor is of a cluster. Machines are told by an event now
    and then. Yields the callback: what is being done, how much is done, and how much there is. The
    bar of the first step is there before it is called.
    """
    console = stderr()
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f}%"),
        _Rate(),
        _Workers(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not (console.is_terminal and for_people()) or bool(os.environ.get("CI")),
    )
    begun: dict[str, tuple[TaskID, float]] = {}
    told = time.monotonic()

    def begin(doing: str) -> tuple[TaskID, float]:
        task = bar.add_task(doing, total=None, unit=unit, executor=executor)
        return task, time.monotonic()

    def show(doing: str, done: int, total: int) -> None:
        nonlocal told
        if doing not in begun:
            begun[doing] = begin(doing)
        task, since = begun[doing]
        bar.update(task, completed=done, total=total)
        if (now := time.monotonic()) - told > TOLD_EVERY_S:
            told = now
            rate = {f"{unit}_per_s": round(done / (now - since))}
            workers = getattr(executor, "workers", None)
            log_event("progress", doing=doing, done=done, total=total, workers=workers, **rate)

    with bar:
        if first is not None:
            begun[first] = begin(first)
        yield show
