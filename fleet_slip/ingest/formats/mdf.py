"""Reads ASAM MDF, versions 2 to 4, through asammdf: each channel group is a time base."""

import mmap
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray
from fleet_slip.base import quote_name
from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.can import Bytes, CanSource, Frames, frame_table
from fleet_slip.ingest.formats.file_formats import FileFormats
from fleet_slip.ingest.formats.source import (
    OWN_TIME,
    Budget,
    Channel,
    Source,
    as_column,
    clock_start_s,
    is_missing_state,
    load_library,
    missing_column,
    names_states,
)

# Applies the conversions of an MDF file, of counts to physical values.
#
# asammdf passes a formula of the file to sympy, which executes it; if that fails, it returns the
# counts. So this module requests raw values and conversions without a formula; formulas are
# refused. asammdf also rounds the bounds of ranges, and the length of a block changes its result.

_KINDS = {
    b"##CC": dict(enumerate(
        ("none", "plain", "plain", "formula", "table", "table", "ranges", "names of values",
         "names of ranges", "text", "text", "text")
    )),
    b"CC": {
        65535: "none", 0: "plain", 1: "table", 2: "table", 6: "plain", 9: "plain", 10: "formula",
        11: "text", 12: "names of ranges",
    },
}  # fmt: skip
"""The kind of each type of conversion, of MDF 4 and of MDF 3; others are refused."""
_NOT_COMPUTED = "its conversion is a formula, which is not evaluated"

Array = np.ndarray[Any, Any]


def conversion_of(channel: Any, *, is_time: bool) -> Any:
    """Return a channel's conversion, or None. Raises `ValueError` for one not to be applied.

    asammdf applies those of times itself, and drops those that it cannot read.
    """
    if channel.conversion is None and channel.conversion_addr:
        raise ValueError("its conversion cannot be read, or is of an unknown type")
    if is_time and _kind_of(channel.conversion) not in {"none", "plain"}:
        raise ValueError("times with a formula or a table as conversion are not supported")
    return channel.conversion


def to_physical(conversion: Any, raw: Array, *, as_numbers: bool = False) -> Array:
    """Return physical values, texts as bytes; of named states their numbers with `as_numbers`.

    Raises `ValueError` for other conversions.
    """
    kind = _kind_of(conversion)
    if kind == "none":
        return raw
    if kind == "formula":
        raise ValueError(_NOT_COMPUTED)
    if kind.startswith(("ranges", "names")):
        return _by_ranges(conversion, kind, raw, as_numbers=as_numbers)
    if kind == "table" and np.any(np.diff(_listed(conversion, "raw")) < 0):
        raise ValueError("the table of its conversion is not sorted")
    if any(not isinstance(part, bytes) for part in conversion.referenced_blocks.values()):
        raise ValueError("its conversion refers to other conversions, which is not supported")
    converted: Array = conversion.convert(raw)
    return converted


def state_names(conversion: Any) -> list[str]:
    """Return the names of states in a conversion's table."""
    blocks = {} if conversion is None else conversion.referenced_blocks or {}
    return [_decoded(text) for text in blocks.values() if isinstance(text, bytes)]


def _kind_of(conversion: Any) -> str:
    if conversion is None:
        return "none"
    number = conversion.conversion_type
    if number not in _KINDS[conversion.id]:
        raise ValueError(f"conversions of type {number} are not supported")
    return _KINDS[conversion.id][number]


def _listed(conversion: Any, name: str) -> Array:
    """Return parameters that are numbered from 0 on."""
    attributes, numbers = vars(conversion), list[float]()
    while f"{name}_{len(numbers)}" in attributes:
        numbers.append(attributes[f"{name}_{len(numbers)}"])
    return np.array(numbers, dtype=np.float64)


