"""The frames of one CAN message, kept as bytes, and the signals in their payloads.

The meaning of start bit, byte order and multiplexing is that of the DBC format, as cantools parses
it; its own decoder, one frame at a time, is what the tests compare with.
"""

import hashlib
import pickle
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fleet_slip.arrays import FloatArray, IntArray
from fleet_slip.base import shown
from fleet_slip.config import Config, Name, read_named_file
from fleet_slip.errors import ConfigError, InputError
from fleet_slip.ingest.formats.source import Spool, load_library

Bytes = NDArray[np.uint8]
Flags = NDArray[np.bool_]

MOST_BYTES = 64
"""Bytes of a frame of CAN FD."""
_FLOATS = {16: np.float16, 32: np.float32, 64: np.float64}

PIECE_FRAMES = 2**12
"""Frames of one message that are in memory at once."""


def is_possible(signal: Any) -> bool:
    """Whether a frame can have a signal: at most 64 bits in 64 bytes, floats of their sizes."""
    if not 0 <= signal.start < 8 * MOST_BYTES or not 1 <= signal.length <= 64:
        return False
    return needed_bytes(signal) <= MOST_BYTES and (not signal.is_float or signal.length in _FLOATS)


def needed_bytes(signal: Any) -> int:
    """Return how long a payload must be to hold a signal."""
    return max(byte for byte, _ in _bits(signal)) + 1


def raw_integers(signal: Any, payloads: Bytes) -> NDArray[np.uint64]:
    """Return a signal's bits as unsigned integers; payloads have shape (frames, bytes)."""
    value = np.zeros(len(payloads), dtype=np.uint64)
    for place, (byte, bit) in enumerate(_bits(signal)):
        value |= ((payloads[:, byte] >> bit) & 1).astype(np.uint64) << np.uint64(place)
    return value


def raw_numbers(signal: Any, payloads: Bytes) -> NDArray[Any]:
    """Return a signal as it was sent: integers, signed if it is, or floats."""
    value = raw_integers(signal, payloads)
    if signal.is_float:
        whole = value.astype(f"u{signal.length // 8}")
        return whole.view(_FLOATS[signal.length]).astype(np.float64)
    if not signal.is_signed:
        return value
    shift = np.int64(64 - signal.length)
    return (value << shift.astype(np.uint64)).view(np.int64) >> shift


def physical(signal: Any, raw: NDArray[Any]) -> FloatArray:
    """Return scale times raw plus offset."""
    scale, offset = float(signal.scale), float(signal.offset)
    return np.asarray(raw.astype(np.float64) * scale + offset, dtype=np.float64)


def is_sent(message: Any, signal: Any, payloads: Bytes) -> Flags:
    """Return in which frames a multiplexed signal is; in all, if it is not multiplexed."""
    sent = np.ones(len(payloads), dtype=np.bool_)
    while signal.multiplexer_ids is not None:
        selector = message.get_signal_by_name(signal.multiplexer_signal)
        sent &= np.isin(raw_integers(selector, payloads), list(signal.multiplexer_ids))
        signal = selector
    return sent


