"""Removes files that nothing refers to any more: replaced ones, and leftovers of killed jobs.

A file stays while a version of the last `retention_hours` refers to it, so that a query that began
then goes on undisturbed; and while it is younger than that, because a job may be about to commit
it. A clock that was set back keeps files longer.
"""

import contextlib
import math
import time
import uuid
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from fleet_slip.storage import TEMPORARY_PREFIX, Snapshot, Table, storage_errors
from fleet_slip.warehouse import Warehouse

RETENTION_HOURS = 168
"""Also the longest that can be kept: Delta checkpoints forget removed files after a week."""


@dataclass(frozen=True)
class Unreferenced:
    """A file that no current version refers to, and the state in which it was found."""

    path: Path
    size_bytes: int
    modified_ns: int
    inode: int

    @property
    def age_hours(self) -> float:
        """Hours since it was written."""
        return (time.time_ns() - self.modified_ns) / 3.6e12


@dataclass(frozen=True)
class VacuumReport:
    """What was removed, or would be."""

    files: tuple[str, ...]
    size_bytes: int
    dry_run: bool


def vacuum(
    warehouse: Warehouse, retention_hours: float = RETENTION_HOURS, *, dry_run: bool = False
) -> VacuumReport:
    """Remove what nothing has referred to for some hours. Raises `StorageError`."""
    removed = []
    for file in expired(warehouse, retention_hours):
        if dry_run or discard(file):
            removed.append(file)
    return VacuumReport(
        files=tuple(str(file.path.relative_to(warehouse.root)) for file in removed),
        size_bytes=sum(file.size_bytes for file in removed),
        dry_run=dry_run,
    )


def expired(warehouse: Warehouse, retention_hours: float) -> list[Unreferenced]:
    """Return the files that `vacuum` removes."""
    found = []
    for table in warehouse.tables:
        files = unreferenced(table)
        kept = removed_since(table.snapshot(), retention_hours)
        found += [file for file in files if str(file.path) not in kept]
    found += temporary_files(warehouse)
    return [file for file in found if file.age_hours >= retention_hours]


def unreferenced(table: Table) -> list[Unreferenced]:
    """Return the data files below a table that its current version does not refer to."""
    # Listed before the log is read: a file that is committed meanwhile is not taken for a leftover.
    with storage_errors(table.path):
        files = [
            _judge(path)
            for path in sorted(table.path.rglob("*.parquet"))
            if "_delta_log" not in path.parts and not path.name.startswith(TEMPORARY_PREFIX)
        ]
    active = set(table.snapshot().paths)
    return [file for file in files if file and str(file.path) not in active]


def temporary_files(warehouse: Warehouse) -> list[Unreferenced]:
    """Return what killed writers left under temporary names: ours, and the Delta library's."""
    with storage_errors(warehouse.root):
        paths = [
            *warehouse.root.rglob(f"{TEMPORARY_PREFIX}*"),
            *warehouse.root.glob("*/_delta_log/*#*"),
        ]
        files = [_judge(path) for path in sorted(paths)]
    return [file for file in files if file]


def replaced(snapshot: Snapshot) -> set[str]:
    """Return the full paths of files that a commit removed from a table, ever."""
    return set(_removed_before(snapshot, 0))


def removed_since(snapshot: Snapshot, hours: float) -> set[str]:
    """Return the full paths of files that a commit of the last hours removed from a table."""
    return replaced(snapshot) - set(_removed_before(snapshot, hours))


def _removed_before(snapshot: Snapshot, hours: float) -> Iterator[str]:
    if snapshot.delta is None:
        return
    with storage_errors(snapshot.table.path):
        paths = snapshot.delta.vacuum(
            math.ceil(hours), dry_run=True, enforce_retention_duration=False, full=False
        )
    for path in paths:
        yield str(snapshot.table.path / path)


def discard(file: Unreferenced) -> bool:
    """Delete the very file that was judged; False if it is gone or another took its place.

    A job may be writing a file of the same name and bytes at this moment. So the file is moved
    aside first; if it is not the one that was judged it is put back.
    """
    aside = file.path.with_name(f"{TEMPORARY_PREFIX}{uuid.uuid4().hex}")
    with storage_errors(file.path):
        try:
            file.path.rename(aside)
        except FileNotFoundError:
            return False
        found = _judge(aside)
        same = found is not None and replace(found, path=file.path) == file
        if not same:
            with contextlib.suppress(FileExistsError):
                file.path.hardlink_to(aside)
        aside.unlink()
    return same


def _judge(path: Path) -> Unreferenced | None:
    try:
        stat = path.stat(follow_symlinks=False)
    except FileNotFoundError:
        return None
    return Unreferenced(path, stat.st_size, stat.st_mtime_ns, stat.st_ino)
