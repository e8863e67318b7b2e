"""Execution of tasks on threads or in an executor.

An executor on other machines may define `in_flight`, its number of concurrent tasks, `lost_task`,
the error of a task whose workers died, and `result`, which returns the result of a future.
"""

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ThreadPoolExecutor,
    wait,
)
from itertools import islice
from typing import TypeVar

from fleet_slip.errors import ClusterError

IN_FLIGHT = 4
"""Maximum number of unprocessed tasks of an executor without `in_flight`."""

NAMED_MAX = 5

POLL_S = 1.0
"""Interval at which a cluster is looked at, in s."""

Item = TypeVar("Item")
Result = TypeVar("Result")

AHEAD = 2
"""Items to read in advance."""


class LocalThreads(ThreadPoolExecutor):
    """Threads of this process."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.in_flight = 2 * number


def in_flight(executor: Executor) -> int:
    """Return the maximum number of concurrent tasks, which bounds memory and the loss by a kill."""
    return int(getattr(executor, "in_flight", IN_FLIGHT))


def run_tasks(
    executor: Executor | None,
    function: Callable[[Item], Result],
    items: Iterable[Item],
    name_of: Callable[[Item], str],
) -> Iterator[tuple[Item, Result]]:
    """Call a function on items; yield each item with its result on completion, in any order.

    Without an executor, calls run in this thread. Tasks whose workers died are repeated one at a
    time at the end, since any task of a worker may have killed it. Raises `ClusterError` with the
    tasks that failed again; any other error ends the iteration.
    """
    if executor is None:
        for item in items:
            yield item, function(item)
        return
    suspects: list[Item] = []
    lost: list[Item] = []
    yield from _completed(executor, function, items, suspects)
    for item in suspects:
        yield from _completed(executor, function, [item], lost)
    if lost:
        more = f" and {len(lost) - NAMED_MAX} more" if len(lost) > NAMED_MAX else ""
        raise ClusterError(
            f"{', '.join(map(name_of, lost[:NAMED_MAX]))}{more}: every worker that tried it died, "
            "often out of memory; see the workers' logs. Everything else is done. Give the workers "
            "more memory, and run the same command again."
        )


def _completed(
    executor: Executor,
    function: Callable[[Item], Result],
    items: Iterable[Item],
    lost: list[Item],
) -> Iterator[tuple[Item, Result]]:
    """Yield items with their results; add those whose workers died to `lost`."""
    pending = iter(items)
    lost_task = getattr(executor, "lost_task", BrokenExecutor)
    result_of = getattr(executor, "result", Future.result)
    futures: dict[Future[Result], Item] = {}
    try:
        while True:
            for item in islice(pending, max(0, in_flight(executor) - len(futures))):
                futures[executor.submit(function, item)] = item
            if not futures:
                return
            for future in wait(futures, POLL_S, FIRST_COMPLETED).done:
                item = futures.pop(future)
                try:
                    result = result_of(future)
                except lost_task:
                    lost.append(item)
                else:
                    yield item, result
    finally:
        for future in futures:
            future.cancel()


def read_ahead(items: Iterator[Item]) -> Generator[Item, None, None]:
    """Yield items in order while a thread reads the next ones; re-raise errors in order.

    Closing the generator waits for the item being read.
    """
    with ThreadPoolExecutor(1, thread_name_prefix="read-ahead") as thread:
        futures = deque(thread.submit(_take, items) for _ in range(AHEAD))
        try:
            while item := futures.popleft().result():
                futures.append(thread.submit(_take, items))
                yield from item
        finally:
            for future in futures:
                future.cancel()


def _take(items: Iterator[Item]) -> tuple[Item, ...]:
    return tuple(islice(items, 1))
