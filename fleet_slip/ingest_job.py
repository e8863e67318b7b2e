"""Brings measured logs into the warehouse; the same file through the same mapping lands once."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.ingest.mapping import Mapping
from fleet_slip.ingest.measured import IngestCounts, MeasuredLog, read_measured
from fleet_slip.storage import Change, Table, Unit, retried
from fleet_slip.warehouse import Warehouse


@dataclass(frozen=True)
class IngestReport:
    """What became of one file."""

    file: str
    new: bool
    counts: IngestCounts

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
        }


def ingest_file(warehouse: Warehouse, file: Path, mapping: Mapping) -> IngestReport:
    """Read a measured log and commit its drives, and its quarantined rows before them.

    Raises `InputError` or `ConfigError` for a file or mapping that is not usable; then nothing is
    written.
    """
    log = read_measured(file, mapping)
    unit = Unit(f"ingest/{log.digest}", 1)
    new = warehouse.logs.snapshot().landed(unit.name) is None
    if new:
        # Not the file's name: it may name a car, and the Delta log outlives what is forgotten.
        note = {"job": "ingest", "mapping": mapping.name, "digest": log.digest}
        if log.quarantine.num_rows:
            _land(warehouse.quarantine, {None: log.quarantine}, log, unit, note)
        new = _land(warehouse.logs, _by_day(log.drives), log, unit, note)
    return IngestReport(str(file), new, log.counts)


def _by_day(rows: pa.Table) -> dict[Any, pa.Table]:
    days = rows["day"].unique().to_pylist()
    return {day: rows.filter(pc.equal(rows["day"], pa.scalar(day, pa.date32()))) for day in days}


def _land(
    table: Table, parts: dict[Any, pa.Table], log: MeasuredLog, unit: Unit, note: dict[str, str]
) -> bool:
    """Commit the parts as files of one commit; False if the unit has landed before."""
    if table.snapshot().landed(unit.name) is not None:
        return False
    name = f"measured-{log.digest[:24]}"
    actions = [table.write_file(name, rows, day) for day, rows in parts.items()]
    change = Change(add=actions, units=[unit], note=note)

    def attempt() -> bool:
        snapshot = table.snapshot()
        if snapshot.landed(unit.name) is not None:
            return False
        snapshot.commit(change)
        return True

    return retried(attempt)
