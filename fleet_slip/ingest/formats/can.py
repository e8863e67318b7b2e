"""The frames of one CAN message, kept as bytes, and the signals in their payloads.

The meaning of start bit, byte order and multiplexing is that of the DBC format, as cantools parses
it; its own decoder, one frame at a time, is what the tests compare with.
"""

import hashlib
import importlib
import re
from array import array
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fleet_slip.base import FloatArray, IntArray, shown
from fleet_slip.config import Config, Name, read_named_file
from fleet_slip.errors import ConfigError, InputError
from fleet_slip.ingest.formats.source import reading_with
from fleet_slip.ingest.log_files import Spool

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
class Frames:
    """Some frames: times in s, numbers of buses, sizes in bytes, and all payloads in a row."""

    times_s: FloatArray
    buses: NDArray[np.uint16]
    sizes: NDArray[np.uint16]
    data: Bytes


@dataclass(frozen=True)
class FrameBlock:
    """Frames in the order of the file: numbers, whether they are of 29 bits, times in s, buses.

    `data`, shape (frames, bytes), is filled up to the longest; `sizes` say how much of it counts.
    """

    numbers: IntArray
    extended: Flags
    times_s: FloatArray
    buses: IntArray
    sizes: IntArray
    data: Bytes

    def where(self, chosen: Any) -> "FrameBlock":
        """Return some of them, by flags or places."""
        return FrameBlock(*(column[chosen] for column in vars(self).values()))


class CanFrames:
    """The frames of one message, in the order in which they came."""

    def __init__(self, spool: Spool) -> None:
        """Begin without any; what is too much for the memory goes to `spool`."""
        self._spool = spool
        self._numbers: dict[str, int] = {}
        self._found: Counter[tuple[int, int]] = Counter()
        self._clear()

    def _clear(self) -> None:
        self._times, self._buses, self._sizes = array("d"), array("H"), array("H")
        self._data = bytearray()

    def append(self, time_s: float, bus: str, payload: bytes) -> None:
        """Keep a frame."""
        number = self._numbers.setdefault(bus, len(self._numbers))
        self._times.append(time_s)
        self._buses.append(number)
        self._sizes.append(len(payload))
        self._data += payload
        self._found[number, len(payload)] += 1
        if len(self._times) >= PIECE_FRAMES:
            self._put_aside()

    def extend(self, block: FrameBlock) -> None:
        """Keep frames of the message."""
        times_s, sizes, data = block.times_s, block.sizes, block.data
        names, places = np.unique(block.buses, return_inverse=True)
        known = [self._numbers.setdefault(str(bus), len(self._numbers)) for bus in names.tolist()]
        numbers = np.array(known, dtype=np.uint16)[places]
        for start in range(0, times_s.size, PIECE_FRAMES):
            some = slice(start, start + PIECE_FRAMES)
            kinds = numbers[some].astype(np.int64) << 16 | sizes[some]
            for kind, frames in zip(*map(np.ndarray.tolist, np.unique_counts(kinds)), strict=True):
                self._found[divmod(kind, 1 << 16)] += frames
            self._times.frombytes(times_s[some].tobytes())
            self._buses.frombytes(numbers[some].tobytes())
            self._sizes.frombytes(sizes[some].astype(np.uint16).tobytes())
            there = np.arange(data.shape[1]) < sizes[some, np.newaxis]
            self._data += data[some][there].tobytes()
            if len(self._times) >= PIECE_FRAMES:
                self._put_aside()

    def _put_aside(self) -> None:
        for column in (self._times, self._buses, self._sizes, self._data):
            self._spool.add(self, bytes(column))
        self._clear()

    @property
    def buses(self) -> list[str]:
        """The buses that the message is on, sorted."""
        return sorted(self._numbers)

    def sizes_on(self, bus: str | None) -> Counter[int]:
        """Return how many frames have how many bytes, on a bus or on all."""
        number, sizes = self._numbers.get(bus or "", -1), Counter[int]()
        for (of, size), frames in self._found.items():
            if bus is None or of == number:
                sizes[size] += frames
        return sizes

    def take(self, bus: str | None, size: int) -> Iterator[tuple[FloatArray, Bytes]]:
        """Yield times and first bytes of the payloads on a bus, or on all, piece by piece."""
        for some in self._pieces():
            sizes = some.sizes.astype(np.int64)
            starts, times_s = np.cumsum(sizes) - sizes, some.times_s
            if bus is not None:
                chosen = some.buses == self._numbers.get(bus, -1)
                starts, times_s = starts[chosen], times_s[chosen]
            payloads = np.empty((starts.size, size), dtype=np.uint8)
            for place in range(size):
                payloads[:, place] = some.data[starts + place]
            yield times_s, payloads

    def _pieces(self) -> Iterator[Frames]:
        aside = self._spool.read(self)
        for times, buses, sizes, data in zip(aside, aside, aside, aside, strict=True):
            yield _frames(times, buses, sizes, data)
        yield _frames(
            self._times.tobytes(), self._buses.tobytes(), self._sizes.tobytes(), bytes(self._data)
        )


