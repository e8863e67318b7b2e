"""The sums of every drive of every car, from Gram rows that are read batch by batch."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import FloatArray
from fleet_slip.grams.rows.gram_rows import by_signals, gram_table
from fleet_slip.regression.exact.gram import packed_position
from fleet_slip.regression.exact.gram_table import GramTable

Drive = tuple[str, date, str]
"""Car, day and name: the order in which a car drove."""


@dataclass(frozen=True)
class DriveSums:
    """Sums of columns over rows that have them all, by drive; `cars` tells where each begins."""

    drives: tuple[Drive, ...]
    table: GramTable
    cars: Mapping[str, slice]

    def moments(self) -> FloatArray:
        """Return the moments of (1, columns) of each drive, shape (drives, k+1, k+1)."""
        k = len(self.table.signals)
        found = np.empty((len(self.table), k + 1, k + 1))
        found[:, 0, 0] = self.table.n
        found[:, 0, 1:] = found[:, 1:, 0] = self.table.sums
        at = np.array([[packed_position(i, j) for j in range(k)] for i in range(k)])
        found[:, 1:, 1:] = self.table.products[:, at]
        return found


@dataclass
class SumCollector:
    """Adds up Gram rows, drive by drive, for several sets of columns at once."""

    kinds: Mapping[str, tuple[str, ...]]
    parts: dict[str, list[GramTable]] = field(default_factory=dict)
    drives: dict[str, list[Drive]] = field(default_factory=dict)

    def add(self, batch: pa.RecordBatch) -> None:
        """Add a batch of Gram rows; those that do not say whose they are count for nobody."""
        for names, rows, _ in by_signals(batch.filter(batch["vehicle_id"].is_valid())):
            table = gram_table(names, rows) if len(rows) else None
            drives = list(zip(*(rows[c].to_pylist() for c in _KEY), strict=True))
            for kind, columns in self.kinds.items():
                if table is not None and set(columns) <= set(names.split(",")):
                    self.parts.setdefault(kind, []).append(table.restrict(columns))
                    self.drives.setdefault(kind, []).extend(drives)

    def sums(self) -> dict[str, DriveSums]:
        """Return what was added, by kind."""
        return {
            kind: _sorted(parts, self.drives[kind])
            for kind, parts in self.parts.items()
            if self.drives[kind]
        }


_KEY = ("vehicle_id", "day", "drive_id")


def collect_sums(
    batches: Iterable[pa.RecordBatch], kinds: Mapping[str, tuple[str, ...]]
) -> dict[str, DriveSums]:
    """Return the sums of the columns of each kind over every drive."""
    collector = SumCollector(kinds)
    for batch in batches:
        if len(batch):
            collector.add(batch)
    return collector.sums()


def _sorted(parts: Sequence[GramTable], rows: Sequence[Drive]) -> DriveSums:
    drives = sorted(set(rows))
    number = {drive: i for i, drive in enumerate(drives)}
    at = np.array([number[row] for row in rows], dtype=np.int64)
    order = np.argsort(at, kind="stable")
    first = np.searchsorted(at[order], np.arange(len(drives)))
    stacked = (
        np.concatenate([getattr(part, name) for part in parts])[order]
        for name in ("n", "sums", "products")
    )
    table = GramTable(parts[0].signals, *(np.add.reduceat(values, first) for values in stacked))
    cars: dict[str, slice] = {}
    for i, (car, _, _) in enumerate(drives):
        cars[car] = slice(cars[car].start if car in cars else i, i + 1)
    return DriveSums(tuple(drives), table, cars)
