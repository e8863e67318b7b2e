"""Writes what a measured file becomes to data files of bounded size. Nothing is committed."""

import os
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from tempfile import TemporaryFile
from typing import IO, Any, Literal, TypeAlias

import polars as pl
import pyarrow as pa
import pyarrow.compute as pc
from deltalake.transaction import AddAction

from fleet_slip.delta import Table
from fleet_slip.ingest.drives.measured_drives import MeasuredDrive, log_table
from fleet_slip.ingest.drives.stream import MeasuredStream
from fleet_slip.ingest.landing.expected_rows import expected_rows
from fleet_slip.ingest.landing.forgotten import keep_drives, keep_refused
from fleet_slip.ingest.mapping.mapping import Mapping
from fleet_slip.progress import Progress, no_progress
from fleet_slip.warehouse.audit import Audit
from fleet_slip.warehouse.tables import QUARANTINE_SCHEMA, Warehouse

FILE_ROWS = 2**18
"""A data file is written as soon as it has so many rows; its last drive may make it larger."""

WRITERS = 2
"""Data files that are written at once: encoding them is the longest part of an ingest."""

TableName: TypeAlias = Literal["quarantine", "logs"]
Rows: TypeAlias = Sequence[MeasuredDrive] | Sequence[pa.Table]
"""Drives for the logs, or refused rows for the quarantine."""


class DataFiles:
    """Rows of one table on their way to data files, one file a day, written by threads."""

    def __init__(self, table: Table, threads: ThreadPoolExecutor, *, by_day: bool) -> None:
        """Take the table and the threads that write."""
        self._table, self._threads, self._by_day = table, threads, by_day
        self._written: list[Future[list[AddAction]]] = []

    def write(self, name: str, rows: Callable[[], pa.Table]) -> None:
        """Write rows, made when it is their turn, while the caller goes on.

        At most `WRITERS` files of a table are on their way.
        """
        if len(self._written) >= WRITERS:
            self._written[-WRITERS].result()
        self._written.append(self._threads.submit(self._write, name, rows))

    def files(self) -> tuple[AddAction, ...]:
        """Return the files, all written."""
        return tuple(file for future in self._written for file in future.result())

    def discard(self) -> None:
        """Delete all that was written."""
        written = [future for future in self._written if future.exception() is None]
        self._table.discard(file for future in written for file in future.result())

    def _write(self, name: str, make: Callable[[], pa.Table]) -> list[AddAction]:
        rows = make()
        parts = _by_day(rows) if self._by_day else {None: rows}
        encoded = {day: self._table.encode(part) for day, part in parts.items()}
        del rows, parts  # a disk may take its time
        return [self._table.put(name, content, day) for day, content in encoded.items()]


class RefusedRows:
    """Rows for the quarantine until the end of their file; of many, most are in a temporary file.

    Only then is it known whether a drive that they are of was forgotten.
    """

    def __init__(self, stream: MeasuredStream) -> None:
        """Take the file that the rows are of."""
        self._stream = stream
        self._rows: list[pl.DataFrame] = []
        self._number = 0
        self._spilled: IO[bytes] | None = None

    def add(self, rows: pl.DataFrame) -> None:
        """Keep rows."""
        if not rows.height:
            return
        self._rows.append(rows)
        self._number += rows.height
        if self._number >= FILE_ROWS:
            self._spilled = self._spilled or TemporaryFile()  # noqa: SIM115 - closed with this
            with pa.ipc.new_stream(self._spilled, QUARANTINE_SCHEMA) as sink:
                sink.write_table(self._stream.quarantine_table(self._rows))
            self._rows, self._number = [], 0

    def tables(self) -> Iterator[pa.Table]:
        """Yield the rows, and let go of them."""
        if self._spilled is not None:
            with self._spilled as file:
                end = file.seek(0, os.SEEK_END)
                file.seek(0)
                while file.tell() < end:
                    yield pa.ipc.open_stream(file).read_all()
        if self._number:
            yield self._stream.quarantine_table(self._rows)


