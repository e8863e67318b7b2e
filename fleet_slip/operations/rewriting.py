"""Rewrites tables: to compact the logs, to erase drives, or for another catalog.

Log files contain whole drives by name and tick, and dictionaries of the names that occur: their
bytes depend on the drives only.
"""

import dataclasses
import math
import re
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from types import MappingProxyType

import pyarrow as pa
import pyarrow.compute as pc
from deltalake import DeltaTable, Field
from deltalake.schema import Schema
from deltalake.transaction import AddAction

from fleet_slip.base import Progress, no_progress, pluralize
from fleet_slip.catalog.features import PLAIN
from fleet_slip.errors import FleetSlipError
from fleet_slip.grams.update import commit_ahead, reconcile
from fleet_slip.ingest.recordings import Fingerprints, SourceRef, TableName, is_from
from fleet_slip.rendering import Answer, Part, Remark
from fleet_slip.storage.folder import SPILL_PREFIX, TEMPORARY_PREFIX, StoredFile
from fleet_slip.storage.table import (
    ALL_STATISTICS,
    SCALE,
    AppTransaction,
    Change,
    Evolution,
    Snapshot,
    Table,
    TableFile,
    retrying,
    scales_of,
)
from fleet_slip.warehouse.gram_reader import BEING_WRITTEN_HOURS, rows_of_set
from fleet_slip.warehouse.warehouse import Warehouse


def build_rewriting(
    warehouse: Warehouse,
    logs: Snapshot,
    packs: Sequence[Sequence[TableFile]],
    without: Mapping[str, Collection[str]] = MappingProxyType({}),
    progress: Progress = no_progress,
) -> Change:
    """Write each pack of log files of a day as one file, and commit the Gram rows of these.

    `without` are the drives to drop, by file; a pack without other drives is only removed. Returns
    the change of the logs; `progress` counts packs. Raises `ConflictError`, after deleting the new
    files, and `StorageError`.
    """
    new: list[AddAction] = []
    replaced = [file for pack in packs for file in pack]
    try:
        for pack in packs:
            dropped = {drive for file in pack for drive in without.get(file.path, ())}
            rows = read_kept_drives(logs.table, pack, dropped)
            if rows.num_rows:
                action = logs.table.write_file("kept" if without else "compact", rows, pack[0].day)
                new.append(dataclasses.replace(action, data_change=bool(without)))
            progress(1, len(packs))
        commit_ahead(warehouse, new, replaced)
    except FleetSlipError:
        logs.table.discard(new)
        raise
    # By these, rewrites of one day conflict; Delta itself lets them pass.
    days = sorted({str(file.day) for file in replaced})
    transactions = [AppTransaction(f"rewrite/{day}", (logs.version or 0) + 1) for day in days]
    return Change(new, replaced, transactions, data_change=bool(without))


def read_kept_drives(
    table: Table, files: Sequence[TableFile], without: Collection[str] = ()
) -> pa.Table:
    """Return the rows of log files but for some drives, ordered and typed for a new file."""
    stored = [_read(table, file) for file in files]
    rows = pa.concat_tables(stored, promote_options="default").combine_chunks()
    names = rows["drive_id"].cast(pa.string())
    order = pc.sort_indices(
        pa.table({"drive_id": names, "tick": rows["tick"]}),
        sort_keys=[("drive_id", "ascending"), ("tick", "ascending")],
    )
    is_unwanted = pc.is_in(names, pa.array(sorted(without), pa.string()))
    rows = rows.take(order.filter(pc.invert(is_unwanted.combine_chunks()).take(order)))
    optional = [name for name in table.optional if name in rows.column_names]
    empty = {name for name in optional if rows[name].null_count == len(rows)}
    names = dict.fromkeys([*table.schema.names, *rows.column_names])
    return rows.select([name for name in names if name in rows.column_names and name not in empty])


