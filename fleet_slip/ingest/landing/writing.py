"""Reads a measured file piece by piece, and passes on what may land to data files."""

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import count
from tempfile import TemporaryFile
from typing import IO, Self

import polars as pl
import pyarrow as pa

from fleet_slip.ingest.drives.measured_drives import IngestCounts, MeasuredDrive
from fleet_slip.ingest.drives.stream import MeasuredStream
from fleet_slip.ingest.drives.suspicion import Suspicion
from fleet_slip.ingest.landing import data_files
from fleet_slip.ingest.landing.data_files import DataFiles, Rows, TableName, Writing
from fleet_slip.ingest.landing.expected_rows import expected_rows
from fleet_slip.ingest.landing.forgotten import keep_drives, keep_refused
from fleet_slip.ingest.logs.log_files import Log
from fleet_slip.progress import Progress, no_progress
from fleet_slip.warehouse.audit import Audit
from fleet_slip.warehouse.tables import QUARANTINE_SCHEMA


@dataclass(frozen=True)
class FileOutcome:
    """What one file became: its drives, those left out as forgotten, and whether it had landed."""

    file: Log
    digest: str
    counts: IngestCounts
    look_alikes: tuple[tuple[str, ...], ...]
    vehicles: frozenset[str] = frozenset()
    left_out: int = 0
    suspicions: tuple[Suspicion, ...] = ()


class FileWriter:
    """Writes one measured file, those tables of it that have not landed.

    When it is left, what it wrote is to land with its batch; after an error nothing of it is there.

    Attributes:
        is_new: whether its drives have not landed.
        longest: the drive with the most ticks, if there is one.
    """

    def __init__(
        self,
        tables: Mapping[TableName, DataFiles],
        audit: Audit,
        progress: Progress = no_progress,
    ) -> None:
        """Take the data files of its batch, and what was forgotten.

        `progress` counts rows of the file, if it is known about how many it has.
        """
        self._tables, self._audit, self._progress = tables, audit, progress
        self._begun: dict[TableName, list[Writing]] = {name: [] for name in tables}
        self._rest: dict[TableName, Rows] = {}
        self._names = count(1)
        self._ticks = 0
        self._vehicles: set[str] = set()
        self._left_out: set[str] = set()
        self.is_new = False
        self.longest: MeasuredDrive | None = None

    def __enter__(self) -> Self:
        """Return it."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Pass on what was written, or delete it."""
        for name, files in self._tables.items():
            if kind is None:
                files.take(self._stream.digest, self._begun[name], self._rest.get(name, ()))
            else:
                files.discard(self._begun[name])

    def outcome(self, file: Log) -> FileOutcome:
        """Return what the file became, by the name that a person knows it by."""
        counts = self._stream.counts()
        outcome = FileOutcome(file, self._stream.digest, counts, self._stream.look_alikes())
        if not self.is_new:
            return outcome
        drives = counts.drives - len(self._left_out)
        return replace(
            outcome,
            counts=replace(counts, drives=drives, ticks=self._ticks),
            vehicles=frozenset(self._vehicles),
            left_out=len(self._left_out),
            suspicions=self._stream.suspicions(),
        )

    def read(self, stream: MeasuredStream) -> None:
        """Read an open file, and write all but its last rows. Raises `InputError`."""
        self._stream, digest = stream, stream.digest
        self.is_new = self._tables["logs"].lacks(digest)
        self._lacking = {
            n for n, files in self._tables.items() if self.is_new and files.lacks(digest)
        }
        refused = _RefusedRows(self._stream)
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
                if self.longest is None or drive.ticks.size > self.longest.ticks.size:
                    self.longest = drive
                if sum(one.ticks.size for one in waiting) >= data_files.FILE_ROWS:
                    self._pass_on_drives(waiting, last=False)
                    waiting = []
        self._pass_on_drives(waiting, last=True)
        tables = refused.tables()
        table = next(tables, None)
        while table is not None:
            kept, vehicles = keep_refused(table, self._audit, self._left_out)
            self._vehicles |= vehicles
            table = next(tables, None)
            if kept.num_rows:
                self._pass_on("quarantine", [kept], last=table is None)

    def _pass_on_drives(self, drives: list[MeasuredDrive], *, last: bool) -> None:
        """Pass on the rows of drives that may land."""
        if not drives:
            return
        kept = keep_drives(sorted(drives, key=lambda drive: drive.drive_id), self._audit)
        self._vehicles |= kept.vehicles
        self._left_out |= kept.left_out
        self._ticks += sum(drive.ticks.size for drive in kept.drives)
        if kept.drives:
            self._pass_on("logs", kept.drives, last=last)

    def _pass_on(self, name: TableName, rows: Rows, *, last: bool) -> None:
        if name not in self._lacking:
            return
        if last:
            self._rest[name] = rows
        else:
            file = f"measured-{self._stream.digest[:24]}-{next(self._names)}"
            self._begun[name].append(self._tables[name].write(file, rows))


class _RefusedRows:
    """Rows for the quarantine until the end of their file; of many, most are in a temporary file.

    Only then is it known whether a drive that they are of was forgotten.
    """

    def __init__(self, stream: MeasuredStream) -> None:
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
        if self._number >= data_files.FILE_ROWS:
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