def _bits(signal: Any) -> list[tuple[int, int]]:
    """Return (byte, bit) of each bit of a signal, the least significant first."""
    if signal.byte_order == "little_endian":
        return [divmod(signal.start + i, 8) for i in range(signal.length)]
    # The start is the most significant bit; from there down to bit 0, then bit 7 of the next byte.
    first = 8 * (signal.start // 8) + 7 - signal.start % 8
    places = range(first + signal.length - 1, first - 1, -1)
    return [(place // 8, 7 - place % 8) for place in places]


@dataclass(frozen=True)
class FrameBlock:
    """Frames in the order of the file: numbers, whether they are of 29 bits, times in s, buses.

    `data`, shape (frames, bytes), is filled up to the longest; `sizes` say how much of it counts.
    """

    numbers: IntArray
    extended: Flags
    times_s: FloatArray
    buses: NDArray[Any]
    sizes: IntArray
    data: Bytes

    def where(self, chosen: Any) -> "FrameBlock":
        """Return some of them, by flags or places."""
        return FrameBlock(*(column[chosen] for column in vars(self).values()))


def joined(blocks: Sequence[FrameBlock]) -> FrameBlock:
    """Return several blocks as one."""
    widest = max(block.data.shape[1] for block in blocks)
    columns = list(zip(*(vars(block).values() for block in blocks), strict=True))
    columns[-1] = tuple(np.pad(data, ((0, 0), (0, widest - data.shape[1]))) for data in columns[-1])
    return FrameBlock(*map(np.concatenate, columns))


class CanFrames:
    """The frames of one message, in the order in which they came."""

    def __init__(self, spool: Spool) -> None:
        """Begin without any; what is too much for the memory goes to `spool`."""
        self._spool = spool
        self._waiting: list[FrameBlock] = []
        self._found: Counter[tuple[str, int]] = Counter()

    def extend(self, block: FrameBlock) -> None:
        """Keep frames of the message."""
        buses = block.buses.astype(np.str_)
        for bus in np.unique(buses).tolist():
            for size, frames in zip(*np.unique_counts(block.sizes[buses == bus]), strict=True):
                self._found[bus, int(size)] += int(frames)
        self._waiting.append(replace(block, buses=buses))
        if sum(len(one.sizes) for one in self._waiting) >= PIECE_FRAMES:
            self._spool.add(self, pickle.dumps(joined(self._waiting)))
            self._waiting = []

    @property
    def buses(self) -> list[str]:
        """The buses that the message is on, sorted."""
        return sorted({bus for bus, _ in self._found})

    def sizes_on(self, bus: str | None) -> Counter[int]:
        """Return how many frames have how many bytes, on a bus or on all."""
        sizes = Counter[int]()
        for (of, size), frames in self._found.items():
            sizes[size] += frames if bus in {None, of} else 0
        return +sizes

    def take(self, bus: str | None, size: int) -> Iterator[tuple[FloatArray, Bytes]]:
        """Yield times and first bytes of the payloads on a bus, or on all, piece by piece."""
        pieces = map(pickle.loads, self._spool.read(self))
        for block in chain(pieces, [joined(self._waiting)] if self._waiting else []):
            some = block if bus is None else block.where(block.buses == bus)
            if some.sizes.size:
                yield some.times_s, some.data[:, :size]


# What a mapping says of a CAN trace: the database of its messages, and the bus.

FORMATS = {".dbc": "dbc", ".kcd": "kcd", ".sym": "sym"}
MAX_DATABASE_BYTES = 2**28


class CanBus(Config):
    """The database of a CAN trace. Its content, not its path, is part of a mapping's identity."""

    database: Name = Field(exclude=True)
    """Path of a DBC, KCD or SYM file, seen from the mapping's own."""
    channel: Name | None = None
    """The bus, as the trace calls it; needed where a message occurs on several."""
    text: str = Field(default="", exclude=True, repr=False)
    """What is in the database, once the mapping was loaded."""
    digest: str = ""
    """SHA-256 of it."""

    @property
    def format(self) -> str:
        """What the database is written in."""
        return FORMATS[Path(self.database).suffix.lower()]


def read_can_database(bus: CanBus, folder: Path) -> CanBus:
    """Return the bus with the content of its database. Raises `ConfigError`."""
    file = folder / bus.database
    if file.suffix.lower() not in FORMATS:
        raise ConfigError(
            f"{file}: a CAN database is a file {', '.join(FORMATS)}. Of ARXML canconvert, of "
            "canmatrix, makes one."
        )
    content = read_named_file(file, MAX_DATABASE_BYTES)
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:
        text = content.decode("cp1252", "replace")  # what most tools on Windows write
    digest = hashlib.sha256(content).hexdigest()
    return bus.model_copy(update={"text": text, "digest": digest})


def parse_database(bus: CanBus) -> Any:
    """Return the messages of a database. Raises `InputError`, which quotes no line of it."""
    database = Path(bus.database)
    cantools = load_library(database, "cantools")
    try:
        return cantools.database.load_string(bus.text, bus.format, strict=False)
    except Exception as error:
        place = re.search(r"line \d+", str(error))
        raise InputError(
            f"{shown(database)}: cantools cannot read it as {bus.format.upper()}"
            f"{f', from {place[0]} on' if place else ''}. Is it the right file, and complete?"
        ) from None