def _read(table: Table, file: TableFile) -> pa.Table:
    stored = table.read(file.path)
    columns = {}
    for field in table.schema:
        if field.name in stored.schema.names:
            column = stored[field.name]
        elif field.name in table.optional or field.name in table.partition_by:
            continue
        else:
            column = pa.chunked_array([pa.nulls(stored.num_rows, field.type)])
        if pa.types.is_string(field.type):
            columns[field.name] = pc.dictionary_encode(column).unify_dictionaries()
        else:
            columns[field.name] = column.cast(field.type)
    retired = [name for name in stored.schema.names if name not in table.schema.names]
    return pa.table(columns | {name: stored[name] for name in retired})


def without_rows(
    snapshot: Snapshot,
    files: Iterable[TableFile],
    is_removed: Callable[[pa.Table], pa.ChunkedArray],
) -> tuple[Change, list[pa.Table]]:
    """Write the files of a table again that have rows which go; return the change, and these."""
    add: list[AddAction] = []
    remove: list[TableFile] = []
    removed_rows = []
    for file in files:
        rows = snapshot.table.read(file.path)
        mask = is_removed(rows)
        if pc.any(mask).as_py():
            remove.append(file)
            removed_rows.append(rows.filter(mask))
            if (remaining := rows.filter(pc.invert(mask))).num_rows:
                add.append(snapshot.table.write_file(file.path.rpartition("-x")[0], remaining))
    return Change(add, remove, note={"job": "forget"}), removed_rows


# Removal of drives that others replace.
#
# They may come again: their files' transactions are withdrawn. Their Gram rows go with the files.


def build_removal(
    warehouse: Warehouse, name: TableName, snapshot: Snapshot, sources: Collection[SourceRef]
) -> Change:
    """Build the change that deletes the drives, or rejected rows, of sources from a table."""
    if name == "quarantine":
        return _without_refused(snapshot, sources)
    drives = drives_in(warehouse, snapshot)
    removed = {
        p: {drive for drive in present if is_from(drive, sources)} for p, present in drives.items()
    }
    remaining = {
        SourceRef.of_drive(drive) for p, present in drives.items() for drive in present - removed[p]
    }
    files = {s.file for s in sources} - {source.file for source in remaining if source}
    transactions = Fingerprints(snapshot.transactions).withdraw(sources, files)
    packs = [[file] for file in snapshot.files if removed.get(file.path)]
    change = build_rewriting(warehouse, snapshot, packs, removed)
    return dataclasses.replace(change, transactions=[*transactions, *change.transactions])


def _without_refused(snapshot: Snapshot, sources: Collection[SourceRef]) -> Change:
    def is_removed(rows: pa.Table) -> pa.ChunkedArray:
        names = rows["drive_id"].cast(pa.string())
        removed = [n for n in names.unique().drop_null().to_pylist() if is_from(n, sources)]
        return pc.fill_null(pc.is_in(names, pa.array(removed, pa.string())), False)

    change, _ = without_rows(snapshot, snapshot.files, is_removed)
    files = {source for source in sources if source == source.file}
    transactions = Fingerprints(snapshot.transactions).withdraw((), files)
    return dataclasses.replace(change, transactions=transactions, note={})


def drives_in(warehouse: Warehouse, logs: Snapshot) -> dict[str, set[str]]:
    """Return the drives of each log file, opening only files without Gram rows."""
    by_file: dict[str, set[str]] = {}
    for rows in rows_of_set(warehouse.grams.snapshot(), PLAIN, "file", "drive_id"):
        for row in rows.to_pylist():
            by_file.setdefault(row["file"], set()).add(row["drive_id"])
    return {
        file.path: by_file.get(file.path) or set(logs.table.read_names(file.path)["drive_id"])
        for file in logs.files
    }


# Turns small log files of a day into large ones.
#
# Gram rows of new files are computed, and land before them; reconciliation drops the old.

TARGET_ROWS = 2_000_000
"""Maximum rows of a compacted file. Files of more than half of them are not compacted."""


@dataclass(frozen=True)
class CompactionReport:
    """The result of a compaction."""

    days: int
    files_before: int
    files_after: int
    rows_rewritten: int
    size_bytes_before: int
    size_bytes_after: int
    logs_version: int | None

    @property
    def changed(self) -> bool:
        """True if there was anything to do."""
        return bool(self.rows_rewritten)


