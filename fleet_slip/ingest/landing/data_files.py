"""Writes rows of measured files to data files of bounded size. Nothing is committed."""

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from hashlib import sha256
from itertools import groupby
from operator import itemgetter
from typing import Any, Literal, TypeAlias

import polars as pl
import pyarrow as pa
import pyarrow.compute as pc
from deltalake.transaction import AddAction

from fleet_slip.catalogue.counts import as_arrow
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.delta import Table, Unit
from fleet_slip.ingest.drives.measured_drives import MeasuredDrive
from fleet_slip.ingest.landing.marks import FILES
from fleet_slip.ingest.mapping.mapping import Mapping

FILE_ROWS = 2**18
"""A data file is written as soon as it has so many rows; its last drive may make it larger."""

WRITERS = 2
"""Data files that are written at once: encoding them is the longest part of an ingest."""

SHARED_ROWS = 2**14
"""Rows of a drive that share the memory of what is the same in all of them."""

TableName: TypeAlias = Literal["quarantine", "logs"]
Rows: TypeAlias = Sequence[MeasuredDrive] | Sequence[pa.Table]
"""Drives for the logs, or refused rows for the quarantine."""
Writing: TypeAlias = Future[list[AddAction]]

_POLARS_TYPES: dict[pa.DataType, type[pl.DataType] | pl.DataType] = {
    pa.string(): pl.String,
    pa.float64(): pl.Float64,
    pa.int64(): pl.Int64,
    pa.int32(): pl.Int32,
    pa.date32(): pl.Date,
    pa.timestamp("us", tz="UTC"): pl.Datetime("us", "UTC"),
}


@dataclass(frozen=True)
class Part:
    """Data files of one table that are not committed yet, and the units that land with them."""

    units: tuple[Unit, ...]
    files: tuple[AddAction, ...]


def unit_of(digest: str) -> Unit:
    """Return the unit of work that a file's content is."""
    return Unit(f"{FILES}{digest}", 1)


def digest_of(digests: Sequence[str]) -> str:
    """Return the digest of several files together."""
    return digests[0] if len(digests) == 1 else sha256("".join(digests).encode()).hexdigest()


class DataFiles:
    """Data files of a batch in one table. Files are read one by one, and ended or discarded."""

    def __init__(
        self,
        table: Table,
        mapping: Mapping,
        threads: ThreadPoolExecutor,
        landed: Callable[[str], bool],
    ) -> None:
        """Take the table, the files' mapping, the threads, and what tells which units it has."""
        self._table, self._mapping, self._threads, self._landed = table, mapping, threads, landed
        self._begun: list[Writing] = []
        self._of_this: list[Writing] = []
        self._of_one: list[Writing] = []
        self._of_several: list[Writing] = []
        self._waiting: dict[str, Rows] = {}
        self._digests: list[str] = []

    def lacks(self, digest: str) -> bool:
        """Whether a file's rows are neither in the table nor about to be."""
        return digest not in self._digests and not self._landed(unit_of(digest).name)

    def add(self, name: str, rows: Rows) -> None:
        """Write rows of the file that is being read to a data file of their own."""
        self._of_this.append(self._begin(name, rows))

    def end_file(self, digest: str, rest: Rows) -> None:
        """End the file that is being read: the rest of its rows wait for those of others."""
        if self._of_this or rest:
            self._digests.append(digest)
        self._of_one += self._of_this
        self._of_this = []
        if rest:
            self._waiting[digest] = rest
        if sum(one.num_rows for rows in self._waiting.values() for one in rows) >= FILE_ROWS:
            self.write_waiting()

    def discard_file(self) -> None:
        """Delete what was written of the file that is being read."""
        written = [writing for writing in self._of_this if writing.exception() is None]
        self._table.discard(file for writing in written for file in writing.result())
        self._of_this = []

    def write_waiting(self) -> None:
        """Write rows in the order of their files' digests, and so of the names of drives."""
        digests = sorted(self._waiting)
        if digests:
            rows: Any = [one for digest in digests for one in self._waiting[digest]]
            name = f"measured-{digest_of(digests)[:24]}"
            self._of_several.append(self._begin(name, rows))
            self._waiting = {}

    def finish(self) -> Part:
        """Return all data files, written, and the units that they are."""
        self.write_waiting()
        writings = (*self._of_one, *self._of_several)
        files = tuple(file for writing in writings for file in writing.result())
        return Part(tuple(map(unit_of, sorted(self._digests))), files)

    def _begin(self, name: str, rows: Rows) -> Writing:
        """Write rows while the caller goes on; at most `WRITERS` files are under way."""
        if len(self._begun) >= WRITERS:
            self._begun[-WRITERS].result()
        self._begun.append(self._threads.submit(self._write, name, rows))
        return self._begun[-1]

    def _write(self, name: str, rows: Rows) -> list[AddAction]:
        parts = _by_day(_as_table(rows, self._mapping))
        encoded = {day: self._table.encode(part) for day, part in parts.items()}
        del parts  # a disk may take its time
        return [self._table.put(name, content, day) for day, content in encoded.items()]


