"""Reads the rows of a log, which is a file or several, in bounded batches.

A batch is a Polars frame with the columns that a mapping uses: text (CSV, text in Parquet), 64-bit
floats, dates or timestamps. CSV fields stay text, so that what is not a number can be quarantined
as it was written. A time base goes on from file to file, each open only while it is read.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import polars as pl

from fleet_slip.errors import InputError
from fleet_slip.ingest.drives.time_bases import merge_bases
from fleet_slip.ingest.formats.budget import Budget
from fleet_slip.ingest.formats.log_source import Base, ClockSource, Source
from fleet_slip.ingest.formats.meter import Meter
from fleet_slip.ingest.formats.parquet_batches import BATCH_ROWS
from fleet_slip.ingest.formats.reading import file_errors, open_source
from fleet_slip.ingest.logs.log_files import parts_of
from fleet_slip.ingest.mapping.mapping import Mapping
from fleet_slip.words import shown

_OpenIt = Callable[[Path], AbstractContextManager[tuple[list[Base], set[str]]]]

_CLOCK = "this file says when each sample was taken: write own_clock = true under [time]"
_NO_CLOCK = "this file has no clock of its own: write column or rate_hz under [time]"


@dataclass
class _Opened:
    """An open file, its time bases, and how many of them are being read."""

    file: ExitStack
    bases: list[Base]
    columns: set[str]
    readers: int = 0


class PartBases:
    """Opens the files of a log, each once for all who read a time base of it at a time."""

    def __init__(self, open_it: _OpenIt) -> None:
        """Take what opens a file: it gives its time bases, and which columns they have."""
        self._open_it = open_it
        self._opened: dict[Path, _Opened] = {}

    def __enter__(self) -> "PartBases":
        """Begin without open files."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close what readers have left open."""
        for part in [*self._opened]:
            self._opened.pop(part).file.close()

    @contextmanager
    def using(self, part: Path) -> Iterator[_Opened]:
        """Give a file, open as long as somebody uses it."""
        if part not in self._opened:
            with ExitStack() as file:
                bases, columns = file.enter_context(self._open_it(part))
                self._opened[part] = _Opened(file.pop_all(), bases, columns)
        opened = self._opened[part]
        opened.readers += 1
        try:
            with file_errors(part):
                yield opened
        finally:
            opened.readers -= 1
            if not opened.readers and self._opened.get(part) is opened:
                del self._opened[part]
                opened.file.close()


@dataclass(frozen=True)
class _Stretch:
    """The rows of a time base in one file: which of its bases it is, and how many there are."""

    part: Path
    place: int
    first_s: float
    rows: int


def join_parts(log: Path, parts: list[Path], mapping: Mapping, opened: PartBases) -> list[Base]:
    """Return the time bases of a log: what has the same columns goes on from file to file.

    Files follow each other in the order of their first times. Raises `InputError` for a column that
    no file has.
    """
    time = str(mapping.time.key)
    missing = {name for names in mapping.time_bases().values() for name in names}
    found: dict[str, list[_Stretch]] = defaultdict(list)
    for part in parts:
        with opened.using(part) as there:
            missing -= there.columns
            for place, base in enumerate(there.bases):
                first = next(base.read())
                name = " ".join(sorted({*first.columns, time}))
                least = first[time].min()
                first_s = least if isinstance(least, float) else 0.0
                found[name].append(_Stretch(part, place, first_s, base.count_rows()))
    if missing:
        raise InputError(f"{shown(log)}: no file in it has the column {min(missing)!r}.")
    for stretches in found.values():
        stretches.sort(key=lambda stretch: stretch.first_s)
    names = sorted(found, key=lambda name: found[name][0].first_s)
    return [
        Base(
            name,
            partial(sum, [stretch.rows for stretch in found[name]]),
            partial(_read, opened, found[name]),
        )
        for name in names
    ]


def _read(opened: PartBases, stretches: list[_Stretch]) -> Iterator[pl.DataFrame]:
    for stretch in stretches:
        with opened.using(stretch.part) as there:
            yield from there.bases[stretch.place].read()


