"""Writes what a batch of measured files became, and commits it as one."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal, TypeAlias

import pyarrow as pa
import pyarrow.compute as pc
from deltalake.transaction import AddAction

from fleet_slip.delta import Change, Snapshot, Table, Unit, retry_conflicts
from fleet_slip.errors import InputError
from fleet_slip.ingest.columns import shown
from fleet_slip.ingest.forgotten import KeptRows, without_forgotten
from fleet_slip.ingest.mapping import Mapping
from fleet_slip.ingest.measured import IngestCounts, read_measured
from fleet_slip.warehouse.audit import Audit
from fleet_slip.warehouse.tables import Warehouse

TableName: TypeAlias = Literal["quarantine", "logs"]


@dataclass(frozen=True)
class AskedFile:
    """A file to ingest, and the digest of what this very path had when it was ingested before."""

    file: Path
    earlier: str | None = None


@dataclass(frozen=True)
class FileOutcome:
    """What one file became: its drives, those left out as forgotten, and whether it had landed."""

    file: Path
    digest: str
    counts: IngestCounts
    look_alikes: tuple[tuple[str, ...], ...]
    vehicles: frozenset[str] = frozenset()
    drives: frozenset[str] = frozenset()
    left_out: int = 0


@dataclass(frozen=True)
class Part:
    """Data files of one table that are not committed yet, and the units that land with them."""

    units: tuple[Unit, ...] = ()
    files: tuple[AddAction, ...] = ()


@dataclass(frozen=True)
class WrittenBatch:
    """What a batch of files became."""

    outcomes: tuple[FileOutcome, ...]
    failures: tuple[InputError, ...]
    quarantine: Part = Part()
    logs: Part = Part()

    @property
    def digest(self) -> str:
        """Digest of what landed first time, of all files together."""
        return _digest([outcome.digest for outcome in self.outcomes])

    @property
    def vehicles(self) -> frozenset[str]:
        """Cars that the data files have."""
        return frozenset().union(*(outcome.vehicles for outcome in self.outcomes))

    @property
    def drives(self) -> frozenset[str]:
        """Drives that the data files have."""
        return frozenset().union(*(outcome.drives for outcome in self.outcomes))


def unit_of(digest: str) -> Unit:
    """Return the unit of work that a file's content is."""
    return Unit(f"ingest/{digest}", 1)


def write_batch(
    warehouse: Warehouse, mapping: Mapping, files: tuple[AskedFile, ...]
) -> WrittenBatch:
    """Read files, and write their rows together: one data file a day. Nothing is committed.

    A file that cannot be used is a failure of its own, and nothing of it is written. What landed
    before is not written again.
    """
    outcomes: list[FileOutcome] = []
    failures: list[InputError] = []
    rows: dict[TableName, dict[str, pa.Table]] = {"quarantine": {}, "logs": {}}
    snapshots: dict[TableName, Snapshot] = {
        "quarantine": warehouse.quarantine.snapshot(),
        "logs": warehouse.logs.snapshot(),
    }
    for asked in files:
        try:
            log = read_measured(asked.file, mapping)
            _require_not_grown(asked, log.digest, snapshots["logs"], mapping)
        except InputError as error:
            failures.append(error)
            continue
        outcome = FileOutcome(asked.file, log.digest, log.counts, log.look_alikes)
        if log.digest not in rows["logs"] and not _landed(snapshots["logs"], log.digest):
            kept = without_forgotten(log, Audit(warehouse.root))
            outcome = _of_kept(outcome, kept)
            tables: dict[TableName, pa.Table] = {"quarantine": kept.quarantine, "logs": kept.logs}
            for name, table in tables.items():
                if table.num_rows and not _landed(snapshots[name], log.digest):
                    rows[name][log.digest] = table
        outcomes.append(outcome)
    return WrittenBatch(
        tuple(outcomes),
        tuple(failures),
        _write(warehouse.quarantine, rows["quarantine"], by_day=False),
        _write(warehouse.logs, rows["logs"], by_day=True),
    )


def _require_not_grown(asked: AskedFile, digest: str, logs: Snapshot, mapping: Mapping) -> None:
    """Raise `InputError` for a file whose earlier content is in the logs: it would count twice."""
    earlier = asked.earlier
    if earlier is None or earlier == digest or not _landed(logs, earlier):
        return
    raise InputError(
        f"{shown(asked.file)}: it has changed since it was ingested, and its drives would count "
        f"twice. Forget the old ones, {mapping.name}-{earlier[:12]}-1 and those that follow, with "
        "fleet-slip forget --drive; or give the changed file another name."
    )


def _of_kept(outcome: FileOutcome, kept: KeptRows) -> FileOutcome:
    drives = outcome.counts.drives - kept.left_out
    return replace(
        outcome,
        vehicles=kept.vehicles,
        drives=kept.drives,
        left_out=kept.left_out,
        counts=replace(outcome.counts, drives=drives, ticks=kept.logs.num_rows),
    )


def _landed(snapshot: Snapshot, digest: str) -> bool:
    return snapshot.landed(unit_of(digest).name) is not None


def _write(table: Table, rows: dict[str, pa.Table], *, by_day: bool) -> Part:
    """Write the rows of files, in the order of their digests: so drives are in that of names."""
    if not rows:
        return Part()
    digests = sorted(rows)
    whole = pa.concat_tables(rows[digest] for digest in digests).unify_dictionaries()
    parts = _by_day(whole) if by_day else {None: whole}
    name = f"measured-{_digest(digests)[:24]}"
    files = tuple(table.write_file(name, part, day) for day, part in parts.items())
    return Part(tuple(map(unit_of, digests)), files)


def _digest(digests: list[str]) -> str:
    return digests[0] if len(digests) == 1 else sha256("".join(digests).encode()).hexdigest()


def _by_day(rows: pa.Table) -> dict[Any, pa.Table]:
    days = rows["day"].unique().to_pylist()
    return {day: rows.filter(pc.equal(rows["day"], pa.scalar(day, pa.date32()))) for day in days}


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
        while audit.barred(self.written.vehicles, self.written.drives) or any(
            snapshot.landed(unit.name) is not None for unit in self._part(name).units
        ):
            self._warehouse.quarantine.discard(self.written.quarantine.files)
            self._warehouse.logs.discard(self.written.logs.files)
            self.written = self._write()
            snapshot = table.snapshot()
        part = self._part(name)
        if not part.files:
            return frozenset()
        snapshot.commit(Change(add=part.files, units=part.units, note=self._note))
        return frozenset(unit.name for unit in part.units)

    def _table(self, name: TableName) -> Table:
        return self._warehouse.logs if name == "logs" else self._warehouse.quarantine

    def _part(self, name: TableName) -> Part:
        return self.written.logs if name == "logs" else self.written.quarantine
