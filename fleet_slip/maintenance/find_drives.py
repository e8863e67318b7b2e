"""Finds the drives of a car, or of a time, in the log files."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.delta import Snapshot
from fleet_slip.maintenance.old_files import rows_of
from fleet_slip.resources import read_sql
from fleet_slip.warehouse.audit import Forgettable
from fleet_slip.warehouse.database import open_database, reading_files
from fleet_slip.warehouse.recordings import Recording, record_drive
from fleet_slip.warehouse.tables import Warehouse

FILES_PER_QUERY = 256
"""DuckDB keeps what it read of each file of a query: some 70 KB."""


@dataclass(frozen=True)
class Located:
    """Which drives of a subject are in which log files, as Gram rows tell.

    A log file never changes, and the Gram rows of the catalogue's signals have all of its drives.

    Attributes:
        known: paths of the log files that have such Gram rows, the subject's drives or not.
        drives: the subject's drives in each log file that has some, by path.
    """

    known: frozenset[str]
    drives: Mapping[str, frozenset[str]]


def locate(grams: Snapshot, subject: Forgettable) -> Located:
    """Look for a subject's drives in the Gram rows."""
    known: set[str] = set()
    drives: dict[str, set[str]] = {}
    columns = ["feature_set", "file", "drive_id", "vehicle_id", "day"]
    for file in grams.files:
        rows = grams.table.read(file.path, columns)
        whole = pc.equal(rows["feature_set"], features().identity(PLAIN))
        known.update(rows["file"].filter(whole).unique().to_pylist())
        found = rows.filter(rows_of(rows, subject))
        for path, drive in zip(
            found["file"].to_pylist(), found["drive_id"].to_pylist(), strict=True
        ):
            drives.setdefault(path, set()).add(drive)
    return Located(frozenset(known), {path: frozenset(names) for path, names in drives.items()})


def cars_with_rows(warehouse: Warehouse) -> set[str]:
    """Return the cars that have Gram rows."""
    grams = warehouse.grams.snapshot()
    each = (grams.table.read(file.path, ["vehicle_id"])["vehicle_id"] for file in grams.files)
    return {name for cars in each for name in cars.unique().to_pylist() if name is not None}


def drives_by_file(
    logs: Snapshot, subject: Forgettable, located: Located
) -> dict[str, frozenset[str]]:
    """Return the drives concerned by log file, opening only files without Gram rows."""
    active = [file.path for file in logs.files]
    found = {path: located.drives[path] for path in active if path in located.drives}
    unknown = [path for path in active if path not in located.known]
    statement = read_sql("jobs", "find_drives.sql").format(condition=subject.condition)
    with (
        open_database(reading=logs.table.folder) as database,
        reading_files(database, f"looking for drives in {logs.table.folder}"),
    ):
        for first in range(0, len(unknown), FILES_PER_QUERY):
            paths = {
                logs.table.uri(path): path for path in unknown[first : first + FILES_PER_QUERY]
            }
            database.execute("SET VARIABLE log_files = $files", {"files": list(paths)})
            rows = database.execute(statement, {"value": subject.value}).fetchall()
            for uri in {uri for _, uri in rows}:
                names = frozenset(drive for drive, other in rows if other == uri)
                found[paths[uri]] = names
    return found


def recordings_of(
    warehouse: Warehouse, subject: Forgettable, located: Located
) -> Iterator[Recording]:
    """Yield what tells a subject's drives again, file by file of the logs."""
    logs = warehouse.logs.snapshot()
    drives = drives_by_file(logs, subject, located)
    for file in logs.files:
        if file.path not in drives:
            continue
        signals = [name for name in catalogue().signals if name in file.null_counts]
        rows = warehouse.logs.read(file.path, ["drive_id", "vehicle_id", "tick", *signals])
        ids = rows["drive_id"].cast(pa.string())
        for name in sorted(drives[file.path]):
            mine = rows.filter(pc.equal(ids, name)).combine_chunks()
            [batch] = mine.to_batches()
            counts = {signal: batch[signal] for signal in signals}
            yield record_drive(str(batch["vehicle_id"][0]), str(file.day), batch["tick"], counts)