def _as_table(rows: Rows, mapping: Mapping) -> pa.Table:
    """Return rows in one table."""
    tables = [one for one in rows if isinstance(one, pa.Table)]
    if tables:
        return pa.concat_tables(tables).unify_dictionaries()
    return log_table([one for one in rows if isinstance(one, MeasuredDrive)], mapping)


def _by_day(rows: pa.Table) -> dict[Any, pa.Table]:
    """Return the rows of each day; refused ones, which are not kept by day, as they are."""
    if "day" not in rows.column_names:
        return {None: rows}
    days = rows["day"].unique().to_pylist()
    if len(days) == 1:
        return {days[0]: rows}
    return {day: rows.filter(pc.equal(rows["day"], pa.scalar(day, pa.date32()))) for day in days}


def log_table(drives: Sequence[MeasuredDrive], mapping: Mapping) -> pa.Table:
    """Return the rows of `logs` for these drives; strings are dictionary-encoded."""
    sizes = [drive.ticks.size for drive in drives]
    columns = {}
    for field in catalogue().log_schema:
        if field.name == "tick":
            columns[field.name] = pa.chunked_array(
                [as_arrow(drive.ticks) for drive in drives], field.type
            )
        elif field.name in mapping.signal_names:
            columns[field.name] = pa.chunked_array([drive.counts[field.name] for drive in drives])
        elif field.name in catalogue().extras:
            continue
        elif field.name in catalogue().signals:
            absent = _shared(pa.nulls(SHARED_ROWS, field.type), sum(sizes))
            columns[field.name] = pa.chunked_array(absent, field.type)
        else:
            values = [drive.metadata.get(field.name) for drive in drives]
            columns[field.name] = _repeat(values, field.type, sizes)
    return pa.table(columns)


def _repeat(values: Sequence[Any], kind: pa.DataType, times: Sequence[int]) -> pa.ChunkedArray:
    """Return each value as often as it is told; texts as codes of a dictionary."""
    if pa.types.is_string(kind):
        texts = list(dict.fromkeys(text for text in values if text is not None))
        codes = {text: i for i, text in enumerate(texts)}
        repeated = _repeat([codes.get(text) for text in values], pa.int32(), times)
        named = _as_arrow(texts, kind)
        return pa.chunked_array(
            [pa.DictionaryArray.from_arrays(chunk, named, safe=False) for chunk in repeated.chunks],
            pa.dictionary(pa.int32(), kind),
        )
    runs = [
        (value, sum(number for _, number in run))
        for value, run in groupby(zip(values, times, strict=True), key=itemgetter(0))
    ]
    scalars = zip(_as_arrow([value for value, _ in runs], kind), runs, strict=True)
    chunks = [
        chunk
        for scalar, (_, number) in scalars
        for chunk in _shared(pa.repeat(scalar, min(number, SHARED_ROWS)), number)
    ]
    repeated = pa.chunked_array(chunks, kind)
    many_short_runs = len(runs) * SHARED_ROWS > sum(times)
    return pa.chunked_array([repeated.combine_chunks()]) if many_short_runs else repeated


def _shared(rows: pa.Array, number: int) -> list[pa.Array]:
    """Return so many rows that are all the same, in chunks of some that share their memory."""
    return [
        rows.slice(0, min(SHARED_ROWS, number - start)) for start in range(0, number, SHARED_ROWS)
    ]


def _as_arrow(values: Sequence[Any], kind: pa.DataType) -> pa.Array:
    """Return values as Arrow has them; not by `pa.array`, which imports pandas if it is there."""
    return pl.Series(values, dtype=_POLARS_TYPES[kind]).to_arrow().cast(kind)
