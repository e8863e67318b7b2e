"""The way of a batch of measured files into the warehouse, from an open file to the commit.

`write_batch` goes through the files of a batch, `_write_file` through the rows of one: what was
forgotten is left out, drives and refused rows become data files. `landing.committing` commits them.
"""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from itertools import chain, count, pairwise

import polars as pl
import pyarrow as pa

from fleet_slip.delta import Table
from fleet_slip.errors import InputError
from fleet_slip.ingest.drafting.preview import signals_of
from fleet_slip.ingest.drives.file_totals import IngestCounts
from fleet_slip.ingest.drives.measured_drives import MeasuredDrive, drive_id
from fleet_slip.ingest.drives.stream import MeasuredStream, open_measured
from fleet_slip.ingest.drives.suspicion import Suspicion, find_suspicions
from fleet_slip.ingest.landing import data_files
from fleet_slip.ingest.landing.allowed_rows import car_of, keep_drives, keep_refused, names_in
from fleet_slip.ingest.landing.data_files import DataFiles, Part, Rows, TableName, digest_of
from fleet_slip.ingest.landing.marks import Origin, mark_drive, mark_file
from fleet_slip.ingest.landing.same_recordings import (
    RecordingInLogs,
    Replace,
    SameRecordings,
    let_return,
)
from fleet_slip.ingest.logs.log_files import LocalCopies, Log
from fleet_slip.ingest.logs.spool import Spool
from fleet_slip.ingest.mapping.mapping import Mapping
from fleet_slip.progress import Progress, no_progress
from fleet_slip.warehouse.audit import Audit
from fleet_slip.warehouse.tables import QUARANTINE_SCHEMA, Warehouse


@dataclass(frozen=True)
class AskedFile:
    """A file to ingest, and the digest of what this very path had when it was ingested before."""

    file: Log
    earlier: str | None = None


@dataclass
class FileOutcome:
    """What one file became.

    Attributes:
        is_new: whether its drives had not landed.
        vehicles: the cars of what lands; `left_out` are drives that do not, as forgotten.
    """

    file: Log
    digest: str
    is_new: bool
    counts: IngestCounts
    look_alikes: tuple[tuple[str, ...], ...]
    suspicions: tuple[Suspicion, ...] = ()
    vehicles: set[str] = field(default_factory=set)
    left_out: int = 0
    marks: dict[str, int] = field(default_factory=dict)
    found: RecordingInLogs = field(default_factory=RecordingInLogs)


@dataclass(frozen=True)
class WrittenBatch:
    """What a batch of files became; `forgotten` are the entries that its drives were judged by."""

    outcomes: tuple[FileOutcome, ...]
    failures: tuple[InputError, ...]
    forgotten: frozenset[int]
    parts: dict[TableName, Part]

    @property
    def replaced(self) -> frozenset[Origin]:
        """What gives way to it."""
        return frozenset[Origin]().union(*(one.found.replaced for one in self.outcomes))

    @property
    def digest(self) -> str:
        """Digest of what landed first time, of all files together."""
        return digest_of([outcome.digest for outcome in self.outcomes])


def write_batch(
    warehouse: Warehouse,
    mapping: Mapping,
    files: tuple[AskedFile, ...],
    progress: Progress = no_progress,
    replace: Replace = "no",
) -> WrittenBatch:
    """Read files, and write their rows together: one data file a day. Nothing is committed.

    A file that cannot be used is a failure of its own, and nothing of it is written. What landed
    before is not written again, nor a recording that is there, unless that is to give way. The
    longest drive of what is new is looked at: one of a batch, so that a folder of small files is
    not held up. `progress` counts bytes of each file.
    """
    audit = Audit(warehouse.root)
    forgotten = audit.begun()
    longest: tuple[FileOutcome, MeasuredDrive] | None = None
    outcomes: list[FileOutcome] = []
    failures: list[InputError] = []
    snapshots = {name: table.snapshot() for name, table in tables_of(warehouse).items()}
    landed = {name: one.landed_among(len(files)) for name, one in snapshots.items()}
    same = SameRecordings(warehouse, snapshots["logs"], mapping.name, replace)
    copies = LocalCopies(asked.file for asked in files)
    with copies, ThreadPoolExecutor(data_files.WRITERS) as threads:
        tables = {
            name: DataFiles(table, mapping, threads, partial(_has_landed, landed, name))
            for name, table in tables_of(warehouse).items()
        }
        for asked in files:
            try:
                with (
                    copies.of(asked.file) as file,
                    open_measured(file, mapping, progress) as stream,
                ):
                    if not tables["logs"].lacks(stream.digest) and let_return(
                        warehouse, stream.digest, drive_id(stream.prefix, 0)
                    ):
                        for name, stored in tables_of(warehouse).items():
                            landed[name] = stored.snapshot().landed_among(len(files))
                    outcome, drive, rest = _write_file(stream, asked.file, tables, audit)
                    if outcome.is_new:
                        earlier = asked.earlier
                        if earlier and not landed["logs"](data_files.unit_of(earlier).name):
                            earlier = None
                        outcome.found = same.judge(
                            asked.file, stream.name, stream.digest, outcome.marks, earlier
                        )
            except BaseException as error:
                for table in tables.values():
                    table.discard_file()
                if not isinstance(error, InputError):
                    raise
                failures.append(error)
                continue
            for name, table in tables.items():
                table.end_file(outcome.digest, rest.get(name, ()))
            outcomes.append(outcome)
            if drive and (longest is None or drive.ticks.size > longest[1].ticks.size):
                longest = outcome, drive
        for table in tables.values():
            table.write_waiting()
        if longest is not None:
            outcome, drive = longest
            outcome.suspicions += tuple(find_suspicions(signals_of(drive)))
        parts = {name: table.finish() for name, table in tables.items()}
    return WrittenBatch(tuple(outcomes), tuple(failures), forgotten, parts)


