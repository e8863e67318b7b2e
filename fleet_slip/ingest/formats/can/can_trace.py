"""Reads CAN traces: BLF, ASC, candump and what else python-can does, with a database of messages.

Each message is a time base, a column is `Message.Signal`. Frames of errors and remote requests are
passed over. A value that the database gives a name, such as `SNA`, is no number: it is null, or in
a signal that has no other values the name itself.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from functools import partial
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from fleet_slip.arrays import BoolArray
from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.budget import Budget
from fleet_slip.ingest.formats.can.blf_frames import read_blf_frames
from fleet_slip.ingest.formats.can.can_bus import CanBus, parse_database
from fleet_slip.ingest.formats.can.can_frames import (
    CanFrames,
    FrameBlock,
    is_possible,
    is_sent,
    needed_bytes,
    physical,
    raw_numbers,
)
from fleet_slip.ingest.formats.log_source import (
    OWN_TIME,
    Base,
    Channel,
    ClockSource,
    describe_missing,
    reading_with,
)
from fleet_slip.ingest.logs.spool import Spool
from fleet_slip.words import shown

SUFFIXES = {".blf", ".asc", ".log", ".trc"}
TOLD_EVERY = 2**12
"""Frames that are read one by one until it is told how far the file is read."""


_Key = tuple[int, bool]
"""Number of a message, and whether it is of 29 bits."""


class CanSource(ClockSource):
    """The messages of a CAN trace."""

    def __init__(self, bus: CanBus, database: Any, spool: Spool, budget: Budget) -> None:
        """Take what the mapping says of the trace, the parsed database, and the file."""
        self._file, self._bus, self._database = budget.file, bus, database
        self._spool, self._budget = spool, budget
        self._messages = {message.name: message for message in database.messages}
        self._wanted: set[_Key] = set()
        self._numbers: set[_Key] = set()
        """Of the messages in the trace, once it was read."""

    def channels(self) -> list[Channel]:
        """Return the signals of all messages of the trace that the database knows."""
        self._want({_key(message) for message in self._database.messages})
        return [
            Channel(f"{message.name}.{signal.name}", signal.unit or "", message.name)
            for message in self._database.messages
            if _key(message) in self._numbers
            for signal in message.signals
        ]

    def bases(self, columns: Sequence[str]) -> list[Base]:
        """Return the messages that have one of the columns. Raises `InputError`."""
        wanted: dict[str, dict[str, Any]] = defaultdict(dict)
        for column in columns:
            name, _, signal = column.partition(".")
            of = self._messages[name].signals if name in self._messages else ()
            found = {s.name: s for s in of if is_possible(s)}
            if signal not in found:
                known = [f"{m}.{s.name}" for m, of in self._messages.items() for s in of.signals]
                raise InputError(f"{shown(self._bus.database)}: {describe_missing(column, known)}")
            wanted[name][column] = found[signal]
        self._want({_key(self._messages[name]) for name in wanted})
        return [
            Base(name, partial(self._count, name, signals), partial(self._read, name, signals))
            for name, signals in wanted.items()
        ]

    def _want(self, asked: set[_Key]) -> None:
        """Read the trace, once more if it was read without these messages."""
        if not self._numbers or not asked <= self._wanted:
            self._wanted |= asked
            self._spool.clear()
            self._frames = {key: CanFrames(self._spool) for key in self._wanted}
            self._numbers = set()
            self._read_trace()
            if not self._numbers:
                raise InputError(
                    f"{shown(self._file)}: there is no CAN frame in it. Record it again."
                )

    def _count(self, name: str, signals: dict[str, Any]) -> int:
        """Return how many frames of a message have one of the signals."""
        if any(signal.multiplexer_ids is None for signal in signals.values()):
            return self._frames[_key(self._messages[name])].sizes_on(self._bus.channel).total()
        return sum(table.height for table in self._read(name, signals))

    def _read(self, name: str, signals: dict[str, Any]) -> Iterator[pl.DataFrame]:
        """Yield the signals of one message; rows are frames that have one of them."""
        message, needed = self._messages[name], max(map(needed_bytes, signals.values()))
        frames = self._require_usable(message, next(iter(signals)), needed)
        named = {
            column
            for column, signal in signals.items()
            if signal.choices and self._has_names_only(message, signal)
        }
        for times_s, payloads in frames.take(self._bus.channel, needed):
            frame = {OWN_TIME: pl.Series(times_s)}
            some = np.zeros(len(times_s), dtype=np.bool_)
            for column, signal in signals.items():
                sent = is_sent(message, signal, payloads)
                some |= sent
                raw = raw_numbers(signal, payloads)
                frame[column] = _values(signal, raw, sent, as_names=column in named).alias(column)
            yield pl.DataFrame(frame).filter(some)

    def _has_names_only(self, message: Any, signal: Any) -> bool:
        """Whether the database gives all values of a signal a name, and there is one."""
        found = False
        needed = needed_bytes(signal)
        for _, payloads in self._frames[_key(message)].take(self._bus.channel, needed):
            sent = is_sent(message, signal, payloads)
            named = np.isin(raw_numbers(signal, payloads), list(signal.choices))
            if not (named | ~sent).all():
                return False
            found |= bool(sent.any())
        return found

    def _require_usable(self, message: Any, column: str, needed: int) -> CanFrames:
        """Return the frames of a message. Raises `InputError` if they are not what it says."""
        frames = self._frames[_key(message)]
        if _key(message) not in self._numbers:
            known = sum(_key(m) in self._numbers for m in self._database.messages)
            raise InputError(
                f"{shown(self._file)}: the message {message.name} ({message.frame_id:#x}) is not "
                f"in it. Of the {len(self._numbers)} numbers in the trace {known} are in "
                f"{self._bus.database}. Is it the database of this car and bus?"
            )
        buses = frames.buses
        if self._bus.channel is None and len(buses) > 1:
            raise InputError(
                f"{shown(self._file)}: the message {message.name} is on the buses "
                f"{', '.join(buses)}. Say in the mapping which counts: [can] channel = "
                f'"{buses[0]}".'
            )
        sizes = frames.sizes_on(self._bus.channel)
        short = sum(number for size, number in sizes.items() if size < needed)
        if short or not sizes:
            raise InputError(
                f"{shown(self._file)}: {short:,} of {sizes.total():,} frames of "
                f"{message.name} ({message.frame_id:#x}) are too short: {column} ends "
                f"in byte {needed}, the longest has {max(sizes, default=0)}; buses: "
                f"{', '.join(buses)}. Is {self._bus.database} the database of this car and bus?"
            )
        return frames

    def _keep(self, block: FrameBlock) -> None:
        """Keep the frames of the wanted messages, and note the numbers of all."""
        keys = block.numbers << 1 | block.extended
        order = np.argsort(keys, kind="stable")
        found, firsts = np.unique(keys[order], return_index=True)
        for key, chosen in zip(found.tolist(), np.split(order, firsts[1:]), strict=True):
            of = key >> 1, bool(key & 1)
            self._numbers.add(of)
            if of in self._frames:
                self._frames[of].extend(block.where(chosen))

    def _read_trace(self) -> None:
        """Keep the frames of the wanted messages, and note the numbers of all."""
        if self._file.suffix.lower() not in SUFFIXES:
            raise InputError(
                f"{shown(self._file)}: the suffix tells the format of a CAN trace: "
                f"{', '.join(sorted(SUFFIXES))}. Name it as what it is."
            )
        with reading_with(self._file, "can") as can, can.LogReader(self._file) as trace:
            self._require_whole(trace)
            if isinstance(trace, can.BLFReader):
                for block in read_blf_frames(self._budget, trace.start_timestamp):
                    self._keep(block)
                return
            for number, frame in enumerate(trace):
                if not number % TOLD_EVERY:
                    self._budget.meter.pass_over(trace.file.buffer.tell(), self._budget.size)
                if frame.is_error_frame or frame.is_remote_frame:
                    continue
                key = frame.arbitration_id, frame.is_extended_id
                self._numbers.add(key)
                if key in self._frames:
                    self._frames[key].append(frame.timestamp, str(frame.channel), frame.data)

    def _require_whole(self, trace: Any) -> None:
        # A BLF file says how long it is; python-can reads what is there of one that was cut.
        stated, there = getattr(trace, "file_size", 0), self._file.stat().st_size
        if stated > there:
            raise InputError(
                f"{shown(self._file)}: {there:,} of {stated:,} bytes: it is truncated. Copy it "
                "again."
            )


def _values(signal: Any, raw: NDArray[Any], sent: BoolArray, *, as_names: bool) -> pl.Series:
    """Return a signal, null where it was not sent; values that have a name are null, or all it."""
    named = np.isin(raw, list(signal.choices)) if signal.choices else np.zeros_like(sent)
    if as_names:
        texts = {value: str(text) for value, text in signal.choices.items()}
        names = [texts[v] if s else None for v, s in zip(raw, sent, strict=True)]
        return pl.Series(names, dtype=pl.String)
    return pl.Series(physical(signal, raw)).set(pl.Series(~sent | named), None)


def _key(message: Any) -> _Key:
    return message.frame_id, message.is_extended_frame


@contextmanager
def open_can_trace(bus: CanBus, budget: Budget) -> Iterator[CanSource]:
    """Open a CAN trace. Raises `InputError`, for a database that cannot be parsed too."""
    with closing(Spool()) as spool:
        yield CanSource(bus, parse_database(bus), spool, budget)
