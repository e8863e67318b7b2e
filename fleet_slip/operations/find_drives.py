"""Finds the drives of a car, or of a time, in log files; and files that nothing refers to."""

import re
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import date

import polars as pl
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.base import pluralize
from fleet_slip.catalog.counts import digest_counts
from fleet_slip.catalog.features import PLAIN
from fleet_slip.errors import StorageError
from fleet_slip.grams.gram_files import gram_digests, read_rows
from fleet_slip.grams.on_board import onboard_feature_sets
from fleet_slip.rendering import Remark
from fleet_slip.storage.folder import SPILL_PREFIX, TEMPORARY_PREFIX, StoredFile
from fleet_slip.storage.table import Snapshot, Table
from fleet_slip.warehouse.erasure_log import ErasureSubject
from fleet_slip.warehouse.gram_reader import BEING_WRITTEN_HOURS
from fleet_slip.warehouse.warehouse import Warehouse

# Removes files that nothing refers to any more: replaced ones, and leftovers of killed jobs.
#
# A file stays while a version of the last `retention_hours` refers to it, for queries; while it is
# younger; an hour at least if no version had it, for jobs about to commit; and where a table has no
# Delta log.

RETENTION_HOURS = 168
"""Also the longest that can be kept: Delta checkpoints forget removed files after a week."""


@dataclass(frozen=True)
class VacuumReport:
    """The removed files, or in a dry run those to remove."""

    files: tuple[str, ...]
    size_bytes: int
    dry_run: bool

    @property
    def remark(self) -> Remark:
        """How much was removed."""
        done = "would be removed" if self.dry_run else "removed"
        return Remark(f"{pluralize(len(self.files), 'file')} with {self.size_bytes:,} bytes {done}")


def vacuum(
    warehouse: Warehouse, retention_hours: float = RETENTION_HOURS, *, dry_run: bool = False
) -> VacuumReport:
    """Remove the files that nothing has referred to for some hours."""
    warehouse.require()
    expired = find_expired(warehouse, retention_hours)
    if not dry_run:
        expired = [file for file in expired if file.folder.remove(file)]
    return VacuumReport(
        files=tuple(path_below(warehouse, file) for file in expired),
        size_bytes=sum(file.size_bytes for file in expired),
        dry_run=dry_run,
    )


def find_expired(warehouse: Warehouse, retention_hours: float) -> list[StoredFile]:
    """Return the files that `vacuum` removes: older than some hours, and in no version of these."""
    candidates, uncommitted = [], find_temporary_files(warehouse)
    for table in warehouse.tables:
        files = find_unreferenced(table)
        snapshot = table.snapshot()
        if snapshot.version is None:  # its Delta log may have been lost, and these be its data
            continue
        expired = snapshot.removed_before(retention_hours)
        candidates += [file for file in files if file.path in expired]
        uncommitted += [file for file in files if file.path not in snapshot.removals]
    candidates += [file for file in uncommitted if file.age_hours >= BEING_WRITTEN_HOURS]
    return [file for file in candidates if file.age_hours >= retention_hours]


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
    """Return temporary files of killed jobs: ours, DuckDB's, and the Delta library's."""
    return [
        file
        for file in warehouse.root.files()
        if file.name.startswith(TEMPORARY_PREFIX)
        or file.path.startswith(SPILL_PREFIX)
        or _OF_DELTA.fullmatch(file.path)
    ]


def find_replaced(warehouse: Warehouse) -> list[StoredFile]:
    """Return the files that commits removed from their tables, of any age."""
    return [
        file
        for table in warehouse.tables
        for file in find_unreferenced(table)
        if file.path in table.snapshot().removals
    ]


_OF_DELTA = re.compile(r"[^/]+/_delta_log/[^/]*#[^/]*")
"""Temporary names of the Delta library, in a file system."""


