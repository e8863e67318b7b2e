"""Fetches objects in parts, so that a slow network takes long and does not fail.

A request has a time limit, whatever it asks for. So a large object is asked for in parts that come
well within it: one that does not come is asked for again, smaller, and what has come is kept.
"""

import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import obstore
from obstore.exceptions import BaseError

from fleet_slip.files.object_errors import is_timeout, object_errors

if TYPE_CHECKING:
    from obstore.store import ObjectStore

FIRST_BYTES, MOST_BYTES, LEAST_BYTES = 2**20, 2**23, 2**15
"""Bytes that a request asks for: at first, and within what limits it adapts to the network."""

QUICK_S = 2.0
"""After a request that took less the next asks for twice as much."""


def fetch_parts(store: "ObjectStore", key: str, where: str) -> Iterator[tuple[Any, bytes]]:
    """Yield the parts of an object in their order, each with what the store says of the object.

    `where` names it in errors. Raises `StorageError`, also if not even `LEAST_BYTES` come within
    the time limit of a request.
    """
    position, length = 0, FIRST_BYTES
    with object_errors(where):
        whole = obstore.get(store, key)
        size = whole.meta["size"]
        if size <= length and (content := _in_time(whole)) is not None:
            yield whole.meta, content
            return
        while position < size:
            begun = time.monotonic()
            end = min(position + length, size)
            part = obstore.get(store, key, options={"range": (position, end)})
            content = _in_time(part, may_fail=length > LEAST_BYTES)
            if content is None:
                length //= 4
                continue
            yield part.meta, content
            position += len(content)
            if time.monotonic() - begun < QUICK_S:
                length = min(2 * length, MOST_BYTES)


def _in_time(answer: Any, *, may_fail: bool = True) -> bytes | None:
    """Return what an answer brings; None if it does not come within the time limit."""
    try:
        return bytes(answer.bytes())
    except (BaseError, OSError) as error:
        if may_fail and is_timeout(error):
            return None
        raise