def _by_ranges(conversion: Any, kind: str, raw: Array, *, as_numbers: bool) -> Array:
    """Apply a table of ranges, or of single values. Integers include the upper end."""
    points = kind == "names of values"
    lower, upper = (_listed(conversion, "val" if points else end) for end in ("lower", "upper"))
    order = np.argsort(lower, kind="stable")
    lower, upper = np.append(lower[order], np.inf), np.append(upper[order], -np.inf)
    place = np.searchsorted(lower[:-1], raw, side="right") - 1
    ends = (raw.dtype.kind in "iub") | (lower == upper)
    inside = (raw < upper[place]) | (ends[place] & (raw == upper[place]))
    place = np.where(inside & (place >= 0), place, len(order))
    if kind == "ranges":
        return np.append(_listed(conversion, "phys")[order], conversion.default)[place]
    blocks = conversion.referenced_blocks
    parts = [*(blocks[f"text_{number}"] for number in order), blocks["default_addr"]]
    names = [_decoded(part) if isinstance(part, bytes) else None for part in parts]
    if any("{X}" in name for name in names if name):  # of MDF 3
        raise ValueError(_NOT_COMPUTED)
    if parts[-1] is None and None not in names[:-1] and names_states(filter(None, names)):
        parts[-1], names[-1] = b"", ""  # a state without a name is missing
    if None not in names and not as_numbers:
        return np.array(parts, dtype=bytes)[place]
    if None not in names:
        absent = np.array([not name or is_missing_state(name) for name in names])
        return np.where(absent[place], np.nan, raw)
    values = np.full(raw.shape, np.nan)  # of which some have a name instead
    for number in np.unique(place).tolist():
        if names[number] is None:
            values[place == number] = to_physical(parts[number], raw[place == number])
    return values


def _decoded(text: bytes) -> str:
    return text.decode("utf-8", "replace")


WINDOW_RECORDS = 2**17
"""Records that are read at once. asammdf takes four times as long for a whole group."""
_TIME_SYNC = 1
_FRAME = "CAN_DataFrame."
"""How ASAM's associated standard begins the names of the channels of CAN frames."""
_EXTENDED = 1 << 31
"""Bit that marks an identifier of 29 bits, where no channel of its own does."""
_IDENTIFIER = (1 << 29) - 1


