"""Gram rows of feature sets with windows, from the columns of log files: what SQL says, faster.

Drives are gone through once, in time. Columns are integers below 2^19 in binary64, whose products
and block sums stay below 2^53: exact in any order. Sums of blocks have 64 bits.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from fleet_slip.arrays import FloatArray, IntArray
from fleet_slip.catalogue.course_change import COURSE_LATE
from fleet_slip.catalogue.feature_sets import FeatureSet
from fleet_slip.catalogue.features import features
from fleet_slip.columns.blocks.block_operations import BLOCK_ROWS
from fleet_slip.columns.blocks.column_plan import ColumnPlan
from fleet_slip.columns.blocks.drive_columns import DriveCounts, Workspace
from fleet_slip.delta import TableFile
from fleet_slip.errors import DataError, StorageError
from fleet_slip.grams.rows.course_sums import course_changes, find_fixes
from fleet_slip.grams.rows.drive_parts import UNKNOWN, Parts
from fleet_slip.grams.rows.drive_rows import LoggedDrive, read_drives
from fleet_slip.warehouse.tables import Warehouse

_EXACT = 2**53
_INT64 = 2**63


def wide_grams(
    warehouse: Warehouse,
    files: Sequence[TableFile],
    feature_set: str,
    late: Mapping[str, int] | None = None,
) -> pa.Table:
    """Return the Gram rows of log files for a feature set, as `jobs/gram.sql` would, sorted.

    `late` is the course's delay of cars, in parts of a tick. Raises `DataError` for a drive that
    cannot be looked back on, `StorageError` for sums of more than 64 bits.
    """
    one = features().feature_set(feature_set)
    workspace = Workspace(ColumnPlan.of_set(features(), feature_set))
    plan = workspace.plan
    identity = features().identity(feature_set)
    schema = warehouse.computed_schema(in_time=one.in_time)
    columns: dict[str, list[Any]] = {name: [] for name in schema.names}
    # Files are shared out among threads; a BLAS with threads of its own would be in their way.
    with threadpool_limits(1, user_api="blas"):
        for file in sorted(files, key=lambda one: one.path):
            for drive in sorted(read_drives(warehouse, file, plan), key=lambda one: one.drive_id):
                _append_rows(
                    columns,
                    workspace,
                    one,
                    drive,
                    {
                        "feature_set": identity,
                        "file": file.path,
                        "day": file.day,
                        COURSE_LATE: (late or {}).get(drive.metadata["vehicle_id"]),
                    },
                )
    return pa.table(columns, schema=schema)


def _append_rows(
    columns: dict[str, list[Any]],
    workspace: Workspace,
    one: FeatureSet,
    drive: LoggedDrive,
    known: Mapping[str, Any],
) -> None:
    parts = Parts.of_set(features(), one)
    where = f"{known['file']}: drive {drive.drive_id}"
    try:
        if one.change_ticks:
            late = (known[COURSE_LATE] or 0) if one.in_time else 0
            found = change_sums(workspace, drive.counts, one.change_ticks, late)
        else:
            found = drive_sums(workspace, parts, drive.counts)
    except DataError as error:
        raise DataError(f"{where}: {error}") from None
    for absent, part in sorted(found, key=_last_if_unknown):
        sums = found[absent, part]
        names = [name for i, name in enumerate(one.columns) if not absent >> i & 1]
        lower = np.tril_indices(len(names))
        row = {
            **drive.metadata,
            **known,
            "part": parts.name(part),
            "signals": ",".join(names),
            "n": sums.n,
            "clipped": sums.clipped,
            "sums": sums.sums,
            "products": sums.products[lower],
        }
        for name, values in columns.items():
            values.append(row[name])


@dataclass
class PartSums:
    """Sums of the rows of a drive, or of a part of it, that have the same columns."""

    size: int
    n: int = 0
    clipped: int = 0
    sums: NDArray[np.int64] = field(init=False)
    products: NDArray[np.int64] = field(init=False)

    def __post_init__(self) -> None:
        self.sums = np.zeros(self.size, dtype=np.int64)
        self.products = np.zeros((self.size, self.size), dtype=np.int64)

    def add(self, block: FloatArray, clipped: FloatArray) -> None:
        """Add complete rows, shape (columns, rows), and what was clipped in each."""
        self.n += block.shape[1]
        self.clipped += int(clipped.sum())
        self.sums += block.sum(axis=1).astype(np.int64)
        self.products += (block @ block.T).astype(np.int64)

    def add_totals(self, totals: NDArray[np.int64]) -> None:
        """Add what `Workspace.add_blocks` has added up: a lower triangle, and sums."""
        lower = np.tril(totals[: self.size, : self.size])
        self.products += lower + np.tril(lower, -1).T
        self.sums += totals[-1, : self.size]


Kind = tuple[int, int]
"""Which columns rows lack, a number of one bit each, and which part of the drive they are."""


def _last_if_unknown(kind: Kind) -> tuple[int, bool, int]:
    """Sort as SQL does: an unknown part, which is null there, comes last."""
    absent, part = kind
    return absent, part == UNKNOWN, part


def drive_sums(workspace: Workspace, parts: Parts, counts: DriveCounts) -> dict[Kind, PartSums]:
    """Return the sums of a drive's rows, by columns missing and part; raises as `wide_grams`."""
    plan, total = workspace.plan, len(counts.ticks)
    largest = max(plan.limits)
    exact_rows = (_EXACT - 1) // largest**2
    if exact_rows < BLOCK_ROWS or total * largest**2 >= _INT64:
        raise StorageError(f"the drive has {total:,} rows: too many for 64-bit sums.")
    workspace.load(counts)
    complete, totals = PartSums(len(plan.names)), workspace.totals()
    found = {(0, 0): complete}
    first = 0
    while first < total:
        if parts:
            workspace.compute_block(first)
        else:
            first, lacks, rows, clipped = workspace.add_blocks(first, exact_rows, totals)
            complete.n += rows
            complete.clipped += clipped
            if not lacks:
                continue
        first += _add_by_kind(found, workspace, parts, counts.ticks, first)
    complete.add_totals(totals)
    return {kind: sums for kind, sums in found.items() if sums.n}


