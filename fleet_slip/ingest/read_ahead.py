"""Reads the next while the last is worked on."""

from collections import deque
from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

Item = TypeVar("Item")

AHEAD = 2
"""Items that are read before they are asked for."""


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


def _take(items: Iterator[Item]) -> tuple[Item, ...]:
    """Return the next item alone, nothing at the end."""
    return tuple(islice(items, 1))
