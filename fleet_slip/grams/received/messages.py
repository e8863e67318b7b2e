"""The message of a car that sends a Gram row instead of a log: its layout.

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
"""

from collections.abc import Sequence
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

_OF_SIGNATURES = {"leaf", "leaves", "path", "signature"}

Messages = NDArray[Any]
"""Messages of the same length: an array with the fields of `message_type`."""


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