def change_sums(
    workspace: Workspace, counts: DriveCounts, times: Sequence[int], late: int = 0
) -> dict[Kind, PartSums]:
    """Return the sums of a drive's changes, by columns missing and time; the course is `late`."""
    largest = 2 * max(workspace.plan.limits)
    exact_rows = (_EXACT - 1) // largest**2
    if len(counts.ticks) * largest**2 >= _INT64:
        raise StorageError(f"the drive has {len(counts.ticks):,} rows: too many for 64-bit sums.")
    workspace.load(counts)
    fixes = find_fixes(workspace, counts, late)
    found: dict[Kind, PartSums] = {}
    for part, apart in enumerate(times):
        changes = course_changes(fixes, apart)
        for (absent, _), rows in _kinds(changes.columns, None):
            has = [i for i in range(len(changes.columns)) if not absent >> i & 1]
            sums = found.setdefault((absent, part), PartSums(len(has)))
            for first in range(0, len(rows), exact_rows):
                some = rows[first : first + exact_rows]
                block = changes.columns.take(some, axis=1)
                sums.add(block if len(has) == len(block) else block[has], changes.clipped[some])
    return found


def _add_by_kind(
    found: dict[Kind, PartSums],
    workspace: Workspace,
    parts: Parts,
    ticks: NDArray[Any],
    first: int,
) -> int:
    """Add the rows of a block, which are of several kinds; return how many there are."""
    block, clipped = workspace.block(first)
    last = first + len(clipped)
    numbers = parts.numbers(ticks[first:last], workspace.beside(first)) if parts else None
    for (absent, part), rows in _kinds(block, numbers):
        has = [i for i in range(len(block)) if not absent >> i & 1]
        few = block[np.ix_(np.array(has, dtype=np.int64), rows)]
        found.setdefault((absent, part), PartSums(len(has))).add(few, clipped[rows])
    return len(clipped)


def _kinds(block: FloatArray, numbers: IntArray | None) -> Iterator[tuple[Kind, NDArray[np.int64]]]:
    lacks = np.isnan(block)
    some = np.flatnonzero(lacks.any(axis=0))  # few, as a rule: patterns take sorting
    pattern_of_row, absents = np.zeros(block.shape[1], dtype=np.int64), [0]
    if len(some):
        packed = np.packbits(lacks[:, some], axis=0, bitorder="little")
        patterns, of_some = np.unique(packed, axis=1, return_inverse=True)
        absents += [int.from_bytes(one.tobytes(), "little") for one in patterns.T]
        pattern_of_row[some] = 1 + of_some.reshape(-1)
    part = 0 if numbers is None else numbers
    kind_of_row = part * len(absents) + pattern_of_row
    for kind in np.unique(kind_of_row).tolist():
        number, pattern = divmod(kind, len(absents))
        yield (absents[pattern], number), np.flatnonzero(kind_of_row == kind)
