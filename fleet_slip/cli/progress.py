"""Progress of long work on stderr."""

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

from fleet_slip.cli.streams import drawing_on, stderr


@contextmanager
def progress(doing: str) -> Iterator[Callable[[int, int], None]]:
    """Show a bar while one thing is done; see `progress_of_steps`."""
    with progress_of_steps() as show:
        show(doing, 0, None)
        yield partial(show, doing)


@contextmanager
def progress_of_steps() -> Iterator[Callable[[str, int, int | None], None]]:
    """Show bars with the time left on stderr while steps are done, if a person watches.

    Yields the callback: what is being done, how much is done, and how much there is, if
    that is known.
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

    def show(doing: str, done: int, total: int | None) -> None:
        if doing not in begun:
            begun[doing] = bar.add_task(doing, total=None)
        bar.update(begun[doing], completed=done, total=total)

    with drawing_on(console), bar:
        yield show
