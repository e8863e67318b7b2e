"""Gram rows of feature sets with windows, from the columns of log files: what SQL says, faster.

Each drive is gone through once in the order of time. Blocks of its columns, integers below 2^19 in
binary64, are multiplied by the BLAS; every product and every sum in a block is an integer below
2^53, so that it is exact in whatever order the BLAS adds. Sums of blocks are 64-bit integers.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from fleet_slip.arrays import FloatArray, IntArray
from fleet_slip.catalogue.features import features
from fleet_slip.delta import TableFile
from fleet_slip.errors import DataError, StorageError
from fleet_slip.grams.columns import (
    BLOCK_ROWS,
    ColumnPlan,
    DriveColumns,
    DriveCounts,
)
from fleet_slip.grams.drive_rows import LoggedDrive, read_drives
from fleet_slip.grams.parts import UNKNOWN, Parts
from fleet_slip.warehouse.tables import Warehouse

_EXACT = 2**53
_INT64 = 2**63


def wide_grams(warehouse: Warehouse, files: Sequence[TableFile], feature_set: str) -> pa.Table:
    """Return the Gram rows of log files for a feature set, as `jobs/gram.sql` would.

    Sorted by file and drive. Raises `DataError` for a drive that cannot be looked back on, and
    `StorageError` for one whose sums need more than 64 bits.
    """
    plan = ColumnPlan.of_set(features(), feature_set)
    parts = Parts.of_set(features(), features().feature_set(feature_set))
    identity = features().identity(feature_set)
    columns: dict[str, list[Any]] = {name: [] for name in warehouse.grams.schema.names}
    # Files are shared out among threads; a BLAS with threads of its own would be in their way.
    with threadpool_limits(1, user_api="blas"):
        for file in sorted(files, key=lambda one: one.path):
            for drive in sorted(read_drives(warehouse, file, plan), key=lambda one: one.drive_id):
                _append_rows(
                    columns,
                    plan,
                    parts,
                    drive,
                    {"feature_set": identity, "file": file.path, "day": file.day},
                )
    return pa.table(columns, schema=warehouse.grams.schema)


def _append_rows(
    columns: dict[str, list[Any]],
    plan: ColumnPlan,
    parts: Parts,
    drive: LoggedDrive,
    known: Mapping[str, Any],
) -> None:
    where = f"{known['file']}: drive {drive.drive_id}"
    try:
        found = drive_sums(plan, parts, drive.counts)
    except DataError as error:
        raise DataError(f"{where}: {error}") from None
    for absent, part in sorted(found, key=_last_if_unknown):
        sums = found[absent, part]
        names = [name for i, name in enumerate(plan.names) if not absent >> i & 1]
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
class DriveSums:
    """Sums of the rows of a drive, or of a part of it, that have the same columns."""

    size: int
    n: int = 0
    clipped: int = 0
    sums: NDArray[np.int64] = field(init=False)
    products: NDArray[np.int64] = field(init=False)

    def __post_init__(self) -> None:
        """Begin with nothing."""
        self.sums = np.zeros(self.size, dtype=np.int64)
        self.products = np.zeros((self.size, self.size), dtype=np.int64)

    def add(self, block: FloatArray, sums: FloatArray, clipped: FloatArray) -> None:
        """Add complete rows, shape (columns, rows), their sums, and what was clipped in each."""
        self.n += block.shape[1]
        self.clipped += int(clipped.sum())
        self.sums += sums.astype(np.int64)
        self.products += (block @ block.T).astype(np.int64)


Kind = tuple[int, int]
"""Which columns rows lack, a number of one bit each, and which part of the drive they are."""


def _last_if_unknown(kind: Kind) -> tuple[int, bool, int]:
    """Sort as SQL does: an unknown part, which is null there, comes last."""
    absent, part = kind
    return absent, part == UNKNOWN, part


def drive_sums(plan: ColumnPlan, parts: Parts, counts: DriveCounts) -> dict[Kind, DriveSums]:
    """Return the sums of a drive's rows, by which columns they lack and by part.

    Raises `DataError` for a drive that cannot be looked back on, and `StorageError` if sums of
    products could need more than 64 bits.
    """
    columns = DriveColumns(plan, counts)
    largest = max(plan.limits)
    if BLOCK_ROWS * largest**2 >= _EXACT or columns.rows * largest**2 >= _INT64:
        raise StorageError(f"the drive has {columns.rows:,} rows: too many for 64-bit sums.")
    numbers = parts.numbers(counts.ticks, columns.rows_now) if parts else None
    found: dict[Kind, DriveSums] = {}
    for first in range(0, columns.rows, BLOCK_ROWS):
        last = min(first + BLOCK_ROWS, columns.rows)
        block = np.empty((len(plan.names), last - first))
        columns.fill(first, block)
        clipped = columns.clipped[first:last]
        sums = block.sum(axis=1)
        if numbers is None and not np.isnan(sums).any():
            found.setdefault((0, 0), DriveSums(len(block))).add(block, sums, clipped)
            continue
        for (absent, part), rows in _kinds(block, None if numbers is None else numbers[first:last]):
            has = [i for i in range(len(block)) if not absent >> i & 1]
            few = block[np.ix_(np.array(has, dtype=np.int64), rows)]
            kept = found.setdefault((absent, part), DriveSums(len(has)))
            kept.add(few, few.sum(axis=1), clipped[rows])
    return found


def _kinds(block: FloatArray, numbers: IntArray | None) -> Iterator[tuple[Kind, NDArray[np.int64]]]:
    """Yield each kind of rows in a block, and which rows those are."""
    packed = np.packbits(np.isnan(block), axis=0, bitorder="little")
    patterns, pattern_of_row = np.unique(packed, axis=1, return_inverse=True)
    part = np.zeros(block.shape[1], dtype=np.int64) if numbers is None else numbers
    both = np.stack([pattern_of_row.reshape(-1), part])
    kinds, kind_of_row = np.unique(both, axis=1, return_inverse=True)
    for kind, (pattern, number) in enumerate(kinds.T.tolist()):
        absent = int.from_bytes(patterns[:, pattern].tobytes(), "little")
        yield (absent, number), np.flatnonzero(kind_of_row.reshape(-1) == kind)
