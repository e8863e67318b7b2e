"""Writes rows again, to compact the logs or to forget drives.

Log files hold whole drives by name and tick, and dictionaries of what occurs: their bytes follow
from the drives, and can be simulated again.
"""

import dataclasses
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from deltalake.transaction import AddAction

from fleet_slip.arrays import IntArray
from fleet_slip.delta import Change, Snapshot, Table, TableFile, Unit, retry_conflicts
from fleet_slip.errors import FleetSlipError
from fleet_slip.grams.rows.gram_files import read_rows, write_rows
from fleet_slip.grams.rows.gram_rows import is_received
from fleet_slip.grams.rows.landing_before_logs import land_ahead
from fleet_slip.maintenance.find_drives import rows_of
from fleet_slip.progress import Progress, no_progress
from fleet_slip.warehouse.audit import Forgettable
from fleet_slip.warehouse.tables import Warehouse


@dataclass(frozen=True)
class Rewriting:
    """Files of one day that become one, named after what is done, without some drives."""

    name: str
    files: Sequence[TableFile]
    without: Collection[str] = ()


def rewrite(
    warehouse: Warehouse,
    logs: Snapshot,
    rewritings: Sequence[Rewriting],
    *,
    note: Mapping[str, Any],
    data_change: bool,
    progress: Progress = no_progress,
) -> list[AddAction]:
    """Exchange log files and their Gram rows in one commit on a snapshot; return what was added.

    Files without kept drives go. `progress` counts rewritings. Raises `ConflictError`, after
    deleting the new files, and `StorageError`.
    """
    new = write_again(warehouse, logs, rewritings, data_change=data_change, progress=progress)
    replaced = [file for one in rewritings for file in one.files]
    units = rewriting_units(logs, replaced)
    logs.commit_or_discard(
        Change(add=new, remove=replaced, units=units, note=note, data_change=data_change)
    )
    return new


def write_again(
    warehouse: Warehouse,
    logs: Snapshot,
    rewritings: Sequence[Rewriting],
    *,
    data_change: bool = True,
    progress: Progress = no_progress,
) -> list[AddAction]:
    """Write log files, land their Gram rows ahead; return what to add. Raises as `rewrite`."""
    new: list[AddAction] = []
    replaced = [file for one in rewritings for file in one.files]
    try:
        for one in rewritings:
            rows = read_kept_drives(logs.table, one.files, one.without)
            if rows.num_rows:
                action = logs.table.write_file(one.name, rows, one.files[0].day)
                new.append(dataclasses.replace(action, data_change=data_change))
            progress(1, len(rewritings))
        land_ahead(warehouse, new, replaced)
    except FleetSlipError:
        logs.table.discard(new)
        raise
    return new


def rewriting_units(logs: Snapshot, replaced: Sequence[TableFile]) -> list[Unit]:
    """Return units that make commits conflict which rewrite the same day; Delta lets them pass."""
    days = sorted({str(file.day) for file in replaced})
    return [Unit(f"rewrite/{day}", (logs.version or 0) + 1) for day in days]


def read_kept_drives(
    table: Table, files: Sequence[TableFile], without: Collection[str] = ()
) -> pa.Table:
    """Return the rows of log files but for some drives, ordered and typed for a new file."""
    parts = [_read(table, file, without) for file in files]
    rows = pa.concat_tables(parts, promote_options="default").combine_chunks()
    order = _order(rows)
    if (np.diff(order) != 1).any():
        rows = rows.take(order)
    optional = [name for name in table.optional if name in rows.column_names]
    empty = {name for name in optional if rows[name].null_count == len(rows)}
    names = dict.fromkeys([*table.schema.names, *rows.column_names])
    return rows.select([name for name in names if name in rows.column_names and name not in empty])


def _read(table: Table, file: TableFile, without: Collection[str]) -> pa.Table:
    stored = table.read(file.path)
    columns = {}
    for field in table.schema:
        if field.name in table.partition_by:
            continue
        there = field.name in stored.schema.names
        if not there and field.name in table.optional:
            continue
        if not there:
            column = pa.chunked_array([pa.nulls(stored.num_rows, field.type)])
        else:
            column = stored[field.name]
        if pa.types.is_string(field.type):
            columns[field.name] = pc.dictionary_encode(column).unify_dictionaries()
        else:
            columns[field.name] = column.cast(field.type)
    retired = [name for name in stored.schema.names if name not in table.schema.names]
    rows = pa.table(columns | {name: stored[name] for name in retired})
    ids = rows["drive_id"].combine_chunks()
    unwanted = pc.is_in(ids.dictionary, pa.array(sorted(without), ids.dictionary.type))
    return rows.filter(pc.invert(unwanted.take(ids.indices)))


def _order(rows: pa.Table) -> IntArray:
    ids = rows["drive_id"].combine_chunks()
    rank = np.argsort(np.argsort(np.array(ids.dictionary.to_pylist(), dtype=object)))
    drive = rank[ids.indices.to_numpy()] if len(rank) else np.empty(0, dtype=np.int64)
    return np.lexsort((rows["tick"].to_numpy(), drive))


def write_without(
    snapshot: Snapshot, gone: Callable[[pa.Table], pa.ChunkedArray]
) -> tuple[list[AddAction], list[TableFile]]:
    """Write the files of a table again that have rows which go; return them, and the old ones."""
    add: list[AddAction] = []
    remove: list[TableFile] = []
    for file in snapshot.files:
        rows = snapshot.table.read(file.path)
        kept = rows.filter(pc.invert(gone(rows)))
        if kept.num_rows < rows.num_rows:
            remove.append(file)
            add += [snapshot.table.write_file("kept", kept)] if kept.num_rows else []
    return add, remove


def drop_unused_names(warehouse: Warehouse) -> int:
    """Write files anew without names that none of their rows has; return how many."""

    def attempt() -> int:
        logs = warehouse.logs.snapshot()
        files = [file for file in logs.files if warehouse.logs.has_unused_names(file.path)]
        if files:
            rewritings = [Rewriting("kept", [file]) for file in files]
            rewrite(warehouse, logs, rewritings, note={"job": "names"}, data_change=False)
        return len(files)

    return retry_conflicts(attempt)


def forget_received(warehouse: Warehouse, subject: Forgettable) -> int:
    """Commit the Gram rows without those that came without a log; return how many rows."""

    def attempt() -> int:
        snapshot = warehouse.grams.snapshot()
        concerned: list[TableFile] = []
        rows = 0
        for file in snapshot.files:
            told = warehouse.grams.read(file.path, ["file", "drive_id", "vehicle_id", "day", "n"])
            mine = pc.and_(rows_of(told, subject), is_received(told))
            if pc.any(mine).as_py():
                concerned.append(file)
                rows += pc.sum(told.filter(mine)["n"]).as_py()
        if concerned:
            read = (read_rows(warehouse.grams, file) for file in concerned)
            kept = (r.filter(pc.invert(pc.and_(rows_of(r, subject), is_received(r)))) for r in read)
            add = write_rows(warehouse, kept)
            snapshot.commit_or_discard(Change(add=add, remove=concerned, note={"job": "forget"}))
        return rows

    return retry_conflicts(attempt)
