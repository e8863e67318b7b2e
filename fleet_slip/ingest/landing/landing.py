"""Writes what a batch of measured files became, and commits it as one."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from hashlib import sha256
from typing import Any

from deltalake.transaction import AddAction

from fleet_slip.delta import Change, Snapshot, Table, Unit, retry_conflicts
from fleet_slip.errors import InputError
from fleet_slip.ingest.drafting.preview import signals_of
from fleet_slip.ingest.drafting.suspicion import Suspicion, find_suspicions
from fleet_slip.ingest.drives.measured_drives import MeasuredDrive
from fleet_slip.ingest.drives.stream import MeasuredStream, open_measured
from fleet_slip.ingest.drives.totals import IngestCounts
from fleet_slip.ingest.formats.columns import shown
from fleet_slip.ingest.landing.local_copies import LocalCopies
from fleet_slip.ingest.landing.log_files import Log
from fleet_slip.ingest.landing.writing import (
    FILE_ROWS,
    WRITERS,
    DataFiles,
    FileWriter,
    Rows,
    TableName,
    WrittenFile,
    as_table,
)
from fleet_slip.ingest.mapping.mapping import Mapping
from fleet_slip.progress import Progress, no_progress
from fleet_slip.warehouse.audit import Audit
from fleet_slip.warehouse.tables import Warehouse


@dataclass(frozen=True)
class AskedFile:
    """A file to ingest, and the digest of what this very path had when it was ingested before."""

    file: Log
    earlier: str | None = None


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


@dataclass(frozen=True)
class Part:
    """Data files of one table that are not committed yet, and the units that land with them."""

    units: tuple[Unit, ...] = ()
    files: tuple[AddAction, ...] = ()


@dataclass(frozen=True)
class WrittenBatch:
    """What a batch of files became; `forgotten` are the entries that its drives were judged by."""

    outcomes: tuple[FileOutcome, ...]
    failures: tuple[InputError, ...]
    forgotten: frozenset[int]
    quarantine: Part = Part()
    logs: Part = Part()

    @property
    def digest(self) -> str:
        """Digest of what landed first time, of all files together."""
        return _digest([outcome.digest for outcome in self.outcomes])


def unit_of(digest: str) -> Unit:
    """Return the unit of work that a file's content is."""
    return Unit(f"ingest/{digest}", 1)


def write_batch(
    warehouse: Warehouse,
    mapping: Mapping,
    files: tuple[AskedFile, ...],
    progress: Progress = no_progress,
) -> WrittenBatch:
    """Read files, and write their rows together: one data file a day. Nothing is committed.

    A file that cannot be used is a failure of its own, and nothing of it is written. What landed
    before is not written again. The longest drive of what is new is looked at: one of a batch, so
    that a folder of small files is not held up. `progress` counts rows of each file.
    """
    forgotten = Audit(warehouse.root).begun()
    longest: tuple[int, MeasuredDrive] | None = None
    outcomes: list[FileOutcome] = []
    failures: list[InputError] = []
    tables: tuple[tuple[TableName, Table, bool], ...] = (
        ("quarantine", warehouse.quarantine, False),
        ("logs", warehouse.logs, True),
    )
    landed = {name: table.snapshot().landed_among(len(files)) for name, table, _ in tables}
    copies = LocalCopies(asked.file for asked in files)
    with copies, ThreadPoolExecutor(WRITERS) as threads:
        parts: dict[TableName, _PartInTheMaking] = {
            name: _PartInTheMaking(DataFiles(table, threads, by_day=by_day), mapping)
            for name, table, by_day in tables
        }
        for asked in files:
            try:
                with copies.of(asked.file) as file, open_measured(file, mapping) as stream:
                    _require_not_grown(asked, stream.digest, landed["logs"], mapping)
                    missing = [
                        name
                        for name, part in parts.items()
                        if not part.has(stream.digest)
                        and not landed[name](unit_of(stream.digest).name)
                    ]
                    missing = missing if "logs" in missing else []
                    written = FileWriter(warehouse, stream, missing, threads, progress).write()
            except InputError as error:
                failures.append(error)
                continue
            outcomes.append(_outcome(asked.file, stream, written, new="logs" in missing))
            drive = written.longest if missing else None
            if drive and (longest is None or drive.ticks.size > longest[1].ticks.size):
                longest = len(outcomes) - 1, drive
            for name in missing:
                parts[name].add(stream.digest, written.rest.get(name, ()), written.files[name])
        for part in parts.values():
            part.write_rest()
        if longest is not None:
            number, drive = longest
            found = tuple(find_suspicions(signals_of(drive)))
            found = (*outcomes[number].suspicions, *found)
            outcomes[number] = replace(outcomes[number], suspicions=found)
        done = {name: part.finish() for name, part in parts.items()}
    return WrittenBatch(
        tuple(outcomes), tuple(failures), forgotten, done["quarantine"], done["logs"]
    )