class MdfSource(Source):
    """An open MDF file. A channel of several groups is named `CHANNEL@GROUP`."""

    has_clock = True

    def __init__(self, mdf: Any, budget: Budget, formats: FileFormats) -> None:
        """Take a file opened by asammdf, and its format in the mapping."""
        self._file, self._mdf = budget.file, mdf
        self._start_s = _start_s(mdf.header, formats.zone)
        self._formats = formats

    def channels(self) -> list[Channel]:
        """Return all channels but the groups' masters."""
        return [
            Channel(self._name(channel.name, number), channel.unit or "", f"group {number}")
            for number, group in enumerate(self._mdf.groups)
            for index, channel in enumerate(group.channels)
            if index != self._mdf.masters_db.get(number)
        ]

    def bases(self, columns: Sequence[str]) -> list[Iterator[pl.DataFrame]]:
        """Return the rows of each channel group that has one of the columns, in file order."""
        return super().bases(sorted(columns, key=lambda name: self.find(name)[1][0]))

    def find(self, column: str) -> tuple[str, tuple[int, int]]:
        """Return the group of a channel, and the numbers of both. Raises `InputError`."""
        name, _, group = column.rpartition("@")
        groups = self._mdf.groups
        places = self._places(column) or [
            (number, index)
            for number, index in self._places(name)
            if group in {str(number), getattr(groups[number].channel_group, "acq_name", "")}
        ]
        if not places:
            raise missing_column(self._file, column, [channel.name for channel in self.channels()])
        if len(places) > 1:
            called = groups[places[0][0]].channels[places[0][1]].name
            names = ", ".join(repr(f"{called}@{number}") for number, _ in places[:5])
            raise InputError(
                f"{quote_name(self._file)}: {len(places)} channels are called {column!r}. Choose "
                f"one: {names}."
            )
        return f"group {places[0][0]}", places[0]

    def read(self, _base: str, places: dict[str, tuple[int, int]]) -> Iterator[pl.DataFrame]:
        """Read channels of a group in windows of records. Invalid values are null."""
        [number] = {number for number, _ in places.values()}
        for signals in self._windows(number, {name: index for name, (_, index) in places.items()}):
            frame = {OWN_TIME: pl.Series(self._times_s(signals[0]))}
            for name, signal in zip(places, signals, strict=True):
                values = as_column(self._file, name, signal.samples)
                invalid = signal.invalidation_bits
                if invalid is not None:
                    values = values.set(pl.Series(np.asarray(invalid, dtype=np.bool_)), None)
                frame[name] = values
            yield pl.DataFrame(frame)

    def _windows(self, number: int, indices: dict[str, int]) -> Iterator[list[Any]]:
        """Yield channels of a group as asammdf's signals, some records at a time."""
        # asammdf would read beyond the records of a damaged group.
        name = next(iter(indices))
        self._require_times(number, name)
        for index in (self._mdf.masters_db[number], *indices.values()):
            self._require_inside(number, index)
        self._require_data(number, name)
        records = int(self._mdf.groups[number].channel_group.cycles_nr)
        for start in range(0, max(records, 1), WINDOW_RECORDS):
            yield self._signals(number, indices, start, min(WINDOW_RECORDS, records - start))

    def _times_s(self, signal: Any) -> FloatArray:
        """Return the times of a signal's samples, since 1970 if the file contains the date."""
        return np.asarray(self._start_s + signal.timestamps.astype(np.float64))

    def _signals(self, number: int, indices: dict[str, int], start: int, records: int) -> list[Any]:
        # For files of 200 MiB and more `select` reads all records, also for a small window.
        select = getattr(self._mdf, "_select_fallback", self._mdf.select)
        signals = select(
            [(None, number, index) for index in indices.values()],
            record_offset=start,
            record_count=records,
            raw=True,
        )
        for signal, (name, index) in zip(signals, indices.items(), strict=True):
            signal.samples = self._physical(number, index, signal.samples, name)
        self._release()
        if len(signals[0]) < records:
            raise InputError(
                f"{quote_name(self._file)}: group {number} has {start + len(signals[0]):,} "
                "samples, fewer "
                "than it states: the file is truncated. Copy it again."
            )
        return list(signals)

    def _physical(self, number: int, index: int, raw: Any, column: str = "") -> Any:
        """Return the physical values of a channel, or None without any raw ones."""
        channel = self._mdf.groups[number].channels[index]
        try:
            conversion = conversion_of(channel, is_time=raw is None)
            if raw is None:
                return None
            as_numbers = self._formats.reads_number(column, state_names(conversion))
            return to_physical(conversion, raw, as_numbers=as_numbers)
        except ValueError as error:
            raise InputError(
                f"{quote_name(self._file)}: channel {channel.name!r}: {error}. Export it again "
                "with physical values, or map another channel."
            ) from None

    def _release(self) -> None:
        """Release the pages of the file: mapped pages would count as memory of this process."""
        mapped = self._mdf._mdf._file
        # The copy of an unfinalised file has changes that are in memory only.
        if isinstance(mapped, mmap.mmap) and memoryview(mapped).readonly:
            mapped.madvise(mmap.MADV_DONTNEED)

    def _require_times(self, number: int, name: str) -> None:
        master = self._mdf.masters_db.get(number)
        group = self._mdf.groups[number]
        kind = None if master is None else getattr(group.channels[master], "sync_type", _TIME_SYNC)
        # MDF 3 has no types of masters: all are times.
        if master is None or kind not in {_TIME_SYNC, None}:
            raise InputError(
                f"{quote_name(self._file)}: channel {name!r} is in group {number}, whose master is "
                "not time but an angle, a distance or an index. Map another channel."
            )
        self._physical(number, master, None)

    def _require_inside(self, number: int, index: int) -> None:
        """Raise `InputError` for a channel outside of its record: asammdf would read beyond it."""
        group, channel = self._mdf.groups[number], self._mdf.groups[number].channels[index]
        start = getattr(channel, "start_offset", None)
        if start is None:
            start = 8 * channel.byte_offset + channel.bit_offset
        else:  # MDF 3 counts bits
            start += 8 * getattr(channel, "additional_byte_offset", 0)
        if start + channel.bit_count > 8 * group.channel_group.samples_byte_nr:
            raise InputError(
                f"{quote_name(self._file)}: channel {channel.name!r} lies outside of the records "
                "of its group: the file is damaged. Copy it again."
            )

    def _require_data(self, number: int, name: str) -> None:
        """Raise `InputError` for a group that states more samples than there are bytes."""
        group, file_bytes = self._mdf.groups[number], self._file.stat().st_size
        data_bytes = file_bytes
        if hasattr(group, "get_data_blocks"):  # MDF 3 has no compressed blocks
            data_bytes = sum(block.original_size for block in group.get_data_blocks())
        samples, size = group.channel_group.cycles_nr, group.channel_group.samples_byte_nr
        if samples * size > data_bytes:
            raise InputError(
                f"{quote_name(self._file)}: the group of {name!r} states {samples:,} samples of "
                f"{size:,} bytes, and has {data_bytes:,} bytes: it is truncated or damaged. Copy "
                "the file again."
            )

    def frames(self) -> Iterator[Frames]:
        """Yield the CAN frames of bus logging. Raises `InputError`."""
        groups = [number for number, _ in self._mdf.channels_db.get(f"{_FRAME}ID", ())]
        groups = [n for n in groups if self._mdf.groups[n].channel_group.cycles_nr]
        if not groups:
            raise InputError(
                f"{quote_name(self._file)}: it has no CAN frames ({_FRAME}ID). Map its channels "
                "without [can] in the mapping."
            )
        for number in groups:
            places = {c.name: i for i, c in enumerate(self._mdf.groups[number].channels)}
            names = ("ID", "DataBytes", "DataLength", "IDE", "BusChannel")
            indices = {n: places[_FRAME + n] for n in names if _FRAME + n in places}
            if "DataBytes" not in indices:
                raise InputError(
                    f"{quote_name(self._file)}: group {number} has frames without "
                    f"{_FRAME}DataBytes. "
                    "Export it again, with payloads."
                )
            for window in self._windows(number, indices):
                samples = {n: signal.samples for n, signal in zip(indices, window, strict=True)}
                numbers, payloads = samples["ID"].astype(np.int64), _payloads(samples["DataBytes"])
                extended = numbers & _EXTENDED != 0
                if "IDE" in samples:
                    extended |= samples["IDE"].astype(np.int64) != 0
                sizes = samples.get("DataLength", np.full(len(numbers), payloads.shape[1]))
                buses = samples.get("BusChannel", np.zeros(len(numbers))).astype(np.int64)
                times_s, sizes = self._times_s(window[0]), sizes.astype(np.int64)
                yield frame_table(numbers & _IDENTIFIER, extended, times_s, buses, sizes, payloads)

    def _places(self, name: str) -> list[tuple[int, int]]:
        places = self._mdf.channels_db.get(name, ())
        return [(n, i) for n, i in places if i != self._mdf.masters_db.get(n)]

    def _name(self, name: str, number: int) -> str:
        return name if len(self._places(name)) < 2 else f"{name}@{number}"


