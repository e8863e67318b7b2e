"""Shared parts of API calls: records, progress, and executors."""

import functools
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, TypeVar

from fleet_slip.base import Progress, Steps, no_progress, require_extra
from fleet_slip.storage.folder import Folder
from fleet_slip.storage.runs import current_run_id, recording

if TYPE_CHECKING:
    from fleet_slip.warehouse.warehouse import Warehouse

ShowProgress = Callable[[int, int], None]
"""Called with the units done so far and the units in total: rows, bytes or files."""

ShowStep = Callable[[str, int, int], None]
"""Like `ShowProgress`, with the name of the step first."""

Workers = int | str | Executor | None
"""Place where tasks run, with the same result.

A number of threads (None: one per core), the address of a Dask scheduler such as
`tcp://10.0.0.1:8786`, or an executor.
"""


P = ParamSpec("P")
R = TypeVar("R")


def record_call(method: Callable[Concatenate[Any, P], R]) -> Callable[Concatenate[Any, P], R]:
    """Record each call of a method in the view `runs`, unless a run is under way already.

    A dry run changes nothing and is not recorded.
    """

    @functools.wraps(method)
    def call(self: Any, /, *arguments: P.args, **options: P.kwargs) -> R:
        if current_run_id() is not None or options.get("dry_run"):
            return method(self, *arguments, **options)
        words = _command_line(arguments, options)
        with recording(self.warehouse.root, method.__name__, words):
            return method(self, *arguments, **options)

    return call


def _command_line(arguments: Sequence[object], options: Mapping[str, object]) -> list[str]:
    """Return the arguments of a call as on a command line, so that the same are left out."""
    words = [text for argument in arguments for text in _texts(argument)]
    for name, value in options.items():
        option = f"--{name.replace('_', '-')}"
        words += [option] if value is True else [f"{option}={text}" for text in _texts(value)]
    return words


def _texts(value: object) -> list[str]:
    match value:
        case None | bool():
            return []
        case str() | int() | float() | Path() | date():
            return [str(value)]
        case list() | tuple():
            return [text for item in value for text in _texts(item)]
        case _:
            return [str(name)] if (name := getattr(value, "name", None)) else []


def total_progress(show: ShowProgress | None) -> Progress:
    """Return a callback that adds up the units newly done and shows their total."""
    if show is None:
        return no_progress
    done = 0

    def progress(more: int, total: int) -> None:
        nonlocal done
        done += more
        show(done, total)

    return progress


def step_progress(show: ShowStep | None, name: str) -> ShowProgress | None:
    """Return the callback that shows the progress of one step."""
    return None if show is None else lambda done, total: show(name, done, total)


def progress_of_steps(show: ShowStep | None) -> Steps:
    """Return a function that returns the progress of a step."""
    return lambda name: total_progress(step_progress(show, name))


@contextmanager
def open_workers(root: Folder, workers: Workers) -> Iterator[Executor]:
    """Yield the executor that `workers` describes; an executor that is passed in stays open.

    Raises `ExtraError`.
    """
    context: Any
    if isinstance(workers, Executor):
        context = nullcontext(workers)
    elif isinstance(workers, str):
        with require_extra("cluster", "a cluster"):
            from fleet_slip.compute.cluster import cluster_executor  # slow
        context = cluster_executor(workers, absolute(root))
    else:
        from fleet_slip.compute.tasks import LocalThreads

        context = LocalThreads(workers or os.cpu_count() or 1)
    with context as executor:
        yield executor


def absolute(root: Folder) -> Folder:
    """Return the root by a path that is valid in every working directory."""
    from fleet_slip.storage.local import LocalFolder

    return LocalFolder(root.path.absolute()) if isinstance(root, LocalFolder) else root


def remote_executor(executor: Executor) -> Executor | None:
    """Return the executor if its workers are other processes, None if they are threads."""
    return None if isinstance(executor, ThreadPoolExecutor) else executor


def for_workers(warehouse: "Warehouse", executor: Executor) -> "Warehouse":
    """Return the warehouse in a form that the workers of an executor can open.

    It is pickled with its catalog: a worker need not have the folder of configs.
    """
    from fleet_slip.warehouse.warehouse import Warehouse

    if remote_executor(executor) is None:
        return warehouse
    return Warehouse(absolute(warehouse.root), warehouse.configs)
