"""Messages of cars, packed by what docs/edge.md says of their layout."""

import struct
import zlib
from typing import Any, NamedTuple

import numpy as np

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.grams.received.counted_sets import counted_sets
from fleet_slip.grams.received.messages import signals_definition
from fleet_slip.regression.exact.gram import Gram

START_S = 1_714_557_600
"""2024-05-01, 10:00 in UTC."""


def message_of(gram: Gram, vehicle: str = "VIN1", start_s: int = START_S, **other: int) -> bytes:
    """The message of a Gram row; `other` fields are as they should not be."""
    names = catalogue().gram_signals
    mask = sum(1 << names.index(name) for name in gram.signals)
    numbers = np.array([*gram.sums, *gram.products], "<i8").tobytes()
    known = {"layout": 1, "size": 60 + len(numbers), "definition": signals_definition()}
    known |= {"place": 0, "parts": 1, "mask": mask, "rows": gram.n, "lost": 0} | other
    head = struct.pack(
        "<4sHHQ16s",
        b"FSGR",
        *(known[k] for k in ("layout", "size", "definition")),
        vehicle.encode(),
    )
    head += struct.pack("<HHQ", known["place"], known["parts"], start_s)
    head += struct.pack("<III", known["mask"], known["rows"], known["lost"])
    body = head + numbers
    return body + zlib.crc32(body).to_bytes(4, "little")


def set_message_of(
    gram: Gram,
    feature_set: str = "course",
    vehicle: str = "VIN1",
    start_s: int = START_S,
    **other: int,
) -> bytes:
    """The message of a Gram row of a feature set; `other` fields are as they should not be."""
    (one,) = (one for one in counted_sets().values() if one.name == feature_set)
    numbers = np.array([*gram.sums, *gram.products], "<i8").tobytes()
    mask = sum(1 << one.columns.index(name) for name in gram.signals)
    known = {"size": 124 + len(numbers), "definition": one.definition, "mask": mask}
    known |= {"part": 0, "late": 0, "rows": gram.n, "lost": 0} | other
    head = struct.pack(
        "<4sHHQ16s", b"FSGR", 3, known["size"], known["definition"], vehicle.encode()
    )
    head += struct.pack("<HHQ", 0, 1, start_s)
    head += struct.pack("<HhII", *(known[k] for k in ("part", "late", "rows", "lost")))
    body = head + known["mask"].to_bytes(64, "little") + numbers
    return body + zlib.crc32(body).to_bytes(4, "little")


def drive_counts(seed: int, rows: int = 500) -> Any:
    """Counts of all signals of a drive, shape (rows, signals), related as those of a car are."""
    random = np.random.default_rng(seed)
    k = len(catalogue().gram_signals)
    hidden = random.normal(0, 900, (rows, 4))
    counts = hidden @ random.normal(0, 1, (4, k)) + random.normal(0, 30, (rows, k))
    signals = [catalogue()[name] for name in catalogue().gram_signals]
    low, high = ([s.min_count for s in signals], [s.max_count for s in signals])
    return np.clip(np.rint(counts), low, high).astype(np.int16)


def gram_of(seed: int, rows: int = 500) -> Gram:
    """The Gram of a drive of all signals."""
    return Gram.from_counts(catalogue().gram_signals, drive_counts(seed, rows).astype(np.int64))


class Message(NamedTuple):
    """What a message says, read by what docs/edge.md says of its layout."""

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


def parse_messages(content: bytes) -> list[Message]:
    """Read sound messages one behind the other, one at a time; the first that is not ends it."""
    found = []
    at = 0
    while content[at : at + 6] == b"FSGR\x01\0":
        size = int.from_bytes(content[at + 6 : at + 8], "little")
        body = content[at : at + size]
        if len(body) < size or zlib.crc32(body[:-4]) != int.from_bytes(body[-4:], "little"):
            break
        definition, vehicle, place, parts, start_s, mask, rows, lost = struct.unpack_from(
            "<Q16sHHQIII", body, 8
        )
        name = vehicle.rstrip(b"\0")
        numbers = body[56:-4]
        found.append(
            Message(definition, name, place, parts, start_s, mask, rows, lost, numbers, body)
        )
        at += size
    return found
