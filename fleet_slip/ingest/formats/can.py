"""Reads CAN traces: BLF, ASC, candump and others of python-can, with a database of messages.

Each message is a time base, a column is `Message.Signal`. Error frames and remote requests are
skipped. A value with a name in the database, such as `SNA`, is null. A signal whose names are
states, such as P, R, N, D, is these names, and null without one; as a signal of a mapping it is a
number.

Start bit, byte order and multiplexing are those of the DBC format, as cantools parses it. The tests
compare with its decoder, which takes one frame at a time.
"""

import logging
import math
import pickle
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from fleet_slip.arrays import BoolArray, FloatArray, IntArray
from fleet_slip.base import quote_name
from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.file_formats import CanBus, FileFormats
from fleet_slip.ingest.formats.source import (
    OWN_TIME,
    Budget,
    Channel,
    FormatSource,
    Spool,
    clock_start_s,
    is_missing_state,
    load_library,
    missing_column,
    names_states,
)

Bytes = NDArray[np.uint8]

MAX_FRAME_BYTES = 64
"""Bytes of a frame of CAN FD."""
_FLOATS = {16: np.float16, 32: np.float32, 64: np.float64}

PIECE_FRAMES = 2**12
"""Frames of one message that are in memory at once."""


def is_possible(signal: Any) -> bool:
    """Return True if a signal fits a frame: at most 64 bits in 64 bytes, floats of their sizes."""
    if not 0 <= signal.start < 8 * MAX_FRAME_BYTES or not 1 <= signal.length <= 64:
        return False
    return needed_bytes(signal) <= MAX_FRAME_BYTES and (
        not signal.is_float or signal.length in _FLOATS
    )


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
        bits = value.astype(f"u{signal.length // 8}")
        return bits.view(_FLOATS[signal.length]).astype(np.float64)
    if not signal.is_signed:
        return value
    shift = np.int64(64 - signal.length)
    return (value << shift.astype(np.uint64)).view(np.int64) >> shift


def physical(signal: Any, raw: NDArray[Any]) -> FloatArray:
    """Return scale times raw plus offset."""
    scale, offset = float(signal.scale), float(signal.offset)
    return np.asarray(raw.astype(np.float64) * scale + offset, dtype=np.float64)


def is_sent(message: Any, signal: Any, payloads: Bytes) -> BoolArray:
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
    """Frames in the order of the file: identifiers, flags for 29 bits, times in s, buses.

    `data`, shape (frames, bytes), is padded to the longest frame; `sizes` are the bytes of each.
    """

    numbers: IntArray
    extended: BoolArray
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
        """Begin without frames; those beyond the limit of memory go to `spool`."""
        self._spool = spool
        self._waiting: list[FrameBlock] = []
        self._frame_counts: Counter[tuple[str, int]] = Counter()

    def extend(self, block: FrameBlock) -> None:
        """Keep frames of the message."""
        buses = block.buses.astype(np.str_)
        for bus in np.unique(buses).tolist():
            for size, frames in zip(*np.unique_counts(block.sizes[buses == bus]), strict=True):
                self._frame_counts[bus, int(size)] += int(frames)
        self._waiting.append(replace(block, buses=buses))
        if sum(len(block.sizes) for block in self._waiting) >= PIECE_FRAMES:
            self._spool.add(self, pickle.dumps(joined(self._waiting)))
            self._waiting = []

    @property
    def buses(self) -> list[str]:
        """The buses that the message is on, sorted."""
        return sorted({bus for bus, _ in self._frame_counts})

    def sizes_on(self, bus: str | None) -> Counter[int]:
        """Return how many frames have how many bytes, on a bus or on all."""
        sizes = Counter[int]()
        for (frame_bus, size), frames in self._frame_counts.items():
            sizes[size] += frames if bus in {None, frame_bus} else 0
        return +sizes

    def take(self, bus: str | None, size: int) -> Iterator[tuple[FloatArray, Bytes]]:
        """Yield times and first bytes of the payloads on a bus, or on all, piece by piece."""
        pieces = map(pickle.loads, self._spool.read(self))
        for block in chain(pieces, [joined(self._waiting)] if self._waiting else []):
            selected = block if bus is None else block.where(block.buses == bus)
            if selected.sizes.size:
                yield selected.times_s, selected.data[:, :size]


