"""The message of a car that sends a Gram row instead of a log: its layout, and reading it.

All numbers are little-endian. A message is

    0   4   "FSGR"                          36  8  when the drive began, s since 1970 in UTC
    4   2   layout, 1                       44  4  which signals it is of, a bit for each
    6   2   length with the checksum        48  4  n, rows
    8   8   what the signals mean, below    56  .. sums, 8 bytes each, of these signals
    16  16  the car, ASCII, zeros behind    ..  .. products, 8 bytes each, packed lower triangle
    32  2   place among the drive's         ..  4  CRC-32 of all before, as in Ethernet and zlib
    34  2   number of them
    52  4   rows that are in none of them

A drive has a message for each set of signals that its rows have. What the signals mean are the
first 8 bytes of the SHA-256 of the canonical JSON of name, scale and range of each.
"""

import struct
import zlib
from collections.abc import Iterator
from functools import cache
from typing import NamedTuple

from fleet_slip.canonical import canonical_json, sha256_of
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.regression.gram import packed_size

MAGIC = b"FSGR"
LAYOUT = 1
HEADER = struct.Struct("<4sHHQ16sHHQIII")
CHECKSUM = struct.Struct("<I")
LONGEST_VEHICLE = 16
MOST_PARTS = 4
"""Sets of signals that a car keeps apart within a drive."""

MOST_ROWS = 2**31 - 1
"""Rows of a drive: 248 days. No sum of so many products of int16 counts reaches 2^61."""


class Message(NamedTuple):
    """A message whose checksum is right.

    Attributes:
        definition: what the signals mean.
        vehicle: bytes of the car's name, without zeros.
        place, parts: which message of its drive it is, of how many.
        start_s: when the drive began.
        mask: which signals it is of.
        rows, lost: n, and how many rows of the drive are in none of its messages.
        numbers: sums and products, 8 bytes each.
        content: the whole message.
    """

    definition: int
    vehicle: bytes
    place: int
    parts: int
    start_s: int
    mask: int
    rows: int
    lost: int
    numbers: bytes
    content: bytes


@cache
def message_size(signals: int) -> int:
    """Return the bytes of a message of so many signals."""
    return HEADER.size + 8 * (signals + packed_size(signals)) + CHECKSUM.size


@cache
def signals_definition() -> int:
    """Return what the signals of today's catalogue mean, as messages say it."""
    signals = catalogue()
    known = [
        [name, f"{s.scale:f}", s.min_count, s.max_count]
        for name in signals.gram_signals
        for s in [signals[name]]
    ]
    return int.from_bytes(bytes.fromhex(sha256_of(canonical_json(known))[:16]), "little")


def read_messages(content: bytes) -> Iterator[tuple[int, Message | str]]:
    """Yield where each message begins, and it, or why it is none.

    After what is none, reading goes on where the next begins with "FSGR".
    """
    at, end = 0, len(content)
    while at < end:
        found = _read(content, at)
        yield at, found
        if isinstance(found, Message):
            at += len(found.content)
        else:
            following = content.find(MAGIC, at + 1)
            at = following if following >= 0 else end


def _read(content: bytes, at: int) -> Message | str:
    if not content.startswith(MAGIC, at):
        return "does not begin as a message does"
    size = HEADER.size
    if len(content) >= at + size:
        size = int.from_bytes(content[at + 6 : at + 8], "little")
    if len(content) < at + size:
        return "is cut off"
    return _read_whole(content[at : at + size])


def _read_whole(body: bytes) -> Message | str:
    """Return a message, or why these bytes are none."""
    size = len(body)
    if size < HEADER.size + CHECKSUM.size:
        return "has a length that does not fit its signals"
    _, layout, _, definition, vehicle, place, parts, start_s, mask, rows, lost = HEADER.unpack_from(
        body
    )
    if layout != LAYOUT:
        return "has another layout"
    if size != message_size(mask.bit_count()):
        return "has a length that does not fit its signals"
    (stated,) = CHECKSUM.unpack_from(body, size - CHECKSUM.size)
    if zlib.crc32(memoryview(body)[: -CHECKSUM.size]) != stated:
        return "has a wrong checksum"
    numbers = body[HEADER.size : -CHECKSUM.size]
    name = vehicle.rstrip(b"\0")
    return Message(definition, name, place, parts, start_s, mask, rows, lost, numbers, body)
