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

    No two are taken at once. Closing it waits for the item that is being taken. A single item,
    as most small files have, needs no thread.
    """
    first = _take(items)
    try:
        second = _take(items) if first else ()
    except Exception:
        yield from first
        raise
    if not second:
        yield from first
        return
    with ThreadPoolExecutor(1, thread_name_prefix="read-ahead") as thread:
        taken = deque(thread.submit(_take, items) for _ in range(ahead))
        try:
            yield from (*first, *second)
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
    held = _take(items)
    failure: Exception | None = None
    with ThreadPoolExecutor(WORKERS, thread_name_prefix="map-ahead") as threads:
        under_way: deque[Future[Result]] = deque()
        try:
            while held:
                try:
                    following = _take(items)
                except Exception as error:
                    following, failure = (), error
                if not following and not under_way:
                    yield function(*held)  # a single item, as most small files have
                    break
                under_way.append(threads.submit(function, *held))
                held = following
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
