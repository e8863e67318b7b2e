"""The rows of drives, one drive at a time in the order of time: from log files, or from a query."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.columns.blocks.column_plan import ColumnPlan
from fleet_slip.columns.blocks.drive_columns import DriveCounts
from fleet_slip.delta import TableFile
from fleet_slip.warehouse.tables import Warehouse


@dataclass(frozen=True)
class LoggedDrive:
    """A drive of a log file: what it is, its metadata, and its counts."""

    drive_id: str
    metadata: Mapping[str, Any]
    counts: DriveCounts


def read_drives(warehouse: Warehouse, file: TableFile, plan: ColumnPlan) -> Iterator[LoggedDrive]:
    """Yield a log file's drives in the order of time; as in SQL, none without a row of tick 0."""
    drive_columns = tuple(warehouse.catalogue.drive)
    present = warehouse.logs.read_metadata(file.path).schema.to_arrow_schema().names
    wanted = [name for name in (*drive_columns, "tick", *plan.signals) if name in present]
    rows = warehouse.logs.read(file.path, wanted)
    for one in rows_by_drive(rows):
        ticks = one["tick"].to_numpy()
        if (ticks[1:] < ticks[:-1]).any():
            order = np.argsort(ticks, kind="stable")
            one, ticks = one.take(order), ticks[order]  # noqa: PLW2901
        at = int(np.searchsorted(ticks, 0))
        if at < len(ticks) and ticks[at] == 0:
            metadata = {
                name: one[name][at].as_py() if name in wanted else None for name in drive_columns
            }
            yield LoggedDrive(str(metadata["drive_id"]), metadata, counts_of(one, plan, metadata))


def counts_of(
    rows: pa.Table,
    plan: ColumnPlan,
    facts: Mapping[str, Any] | None = None,
    numbers: Mapping[str, int] | None = None,
) -> DriveCounts:
    """Return a drive's rows, in the order of time, as what a plan is computed from.

    Facts are by default the first row's; `numbers` are what the car's drives told of it.
    """
    counts, present = {}, {}
    for name in plan.signals:
        if name not in rows.column_names:
            counts[name] = np.zeros(len(rows), dtype=np.int16)
            present[name] = np.zeros(len(rows), dtype=np.bool_)
            continue
        column = rows[name].combine_chunks()
        if column.null_count:
            present[name] = column.is_valid().to_numpy(zero_copy_only=False)
            column = column.fill_null(0)
        counts[name] = column.to_numpy()
    known = facts if facts is not None else {name: rows[name][0].as_py() for name in plan.facts}
    return DriveCounts(rows["tick"].to_numpy(), counts, present, known, numbers or {})


def drives_of_stream(batches: Iterable[pa.RecordBatch]) -> Iterator[pa.Table]:
    """Yield the rows of each drive from batches that are sorted by drive."""
    waiting: list[pa.Table] = []
    for batch in batches:
        for part in rows_by_drive(pa.Table.from_batches([batch])):
            if waiting and waiting[0]["drive_id"][0] != part["drive_id"][0]:
                yield pa.concat_tables(waiting)
                waiting = []
            waiting.append(part)
    if waiting:
        yield pa.concat_tables(waiting)


def rows_by_drive(rows: pa.Table) -> Iterator[pa.Table]:
    """Yield the rows of each drive, in their order."""
    ids = rows["drive_id"].combine_chunks()
    if not pa.types.is_dictionary(ids.type):
        ids = pc.dictionary_encode(ids)
    drive_of_row = ids.indices.to_numpy()
    starts = np.flatnonzero(np.diff(drive_of_row, prepend=-1))
    if len(starts) > len(np.unique(drive_of_row[starts])):  # the rows of drives are mixed
        order = np.argsort(drive_of_row, kind="stable")
        rows, drive_of_row = rows.take(order), drive_of_row[order]
        starts = np.flatnonzero(np.diff(drive_of_row, prepend=-1))
    for start, stop in pairwise([*starts.tolist(), rows.num_rows]):
        yield rows.slice(start, stop - start)
