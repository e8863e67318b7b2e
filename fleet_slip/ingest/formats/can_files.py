"""Reads CAN traces: BLF, ASC, candump and what else python-can does, with a database of messages.

Each message is a time base, a column is `Message.Signal`. Frames of errors and remote requests are
passed over. A value that the database gives a name, such as `SNA`, is no number: it is null, or in
a signal that has no other values the name itself.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from fleet_slip.arrays import BoolArray
from fleet_slip.base import shown
from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.can import (
    MOST_BYTES,
    CanBus,
    CanFrames,
    FrameBlock,
    is_possible,
    is_sent,
    needed_bytes,
    parse_database,
    physical,
    raw_numbers,
)
from fleet_slip.ingest.formats.source import (
    OWN_TIME,
    Budget,
    Channel,
    FormatSource,
    Spool,
    load_library,
    missing_column,
)

SUFFIXES = {".blf", ".asc", ".log", ".trc"}
AT_ONCE = 2**14
"""Frames of python-can that are kept together."""


def _read_trace(budget: Budget) -> Iterator[FrameBlock]:
    """Yield the data frames of a trace. Raises `InputError`."""
    if budget.file.suffix.lower() not in SUFFIXES:
        raise InputError(
            f"{shown(budget.file)}: the suffix names the format of a CAN trace: "
            f"{', '.join(sorted(SUFFIXES))}. Name it as what it is."
        )
    can = load_library(budget.file, "can")
    with can.LogReader(budget.file) as trace:
        # A BLF file says how long it is; python-can reads what is there of one that was cut.
        stated = getattr(trace, "file_size", 0)
        if stated > budget.size:
            raise InputError(
                f"{shown(budget.file)}: {budget.size:,} of {stated:,} bytes: it is truncated. Copy "
                "it again."
            )
        sent = (one for one in trace if not (one.is_error_frame or one.is_remote_frame))
        while some := list(islice(sent, AT_ONCE)):
            yield _block_of(some)
        if b"LOBJ" in getattr(trace, "_tail", b""):  # which python-can passes over
            raise InputError(
                f"{shown(budget.file)}: an object in it is damaged, or ends too early. Copy it "
                "again."
            )


def _block_of(frames: list[Any]) -> FrameBlock:
    """Return frames of python-can."""
    payloads = b"".join(bytes(one.data).ljust(MOST_BYTES, b"\0") for one in frames)
    return FrameBlock(
        np.array([one.arbitration_id for one in frames]),
        np.array([one.is_extended_id for one in frames]),
        np.array([one.timestamp for one in frames]),
        np.array([str(one.channel) for one in frames]),
        np.array([len(one.data) for one in frames]),
        np.frombuffer(payloads, dtype=np.uint8).reshape(-1, MOST_BYTES),
    )


_Key = tuple[int, bool]
"""Number of a message, and whether it is of 29 bits."""


class CanSource(FormatSource):
    """The messages of a CAN trace, or of a file with bus logging."""

    def __init__(self, file: Path, bus: CanBus, blocks: Callable[[], Iterator[FrameBlock]]) -> None:
        """Take a file, what the mapping says of it, and what reads its frames."""
        self._file, self._bus, self._spool, self._blocks = file, bus, Spool(), blocks
        self._database = parse_database(bus)
        self._messages = {message.name: message for message in self._database.messages}
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

    def find(self, column: str) -> tuple[str, Any]:
        """Return the name of a message, and the signal. Raises `InputError`."""
        name, _, signal_name = column.partition(".")
        of = self._messages[name].signals if name in self._messages else ()
        signal = next((s for s in of if s.name == signal_name and is_possible(s)), None)
        if signal is None:
            known = [f"{m}.{s.name}" for m, of in self._messages.items() for s in of.signals]
            raise missing_column(self._bus.database, column, known)
        if not math.isfinite(signal.scale) or not signal.scale:
            raise InputError(
                f"{shown(self._bus.database)}: the conversion of {column!r} is not linear (one "
                "factor and offset). Make it so, or map another signal."
            )
        return name, signal

    def prepare(self, wanted: dict[str, dict[str, Any]]) -> None:
        """Read the trace for some messages."""
        self._want({_key(self._messages[name]) for name in wanted})

    def _want(self, asked: set[_Key]) -> None:
        """Read the trace, once more if it was read without these messages."""
        if not self._numbers or not asked <= self._wanted:
            self._wanted |= asked
            self._spool.clear()
            self._frames = {key: CanFrames(self._spool) for key in self._wanted}
            self._numbers = set()
            for block in self._blocks():
                self._keep(block)
            if not self._numbers:
                raise InputError(f"{shown(self._file)}: it has no CAN frames. Record it again.")

    def read(self, name: str, signals: dict[str, Any]) -> Iterator[pl.DataFrame]:
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
                f"{shown(self._file)}: no message {message.name} ({message.frame_id:#x}). Of the "
                f"{len(self._numbers)} identifiers in the trace, {known} are in "
                f"{self._bus.database}. Is it the database of this car and bus?"
            )
        buses = frames.buses
        if self._bus.channel is None and len(buses) > 1:
            raise InputError(
                f"{shown(self._file)}: the message {message.name} is on the buses "
                f"{', '.join(buses)}. Choose one in the mapping: [can] channel = "
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
    yield CanSource(budget.file, bus, partial(_read_trace, budget))
