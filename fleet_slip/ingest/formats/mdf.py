"""Reads ASAM MDF, versions 2 to 4, through asammdf: each channel group is a time base."""

import mmap
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import polars as pl

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.budget import Budget
from fleet_slip.ingest.formats.log_source import (
    OWN_TIME,
    Base,
    Channel,
    ClockSource,
    as_column,
    describe_missing,
    reading_with,
)
from fleet_slip.ingest.formats.mdf_conversions import conversion_of, require_arithmetic, to_physical
from fleet_slip.words import shown

WINDOW_RECORDS = 2**17
"""Records that are read at once. asammdf takes four times as long for a whole group."""
_TIME_SYNC = 1
_EARLIEST_S = 10**8
"""Loggers without a clock write 0: a start before 1973 is not a date."""


class MdfSource(ClockSource):
    """An open MDF file. A channel of several groups is named `CHANNEL@GROUP`."""

    def __init__(self, mdf: Any, budget: Budget) -> None:
        """Take what asammdf has opened."""
        self._file, self._mdf = budget.file, mdf
        start = mdf.start_time.timestamp()
        self._start_s = start if start > _EARLIEST_S else 0.0

    def channels(self) -> list[Channel]:
        """Return all channels but the groups' masters."""
        return [
            Channel(self._name(channel.name, number), channel.unit or "", f"group {number}")
            for number, group in enumerate(self._mdf.groups)
            for index, channel in enumerate(group.channels)
            if index != self._mdf.masters_db.get(number)
        ]

    def bases(self, columns: Sequence[str]) -> list[Base]:
        """Return the channel groups that have one of the columns. Raises `InputError`."""
        groups: dict[int, dict[str, int]] = {}
        for name in columns:
            number, index = self._find(name)
            groups.setdefault(number, {})[name] = index
        return [
            Base(
                f"group {number}",
                partial(self.count_records, number),
                partial(self._read, number, of),
            )
            for number, of in sorted(groups.items())
        ]

    def count_records(self, number: int) -> int:
        """Return how many samples a group says that it has."""
        return int(self._mdf.groups[number].channel_group.cycles_nr)

    def _read(self, number: int, indices: dict[str, int]) -> Iterator[pl.DataFrame]:
        """Read channels of a group, some records at a time."""
        self._require_sound(number, indices)
        records = self.count_records(number)
        for start in range(0, max(records, 1), WINDOW_RECORDS):
            yield self._window(number, indices, start, min(WINDOW_RECORDS, records - start))

    def _require_sound(self, number: int, indices: dict[str, int]) -> None:
        """Raise `InputError` for a group that asammdf would read beyond, or without times."""
        name = next(iter(indices))
        self._require_times(number, name)
        for index in (self._mdf.masters_db[number], *indices.values()):
            self._require_inside(number, index)
        self._require_data(number, name)

    def windows(self, number: int, indices: dict[str, int]) -> Iterator[list[Any]]:
        """Yield channels of a group as asammdf's signals, some records at a time."""
        self._require_sound(number, indices)
        records = self.count_records(number)
        for start in range(0, records, WINDOW_RECORDS):
            yield self._signals(number, indices, start, min(WINDOW_RECORDS, records - start))

    def times_s(self, signal: Any) -> FloatArray:
        """Return when a signal's samples were taken, since 1970 if the file knows the date."""
        return np.asarray(self._start_s + signal.timestamps.astype(np.float64))

    def groups_with(self, name: str) -> Iterator[tuple[int, dict[str, int]]]:
        """Yield the groups that have a channel of a name, and where each of their channels is."""
        for number, _ in self._mdf.channels_db.get(name, ()):
            group = self._mdf.groups[number]
            if group.channel_group.cycles_nr:
                yield number, {c.name: i for i, c in enumerate(group.channels)}

    def _signals(self, number: int, indices: dict[str, int], start: int, records: int) -> list[Any]:
        with reading_with(self._file, "asammdf"):
            # Of 200 MiB and more `select` reads all records, however few it is asked for.
            select = getattr(self._mdf, "_select_fallback", self._mdf.select)
            signals = select(
                [(None, number, index) for index in indices.values()],
                record_offset=start,
                record_count=records,
                raw=True,
            )
            for signal, index in zip(signals, indices.values(), strict=True):
                signal.samples = self._physical(number, index, signal.samples)
            self._release()
        if len(signals[0]) < records:
            raise InputError(
                f"{shown(self._file)}: group {number} has {start + len(signals[0]):,} samples and "
                "not as many as it says: it is truncated. Copy it again."
            )
        return list(signals)

    def _physical(self, number: int, index: int, raw: Any) -> Any:
        """Return the physical values of a channel, or None without any raw ones."""
        channel = self._mdf.groups[number].channels[index]
        try:
            conversion = conversion_of(channel)
            if raw is not None:
                return to_physical(conversion, raw)
            require_arithmetic(conversion)
        except ValueError as error:
            raise InputError(
                f"{shown(self._file)}: channel {channel.name!r}: {error}. Export it again with "
                "physical values, or map another channel."
            ) from None

    def _release(self) -> None:
        """Let the system have back the pages of the file, or all of it counts as our memory."""
        mapped = self._mdf._mdf._file
        # The copy of an unfinalised file has changes that are in memory only.
        if isinstance(mapped, mmap.mmap) and memoryview(mapped).readonly:
            mapped.madvise(mmap.MADV_DONTNEED)

    def _window(
        self, number: int, indices: dict[str, int], start: int, records: int
    ) -> pl.DataFrame:
        """Read some records of a group; what the file marks as invalid is null."""
        signals = self._signals(number, indices, start, records)
        frame = {OWN_TIME: pl.Series(self.times_s(signals[0])[:records])}
        for name, signal in zip(indices, signals, strict=True):
            values = as_column(self._file, name, signal.samples[:records])
            invalid = signal.invalidation_bits
            if invalid is not None:
                values = values.set(pl.Series(np.asarray(invalid[:records], dtype=np.bool_)), None)
            frame[name] = values
        return pl.DataFrame(frame)

    def _require_times(self, number: int, name: str) -> None:
        master = self._mdf.masters_db.get(number)
        group = self._mdf.groups[number]
        kind = None if master is None else getattr(group.channels[master], "sync_type", _TIME_SYNC)
        # MDF 3 knows no kinds: its masters are times.
        if master is None or kind not in {_TIME_SYNC, None}:
            raise InputError(
                f"{shown(self._file)}: channel {name!r} is of group {number}, which has no times "
                "(it is over an angle, a distance or an index). Map another channel."
            )
        self._physical(number, master, None)

    def _require_inside(self, number: int, index: int) -> None:
        """Raise `InputError` for a channel outside of its record: asammdf would read beyond it."""
        group, channel = self._mdf.groups[number], self._mdf.groups[number].channels[index]
        cg = group.channel_group
        start = getattr(channel, "start_offset", None)  # MDF 3 counts bits
        if start is None:
            start = 8 * channel.byte_offset + channel.bit_offset
            within = channel.pos_invalidation_bit < 8 * cg.invalidation_bytes_nr
            flagged = within or not cg.invalidation_bytes_nr
        else:
            start += 8 * getattr(channel, "additional_byte_offset", 0)
            flagged = True
        if not flagged or start + channel.bit_count > 8 * cg.samples_byte_nr:
            raise InputError(
                f"{shown(self._file)}: channel {channel.name!r} lies outside of the records of its "
                "group: the file is damaged. Copy it again."
            )

    def _require_data(self, number: int, name: str) -> None:
        """Raise `InputError` for a group that states more samples than there are bytes."""
        group, there = self._mdf.groups[number], self._file.stat().st_size
        whole = there
        if hasattr(group, "get_data_blocks"):  # MDF 3 has no compressed blocks
            whole = sum(block.original_size for block in group.get_data_blocks())
        samples, size = group.channel_group.cycles_nr, group.channel_group.samples_byte_nr
        if samples * size > whole:
            raise InputError(
                f"{shown(self._file)}: the group of {name!r} says that it has {samples:,} samples "
                f"of {size:,} bytes, and there are {whole:,}: it is truncated or damaged. Copy it "
                "again."
            )

    def _find(self, name: str) -> tuple[int, int]:
        places = self._places(name)
        base, _, group = name.rpartition("@")
        if not places and base:
            places = [p for p in self._places(base) if group in {str(p[0]), self._title(p[0])}]
        if not places:
            names = [channel.name for channel in self.channels()]
            raise InputError(f"{shown(self._file)}: {describe_missing(name, names)}")
        if len(places) > 1:
            titles = ", ".join(repr(f"{base or name}@{number}") for number, _ in places[:5])
            raise InputError(
                f"{shown(self._file)}: {len(places)} channels are called {name!r}. Say which: "
                f"{titles}."
            )
        return places[0]

    def _places(self, name: str) -> list[tuple[int, int]]:
        places = self._mdf.channels_db.get(name, ())
        return [(n, i) for n, i in places if i != self._mdf.masters_db.get(n)]

    def _title(self, number: int) -> str:
        return str(getattr(self._mdf.groups[number].channel_group, "acq_name", "") or "")

    def _name(self, name: str, number: int) -> str:
        return name if len(self._places(name)) < 2 else f"{name}@{number}"