def rows_of(rows: pa.Table, subject: ErasureSubject) -> pa.ChunkedArray:
    """Return which rows of `logs` or `grams` are of a subject."""
    if subject.kind == "before":
        is_before = pc.less(rows["day"], pa.scalar(date.fromisoformat(subject.value)))
        kept_days = pa.array(sorted(subject.kept_days), pa.date32())
        return pc.and_not(is_before, pc.is_in(rows["day"], kept_days))
    names = rows[subject.column].cast(pa.string())
    return pc.is_in(names, pa.array(subject.select(names.unique().to_pylist()), pa.string()))


def quarantined_of(
    rows: pa.Table, subject: ErasureSubject, drives: Collection[str]
) -> pa.ChunkedArray:
    """Return a mask of the quarantine's rows of a subject or of its drives.

    Rows rejected before a cut at a gap have the name of the uncut drive.
    """
    ids = rows["drive_id"].cast(pa.string())
    if subject.kind == "drive":
        drives = {*drives, subject.value, *subject.select(ids.unique().to_pylist())}
    concerned = {
        name
        for name in ids.unique().to_pylist()
        if name and any(drive == name or drive.startswith(f"{name}-") for drive in drives)
    }
    of_drives = pc.is_in(ids, pa.array(sorted(concerned), pa.string()))
    if subject.kind != "vehicle":
        return of_drives
    return pc.or_(of_drives, rows_of(rows, subject))


@dataclass(frozen=True)
class Located:
    """A subject's `drives` by log file, and the `reduced` log files, which have plain Gram rows."""

    reduced: frozenset[str]
    drives: Mapping[str, frozenset[str]]


def locate(grams: Snapshot, subject: ErasureSubject) -> Located:
    """Look for a subject's drives in the Gram rows."""
    reduced: set[str] = set()
    drives: dict[str, set[str]] = {}
    columns = ["feature_set", "file", "drive_id", "vehicle_id", "day"]
    for file in grams.files:
        rows = grams.table.read(file.path, columns)
        is_plain = pc.equal(rows["feature_set"], PLAIN)
        reduced.update(rows["file"].filter(is_plain).unique().to_pylist())
        matches = rows.filter(rows_of(rows, subject))
        for path, drive in zip(
            matches["file"].to_pylist(), matches["drive_id"].to_pylist(), strict=True
        ):
            drives.setdefault(path, set()).add(drive)
    return Located(frozenset(reduced), {path: frozenset(names) for path, names in drives.items()})


def drives_by_file(
    logs: Snapshot, subject: ErasureSubject, located: Located
) -> dict[str, frozenset[str]]:
    """Return the drives concerned by log file, opening only files without Gram rows."""
    by_file = {}
    for file in logs.files:
        drives = located.drives.get(file.path, frozenset())
        if file.path not in located.reduced:
            names = logs.table.read_combinations(file.path, ["drive_id", "vehicle_id"])
            names = names.append_column("day", pa.repeat(file.day, names.num_rows))
            drives = frozenset(names.filter(rows_of(names, subject))["drive_id"].to_pylist())
        if drives:
            by_file[file.path] = drives
    return by_file


def tables_with(
    warehouse: Warehouse,
    subject: ErasureSubject,
    drives: Collection[str] = (),
    located: Located | None = None,
) -> dict[str, set[str]]:
    """Return the tables that have rows of a subject or of its drives, and the drives of these."""
    located = located or locate(warehouse.grams.snapshot(), subject)
    in_logs = drives_by_file(warehouse.logs.snapshot(), subject, located)
    tables: dict[str, set[str]] = {}
    for name, by_file in (("grams", located.drives), ("logs", in_logs)):
        if by_file:
            tables[name] = set().union(*by_file.values())
    for file in warehouse.quarantine.snapshot().files:
        refused = find_in_file(warehouse, warehouse.quarantine, file.path, subject, drives)
        if refused is not None:
            tables.setdefault("quarantine", set()).update(refused)
    return tables


def drives_of(warehouse: Warehouse, subject: ErasureSubject, located: Located) -> frozenset[str]:
    """Return a subject's drives in all tables."""
    return frozenset().union(*tables_with(warehouse, subject, (), located).values())