@dataclass
class WrittenFile:
    """What a measured file became.

    Attributes:
        rest: rows that wait for those of other files: those of a small file, or the last.
        vehicles: whose rows they are.
        left_out: drives that were forgotten.
        longest: the drive with the most ticks.
    """

    rest: dict[TableName, Rows] = field(default_factory=dict)
    files: dict[TableName, tuple[AddAction, ...]] = field(default_factory=dict)
    vehicles: set[str] = field(default_factory=set)
    left_out: set[str] = field(default_factory=set)
    ticks: int = 0
    longest: MeasuredDrive | None = None


class FileWriter:
    """Writes one measured file, those tables of it that have not landed."""

    def __init__(
        self,
        warehouse: Warehouse,
        stream: MeasuredStream,
        missing: Collection[TableName],
        threads: ThreadPoolExecutor,
        progress: Progress = no_progress,
    ) -> None:
        """Take an open file, the tables that miss it, and the threads that write.

        `progress` counts rows of the file, if it is known about how many it has.
        """
        self._progress = progress
        self._stream, self._missing = stream, missing
        self._audit = Audit(warehouse.root)
        self._large: dict[TableName, DataFiles] = {
            "quarantine": DataFiles(warehouse.quarantine, threads, by_day=False),
            "logs": DataFiles(warehouse.logs, threads, by_day=True),
        }
        self._names = count(1)
        self._result = WrittenFile()

    def write(self) -> WrittenFile:
        """Read the file, and write all but its last rows. Raises `InputError`; nothing is left."""
        try:
            self._read()
        except BaseException:
            for files in self._large.values():
                files.discard()
            raise
        self._result.files = {name: files.files() for name, files in self._large.items()}
        return self._result

    def _read(self) -> None:
        refused = RefusedRows(self._stream)
        waiting: list[MeasuredDrive] = []
        told = self._progress is not no_progress
        expected, read = expected_rows(self._stream.file) if told else 0, 0
        for piece in self._stream.pieces():
            rows = self._stream.checker.rows
            if expected:
                self._progress(rows - read, max(expected, rows))
            read = rows
            refused.add(piece.refused)
            for drive in piece.drives:
                waiting.append(drive)
                longest = self._result.longest
                if longest is None or drive.ticks.size > longest.ticks.size:
                    self._result.longest = drive
                if sum(one.ticks.size for one in waiting) >= FILE_ROWS:
                    self._pass_on_drives(waiting, last=False)
                    waiting = []
        self._pass_on_drives(waiting, last=True)
        tables = refused.tables()
        table = next(tables, None)
        while table is not None:
            kept, vehicles = keep_refused(table, self._audit, self._result.left_out)
            self._result.vehicles |= vehicles
            table = next(tables, None)
            if kept.num_rows:
                self._pass_on("quarantine", [kept], last=table is None)

    def _pass_on_drives(self, drives: list[MeasuredDrive], *, last: bool) -> None:
        """Pass on the rows of drives that may land."""
        if not drives:
            return
        kept = keep_drives(sorted(drives, key=lambda drive: drive.drive_id), self._audit)
        self._result.vehicles |= kept.vehicles
        self._result.left_out |= kept.left_out
        self._result.ticks += sum(drive.ticks.size for drive in kept.drives)
        if kept.drives:
            self._pass_on("logs", kept.drives, last=last)

    def _pass_on(self, name: TableName, rows: Rows, *, last: bool) -> None:
        if name not in self._missing:
            return
        if last:
            self._result.rest[name] = rows
        else:
            self._large[name].write(
                f"measured-{self._stream.digest[:24]}-{next(self._names)}",
                partial(as_table, rows, self._stream.mapping),
            )


def as_table(rows: Rows, mapping: Mapping) -> pa.Table:
    """Return rows in one table."""
    tables = [one for one in rows if isinstance(one, pa.Table)]
    if tables:
        return pa.concat_tables(tables).unify_dictionaries()
    return log_table([one for one in rows if isinstance(one, MeasuredDrive)], mapping)


def _by_day(rows: pa.Table) -> dict[Any, pa.Table]:
    days = rows["day"].unique().to_pylist()
    if len(days) == 1:
        return {days[0]: rows}
    return {day: rows.filter(pc.equal(rows["day"], pa.scalar(day, pa.date32()))) for day in days}
