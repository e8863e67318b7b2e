"""Progress of long work on stderr."""

import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

from rich.progress import (
    BarColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from fleet_slip.cli.output import say
from fleet_slip.cli.streams import drawing_on, stderr


@contextmanager
def progress(doing: str, unit: str) -> Iterator[Callable[[int, int], None]]:
    """Show a bar while one thing is done; see `progress_of_steps`."""
    with progress_of_steps(unit, doing) as show:
        yield partial(show, doing)


@contextmanager
def progress_of_steps(
    unit: str, first: str | None = None
) -> Iterator[Callable[[str, int, int], None]]:
    """Show bars with the time left on stderr while steps are done, if a person watches.

    Yields the callback: what is being done, how much is done, and how much there is. At Ctrl-C a
    line says how much of each step was done.
    """
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
    begun: dict[str, TaskID] = {}
    reached: dict[str, tuple[int, int]] = {}

    def begin(doing: str) -> None:
        begun[doing] = bar.add_task(doing, total=None)

    def show(doing: str, done: int, total: int) -> None:
        if doing not in begun:
            begin(doing)
        reached[doing] = done, total
        bar.update(begun[doing], completed=done, total=total)

    try:
        with drawing_on(console), bar:
            if first is not None:
                begin(first)
            yield show
    except KeyboardInterrupt:
        for doing, (done, total) in reached.items():
            say(f"{doing}: {_how_far(done, total, unit)}.", logging.WARNING)
        raise


def _how_far(done: int, total: int, unit: str) -> str:
    if done >= total:
        return f"all {total:,} {unit} were done"
    return f"{done:,} of {total:,} {unit} were done, {total - done:,} were not"