def remove_uncommitted(
    warehouse: Warehouse, subject: ErasureSubject, drives: Collection[str]
) -> None:
    """Delete files with rows of a subject that were never committed: the fence refuses them now.

    Log files are deleted last: only they may name a car's drives. Drives before a day may still be
    committed, and are left.
    """
    leftovers: list[StoredFile] = []
    for table in warehouse.tables if subject.kind != "before" else ():
        removals = table.snapshot().removals
        for file in find_unreferenced(table):
            if file.path in removals:
                continue
            with suppress(StorageError):  # half a file, or just deleted
                matches = find_in_file(warehouse, table, file.path, subject, drives)
                if matches is not None:
                    drives = {*drives, *matches}
                    leftovers.append(file)
    for file in reversed(leftovers):
        file.folder.remove(file)


def find_in_file(
    warehouse: Warehouse,
    table: Table,
    path: str,
    subject: ErasureSubject,
    drives: Collection[str],
) -> set[str] | None:
    """Return a subject's drives in a file, None if no row is of the subject."""
    rows = table.read(path, ["drive_id", "vehicle_id"])
    is_quarantine = table is warehouse.quarantine
    mask = quarantined_of(rows, subject, drives) if is_quarantine else rows_of(rows, subject)
    matches = rows["drive_id"].filter(mask)
    return set(matches.drop_null().to_pylist()) if len(matches) else None


def find_remains(
    warehouse: Warehouse, subject: ErasureSubject, drives: Collection[str]
) -> Iterator[str]:
    """Yield the files that are in no table and have rows of a subject, or cannot be read.

    Files with drives before a day may be landing: these are not judged.
    """
    for table in warehouse.tables if subject.kind != "before" else ():
        for file in find_unreferenced(table):
            try:
                if find_in_file(warehouse, table, file.path, subject, drives) is not None:
                    yield path_below(warehouse, file)
            except StorageError:
                if any(file == other for other in find_unreferenced(table)):  # not just deleted
                    yield f"{path_below(warehouse, file)} (unreadable)"


def half_written(warehouse: Warehouse) -> list[StoredFile]:
    """Return the temporary files that may have rows of any drive."""
    tables = {table.folder.name for table in warehouse.tables}
    return [
        file
        for file in find_temporary_files(warehouse)
        if file.path.startswith(SPILL_PREFIX)
        or (file.path.split("/")[0] in tables and "_delta_log" not in file.path)
    ]


def path_below(warehouse: Warehouse, file: StoredFile) -> str:
    """Return the path of a file below the data root."""
    return str(file).removeprefix(f"{warehouse.root}/")


def digests_of(warehouse: Warehouse, subject: ErasureSubject, located: Located) -> Iterator[str]:
    """Yield the digests of the counts of a subject's drives: of their Gram rows, and of logs."""
    grams = warehouse.grams.snapshot()
    for file in grams.files:
        names = warehouse.grams.read(file.path, ["drive_id", "vehicle_id", "day"])
        if pc.any(selected := rows_of(names, subject)).as_py():
            rows = read_rows(warehouse.grams, file).filter(selected)
            on_board = pc.is_in(
                rows["feature_set"],
                pa.array(list(onboard_feature_sets(warehouse.catalog)), pa.string()),
            )
            yield from gram_digests(rows.filter(on_board))[0]
    logs = warehouse.logs.snapshot()
    drives = drives_by_file(logs, subject, located)
    for file in logs.files:
        if file.path not in drives:
            continue
        signals = [name for name in warehouse.catalog.signals.signals if name in file.null_counts]
        rows = warehouse.logs.read(file.path, ["drive_id", "vehicle_id", "tick", *signals])
        ids = rows["drive_id"].cast(pa.string())
        for name in sorted(drives[file.path]):
            rows_of_drive = rows.filter(pc.equal(ids, name)).combine_chunks()
            [batch] = rows_of_drive.to_batches()
            counts = {signal: batch[signal] for signal in signals}
            car, ticks = str(batch["vehicle_id"][0]), pl.Series(batch["tick"]).to_numpy()
            yield digest_counts(car, str(file.day), ticks, counts)
