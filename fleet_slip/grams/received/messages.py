"""The message of a car that sends a Gram row instead of a log: its layout, and reading many.

All numbers are little-endian. A message is

    0   4   "FSGR"                          36  8  when the drive began, s since 1970 in UTC
    4   2   layout, 1; signed: 2            44  4  which signals it is of, a bit for each
    6   2   length with the checksum        48  4  n, rows
    8   8   what the signals mean, below    56  .. sums, 8 bytes each, of these signals
    16  16  the car, ASCII, zeros behind    ..  .. products, 8 bytes each, packed lower triangle
    32  2   place among the drive's         ..  4  CRC-32 of all before, as in Ethernet and zlib
    34  2   number of them
    52  4   rows that are in none of them

A drive has a message for each set of signals that its rows have. What the signals mean are the
first 8 bytes of the SHA-256 of the canonical JSON of name, scale and range of each.

A message of another feature set has the layout 3, signed 4. It differs from byte 44 on:

    44  2   over which time, from 0         52  4   rows that are in none of them
    46  2   delay of the course, signed,    56  64  which columns of the set it is of, a bit for
            in quarters of a tick                   each, the first the lowest
    48  4   n, rows                         120 ..  sums, products and checksum, as above

and says by its definition which set it is of (`counted_sets`).

A signed message has its signature, 64 bytes, before the checksum (`signatures`). One that is signed
with all others of its car and day has the layout 16, of a feature set 64, and more by the levels of
their tree (`day_tree`). Before the signature it has

    0   2   place in the tree, from 0       2   2   number of messages in it
    4   ..  32 bytes of each level: the node beside its own, from the leaves up

Messages of one length that stand one behind the other are read at once, as an array.
"""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleet_slip.canonical import canonical_json, sha256_of
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.regression.exact.gram import packed_size

MAGIC = b"FSGR"
LAYOUT = 1
SET_LAYOUT = 3
SIGNED_LAYOUTS = {LAYOUT: 2, SET_LAYOUT: 4}
"""The layout of a signed message, by that of one which is not."""
DAY_LAYOUTS = {LAYOUT: 16, SET_LAYOUT: 64}
"""That of one whose day is signed, in a tree without levels."""
MOST_LEVELS = 10
"""Of a tree: 1,024 messages."""
NODE_BYTES = 32
PLACE_BYTES = 4
"""Of a message in its tree, and of how many there are."""
SIGNATURE_BYTES = 64
HEADER_BYTES = 56
CHECKSUM_BYTES = 4
LONGEST_VEHICLE = 16
MOST_PARTS = 4
"""Sets of signals that a car keeps apart within a drive."""

MOST_ROWS = 2**31 - 1
"""Rows of a drive: 248 days. No sum of so many products of int16 counts reaches 2^61."""

MOST_SIGNALS = 32
"""Of a message: the logged signals have a bit for each."""

MOST_COLUMNS = 512
"""Of a feature set that cars count: there is a bit for each."""

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

_OF_SIGNATURES = {"leaf", "leaves", "path", "signature"}

Messages = NDArray[Any]
"""Messages of the same length: an array with the fields of `message_type`."""


@dataclass
class Found:
    """The messages that a file holds.

    Attributes:
        runs: messages whose checksum is right, of one length and one behind the other: the number
            of the first among all that was found, from 1, and they.
        refused: what is no message: its number, and why.
    """

    runs: list[tuple[int, Messages]] = field(default_factory=list)
    refused: list[tuple[int, str]] = field(default_factory=list)
    count: int = 0


def message_size(signals: int, *, of_set: bool = False) -> int:
    """Return the bytes of a message of so many signals, or columns of a set."""
    return message_type(signals, of_set=of_set).itemsize


