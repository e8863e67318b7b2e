"""Brings measured logs into the warehouse; the same file through the same mapping lands once."""

from collections.abc import Iterable, Iterator, Sequence
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
from fleet_slip.ingest.look_alikes import find_vehicles_like
from fleet_slip.ingest.mapping import Mapping
from fleet_slip.ingest.measured import IngestCounts, MeasuredLog, read_measured
from fleet_slip.warehouse.tables import Warehouse


@dataclass(frozen=True)
class IngestReport:
    """What became of one file."""

    file: str
    new: bool
    counts: IngestCounts
    look_alikes: tuple[tuple[str, ...], ...] = ()
    """Names that differ only in their Unicode form: in the file, or of cars in the logs."""

    def as_dict(self) -> dict[str, Any]:
        """Return what `ingest --json` prints."""
        return {
            "file": self.file,
            "new": self.new,
            "rows_read": self.counts.rows_read,
            "rows_kept": self.counts.rows_kept,
            "rows_quarantined": sum(self.counts.quarantined.values()),
            "quarantined": self.counts.quarantined,
            "drives": self.counts.drives,
            "drives_resampled": self.counts.drives_resampled,
            "ticks": self.counts.ticks,
            "look_alikes": self.look_alikes,
        }


@dataclass(frozen=True)
class _Written:
    """What one file became: data files that are not committed yet, none if it has landed before."""

    digest: str
    counts: IngestCounts
    look_alikes: tuple[tuple[str, ...], ...] = ()
    vehicles: tuple[str, ...] = ()
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
        _commit(warehouse.quarantine, written.quarantine, written.unit, note)
        new = _commit(warehouse.logs, written.logs, written.unit, note)
        vehicles = find_vehicles_like(warehouse, written.vehicles) if new else ()
        look_alikes = tuple(sorted({*written.look_alikes, *vehicles}))
        yield IngestReport(str(file), new, written.counts, look_alikes)


def _write(warehouse: Warehouse, mapping: Mapping, file: Path) -> _Written:
    log = read_measured(file, mapping)
    written = _Written(log.digest, log.counts, log.look_alikes)
    if warehouse.logs.snapshot().landed(written.unit.name) is not None:
        return written
    quarantine = {None: log.quarantine} if log.quarantine.num_rows else {}
    return replace(
        written,
        vehicles=tuple(log.drives["vehicle_id"].unique().to_pylist()),
        quarantine=_write_parts(warehouse.quarantine, quarantine, log),
        logs=_write_parts(warehouse.logs, _by_day(log.drives), log),
    )


def _by_day(rows: pa.Table) -> dict[Any, pa.Table]:
    days = rows["day"].unique().to_pylist()
    return {day: rows.filter(pc.equal(rows["day"], pa.scalar(day, pa.date32()))) for day in days}


def _write_parts(
    table: Table, parts: dict[Any, pa.Table], log: MeasuredLog
) -> tuple[AddAction, ...]:
    name = f"measured-{log.digest[:24]}"
    return tuple(table.write_file(name, rows, day) for day, rows in parts.items())


def _commit(table: Table, actions: Sequence[AddAction], unit: Unit, note: dict[str, str]) -> bool:
    """Commit files as one; False if there are none, or the unit has landed before."""
    change = Change(add=actions, units=[unit], note=note)

    def attempt() -> bool:
        snapshot = table.snapshot()
        if not actions or snapshot.landed(unit.name) is not None:
            return False
        snapshot.commit(change)
        return True

    return retry_conflicts(attempt)