def _frames(times: bytes, buses: bytes, sizes: bytes, data: bytes) -> Frames:
    return Frames(
        np.frombuffer(times),
        np.frombuffer(buses, dtype=np.uint16),
        np.frombuffer(sizes, dtype=np.uint16),
        np.frombuffer(data, dtype=np.uint8),
    )


# What a mapping says of a CAN trace: the database of its messages, and the bus.

FORMATS = {".dbc": "dbc", ".arxml": "arxml", ".kcd": "kcd", ".sym": "sym"}
MAX_DATABASE_BYTES = 2**28


class CanBus(Config):
    """The database of a CAN trace. Its content, not its path, is part of a mapping's identity."""

    database: Name = Field(exclude=True)
    """Path of a DBC, ARXML, KCD or SYM file, seen from the mapping's own."""
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
        raise ConfigError(f"{file}: a CAN database is a file {', '.join(FORMATS)}.")
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
    with reading_with(database, "cantools") as cantools:
        try:
            if bus.format == "arxml":
                return _parse_arxml(bus.text)
            return cantools.database.load_string(bus.text, bus.format, strict=False)
        except Exception as error:
            place = re.search(r"line \d+", str(error))
            raise InputError(
                f"{shown(database)}: cantools cannot read it as {bus.format.upper()}"
                f"{f', from {place[0]} on' if place else ''}. Is it the right file, and complete?"
            ) from None


def _parse_arxml(text: str) -> Any:
    """Return the messages of a system description; what is not applied has a factor of NaN."""
    arxml: Any = importlib.import_module("cantools.database.can.formats.arxml")

    class Loader(arxml.SystemLoader):  # type: ignore[misc]
        """Where cantools knows no conversion, or several lines, it takes the counts."""

        def _load_signal(self, mapped: Any) -> Any:
            self._mapped = mapped
            return super()._load_signal(mapped)

        def _get_compu_method(self, system_signal: Any) -> Any:
            """Return that of the system's signal, else that of the signal on the bus."""
            path = ["&I-SIGNAL", "&NETWORK-REPRESENTATION-PROPS", "SW-DATA-DEF-PROPS-VARIANTS"]
            path += ["&SW-DATA-DEF-PROPS-CONDITIONAL", "&COMPU-METHOD"]
            found = super()._get_compu_method(system_signal)
            return self._get_unique_arxml_child(self._mapped, path) if found is None else found

        def _load_system_signal(self, system_signal: Any, is_float: bool) -> Any:
            method = self._get_compu_method(system_signal)
            if method is None or self._is_applied(method):
                return super()._load_system_signal(system_signal, is_float)
            return None, None, float("nan"), 0.0, None, None, None

        def _is_applied(self, method: Any) -> bool:
            """Whether cantools applies a conversion; one line is called so after this."""
            path = ["COMPU-INTERNAL-TO-PHYS", "COMPU-SCALES", "*&COMPU-SCALE"]
            scales, lines = self._get_arxml_children(method, path), 0
            for scale in scales:
                if self._get_unique_arxml_child(scale, ["&COMPU-CONST", "VT"]) is not None:
                    low, high = self._load_scale_limits(scale)
                    if low is None or low != high:
                        return False
                elif self._get_unique_arxml_child(scale, "&COMPU-RATIONAL-COEFFS") is None:
                    return False
                else:
                    lines += 1
            category = self._get_unique_arxml_child(method, "CATEGORY")
            kind = "IDENTICAL" if category is None else str(category.text)
            if kind == "SCALE_LINEAR":
                kind = category.text = "LINEAR"
            if kind == "SCALE_LINEAR_AND_TEXTTABLE":
                return lines < 2
            return {"LINEAR": 1, "IDENTICAL": 0, "TEXTTABLE": 0}.get(kind) == lines

    root = ElementTree.fromstring(text)  # noqa: S314 - in the confined reader
    if arxml.is_ecu_extract(root):
        raise ValueError("an extract of one ECU has no conversions")
    return Loader(root, strict=False).load()