def parse_database(bus: CanBus) -> Any:
    """Return the messages of a database. Raises `InputError`, which quotes no line of it."""
    database = Path(bus.database)
    cantools = load_library(database, "cantools")
    try:
        return cantools.database.load_string(bus.text, bus.format, strict=False)
    except Exception as error:
        place = re.search(r"line \d+", str(error))
        raise InputError(
            f"{quote_name(database)}: cantools cannot read it as {bus.format.upper()}"
            f"{f', from {place[0]} on' if place else ''}. Is it the right file, and complete?"
        ) from None


# A trace, read by python-can.

SUFFIXES = {".blf", ".asc", ".log", ".trc"}
AT_ONCE = 2**14
"""Frames of python-can that are kept together."""


_ASC_TIME = re.compile(r"\s*(-?\d+[.,]\d+)\s+(.*)", re.DOTALL)
_ASC_DATE = re.compile(r"\s*(?:date|begin\s+triggerblock)\s+\w+\s+(.+?)\s*$", re.IGNORECASE)
_RELATIVE = re.compile(r"\s*base\s+\w+\s+timestamps\s+relative", re.IGNORECASE)


class _AscLines:
    """The lines of an ASC trace, with the time of the last one in s since the header's date.

    python-can drops frames before the trigger, whose times are negative, and reads times since the
    previous event as absolute. So it gets lines at time 0, and frames get their times from here.
    """

    def __init__(self, lines: Iterable[str], can: Any) -> None:
        self._lines, self._can = lines, can
        self.time_s, self._is_relative = 0.0, False
        self.start: datetime | None = None

    def __iter__(self) -> Iterator[str]:
        for line in self._lines:
            self._is_relative |= _RELATIVE.match(line) is not None
            if self.start is None and (date := _ASC_DATE.match(line)):
                with suppress(ValueError):
                    start_s = self._can.ASCReader._datetime_to_timestamp(date[1])
                    self.start = datetime.fromtimestamp(start_s)
            if event := _ASC_TIME.match(line):
                time_s = float(event[1].replace(",", "."))
                self.time_s = self.time_s + time_s if self._is_relative else time_s
                yield f"0.0 {event[2]}"
            else:
                yield line

    def close(self) -> None:
        """Leave the file open: python-can calls this at its end."""


def _read_trace(budget: Budget, zone: str | None) -> Iterator[FrameBlock]:
    """Yield the data frames of a trace. Raises `InputError`."""
    if budget.file.suffix.lower() not in SUFFIXES:
        raise InputError(
            f"{quote_name(budget.file)}: unknown suffix. CAN traces end with "
            f"{', '.join(sorted(SUFFIXES))}. Rename the file."
        )
    can = load_library(budget.file, "can")
    if budget.file.suffix.lower() == ".asc":
        yield from _read_asc(budget.file, can, zone)
        return
    passes_over = logging.getLogger("can.io.blf")
    passes_over.setLevel(logging.WARNING)
    passes_over.addFilter(_refuse_unknown)
    with can.LogReader(budget.file) as trace:
        # A BLF file states its length; python-can reads a cut file without an error.
        stated = getattr(trace, "file_size", 0)
        if stated > budget.size:
            raise InputError(
                f"{quote_name(budget.file)}: {budget.size:,} of {stated:,} bytes: it is truncated. "
                "Copy it again."
            )
        is_blf = hasattr(trace, "start_timestamp")
        shift_s = 0.0
        if is_blf and zone is not None and trace.start_timestamp:  # python-can reads UTC
            local = datetime.fromtimestamp(trace.start_timestamp, UTC).replace(tzinfo=None)
            shift_s = clock_start_s(local, zone) - trace.start_timestamp
        for frames in _data_frames(trace):
            yield _block_of(frames, shift_s, bus_offset=int(is_blf))
        if b"LOBJ" in getattr(trace, "_tail", b""):  # which python-can passes over
            raise InputError(
                f"{quote_name(budget.file)}: an object in it is damaged, or ends too early. Copy "
                "it again."
            )


def _read_asc(file: Path, can: Any, zone: str | None) -> Iterator[FrameBlock]:
    """Yield the data frames of an ASC trace, with dates if the mapping states their time zone."""
    with file.open(encoding="cp1252", errors="replace") as text:
        lines = _AscLines(text, can)

        def timed() -> Iterator[Any]:
            for frame in can.ASCReader(lines):
                frame.timestamp = lines.time_s
                yield frame

        for frames in _data_frames(timed()):
            start = lines.start if zone is not None else None
            start_s = 0.0 if start is None else clock_start_s(start, zone)
            yield _block_of(frames, start_s, bus_offset=1)


def _data_frames(frames: Iterable[Any]) -> Iterator[list[Any]]:
    """Yield the frames with data, some at once."""
    sent = (frame for frame in frames if not (frame.is_error_frame or frame.is_remote_frame))
    while several := list(islice(sent, AT_ONCE)):
        yield several