def _has_landed(landed: dict[TableName, Callable[[str], bool]], name: TableName, unit: str) -> bool:
    return landed[name](unit)


def _write_file(
    stream: MeasuredStream,
    file: Log,
    tables: dict[TableName, DataFiles],
    audit: Audit,
) -> tuple[FileOutcome, MeasuredDrive | None, dict[TableName, Rows]]:
    """Read a file, write all but its last rows; return what it became, its longest drive, these."""
    is_new = tables["logs"].lacks(stream.digest)
    lacking = {n for n, table in tables.items() if is_new and table.lacks(stream.digest)}
    names = (f"measured-{stream.digest[:24]}-{number}" for number in count(1))
    refused, rest = _RefusedRows(stream), dict[TableName, Rows]()
    longest: MeasuredDrive | None = None
    left_out, vehicles, ticks = set[str](), set[str](), 0
    marks = mark_file(stream.digest, stream.content)
    for drives in _groups(_read_drives(stream, refused)):
        longest = max([*([longest] if longest else []), *drives], key=lambda one: one.ticks.size)
        kept = keep_drives(sorted(drives, key=lambda drive: drive.drive_id), audit)
        left_out |= {drive.drive_id for drive in drives} - {drive.drive_id for drive in kept}
        vehicles |= set(map(car_of, kept))
        ticks += _rows_of(kept)
        for drive in kept if is_new else ():
            marks |= mark_drive(drive.drive_id, drive.counts_digest)
        if not kept or "logs" not in lacking:
            continue
        if _rows_of(drives) >= data_files.FILE_ROWS:
            tables["logs"].add(next(names), kept)
        else:
            rest["logs"] = kept
    for table, following in pairwise(chain(refused.tables(), [None])):
        allowed = keep_refused(table, audit, left_out)
        vehicles |= names_in(allowed, "vehicle_id")
        if not allowed.num_rows or "quarantine" not in lacking:
            continue
        if following is not None:
            tables["quarantine"].add(next(names), [allowed])
        else:
            rest["quarantine"] = [allowed]
    counts = stream.counts()
    outcome = FileOutcome(file, stream.digest, is_new, counts, stream.look_alikes())
    if not is_new:
        return outcome, None, {}
    outcome.counts = counts.without(len(left_out), ticks)
    outcome.vehicles, outcome.left_out = vehicles, len(left_out)
    outcome.suspicions = stream.suspicions()
    if ticks:
        outcome.marks = marks
    return outcome, longest, rest


def _read_drives(stream: MeasuredStream, refused: "_RefusedRows") -> Iterator[MeasuredDrive]:
    """Yield the drives of a file; keep its refused rows."""
    for piece in stream.pieces():
        refused.add(piece.refused)
        yield from piece.drives


def _groups(drives: Iterable[MeasuredDrive]) -> Iterator[list[MeasuredDrive]]:
    """Yield drives with as many rows as a data file has; the last ones may have fewer."""
    group: list[MeasuredDrive] = []
    for drive in drives:
        group.append(drive)
        if _rows_of(group) >= data_files.FILE_ROWS:
            yield group
            group = []
    if group:
        yield group


class _RefusedRows:
    """Rows for the quarantine, spooled until it is known whether their drive was forgotten."""

    def __init__(self, stream: MeasuredStream) -> None:
        self._stream, self._spool = stream, Spool()
        self._rows: list[pl.DataFrame] = []

    def add(self, rows: pl.DataFrame) -> None:
        if rows.height:
            self._rows.append(rows)
        if sum(one.height for one in self._rows) >= data_files.FILE_ROWS:
            sink = pa.BufferOutputStream()
            with pa.ipc.new_stream(sink, QUARANTINE_SCHEMA) as writer:
                writer.write_table(self._stream.quarantine_table(self._rows))
            self._spool.add("", sink.getvalue().to_pybytes())
            self._rows = []

    def tables(self) -> Iterator[pa.Table]:
        for piece in self._spool.read(""):
            yield pa.ipc.open_stream(piece).read_all()
        if self._rows:
            yield self._stream.quarantine_table(self._rows)


def tables_of(warehouse: Warehouse) -> dict[TableName, Table]:
    """Return the tables that files land in, in the order in which they are committed."""
    return {"quarantine": warehouse.quarantine, "logs": warehouse.logs}


def _rows_of(drives: Iterable[MeasuredDrive]) -> int:
    return sum(drive.ticks.size for drive in drives)
