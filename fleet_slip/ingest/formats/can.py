"""Reads CAN traces: BLF, ASC, candump and others of python-can, with a database of messages.

Each message is a time base, a column is `Message.Signal`. Error frames and remote requests are
skipped. A value with a name in the database, such as `SNA`, is null. A signal whose names are
states, such as P, R, N, D, becomes these names, and null without one; a signal of a mapping becomes
a number.

Start bit, byte order and multiplexing are those of the DBC format, as cantools parses it. The tests
compare with its decoder, which takes one frame at a time.
"""

import logging
import math
import pickle
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from functools import partial
from itertools import islice, pairwise
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
    Source,
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


def is_possible(signal: Any) -> bool:
    """Return True if a signal fits a frame: at most 64 bits in 64 bytes, floats of their sizes."""
    if not 0 <= signal.start < 8 * MAX_FRAME_BYTES or not 1 <= signal.length <= 64:
        return False
    return needed_bytes(signal) <= MAX_FRAME_BYTES and (
        not signal.is_float or signal.length in _FLOATS
    )


def needed_bytes(signal: Any) -> int:
    """Return the minimum number of bytes of a payload with a signal."""
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


def with_multiplexers(message: Any, signal: Any) -> list[Any]:
    """Return a signal, its multiplexer if it has one, the multiplexer of that, and so on."""
    chain = [signal]
    while chain[-1].multiplexer_ids is not None:
        chain.append(message.get_signal_by_name(chain[-1].multiplexer_signal))
    return chain


def is_sent(message: Any, signal: Any, payloads: Bytes) -> BoolArray:
    """Return a mask of the frames with a signal: all frames if it is not multiplexed."""
    sent = np.ones(len(payloads), dtype=np.bool_)
    for selected, selector in pairwise(with_multiplexers(message, signal)):
        sent &= np.isin(raw_integers(selector, payloads), list(selected.multiplexer_ids))
    return sent


