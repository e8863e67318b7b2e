"""Reads the next while the last is worked on."""

from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

Item = TypeVar("Item")


def read_ahead(items: Iterator[Item]) -> Generator[Item, None, None]:
    """Yield items, in their order, while a thread takes the next one; errors come in their place.

    No two are taken at once. Who closes it waits for the item that is being taken.
    """
    with ThreadPoolExecutor(1, thread_name_prefix="read-ahead") as thread:
        taken = thread.submit(_take, items)
        while item := taken.result():
            taken = thread.submit(_take, items)
            yield from item


def _take(items: Iterator[Item]) -> tuple[Item, ...]:
    """Return the next item alone, nothing at the end."""
    return tuple(islice(items, 1))
