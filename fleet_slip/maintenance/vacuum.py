"""Removes files that nothing refers to any more: replaced ones, and leftovers of killed jobs.

A file stays while a version of the last `retention_hours` refers to it, for queries, and while it
is younger, for jobs about to commit; and where a table has no Delta log.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass

from fleet_slip.delta import Table
from fleet_slip.files.folder import TEMPORARY_PREFIX, StoredFile
from fleet_slip.runs.history import gather_runs
from fleet_slip.warehouse.tables import Warehouse

RETENTION_HOURS = 168
"""Also the longest that can be kept: Delta checkpoints forget removed files after a week."""


@dataclass(frozen=True)
class VacuumReport:
    """What was removed, or would be."""

    files: tuple[str, ...]
    size_bytes: int
    dry_run: bool


def vacuum(warehouse: Warehouse, retention_hours: float = RETENTION_HOURS) -> VacuumReport:
    """Remove what nothing has referred to for some hours; gather the records of runs."""
    warehouse.require()
    expired = find_expired(warehouse, retention_hours)
    removed = [file for file in expired if file.folder.remove(file)]
    gather_runs(warehouse.root)
    return _report(warehouse, removed, dry_run=False)


def preview_vacuum(warehouse: Warehouse, retention_hours: float = RETENTION_HOURS) -> VacuumReport:
    """Return what `vacuum` would remove. Raises `StorageError`."""
    warehouse.require()
    return _report(warehouse, find_expired(warehouse, retention_hours), dry_run=True)


def _report(warehouse: Warehouse, files: Sequence[StoredFile], *, dry_run: bool) -> VacuumReport:
    return VacuumReport(
        files=tuple(str(file).removeprefix(f"{warehouse.root}/") for file in files),
        size_bytes=sum(file.size_bytes for file in files),
        dry_run=dry_run,
    )


def find_expired(warehouse: Warehouse, retention_hours: float) -> list[StoredFile]:
    """Return the files that `vacuum` removes: of no version of so many hours, and as old."""
    found = []
    for table in warehouse.tables:
        files = find_unreferenced(table)
        snapshot = table.snapshot()
        if snapshot.version is None:  # its Delta log may have been lost, and these be its data
            continue
        kept = snapshot.removed() - snapshot.removed(retention_hours)
        found += [file for file in files if file.path not in kept]
    found += find_temporary_files(warehouse)
    return [file for file in found if file.age_hours >= retention_hours]


def find_unreferenced(table: Table) -> list[StoredFile]:
    """Return the data files below a table that its current version does not refer to."""
    # Listed before the log is read: a file that is committed meanwhile is not taken for a leftover.
    files = [
        file
        for file in table.folder.files()
        if file.path.endswith(".parquet")
        and not file.path.startswith("_delta_log/")
        and not file.name.startswith(TEMPORARY_PREFIX)
    ]
    active = {file.path for file in table.snapshot().files}
    return [file for file in files if file.path not in active]


def find_temporary_files(warehouse: Warehouse) -> list[StoredFile]:
    """Return what killed writers left under temporary names: ours, and the Delta library's."""
    return [
        file
        for file in warehouse.root.files()
        if file.name.startswith(TEMPORARY_PREFIX) or _OF_DELTA.fullmatch(file.path)
    ]


_OF_DELTA = re.compile(r"[^/]+/_delta_log/[^/]*#[^/]*")
"""Temporary names of the Delta library, in a file system."""