def _refuse_unknown(record: logging.LogRecord) -> bool:
    """Raise `ValueError` for a container that python-can skips; suppress other warnings."""
    if "compression" in record.msg:
        raise ValueError(record.getMessage())
    return False


def _block_of(frames: list[Any], start_s: float, bus_offset: int) -> FrameBlock:
    """Return frames of python-can, which counts the buses of ASC and BLF from 0, they from 1."""
    payloads = b"".join(bytes(frame.data).ljust(MAX_FRAME_BYTES, b"\0") for frame in frames)
    buses = (frame.channel for frame in frames)
    return FrameBlock(
        np.array([frame.arbitration_id for frame in frames]),
        np.array([frame.is_extended_id for frame in frames]),
        start_s + np.array([frame.timestamp for frame in frames]),
        np.array([str(bus + bus_offset if isinstance(bus, int) else bus) for bus in buses]),
        np.array([len(frame.data) for frame in frames]),
        np.frombuffer(payloads, dtype=np.uint8).reshape(-1, MAX_FRAME_BYTES),
    )


_Key = tuple[int, bool]
"""Number of a message, and whether it is of 29 bits."""


class CanSource(FormatSource):
    """The messages of a CAN trace, or of a file with bus logging."""

    def __init__(
        self, file: Path, formats: FileFormats, blocks: Callable[[], Iterator[FrameBlock]]
    ) -> None:
        """Take a file, its keys in the mapping, and the function that reads its frames."""
        if formats.can is None:
            raise InputError(
                f'{quote_name(file)}: this format needs [can] with database = "….dbc" in the '
                f"mapping {formats.name!r}."
            )
        self._file, self._bus, self._spool, self._blocks = file, formats.can, Spool(), blocks
        self._formats = formats
        self._database = parse_database(formats.can)
        self._messages = {message.name: message for message in self._database.messages}
        self._identifiers_to_keep: set[_Key] = set()
        self._numbers: set[_Key] = set()
        """Identifiers of the messages in the trace, after it was read."""

    def channels(self) -> list[Channel]:
        """Return the signals of all messages of the trace that the database contains."""
        self._want({_key(message) for message in self._database.messages})
        return [
            Channel(f"{message.name}.{signal.name}", signal.unit or "", message.name)
            for message in self._database.messages
            if _key(message) in self._numbers
            for signal in message.signals
        ]

    def find(self, column: str) -> tuple[str, Any]:
        """Return the name of a message, and the signal. Raises `InputError`."""
        name, _, signal_name = column.partition(".")
        signals = self._messages[name].signals if name in self._messages else ()
        signal = next((s for s in signals if s.name == signal_name and is_possible(s)), None)
        if signal is None:
            names = [
                f"{m}.{s.name}" for m, signals in self._messages.items() for s in signals.signals
            ]
            raise missing_column(self._bus.database, column, names)
        if not math.isfinite(signal.scale) or not signal.scale:
            raise InputError(
                f"{quote_name(self._bus.database)}: the conversion of {column!r} is not linear "
                "(one "
                "factor and offset). Make it so, or map another signal."
            )
        return name, signal

    def prepare(self, places_by_base: dict[str, dict[str, Any]]) -> None:
        """Read the trace for some messages."""
        self._want({_key(self._messages[name]) for name in places_by_base})

    def _want(self, keys: set[_Key]) -> None:
        """Read the trace, once more if it was read without these messages."""
        if not self._numbers or not keys <= self._identifiers_to_keep:
            self._identifiers_to_keep |= keys
            self._spool.clear()
            self._frames = {key: CanFrames(self._spool) for key in self._identifiers_to_keep}
            self._numbers = set()
            for block in self._blocks():
                self._keep(block)
            if not self._numbers:
                raise InputError(
                    f"{quote_name(self._file)}: it has no CAN frames. Record it again."
                )

    def read(self, name: str, signals: dict[str, Any]) -> Iterator[pl.DataFrame]:
        """Yield the signals of one message; rows are frames that have one of them."""
        message, needed = self._messages[name], max(map(needed_bytes, signals.values()))
        frames = self._require_usable(message, next(iter(signals)), needed)
        states = {
            column
            for column, signal in signals.items()
            if signal.choices and self._has_states(message, signal)
        }
        names = {
            column
            for column in states
            if not self._formats.reads_number(column, map(str, signals[column].choices.values()))
        }
        for times_s, payloads in frames.take(self._bus.channel, needed):
            frame = {OWN_TIME: pl.Series(times_s)}
            has_value = np.zeros(len(times_s), dtype=np.bool_)
            for column, signal in signals.items():
                sent = is_sent(message, signal, payloads)
                has_value |= sent
                raw = raw_numbers(signal, payloads)
                frame[column] = _values(
                    signal, raw, sent, as_names=column in names, is_state=column in states
                ).alias(column)
            yield pl.DataFrame(frame).filter(has_value)

    def _has_states(self, message: Any, signal: Any) -> bool:
        """Return True if the names of a signal are states, and at least half of its values named.

        A quantity, with a unit or a factor, has names for missing values alone.
        """
        is_quantity = signal.is_float or signal.scale != 1 or signal.offset != 0
        if is_quantity or not names_states(map(str, signal.choices.values())):
            return False
        named = total = 0
        for _, payloads in self._frames[_key(message)].take(
            self._bus.channel, needed_bytes(signal)
        ):
            sent = is_sent(message, signal, payloads)
            named += int(
                (np.isin(raw_numbers(signal, payloads), list(signal.choices)) & sent).sum()
            )
            total += int(sent.sum())
        return 2 * named > total

    def _require_usable(self, message: Any, column: str, needed: int) -> CanFrames:
        """Return the frames of a message. Raises `InputError` if their sizes differ."""
        frames = self._frames[_key(message)]
        if _key(message) not in self._numbers:
            known_ids = sum(_key(m) in self._numbers for m in self._database.messages)
            raise InputError(
                f"{quote_name(self._file)}: no message {message.name} ({message.frame_id:#x}). Of "
                "the "
                f"{len(self._numbers)} identifiers in the trace, {known_ids} are in "
                f"{self._bus.database}. Is it the database of this car and bus?"
            )
        buses = frames.buses
        if self._bus.channel is None and len(buses) > 1:
            raise InputError(
                f"{quote_name(self._file)}: the message {message.name} is on the buses "
                f"{', '.join(buses)}. Choose one in the mapping: [can] channel = "
                f'"{buses[0]}".'
            )
        if self._bus.channel is not None and self._bus.channel not in buses:
            raise InputError(
                f"{quote_name(self._file)}: the message {message.name} is not on the bus "
                f"{self._bus.channel}, but on {', '.join(buses)}. Choose one in the mapping: [can] "
                f'channel = "{buses[0]}".'
            )
        sizes = frames.sizes_on(self._bus.channel)
        short = sum(number for size, number in sizes.items() if size < needed)
        if short:
            raise InputError(
                f"{quote_name(self._file)}: {short:,} of {sizes.total():,} frames of "
                f"{message.name} ({message.frame_id:#x}) are too short: {column} ends "
                f"in byte {needed}, the longest has {max(sizes, default=0)}; buses: "
                f"{', '.join(buses)}. Is {self._bus.database} the database of this car and bus?"
            )
        return frames

    def _keep(self, block: FrameBlock) -> None:
        """Keep the frames of the wanted messages, and note the numbers of all."""
        keys = block.numbers << 1 | block.extended
        order = np.argsort(keys, kind="stable")
        distinct, firsts = np.unique(keys[order], return_index=True)
        for key, chosen in zip(distinct.tolist(), np.split(order, firsts[1:]), strict=True):
            identifier = key >> 1, bool(key & 1)
            self._numbers.add(identifier)
            if identifier in self._frames:
                self._frames[identifier].extend(block.where(chosen))


def _values(
    signal: Any, raw: NDArray[Any], sent: BoolArray, *, as_names: bool, is_state: bool
) -> pl.Series:
    """Return a signal, null where it was not sent: names, or numbers but those for no value."""
    choices = {value: str(text) for value, text in (signal.choices or {}).items()}
    if as_names:
        names = [choices.get(v) if s else None for v, s in zip(raw.tolist(), sent, strict=True)]
        return pl.Series(names, dtype=pl.String)
    absent = [v for v, text in choices.items() if not is_state or is_missing_state(text)]
    if is_state and raw.size:  # a value without a name is missing
        absent += list(set(np.unique(raw).tolist()) - set(choices))
    return pl.Series(physical(signal, raw)).set(pl.Series(~sent | np.isin(raw, absent)), None)


def _key(message: Any) -> _Key:
    return message.frame_id, message.is_extended_frame


@contextmanager
def open_can_trace(budget: Budget, formats: FileFormats) -> Iterator[CanSource]:
    """Open a CAN trace. Raises `InputError`, for a database that cannot be parsed too."""
    yield CanSource(budget.file, formats, partial(_read_trace, budget, formats.zone))
