"""Writes what a batch of measured files became, and commits it as one."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

from fleet_slip.delta import Change, Table, retry_conflicts
from fleet_slip.errors import InputError
from fleet_slip.ingest.drafting.preview import signals_of
from fleet_slip.ingest.drives.measured_drives import MeasuredDrive
from fleet_slip.ingest.drives.stream import open_measured
from fleet_slip.ingest.drives.suspicion import find_suspicions
from fleet_slip.ingest.landing.data_files import (
    WRITERS,
    DataFiles,
    Part,
    TableName,
    digest_of,
    unit_of,
)
from fleet_slip.ingest.landing.writing import FileOutcome, FileWriter
from fleet_slip.ingest.logs.log_files import LocalCopies, Log
from fleet_slip.ingest.mapping.mapping import Mapping
from fleet_slip.progress import Progress, no_progress
from fleet_slip.warehouse.audit import Audit
from fleet_slip.warehouse.tables import Warehouse
from fleet_slip.words import shown


@dataclass(frozen=True)
class AskedFile:
    """A file to ingest, and the digest of what this very path had when it was ingested before."""

    file: Log
    earlier: str | None = None


@dataclass(frozen=True)
class WrittenBatch:
    """What a batch of files became; `forgotten` are the entries that its drives were judged by."""

    outcomes: tuple[FileOutcome, ...]
    failures: tuple[InputError, ...]
    forgotten: frozenset[int]
    parts: dict[TableName, Part]

    @property
    def digest(self) -> str:
        """Digest of what landed first time, of all files together."""
        return digest_of([outcome.digest for outcome in self.outcomes])


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
    landed = {n: t.snapshot().landed_among(len(files)) for n, t in _tables(warehouse).items()}
    copies = LocalCopies(asked.file for asked in files)
    with copies, ThreadPoolExecutor(WRITERS) as threads:
        tables = {
            name: DataFiles(table, mapping, threads, landed[name])
            for name, table in _tables(warehouse).items()
        }
        for asked in files:
            try:
                with (
                    FileWriter(tables, Audit(warehouse.root), progress) as writer,
                    copies.of(asked.file) as file,
                    open_measured(file, mapping) as stream,
                ):
                    _require_not_grown(asked, stream.digest, landed["logs"], mapping)
                    writer.read(stream)
            except InputError as error:
                failures.append(error)
                continue
            drive = writer.longest if writer.is_new else None
            if drive and (longest is None or drive.ticks.size > longest[1].ticks.size):
                longest = len(outcomes), drive
            outcomes.append(writer.outcome(asked.file))
        for rows in tables.values():
            rows.write_waiting()
        if longest is not None:
            number, drive = longest
            found = (*outcomes[number].suspicions, *find_suspicions(signals_of(drive)))
            outcomes[number] = replace(outcomes[number], suspicions=found)
        parts = {name: rows.finish() for name, rows in tables.items()}
    return WrittenBatch(tuple(outcomes), tuple(failures), forgotten, parts)


def land_batch(
    warehouse: Warehouse,
    written: WrittenBatch,
    write: Callable[[], WrittenBatch],
    note: dict[str, str],
) -> tuple[WrittenBatch, frozenset[str]]:
    """Commit what was written of a batch; return it, and the units that are now in the logs.

    Where something was forgotten, or landed by another process, since it was written, `write`
    writes it again. Each table's files are one commit, with a note: refused rows, then drives.
    """
    tables = _tables(warehouse)

    def commit(name: TableName) -> frozenset[str]:
        nonlocal written
        snapshot = tables[name].snapshot()
        # Asked after the snapshot: who forgets a car from now on makes this commit a conflict.
        audit = Audit(warehouse.root)
        landed = snapshot.landed_among(len(written.parts[name].units))
        while audit.begun() != written.forgotten or any(
            landed(unit.name) for unit in written.parts[name].units
        ):
            for other, table in tables.items():
                table.discard(written.parts[other].files)
            written = write()
            snapshot = tables[name].snapshot()
            landed = snapshot.landed_among(len(written.parts[name].units))
        part = written.parts[name]
        if part.files:
            snapshot.commit(Change(add=part.files, units=part.units, note=note))
        return frozenset(unit.name for unit in part.units) if part.files else frozenset()

    retry_conflicts(lambda: commit("quarantine"))
    new = retry_conflicts(lambda: commit("logs"))
    return written, new


def _tables(warehouse: Warehouse) -> dict[TableName, Table]:
    return {"quarantine": warehouse.quarantine, "logs": warehouse.logs}


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
