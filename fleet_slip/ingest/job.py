"""Brings measured logs into the warehouse; the same file through the same mapping lands once."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
from deltalake.transaction import AddAction

from fleet_slip.compute.tasks import run_tasks
from fleet_slip.delta import Change, Table, Unit, retry_conflicts
from fleet_slip.ingest.forgotten import without_forgotten
from fleet_slip.ingest.look_alikes import find_vehicles_like
from fleet_slip.ingest.mapping import Mapping
from fleet_slip.ingest.measured import IngestCounts, MeasuredLog, read_measured
from fleet_slip.warehouse.audit import Audit
from fleet_slip.warehouse.tables import Warehouse


@dataclass(frozen=True)
class IngestReport:
    """What became of one file."""

    file: str
    new: bool
    counts: IngestCounts
    look_alikes: tuple[tuple[str, ...], ...] = ()
    """Names that differ only in their Unicode form: in the file, or of cars in the logs."""
    drives_forgotten: int = 0
    """Drives that were left out: of cars that were forgotten, or forgotten themselves."""

    def as_dict(self) -> dict[str, Any]:
        """Return what `ingest --json` prints."""
        return {
            "file": self.file,
            "new": self.new,
            "rows_read": self.counts.rows_read,
            "rows_left_out": self.counts.rows_left_out,
            "rows_kept": self.counts.rows_kept,
            "rows_quarantined": sum(self.counts.quarantined.values()),
            "quarantined": self.counts.quarantined,
            "drives": self.counts.drives,
            "drives_forgotten": self.drives_forgotten,
            "drives_resampled": self.counts.drives_resampled,
            "ticks": self.counts.ticks,
            "look_alikes": self.look_alikes,
        }


@dataclass(frozen=True)
class _Written:
    """What one file became: data files that are not committed yet, none if it has landed before.

    Attributes:
        vehicles, drives: which the data files have.
        left_out: drives of cars that were forgotten, or that were themselves.
    """

    digest: str
    counts: IngestCounts
    look_alikes: tuple[tuple[str, ...], ...] = ()
    vehicles: frozenset[str] = frozenset()
    drives: frozenset[str] = frozenset()
    left_out: int = 0
    quarantine: tuple[AddAction, ...] = ()
    logs: tuple[AddAction, ...] = ()

    @property
    def unit(self) -> Unit:
        return Unit(f"ingest/{self.digest}", 1)


def ingest_file(warehouse: Warehouse, file: Path, mapping: Mapping) -> IngestReport:
    """Read a measured log and commit its drives, and its quarantined rows before them.

    Raises `InputError` or `ConfigError` for a file or mapping that is not usable; then nothing is
    written.
    """
    return next(ingest_files(warehouse, [file], mapping))


def ingest_files(
    warehouse: Warehouse, files: Iterable[Path], mapping: Mapping, executor: Executor | None = None
) -> Iterator[IngestReport]:
    """Ingest files, and yield a report of each as it is committed.

    With an executor they are read and written by its workers, in any order. Raises like
    `ingest_file`, and `ClusterError` at the end for files that workers died of.
    """
    for file, written in run_tasks(executor, partial(_write, warehouse, mapping), files, str):
        # Not the file's name: it may name a car, and the Delta log outlives what is forgotten.
        note = {"job": "ingest", "mapping": mapping.name, "digest": written.digest}
        landing = _Landing(warehouse, partial(_write, warehouse, mapping, file), written, note)
        landing.commit(warehouse.quarantine)
        new = landing.commit(warehouse.logs)
        landed = landing.written
        vehicles = find_vehicles_like(warehouse, landed.vehicles) if new else ()
        look_alikes = tuple(sorted({*landed.look_alikes, *vehicles}))
        yield IngestReport(str(file), new, landed.counts, look_alikes, landed.left_out)


def _write(warehouse: Warehouse, mapping: Mapping, file: Path) -> _Written:
    log = read_measured(file, mapping)
    written = _Written(log.digest, log.counts, log.look_alikes)
    if warehouse.logs.snapshot().landed(written.unit.name) is not None:
        return written
    kept = without_forgotten(log, Audit(warehouse.root))
    quarantine = {None: kept.quarantine} if kept.quarantine.num_rows else {}
    return replace(
        written,
        vehicles=kept.vehicles,
        drives=kept.drives,
        left_out=kept.left_out,
        counts=replace(
            log.counts, drives=log.counts.drives - kept.left_out, ticks=kept.logs.num_rows
        ),
        quarantine=_write_parts(warehouse.quarantine, quarantine, log),
        logs=_write_parts(warehouse.logs, _by_day(kept.logs), log),
    )


def _by_day(rows: pa.Table) -> dict[Any, pa.Table]:
    days = rows["day"].unique().to_pylist()
    return {day: rows.filter(pc.equal(rows["day"], pa.scalar(day, pa.date32()))) for day in days}


def _write_parts(
    table: Table, parts: dict[Any, pa.Table], log: MeasuredLog
) -> tuple[AddAction, ...]:
    name = f"measured-{log.digest[:24]}"
    return tuple(table.write_file(name, rows, day) for day, rows in parts.items())


class _Landing:
    """Commits what was written of a file, without what was forgotten until then."""

    def __init__(
        self,
        warehouse: Warehouse,
        write: Callable[[], _Written],
        written: _Written,
        note: dict[str, str],
    ) -> None:
        self._warehouse, self._write, self._note = warehouse, write, note
        self.written = written

    def commit(self, table: Table) -> bool:
        """Commit a table's files as one; False if there are none, or the unit landed before."""
        return retry_conflicts(lambda: self._attempt(table))

    def _attempt(self, table: Table) -> bool:
        snapshot = table.snapshot()
        # Asked after the snapshot: who forgets a car from now on makes this commit a conflict.
        audit = Audit(self._warehouse.root)
        while audit.barred(self.written.vehicles, self.written.drives):
            self._discard(self._warehouse.quarantine, self._warehouse.logs)
            self.written = self._write()
        unit = self.written.unit
        if snapshot.landed(unit.name) is not None:
            self._discard(table)
        actions = self._files(table)
        if not actions:
            return False
        snapshot.commit(Change(add=actions, units=[unit], note=self._note))
        return True

    def _files(self, table: Table) -> tuple[AddAction, ...]:
        return self.written.logs if table is self._warehouse.logs else self.written.quarantine

    def _discard(self, *tables: Table) -> None:
        for table in tables:
            table.discard(self._files(table))
            if table is self._warehouse.logs:
                self.written = replace(self.written, logs=())
            else:
                self.written = replace(self.written, quarantine=())