def compact(
    warehouse: Warehouse, target_rows: int = TARGET_ROWS, progress: Progress = no_progress
) -> CompactionReport:
    """Compact each day in a commit, then reconcile Gram rows. Raises `ConflictError`."""
    warehouse.require()
    before = warehouse.logs.snapshot()
    days = sorted({file.day for file in before.files if file.day is not None})
    rewritten = 0
    for day in days:
        rewritten += _compact_day(warehouse, day, target_rows)
        progress(1, len(days))
    reconcile(warehouse)
    after = warehouse.logs.snapshot()
    return CompactionReport(
        days=len(days),
        files_before=len(before.files),
        files_after=len(after.files),
        rows_rewritten=rewritten,
        size_bytes_before=before.size_bytes,
        size_bytes_after=after.size_bytes,
        logs_version=after.version,
    )


@retrying
def _compact_day(warehouse: Warehouse, day: date, target_rows: int) -> int:
    snapshot = warehouse.logs.snapshot()
    small = [f for f in snapshot.files if f.day == day and 2 * f.rows <= target_rows]
    packs = list(_packs(small, target_rows))
    if packs:
        note = {"job": "compact", "day": day.isoformat()}
        change = build_rewriting(warehouse, snapshot, packs)
        snapshot.commit_or_discard(dataclasses.replace(change, note=note))
    return sum(file.rows for pack in packs for file in pack)


def _packs(files: Iterable[TableFile], target_rows: int) -> Iterable[list[TableFile]]:
    """Yield runs of two files or more that fit together; only the last may be packed again."""
    pack: list[TableFile] = []
    for file in files:
        if pack and sum(f.rows for f in pack) + file.rows > target_rows:
            if len(pack) > 1:
                yield pack
            pack = []
        pack.append(file)
    if len(pack) > 1:
        yield pack


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
        newest_ms = 1e3 * time.time() - 3.6e6 * retention_hours
        removals = snapshot.removals
        candidates += [file for file in files if removals.get(file.path, math.inf) <= newest_ms]
        uncommitted += [file for file in files if file.path not in removals]
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


def path_below(warehouse: Warehouse, file: StoredFile) -> str:
    """Return the path of a file below the data root."""
    return str(file).removeprefix(f"{warehouse.root}/")


# Brings the tables of a data root to the signal catalog: every table gets the columns that came
# later. No file is touched: there they are null.


@dataclass(frozen=True)
class MigrationReport(Answer):
    """The result of a migration. `retired` are columns that the catalog has no longer."""

    added: tuple[str, ...]
    retired: tuple[str, ...]
    logs_version: int | None

    @property
    def changed(self) -> bool:
        """True if there was anything to do."""
        return bool(self.added)

    def parts(self) -> Iterator[Part]:
        """Return a remark on the added columns."""
        if not self.changed:
            yield Remark("migrate: nothing to do, the logs agree with the signal catalog")
        if self.added:
            yield Remark(f"added: {', '.join(self.added)}; null in the files that are there")


def migrate(warehouse: Warehouse) -> MigrationReport:
    """Make the tables agree with program and catalog. Again, it does nothing.

    Raises `RefusedError` if the counts are in other scales, and `ConflictError`.
    """
    warehouse.require()
    evolution: Evolution | None = None
    for table in (warehouse.quarantine, warehouse.grams, warehouse.logs):
        delta = table.open_delta()
        evolution = None
        if delta is not None:
            evolution = table.require_readable(delta)
            if evolution.added:
                _add_columns(table, delta, evolution.added)
    if evolution is None:
        return MigrationReport((), (), None)
    version = warehouse.logs.snapshot().version
    return MigrationReport(evolution.added, evolution.retired, version)


def _add_columns(table: Table, delta: DeltaTable, names: Collection[str]) -> None:
    scales = scales_of(table.schema)
    fields = [
        Field(
            field.name,
            field.type,
            nullable=True,
            metadata={SCALE: str(scales[field.name])} if field.name in scales else {},
        )
        for field in Schema.from_arrow(table.schema).fields
        if field.name in names
    ]
    with table.committing():
        delta.alter.set_table_properties(ALL_STATISTICS)
        delta.alter.add_columns(fields)
