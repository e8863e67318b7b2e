"""Files on disk that no version of a table refers to any more, and the drives that they hold."""

from collections.abc import Collection, Iterator
from datetime import date

import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.delta import Snapshot
from fleet_slip.errors import FleetSlipError
from fleet_slip.files.folder import StoredFile
from fleet_slip.maintenance.audit import Forgettable
from fleet_slip.maintenance.vacuum import find_replaced, find_unreferenced
from fleet_slip.warehouse.tables import Warehouse

BEING_WRITTEN_HOURS = 1.0
"""A file that no commit ever knew and that is younger may belong to a job that is running."""


def find_old_files(warehouse: Warehouse, subject: Forgettable) -> list[StoredFile]:
    """Return the files with the drives that no version refers to, in the order of deletion.

    The logs come last: their old files may be all that tells the drives of a car in the quarantine.
    """
    logs = list(_with_subject(warehouse.logs.snapshot(), subject))
    drives = {drive for _, names in logs for drive in names}
    old = list(_of_quarantine(warehouse.quarantine.snapshot(), subject, drives))
    old += [file for file, _ in _with_subject(warehouse.grams.snapshot(), subject)]
    return old + [file for file, _ in logs]


def _readable(snapshot: Snapshot) -> Iterator[tuple[StoredFile, pa.Table]]:
    """Yield replaced files and leftovers that are not being written, with what tells the drives."""
    known = find_replaced(snapshot)
    wanted = {"drive_id", "vehicle_id", "day"}
    for file in find_unreferenced(snapshot.table):
        if file.path not in known and file.age_hours < BEING_WRITTEN_HOURS:
            continue
        try:
            names = snapshot.table.read_metadata(file.path).schema.to_arrow_schema().names
            rows = snapshot.table.read(file.path, [name for name in names if name in wanted])
        except FleetSlipError:
            continue  # half a file, or just deleted
        yield file, _with_day(file, rows)


def _with_day(file: StoredFile, rows: pa.Table) -> pa.Table:
    """Return the rows of a partitioned file with the day that its folder tells."""
    key, _, day = file.path.partition("/")[0].partition("=")
    if key != "day":
        return rows
    return rows.append_column("day", pa.repeat(date.fromisoformat(day), rows.num_rows))


def _with_subject(
    snapshot: Snapshot, subject: Forgettable
) -> Iterator[tuple[StoredFile, frozenset[str]]]:
    for file, rows in _readable(snapshot):
        names = rows.filter(rows_of(rows, subject))["drive_id"].unique().to_pylist()
        if names:
            yield file, frozenset(names)


def _of_quarantine(
    snapshot: Snapshot, subject: Forgettable, drives: Collection[str]
) -> Iterator[StoredFile]:
    for file, rows in _readable(snapshot):
        if pc.any(quarantined_of(rows, subject, drives)).as_py():
            yield file


def rows_of(rows: pa.Table, subject: Forgettable) -> pa.ChunkedArray:
    """Return which rows of `logs` or `grams` are of a subject."""
    if subject.kind == "before":
        return pc.less(rows["day"], pa.scalar(date.fromisoformat(subject.value)))
    return pc.equal(rows[subject.column].cast(pa.string()), subject.value)


def quarantined_of(
    rows: pa.Table, subject: Forgettable, drives: Collection[str]
) -> pa.ChunkedArray:
    """Return which rows of the quarantine are of a subject, or of drives that are known to be.

    A row that was refused before its drive was cut at a gap in time names the drive as a whole.
    Rows that an earlier version of this program refused do not name the vehicle.
    """
    if subject.kind == "drive":
        drives = {*drives, subject.value}
    ids = rows["drive_id"].cast(pa.string())
    concerned = {
        name
        for name in ids.unique().to_pylist()
        if name and any(drive == name or drive.startswith(f"{name}-") for drive in drives)
    }
    of_drives = pc.is_in(ids, pa.array(sorted(concerned), pa.string()))
    if subject.kind != "vehicle" or "vehicle_id" not in rows.schema.names:
        return of_drives
    return pc.or_(of_drives, pc.fill_null(rows_of(rows, subject), False))
