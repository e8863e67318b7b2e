"""Reads CAN traces: BLF, ASC, candump and what else python-can does, with a database of messages.

Each message is a time base, a column is `Message.Signal`. Frames of errors and remote requests are
passed over. A value that the database gives a name, such as `SNA`, is no number: it is null, or in
a signal that has no other values the name itself.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from fleet_slip.errors import InputError
from fleet_slip.ingest.can_bus import CanBus
from fleet_slip.ingest.can_decoding import is_sent, needed_bytes, physical, raw_numbers
from fleet_slip.ingest.can_frames import CanFrames
from fleet_slip.ingest.columns import describe_missing, shown
from fleet_slip.ingest.source import BASE, OWN_TIME, Channel, reading_with

MAX_FRAMES = 20_000_000
SUFFIXES = {".blf", ".asc", ".log", ".trc"}

_Key = tuple[int, bool]
"""Number of a message, and whether it is of 29 bits."""


class CanSource:
    """The messages of a CAN trace."""

    has_clock = True

    def __init__(self, file: Path, bus: CanBus, database: Any) -> None:
        """Take the trace's path, what the mapping says of it, and the parsed database."""
        self._file, self._bus, self._database = file, bus, database
        self._wanted: set[_Key] | None = None

    def channels(self) -> list[Channel]:
        """Return the signals of all messages of the trace that the database knows."""
        return [
            Channel(f"{message.name}.{signal.name}", signal.unit or "", message.name)
            for message in self._database.messages
            if _key(message) in self._frames
            for signal in message.signals
        ]

    def number_of_bases(self, columns: Sequence[str]) -> int:
        """Return how many messages have one of the columns."""
        return len({column.partition(".")[0] for column in columns})

    def batches(self, columns: Sequence[str]) -> Iterator[pl.DataFrame]:
        """Yield one batch for each message that has one of the columns."""
        wanted: dict[str, dict[str, Any]] = defaultdict(dict)
        messages = {message.name: message for message in self._database.messages}
        for column in columns:
            name, _, signal = column.partition(".")
            found = {s.name: s for s in messages[name].signals} if name in messages else {}
            if signal not in found:
                known = [f"{m}.{s.name}" for m, of in messages.items() for s in of.signals]
                raise InputError(f"{shown(self._bus.database)}: {describe_missing(column, known)}")
            wanted[name][column] = found[signal]
        asked = {_key(messages[name]) for name in wanted}
        if self._wanted is not None and not asked <= self._wanted:
            self.__dict__.pop("_frames", None)  # they were left empty
        self._wanted = asked
        for name, signals in wanted.items():
            yield self._decode(messages[name], signals)

    def _decode(self, message: Any, signals: dict[str, Any]) -> pl.DataFrame:
        """Return the signals of one message; rows are frames that have one of them."""
        times, payloads = self._payloads(message, signals)
        frame = {OWN_TIME: times}
        some = np.zeros(len(times), dtype=np.bool_)
        for column, signal in signals.items():
            sent = is_sent(message, signal, payloads)
            some |= sent
            raw = raw_numbers(signal, payloads)
            values = pl.Series(column, physical(signal, raw)).set(pl.Series(~sent), None)
            named = np.isin(raw, list(signal.choices)) if signal.choices else ~sent
            if (named & sent).any():
                texts = {value: str(text) for value, text in signal.choices.items()}
                if (named | ~sent).all():
                    names = [texts[v] if s else None for v, s in zip(raw, sent, strict=True)]
                    values = pl.Series(column, names, pl.String)
                else:
                    values = values.set(pl.Series(named), None)
            frame[column] = values
        return pl.DataFrame(frame).filter(some).with_columns(pl.lit(message.name).alias(BASE))

    def _payloads(self, message: Any, signals: dict[str, Any]) -> tuple[Any, Any]:
        frames = self._frames.get(_key(message))
        if frames is None:
            known = sum(_key(m) in self._frames for m in self._database.messages)
            raise InputError(
                f"{shown(self._file)}: the message {message.name} ({message.frame_id:#x}) is not "
                f"in it. Of the {len(self._frames)} numbers in the trace {known} are in "
                f"{self._bus.database}. Is it the database of this car and bus?"
            )
        buses, chosen = frames.buses, np.ones(len(frames), dtype=np.bool_)
        if self._bus.channel is not None:
            chosen = frames.are_on(self._bus.channel)
        elif len(buses) > 1:
            raise InputError(
                f"{shown(self._file)}: the message {message.name} is on the buses "
                f"{', '.join(buses)}. Say in the mapping which counts: [can] channel = "
                f'"{buses[0]}".'
            )
        needed = max(map(needed_bytes, signals.values()))
        sizes = np.asarray(frames.sizes)[chosen]
        short = int((sizes < needed).sum())
        if short or not sizes.size:
            raise InputError(
                f"{shown(self._file)}: {short:,} of {sizes.size:,} frames of "
                f"{message.name} ({message.frame_id:#x}) are too short: {next(iter(signals))} ends "
                f"in byte {needed}, the longest has {sizes.max(initial=0)}; buses: "
                f"{', '.join(buses)}. Is {self._bus.database} the database of this car and bus?"
            )
        return frames.take(chosen, needed)

    @cached_property
    def _frames(self) -> dict[_Key, CanFrames]:
        """All frames, by message; those of messages that are not wanted are left empty."""
        frames: dict[_Key, CanFrames] = defaultdict(CanFrames)
        count = 0
        with reading_with(self._file, "can") as can, can.LogReader(self._file) as trace:
            self._require_whole(trace)
            for frame in trace:
                if frame.is_error_frame or frame.is_remote_frame:
                    continue
                found = frames[frame.arbitration_id, frame.is_extended_id]
                if not self._is_wanted(frame.arbitration_id, frame.is_extended_id):
                    continue
                count += 1
                if count > MAX_FRAMES:
                    raise InputError(
                        f"{shown(self._file)}: more than {MAX_FRAMES:,} frames. Split the trace."
                    )
                found.append(frame.timestamp, str(frame.channel), frame.data)
        if not frames:
            raise InputError(f"{shown(self._file)}: there is no CAN frame in it. Record it again.")
        return dict(frames)

    def _is_wanted(self, number: int, is_extended: bool) -> bool:
        """Whether a column is of this message; all are wanted of who lists what is there."""
        return self._wanted is None or (number, is_extended) in self._wanted

    def _require_whole(self, trace: Any) -> None:
        # A BLF file says how long it is; python-can reads what is there of one that was cut.
        stated, there = getattr(trace, "file_size", 0), self._file.stat().st_size
        if stated > there:
            raise InputError(
                f"{shown(self._file)}: {there:,} of {stated:,} bytes: it is truncated. Copy it "
                "again."
            )


def _key(message: Any) -> _Key:
    return message.frame_id, message.is_extended_frame


@contextmanager
def open_can_trace(file: Path, bus: CanBus) -> Iterator[CanSource]:
    """Open a CAN trace. Raises `InputError`, for a database that cannot be parsed too."""
    yield CanSource(file, bus, parse_database(bus))


def parse_database(bus: CanBus) -> Any:
    """Return the messages that a database describes. Raises `InputError`."""
    with reading_with(Path(bus.database), "cantools") as cantools:
        return cantools.database.load_string(bus.text, bus.format, strict=False)