@contextmanager
def open_mdf(budget: Budget) -> Iterator[MdfSource]:
    """Open an MDF file. Raises `InputError`.

    An attachment may be any other file, and so may the database by which asammdf would decode bus
    logging at once: nothing is read of either.
    """
    file = budget.file
    # It leaves copies of unfinalised files behind, and more where it fails.
    with TemporaryDirectory(prefix="fleet-slip-", ignore_cleanup_errors=True) as folder:
        with reading_with(file, "asammdf") as asammdf:
            try:
                mdf = asammdf.MDF(file, temporary_folder=folder, process_bus_logging=False)
            except Exception as error:
                _close_half_made(error)
                raise
        if getattr(mdf._mdf, "_delete_on_close", False):
            mdf._mdf.name.unlink()  # it stays open, and goes with the process however that ends
        mdf._mdf.extract_attachment = lambda *_, **__: (b"", Path(), b"")
        try:
            yield MdfSource(mdf, budget)
        finally:
            mdf.close()


def _close_half_made(error: Exception) -> None:
    """Mark what asammdf had half opened as closed: its destructor would raise once more."""
    for frame, _ in traceback.walk_tb(error.__traceback__):
        half_made: Any = frame.f_locals.get("self")
        if hasattr(half_made, "_closed"):
            half_made._closed = True
            if hasattr(half_made, "_tempfile"):
                half_made._tempfile.close()  # while its folder is there
