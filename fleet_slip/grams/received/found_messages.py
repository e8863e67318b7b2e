"""Reads the messages in a file from cars, and says which parts of it are no message.

Those of one length are read at once, as an array.
"""

import zlib
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleet_slip.grams.received.messages import (
    CHECKSUM_BYTES,
    DAY_LAYOUTS,
    HEADER_BYTES,
    MAGIC,
    MOST_LEVELS,
    MOST_SIGNALS,
    SET_LAYOUT,
    SIGNED_LAYOUTS,
    Messages,
    count_columns,
    message_type,
)

MOST_AT_ONCE = 8192
"""Messages that are looked at as an array: one, two, four, ... while they are of one length."""

MOST_MESSAGES = 500_000
"""Of a file: 340 MB of messages of eleven signals."""

MOST_REFUSED = 1000
"""Places of a file that are no message. Beyond that it is something else."""

CUT_OFF = "is cut off"
NO_MESSAGE = "does not begin as a message does"
OTHER_LAYOUT = "has another layout"
WRONG_LENGTH = "has a length that does not fit its signals"
WRONG_CHECKSUM = "has a wrong checksum"
TOO_MANY = f"and all that follows is beyond the {MOST_MESSAGES:,} messages of a file: cut it"
NO_FILE = f"and all that follows is not read, after {MOST_REFUSED:,} places that are no message"


@dataclass
class FoundMessages:
    """The messages that a file holds.

    Attributes:
        runs: messages whose checksum is right, of one length and one behind the other: the number
            of the first among all that was found, from 1, and they.
        refused: what is no message: its number, and why.
    """

    runs: list[tuple[int, Messages]] = field(default_factory=list)
    refused: list[tuple[int, str]] = field(default_factory=list)
    count: int = 0


def read_messages(content: bytes) -> FoundMessages:
    """Read messages that stand one behind the other.

    After what is none, reading goes on where the next begins with "FSGR". Beyond `MOST_MESSAGES` or
    `MOST_REFUSED` all that is left is refused as one.
    """
    found = FoundMessages()
    at, end, most = 0, len(content), 1
    while at < end:
        if len(found.refused) >= MOST_REFUSED or found.count >= MOST_MESSAGES:
            found.count += 1
            rest = NO_FILE if len(found.refused) >= MOST_REFUSED else TOO_MANY
            found.refused.append((found.count, rest))
            break
        messages = _read_run(content, at, min(most, MOST_MESSAGES - found.count))
        found.count += 1
        if len(messages):
            begun = _continued(found, messages, content, at)
            found.runs.append(begun or (found.count, messages))
            found.count += len(messages) - 1
            at += messages.nbytes
            most = min(2 * len(messages), MOST_AT_ONCE)
        else:
            found.refused.append((found.count, _why_none(content, at)))
            following = content.find(MAGIC, at + 1)
            at, most = following if following >= 0 else end, 1
    return found


def _continued(
    found: FoundMessages, messages: Messages, content: bytes, at: int
) -> tuple[int, Messages] | None:
    """Return messages as one with the run before them, which is taken back, if they continue it."""
    if not found.runs:
        return None
    first, before = found.runs[-1]
    if before.dtype != messages.dtype or first + len(before) != found.count:
        return None
    found.runs.pop()
    count = len(before) + len(messages)
    return first, np.frombuffer(content, messages.dtype, count, at - before.nbytes)


@cache
def _types() -> dict[tuple[int, int], tuple[int, np.dtype[Any]]]:
    """Return the number of signals and the fields of a message, by its layout and its length."""
    kinds: dict[int, dict[str, Any]] = {}
    for plain, signed in SIGNED_LAYOUTS.items():
        of_set = plain == SET_LAYOUT
        kinds |= {plain: {"of_set": of_set}, signed: {"of_set": of_set, "signed": True}}
        for levels in range(MOST_LEVELS + 1):
            kinds[DAY_LAYOUTS[plain] + levels] = {"of_set": of_set, "levels": levels}
    return {
        (layout, kind.itemsize): (signals, kind)
        for layout, words in kinds.items()
        for signals in range(MOST_SIGNALS + 1)
        for kind in [message_type(signals, **words)]
    }


def _read_run(content: bytes, at: int, most: int) -> Messages:
    """Return the messages from a place on that are as long as the first, if it is one."""
    layout, size = (int.from_bytes(content[at + i : at + i + 2], "little") for i in (4, 6))
    if (layout, size) not in _types():
        return np.empty(0, message_type(0))
    signals, kind = _types()[layout, size]
    count = min(most, (len(content) - at) // size)
    messages = np.frombuffer(content, kind, count, at)
    right = (
        (messages["magic"] == MAGIC)
        & (messages["layout"] == layout)
        & (messages["length"] == size)
        & (count_columns(messages) == signals)
    )
    messages = messages[: _leading(right)]
    view = memoryview(content)
    places = range(at, at + messages.nbytes, size)
    summed = [zlib.crc32(view[place : place + size - CHECKSUM_BYTES]) for place in places]
    return messages[: _leading(messages["checksum"] == np.array(summed, dtype=np.uint32))]


def _leading(right: NDArray[np.bool_]) -> int:
    """Return how many are right before the first that is not."""
    wrong = np.flatnonzero(~right)
    return int(wrong[0]) if len(wrong) else len(right)


def _why_none(content: bytes, at: int) -> str:
    """Return why no message is at a place."""
    if not content.startswith(MAGIC, at):
        return NO_MESSAGE
    size = HEADER_BYTES
    if len(content) >= at + size:
        size = int.from_bytes(content[at + 6 : at + 8], "little")
    if len(content) < at + size:
        return CUT_OFF
    if size < HEADER_BYTES + CHECKSUM_BYTES:
        return WRONG_LENGTH
    layout = int.from_bytes(content[at + 4 : at + 6], "little")
    if not any(layout == kind for kind, _ in _types()):
        return OTHER_LAYOUT
    signals, kind = _types().get((layout, size), (-1, message_type(0)))
    fits = signals >= 0 and count_columns(np.frombuffer(content, kind, 1, at))[0] == signals
    return WRONG_CHECKSUM if fits else WRONG_LENGTH