def read_batches(log: Path, mapping: Mapping, meter: Meter | None = None) -> Iterator[pl.DataFrame]:
    """Yield the columns of a log that a mapping uses, in its order, in bounded batches.

    Rows of several time bases come as `merge_bases` says. The meter is told how many rows come.
    Raises `InputError` if a file cannot be read, or a column is missing or ambiguous.
    """
    meter = meter or Meter()
    wanted, parts, time = mapping.time_bases(), parts_of(log), mapping.time.key
    if time is None or (len(wanted) == 1 and not mapping.time.own_clock):
        for part in parts:
            with _open_part(part, mapping) as source:
                columns = next(iter(wanted.values()))
                if meter.is_watched and part == parts[0]:
                    meter.expect(source.expected_rows(columns), of=part.stat().st_size)
                yield from Budget.of(part).metered(source.batches(columns))
    elif len(parts) == 1:
        with _open_part(log, mapping, meter) as source:
            bases = _bases_of(source, log, mapping, wanted)
            if meter.is_watched:
                meter.expect(sum(map(source.expected_rows, wanted.values())))
            yield from _merged(bases, mapping)
    else:
        with PartBases(partial(_open_bases, mapping)) as opened:
            bases = join_parts(log, parts, mapping, opened)
            meter.expect(sum(base.count_rows() for base in bases))
            yield from _merged(bases, mapping)


def _merged(bases: list[Base], mapping: Mapping) -> Iterator[pl.DataFrame]:
    """Yield the rows of time bases as those of one table."""
    time, held = str(mapping.time.key), mapping.common_columns()
    for rows in merge_bases(bases, time, held, mapping.time.split_gap_s):
        yield from rows.iter_slices(BATCH_ROWS)


@contextmanager
def _open_part(part: Path, mapping: Mapping, meter: Meter | None = None) -> Iterator[Source]:
    """Open a file that says times as the mapping does. Raises `InputError`."""
    with file_errors(part), open_source(part, mapping.formats, meter) as source:
        if source.has_clock != mapping.time.own_clock:
            raise InputError(
                f"{shown(part)}: {_CLOCK if source.has_clock else _NO_CLOCK}, in the mapping "
                f"{mapping.name!r}."
            )
        yield source


@contextmanager
def _open_bases(mapping: Mapping, part: Path) -> Iterator[tuple[list[Base], set[str]]]:
    """Open a file, which may lack wanted columns; yield its time bases, and the columns it has."""
    wanted = mapping.time_bases()
    with _open_part(part, mapping) as source:
        names = {channel.name for channel in source.channels()}
        # What several groups of one file have is called NAME@GROUP, there only.
        all_names = {name for columns in wanted.values() for name in columns}
        there = names | {name for name in all_names if name.rpartition("@")[0] in names}
        found = {
            own: [name for name in columns if name in there]
            for own, columns in wanted.items()
            if own is None or own in there
        }
        found = {own: columns for own, columns in found.items() if columns}
        columns = {name for columns in found.values() for name in columns}
        yield _bases_of(source, part, mapping, found), columns


def _bases_of(
    source: Source, part: Path, mapping: Mapping, wanted: dict[str | None, list[str]]
) -> list[Base]:
    """Return the time bases of a file that have one of the wanted columns."""
    if isinstance(source, ClockSource):
        bases = [base for columns in wanted.values() for base in source.bases(columns)]
    else:
        time = str(mapping.time.key)
        bases = [
            Base(
                str(own),
                partial(_count_rows, source, str(own), own == time),
                partial(_read_with_times, source, part, columns, str(own), time),
            )
            for own, columns in wanted.items()
        ]

    def metered(read: Callable[[], Iterator[pl.DataFrame]]) -> Iterator[pl.DataFrame]:
        return Budget.of(part).metered(read())

    return [replace(base, read=partial(metered, base.read)) for base in bases]


def _count_rows(source: Source, own: str, is_main: bool) -> int:
    """Return how many rows a base has: those with a time, where it has times of its own."""
    batches = source.batches([own])
    return sum(batch.height - (0 if is_main else batch[own].null_count()) for batch in batches)


def _read_with_times(
    source: Source, part: Path, columns: list[str], own: str, time: str
) -> Iterator[pl.DataFrame]:
    """Yield the rows of a base, its times under the name that all times have."""
    for batch in source.batches(columns):
        if not batch[own].dtype.is_numeric():
            raise InputError(
                f"{shown(part)}: the time {own!r} is not of numbers; signals with times of their "
                "own need them."
            )
        if own == time:
            yield batch
        else:
            yield batch.filter(pl.col(own).is_not_null()).rename({own: time})