def _bits(signal: Any) -> list[tuple[int, int]]:
    """Return (byte, bit) of each bit of a signal, the least significant first."""
    if signal.byte_order == "little_endian":
        return [divmod(signal.start + i, 8) for i in range(signal.length)]
    # The start is the most significant bit; from there down to bit 0, then bit 7 of the next byte.
    first = 8 * (signal.start // 8) + 7 - signal.start % 8
    places = range(first + signal.length - 1, first - 1, -1)
    return [(place // 8, 7 - place % 8) for place in places]


Frames = pl.DataFrame
"""Frames in the order of the file: `key` of the message, `OWN_TIME`, `bus`, `size` in bytes, and
`payload`, padded to the longest."""


def frame_table(
    identifiers: IntArray,
    extended: BoolArray,
    times_s: FloatArray,
    buses: Sequence[str] | IntArray,
    sizes: IntArray,
    payloads: Bytes,
) -> Frames:
    """Return frames as a table; payloads have shape (frames, bytes)."""
    width = payloads.shape[1]
    columns = {
        "key": identifiers << 1 | extended,
        OWN_TIME: times_s,
        "bus": pl.Series(buses).cast(pl.String),
        "size": np.minimum(sizes, width),
        "payload": pl.Series(payloads, dtype=pl.Array(pl.UInt8, width)),
    }
    return pl.DataFrame(columns)


def _key(message: Any) -> int:
    """Return the identifier of a message, and in bit 0 whether it has 29 bits."""
    return int(message.frame_id << 1 | message.is_extended_frame)


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
AT_ONCE = 2**16
"""Frames that are read at once."""


_ASC_TIME = re.compile(r"\s*(-?\d+[.,]\d+)\s+(.*)", re.DOTALL)
_ASC_DATE = re.compile(r"\s*(?:date|begin\s+triggerblock)\s+\w+\s+(.+?)\s*$", re.IGNORECASE)
_RELATIVE = re.compile(r"\s*base\s+\w+\s+timestamps\s+relative", re.IGNORECASE)


class _AscLines:
    """The lines of an ASC trace, with the time of the last one in s since the header's date.

    python-can drops frames before the trigger, whose times are negative, and reads times since the
    previous event as absolute. So it gets lines at time 0, and frames get their times from here.
    """

    def __init__(self, lines: Iterable[str], can: Any, zone: str | None) -> None:
        self._lines, self._can, self._zone = lines, can, zone
        self.time_s, self._is_relative = 0.0, False
        self.start_s: float | None = None

    def __iter__(self) -> Iterator[str]:
        for line in self._lines:
            self._is_relative |= _RELATIVE.match(line) is not None
            if self.start_s is None and self._zone and (date := _ASC_DATE.match(line)):
                with suppress(ValueError):
                    start_s = self._can.ASCReader._datetime_to_timestamp(date[1])
                    self.start_s = clock_start_s(datetime.fromtimestamp(start_s), self._zone)
            if event := _ASC_TIME.match(line):
                time_s = float(event[1].replace(",", "."))
                self.time_s = self.time_s + time_s if self._is_relative else time_s
                yield f"0.0 {event[2]}"
            else:
                yield line

    def frames(self) -> Iterator[Any]:
        """Yield the frames with their times, with dates if the mapping states their time zone."""
        for frame in self._can.ASCReader(self):
            frame.timestamp = (self.start_s or 0.0) + self.time_s
            yield frame

    def close(self) -> None:
        """Leave the file open: python-can calls this at its end."""


def _read_trace(budget: Budget, zone: str | None) -> Iterator[Frames]:
    """Yield the data frames of a trace. Raises `InputError`."""
    if budget.file.suffix.lower() not in SUFFIXES:
        raise InputError(
            f"{quote_name(budget.file)}: unknown suffix. CAN traces end with "
            f"{', '.join(sorted(SUFFIXES))}. Rename the file."
        )
    can = load_library(budget.file, "can")
    if budget.file.suffix.lower() == ".asc":
        with budget.file.open(encoding="cp1252", errors="replace") as text:
            yield from _tables(_AscLines(text, can, zone).frames(), 0.0, bus_offset=1)
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
        yield from _tables(trace, shift_s, bus_offset=int(is_blf))
        if b"LOBJ" in getattr(trace, "_tail", b""):  # which python-can passes over
            raise InputError(
                f"{quote_name(budget.file)}: an object in it is damaged, or ends too early. Copy "
                "it again."
            )


def _refuse_unknown(record: logging.LogRecord) -> bool:
    """Raise `ValueError` for a container that python-can skips; suppress other warnings."""
    if "compression" in record.msg:
        raise ValueError(record.getMessage())
    return False


def _tables(trace: Iterable[Any], start_s: float, bus_offset: int) -> Iterator[Frames]:
    """Yield the frames with data, some at once.

    The buses of ASC and BLF are numbered from 1, those of python-can from 0.
    """
    sent = (frame for frame in trace if not (frame.is_error_frame or frame.is_remote_frame))
    while frames := list(islice(sent, AT_ONCE)):
        sizes = np.array([len(frame.data) for frame in frames])
        width = max(int(sizes.max()), 1)
        payloads = b"".join(bytes(frame.data).ljust(width, b"\0") for frame in frames)
        buses = (frame.channel for frame in frames)
        yield frame_table(
            np.array([frame.arbitration_id for frame in frames]),
            np.array([frame.is_extended_id for frame in frames]),
            start_s + np.array([frame.timestamp for frame in frames]),
            [str(bus + bus_offset if isinstance(bus, int) else bus) for bus in buses],
            sizes,
            np.frombuffer(payloads, dtype=np.uint8).reshape(-1, width),
        )


class CanSource(Source):
    """The messages of a CAN trace, or of a file with bus logging."""

    has_clock = True

    def __init__(
        self, file: Path, formats: FileFormats, read_frames: Callable[[], Iterator[Frames]]
    ) -> None:
        """Take a file, its keys in the mapping, and the function that reads its frames."""
        if formats.can is None:
            raise InputError(
                f'{quote_name(file)}: this format needs [can] with database = "….dbc" in the '
                f"mapping {formats.name!r}."
            )
        self._file, self._bus, self._formats = file, formats.can, formats
        self._spool, self._read_frames = Spool(), read_frames
        self._messages = {m.name: m for m in parse_database(formats.can).messages}
        self._spooled: set[int] = set()
        self._counts = pl.DataFrame()
        """Number of frames by key, bus and size, after the trace was read."""

    def channels(self) -> list[Channel]:
        """Return the signals of all messages of the trace that the database contains."""
        self._spool_messages(self._messages)
        present = set(self._counts["key"])
        return [
            Channel(f"{message.name}.{signal.name}", signal.unit or "", message.name)
            for message in self._messages.values()
            if _key(message) in present
            for signal in message.signals
        ]

    def find(self, column: str) -> tuple[str, Any]:
        """Return the name of a message, and the signal. Raises `InputError`."""
        name, _, signal_name = column.partition(".")
        signals = self._messages[name].signals if name in self._messages else ()
        signal = next((s for s in signals if s.name == signal_name and is_possible(s)), None)
        if signal is None:
            names = [
                f"{m}.{s.name}" for m, message in self._messages.items() for s in message.signals
            ]
            raise missing_column(self._bus.database, column, names)
        if not math.isfinite(signal.scale) or not signal.scale:
            raise InputError(
                f"{quote_name(self._bus.database)}: the conversion of {column!r} is not one factor "
                "and offset. Make it so, or map another signal."
            )
        return name, signal

    def bases(self, columns: Sequence[str]) -> list[Iterator[pl.DataFrame]]:
        """Return the rows of each message that has one of the columns. Raises `InputError`."""
        self._spool_messages({self.find(column)[0] for column in columns})
        return super().bases(columns)

    def _spool_messages(self, names: Iterable[str]) -> None:
        """Read the trace, once more if it was read without these messages."""
        keys = {_key(self._messages[name]) for name in names}
        if not self._counts.is_empty() and keys <= self._spooled:
            return
        self._spooled |= keys
        self._spool = Spool()
        counts = []
        for frames in self._read_frames():
            counts.append(frames.group_by("key", "bus", "size").len())
            wanted_frames = frames.filter(pl.col("key").is_in(self._spooled))
            for piece in wanted_frames.partition_by("key", maintain_order=True):
                self._spool.add(piece["key"][0], pickle.dumps(piece))
        if not counts:
            raise InputError(f"{quote_name(self._file)}: it has no CAN frames. Record it again.")
        self._counts = pl.concat(counts).group_by("key", "bus", "size").agg(pl.sum("len"))

    def read(self, name: str, signals: dict[str, Any]) -> Iterator[pl.DataFrame]:
        """Yield the signals of one message; rows are frames that have one of them."""
        message = self._messages[name]
        self._require_usable(message, signals)
        states = {c for c, signal in signals.items() if self._has_states(message, signal)}
        for times_s, payloads in self._frames_of(message):
            values = {OWN_TIME: pl.Series(times_s)}
            has_value = np.zeros(len(times_s), dtype=np.bool_)
            for column, signal in signals.items():
                sent = is_sent(message, signal, payloads)
                has_value |= sent
                values[column] = self._values(column, signal, payloads, sent, column in states)
            yield pl.DataFrame(values).filter(has_value)

    def _frames_of(self, message: Any) -> Iterator[tuple[FloatArray, Bytes]]:
        """Yield times and payloads of the frames on the bus of the mapping, piece by piece."""
        for piece in map(pickle.loads, self._spool.read(_key(message))):
            on_bus = pl.lit(value=True) if self._bus.channel is None else self._is_on_bus
            frames = piece.filter(on_bus)
            if frames.height:
                yield frames[OWN_TIME].to_numpy(), frames["payload"].to_numpy()

    @property
    def _is_on_bus(self) -> pl.Expr:
        return pl.col("bus") == self._bus.channel

    def _has_states(self, message: Any, signal: Any) -> bool:
        """Return True if the names of a signal are states, and at least half of its values named.

        A quantity, with a unit or a factor, has names for missing values alone.
        """
        is_quantity = signal.is_float or signal.scale != 1 or signal.offset != 0
        if is_quantity or not names_states(map(str, (signal.choices or {}).values())):
            return False
        named = total = 0
        for _, payloads in self._frames_of(message):
            sent = is_sent(message, signal, payloads)
            named += int(np.isin(raw_numbers(signal, payloads)[sent], list(signal.choices)).sum())
            total += int(sent.sum())
        return 2 * named > total

    def _values(
        self, column: str, signal: Any, payloads: Bytes, sent: BoolArray, is_state: bool
    ) -> pl.Series:
        """Return a signal, null where it was not sent: names, or numbers but those for no value."""
        raw = raw_numbers(signal, payloads)
        choices = {value: str(text) for value, text in (signal.choices or {}).items()}
        if is_state and not self._formats.reads_number(column, choices.values()):
            names = [choices.get(v) if s else None for v, s in zip(raw.tolist(), sent, strict=True)]
            return pl.Series(column, names, dtype=pl.String)
        absent = [v for v, text in choices.items() if not is_state or is_missing_state(text)]
        if is_state:  # a value without a name is missing
            absent += list(set(np.unique(raw).tolist()) - set(choices))
        values = pl.Series(column, physical(signal, raw))
        return values.set(pl.Series(~sent | np.isin(raw, absent)), None)

    def _require_usable(self, message: Any, signals: dict[str, Any]) -> None:
        """Raise `InputError` for frames that are absent, on several buses, or too short."""
        counts = self._counts.filter(pl.col("key") == _key(message))
        database, title = self._bus.database, f"{message.name} ({message.frame_id:#x})"
        if counts.is_empty():
            present = self._counts["key"].unique()
            matches = present.is_in([_key(m) for m in self._messages.values()]).sum()
            raise InputError(
                f"{quote_name(self._file)}: no message {title}. Of the {len(present)} identifiers "
                f"in the trace, {matches} are in {database}. Is it the database of this car and "
                "bus?"
            )
        buses = sorted(counts["bus"].unique())
        if len(buses) > 1 if self._bus.channel is None else self._bus.channel not in buses:
            on_it = "" if self._bus.channel is None else f"not on the bus {self._bus.channel}, but "
            raise InputError(
                f"{quote_name(self._file)}: the message {message.name} is {on_it}on "
                f"the buses {', '.join(buses)}. Choose one in the mapping: [can] channel = "
                f'"{buses[0]}".'
            )
        if self._bus.channel is not None:
            counts = counts.filter(self._is_on_bus)
        for column, signal in signals.items():
            end = max(map(needed_bytes, with_multiplexers(message, signal)))
            short = counts.filter(pl.col("size") < end)["len"].sum()
            if short:
                raise InputError(
                    f"{quote_name(self._file)}: {short:,} of {counts['len'].sum():,} frames of "
                    f"{title} are too short: {column} ends in byte {end}, the longest has "
                    f"{max(counts['size'])}; buses: {', '.join(buses)}. Is {database} the "
                    "database of this car and bus?"
                )


@contextmanager
def open_can_trace(budget: Budget, formats: FileFormats) -> Iterator[CanSource]:
    """Open a CAN trace. Raises `InputError`, for a database that cannot be parsed too."""
    yield CanSource(budget.file, formats, partial(_read_trace, budget, formats.zone))