@cache
def message_type(
    signals: int, *, signed: bool = False, of_set: bool = False, levels: int | None = None
) -> np.dtype[Any]:
    """Return the fields of a message of so many signals, or columns of a set.

    `rows` are n, `lost` rows of the drive that none of its messages has; `numbers` are sums, then
    products. With `levels` it is signed with its day, in a tree of so many.
    """
    which = [("part", "<u2"), ("late", "<i2")] if of_set else [("mask", "<u4")]
    return np.dtype(
        [
            ("magic", "S4"),
            ("layout", "<u2"),
            ("length", "<u2"),
            ("definition", "<u8"),
            ("vehicle", f"S{LONGEST_VEHICLE}"),
            ("place", "<u2"),
            ("parts", "<u2"),
            ("start_s", "<u8"),
            *which,
            ("rows", "<u4"),
            ("lost", "<u4"),
            *([("columns", "<u8", (MOST_COLUMNS // 64,))] if of_set else []),
            ("numbers", "<i8", (signals + packed_size(signals),)),
            *_fields_of_tree(levels),
            *([("signature", f"V{SIGNATURE_BYTES}")] if signed or levels is not None else []),
            ("checksum", "<u4"),
        ]
    )


def _fields_of_tree(levels: int | None) -> list[tuple[str, str]]:
    """Return what says where a message stands in the tree of its day, if it does."""
    if levels is None:
        return []
    return [("leaf", "<u2"), ("leaves", "<u2"), *[("path", f"V{NODE_BYTES * levels}")][:levels]]


@cache
def kept_type(levels: int | None) -> np.dtype[Any]:
    """Return the fields of what is kept of a signature: what else rebuilds the message."""
    return np.dtype(
        [
            ("signature", f"V{SIGNATURE_BYTES}"),
            ("definition", "<u8"),
            ("mask", "<u4"),
            ("place", "<u2"),
            ("parts", "<u2"),
            *_fields_of_tree(levels),
        ]
    )


@cache
def signals_definition() -> int:
    """Return what the signals of today's catalogue mean, as messages say it."""
    return definition_of(catalogue().gram_signals)


def definition_of(signals: Sequence[str], identity: str | None = None) -> int:
    """Return what messages call some signals, or a feature set that is made of them."""
    known = [
        [name, f"{s.scale:f}", s.min_count, s.max_count]
        for name in signals
        for s in [catalogue()[name]]
    ]
    content = canonical_json(known if identity is None else [identity, known])
    return int.from_bytes(bytes.fromhex(sha256_of(content)[:16]), "little")


def count_columns(messages: Messages) -> NDArray[np.int64]:
    """Return of how many signals or columns messages say that they are."""
    if "mask" in (messages.dtype.names or ()):
        found: NDArray[np.int64] = np.bitwise_count(messages["mask"]).astype(np.int64)
    else:
        found = np.bitwise_count(messages["columns"]).sum(axis=1, dtype=np.int64)
    return found


def read_messages(content: bytes) -> Found:
    """Read messages that stand one behind the other.

    After what is none, reading goes on where the next begins with "FSGR". Beyond `MOST_MESSAGES` or
    `MOST_REFUSED` all that is left is refused as one.
    """
    found = Found()
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
    found: Found, messages: Messages, content: bytes, at: int
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


def without_signatures(messages: Messages) -> Messages:
    """Return messages as they were before they were signed, but for their checksums."""
    if not is_signed(messages):
        return messages
    kept = [name for name in messages.dtype.names or () if name not in _OF_SIGNATURES]
    plain = np.empty(len(messages), [(name, messages.dtype[name]) for name in kept])
    for name in kept:
        plain[name] = messages[name]
    return plain


def is_signed(messages: Messages) -> bool:
    """Whether messages have signatures."""
    return "signature" in (messages.dtype.names or ())


def levels_of(messages: Messages) -> int | None:
    """Return the levels of the trees of days that messages stand in, None if they do not."""
    names = messages.dtype.names or ()
    if "leaf" not in names:
        return None
    return messages.dtype["path"].itemsize // NODE_BYTES if "path" in names else 0


def keep_signatures(messages: Messages) -> Messages:
    """Return what is kept of each message, the bytes of `kept_type`; None if it is not signed."""
    found = np.full(len(messages), None, dtype=np.object_)
    if is_signed(messages):
        kept = np.zeros(len(messages), kept_type(levels_of(messages)))
        for name in set(kept.dtype.names or ()).intersection(messages.dtype.names or ()):
            kept[name] = messages[name]
        content, size = kept.tobytes(), kept.itemsize
        found[:] = [content[at : at + size] for at in range(0, len(content), size)]
    return found
