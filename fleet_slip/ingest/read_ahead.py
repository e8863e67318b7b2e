"""Reads the next while the last is worked on, and works on several at once, in their order."""

from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

AHEAD = 2
"""Items that are read before they are asked for."""
WORKERS = 2
"""Items that are worked on at once."""


def read_ahead(items: Iterator[Item], ahead: int = AHEAD) -> Generator[Item, None, None]:
    """Yield items, in their order, while a thread takes the next; errors come in their place.

    No two are taken at once. Who closes it waits for the item that is being taken.
    """
    with ThreadPoolExecutor(1, thread_name_prefix="read-ahead") as thread:
        taken = deque(thread.submit(_take, items) for _ in range(ahead))
        try:
            while item := taken.popleft().result():
                taken.append(thread.submit(_take, items))
                yield from item
        finally:
            for future in taken:
                future.cancel()


def map_ahead(
    function: Callable[[Item], Result], items: Iterator[Item]
) -> Generator[Result, None, None]:
    """Yield a function's results in the order of the items, while threads work on the next ones.

    Errors, of the function and of the items, come in their place.
    """
    with ThreadPoolExecutor(WORKERS, thread_name_prefix="map-ahead") as threads:
        under_way: deque[Future[Result]] = deque()
        failure: Exception | None = None
        try:
            while True:
                try:
                    item = next(items)
                except StopIteration:
                    break
                except Exception as error:
                    failure = error
                    break
                under_way.append(threads.submit(function, item))
                if len(under_way) > WORKERS:
                    yield under_way.popleft().result()
            while under_way:
                yield under_way.popleft().result()
        finally:
            for future in under_way:
                future.cancel()
        if failure is not None:
            raise failure


def _take(items: Iterator[Item]) -> tuple[Item, ...]:
    """Return the next item alone, nothing at the end."""
    return tuple(islice(items, 1))