class _PartInTheMaking:
    """The rows of small files, which are written together, and data files of large ones."""

    def __init__(self, together: DataFiles, mapping: Mapping) -> None:
        self._together, self._mapping = together, mapping
        self._rest: dict[str, Rows] = {}
        self._number_of_rows = 0
        self._digests: list[str] = []
        self._files: list[AddAction] = []

    def has(self, digest: str) -> bool:
        return digest in self._digests

    def add(self, digest: str, rest: Rows, files: tuple[AddAction, ...]) -> None:
        if rest:
            self._rest[digest] = rest
            self._number_of_rows += sum(one.num_rows for one in rest)
        if rest or files:
            self._digests.append(digest)
        self._files += files
        if self._number_of_rows >= FILE_ROWS:
            self.write_rest()

    def finish(self) -> Part:
        units = tuple(map(unit_of, sorted(self._digests)))
        return Part(units, (*self._files, *self._together.files()))

    def write_rest(self) -> None:
        """Write the rows of files in the order of their digests: so drives are in that of names."""
        if not self._rest:
            return
        digests = sorted(self._rest)
        rows: Any = [one for digest in digests for one in self._rest[digest]]
        name = f"measured-{_digest(digests)[:24]}"
        self._together.write(name, partial(as_table, rows, self._mapping))
        self._rest, self._number_of_rows = {}, 0


def _require_not_grown(
    asked: AskedFile, digest: str, landed: Callable[[str], bool], mapping: Mapping
) -> None:
    """Raise `InputError` for a file whose earlier content is in the logs: it would count twice."""
    earlier = asked.earlier
    if earlier is None or earlier == digest or not landed(unit_of(earlier).name):
        return
    raise InputError(
        f"{shown(asked.file)}: it has changed since it was ingested, and its drives would count "
        f"twice. Forget the old ones, {mapping.name}-{earlier[:12]}-1 and those that follow, with "
        "fleet-slip forget --drive; or give the changed file another name."
    )


def _outcome(file: Log, stream: MeasuredStream, written: WrittenFile, *, new: bool) -> FileOutcome:
    counts = stream.counts()
    outcome = FileOutcome(file, stream.digest, counts, stream.look_alikes())
    if not new:
        return outcome
    return replace(
        outcome,
        vehicles=frozenset(written.vehicles),
        left_out=len(written.left_out),
        suspicions=stream.suspicions(),
        counts=replace(counts, drives=counts.drives - len(written.left_out), ticks=written.ticks),
    )


def _digest(digests: list[str]) -> str:
    return digests[0] if len(digests) == 1 else sha256("".join(digests).encode()).hexdigest()


class Landing:
    """Commits what was written of a batch, without what was forgotten until then."""

    def __init__(
        self,
        warehouse: Warehouse,
        write: Callable[[], WrittenBatch],
        written: WrittenBatch,
        note: dict[str, str],
    ) -> None:
        """Take what was written, what writes it again, and what the commit notes."""
        self._warehouse, self._write, self._note = warehouse, write, note
        self.written = written

    def commit(self, name: TableName) -> frozenset[str]:
        """Commit a table's files as one; return the units that landed now."""
        return retry_conflicts(lambda: self._attempt(name))

    def _attempt(self, name: TableName) -> frozenset[str]:
        table = self._table(name)
        snapshot = table.snapshot()
        # Asked after the snapshot: who forgets a car from now on makes this commit a conflict.
        audit = Audit(self._warehouse.root)
        while audit.begun() != self.written.forgotten or self._has_landed(snapshot, name):
            self._warehouse.quarantine.discard(self.written.quarantine.files)
            self._warehouse.logs.discard(self.written.logs.files)
            self.written = self._write()
            snapshot = table.snapshot()
        part = self._part(name)
        if not part.files:
            return frozenset()
        snapshot.commit(Change(add=part.files, units=part.units, note=self._note))
        return frozenset(unit.name for unit in part.units)

    def _has_landed(self, snapshot: Snapshot, name: TableName) -> bool:
        units = self._part(name).units
        landed = snapshot.landed_among(len(units))
        return any(landed(unit.name) for unit in units)

    def _table(self, name: TableName) -> Table:
        return self._warehouse.logs if name == "logs" else self._warehouse.quarantine

    def _part(self, name: TableName) -> Part:
        return self.written.logs if name == "logs" else self.written.quarantine