def _start_s(header: Any, zone: str | None) -> float:
    """Return the start of the measurement in s since 1970, 0 if the file has no date.

    MDF 3 may have the local date and time as text alone: asammdf would read them in the zone of
    this machine, and a damaged date as now.
    """
    counted_ns: int = getattr(header, "abs_time", 0)
    if hasattr(header, "time_flags") or counted_ns:
        return clock_start_s(header.start_time, zone)
    text = f"{header.date.decode('latin-1')} {header.time.decode('latin-1')}".strip("\0 ")
    try:
        start = datetime.strptime(text, "%d:%m:%Y %H:%M:%S")
    except ValueError:
        return 0.0
    return clock_start_s(start, zone)


@contextmanager
def open_mdf(budget: Budget, formats: FileFormats) -> Iterator[MdfSource]:
    """Open an MDF file. Raises `InputError`.

    An attachment may be any other file, and so may the database for decoding bus logging: neither
    is read.
    """
    mdf = load_library(budget.file, "asammdf").MDF(
        budget.file, temporary_folder=tempfile.gettempdir(), process_bus_logging=False
    )
    if getattr(mdf._mdf, "_delete_on_close", False):
        mdf._mdf.name.unlink()  # it stays open until the process ends
    mdf._mdf.extract_attachment = lambda *_, **__: (b"", Path(), b"")
    try:
        yield MdfSource(mdf, budget, formats)
    finally:
        mdf.close()


def _payloads(samples: NDArray[Any]) -> Bytes:
    """Return payloads as a matrix of bytes, those that are shorter filled up."""
    if samples.ndim > 1:
        return samples.astype(np.uint8, copy=False)
    texts = np.asarray(samples, dtype="S64" if samples.dtype.kind == "O" else samples.dtype)
    return np.ascontiguousarray(texts).view(np.uint8).reshape(len(texts), -1)


@contextmanager
def open_mdf_bus(budget: Budget, formats: FileFormats) -> Iterator[CanSource]:
    """Open an MDF file for the CAN frames in it. Raises `InputError`."""
    with open_mdf(budget, formats) as mdf:
        yield CanSource(budget.file, formats, mdf.frames)
