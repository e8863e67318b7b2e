"""Computes the integer columns of a feature set from the counts of one drive.

Gram rows, scores, evaluations and predictions come through it, and it computes what
the SQL of `fleet_slip.columns.column_sql` says.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.catalog.definitions import limit_of
from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.columns.block_program import BLOCK_ROWS, ColumnPlan, Region
from fleet_slip.columns.kernel import GAPS, run
from fleet_slip.columns.lowering import VehicleAttribute
from fleet_slip.errors import DataError

_EXACT = 2**53
_COUNTS = np.iinfo(np.int16)


@dataclass(frozen=True)
class DriveCounts:
    """The counts of one drive.

    Attributes
    ----------
    ticks
        Increasing, shape (rows,).
    counts, present
        By signal, shape (rows,); a signal without missing values has no `present`.
    facts
        Vehicle attributes, by drive column.
    numbers
        Counts of the known calibration parameters.
    """

    ticks: NDArray[Any]
    counts: Mapping[str, NDArray[Any]]
    present: Mapping[str, BoolArray] = field(default_factory=dict)
    facts: Mapping[str, Any] = field(default_factory=dict)
    numbers: Mapping[str, int] = field(default_factory=dict)

    @property
    def is_complete(self) -> bool:
        """True if no tick between the first and the last is missing."""
        return bool(int(self.ticks[-1]) - int(self.ticks[0]) + 1 == len(self.ticks))

    def segment(
        self, rows: Any, facts: Mapping[str, Any], numbers: Mapping[str, int]
    ) -> "DriveCounts":
        """Return some rows, with these attributes and parameters."""
        counts = {name: values[rows] for name, values in self.counts.items()}
        present = {name: values[rows] for name, values in self.present.items()}
        return DriveCounts(self.ticks[rows], counts, present, facts, numbers)


def as_counts(
    signals: SignalCatalog,
    values: Mapping[str, FloatArray],
    names: Sequence[str],
    facts: Mapping[str, Any],
) -> DriveCounts:
    """Return the counts of some signals of a drive that has a row for every tick.

    The values are by SI column, shape (ticks,), NaN where null.
    """
    counts, present = {}, {}
    for name in names:
        column = values[signals[name].column]
        present[name] = np.isfinite(column)
        scaled = np.where(present[name], column, 0.0) / float(signals[name].scale)
        counts[name] = np.rint(scaled).astype(np.int64)
    ticks = np.arange(len(next(iter(counts.values()))))
    return DriveCounts(ticks, counts, present, facts)


class Workspace:
    """Reusable memory of a plan's columns, for one thread.

    `rows_at_most` is the number of rows for which memory is allocated.
    """

    def __init__(self, plan: ColumnPlan) -> None:
        """Set the plan; memory is allocated with the first drive."""
        self.plan, self._program = plan, plan.program
        self.rows_at_most = -1

    def blocks(self, drive: DriveCounts) -> Iterator[tuple[slice, FloatArray, FloatArray]]:
        """Yield blocks of a drive: row range, values, and number of clipped values per row.

        Values have the shape (columns, rows), NaN where missing; their memory is reused. Raises
        `DataError` for a drive with invalid ticks or too many rows.
        """
        rows, columns = len(drive.ticks), len(self.plan.names)
        self._load(drive, rows)
        place, stride = self._regions[Region.REGISTER]
        registers = self._memory[place : place + columns * stride].reshape(columns, stride)
        program, ticks = (self._steps, self._program.ratios), self._regions[Region.TICK, 0]
        recursion = self._program.code.recursion
        recursive = (recursion.code, recursion.memory(), self._program.outputs)
        for first in range(0, rows, BLOCK_ROWS):
            run(*program, self._memory, self._flags, rows, ticks, first, *recursive)
            size = min(BLOCK_ROWS, rows - first)
            yield slice(first, first + size), registers[:, :size], self._memory[:size]

    def _load(self, drive: DriveCounts, rows: int) -> None:
        _require_exact(self.plan, drive)
        program, code = self._program, self._program.code
        if rows > self.rows_at_most:
            self.rows_at_most = rows
            self._steps, self._regions = program.steps(rows), program.regions(rows)
            self._memory = np.zeros(self._regions[-1, 0])
        for number, name in enumerate(code.signals):
            counts = self._part(Region.SIGNAL, number, rows)
            counts[:] = drive.counts[name]
            if name in drive.present:
                counts[~drive.present[name]] = np.nan
        self._part(Region.TICK, 0, rows)[:] = drive.ticks
        for number, car_input in enumerate(code.of_car):
            value = (
                car_input.count(drive.facts[car_input.name])
                if isinstance(car_input, VehicleAttribute)
                else drive.numbers.get(car_input.name)
            )
            self._part(Region.OF_CAR, number, 1)[:] = np.nan if value is None else value
        summed = max(len(code.summed), len(code.kinds), 1)
        self._flags = np.zeros((2, summed), dtype=np.bool_)
        self._flags[GAPS] = not drive.is_complete

    def _part(self, region: Region, number: int, size: int) -> FloatArray:
        begin, stride = self._regions[region]
        return self._memory[begin + number * stride :][:size]


def _require_exact(plan: ColumnPlan, drive: DriveCounts) -> None:
    """Raise `DataError` for a drive whose sums may not be exact."""
    rows = len(drive.ticks)
    if (drive.ticks[1:] <= drive.ticks[:-1]).any():
        raise DataError(
            "the ticks of a drive do not increase: it has no windows. Run: fleet-slip verify"
        )
    for window in plan.windows.values():
        summed = window.over not in {None, "lag"}
        if summed and 2 * (rows + 1) * limit_of(window.of_bits) * window.ratio.numerator >= _EXACT:
            raise DataError(f"the drive has {rows:,} rows: too many for windows.")
    if rows > plan.most_rows:
        raise DataError(f"the drive has {rows:,} rows: too many for windows.")
    for name in plan.program.code.signals:
        counts = drive.counts[name]
        if counts.dtype == np.int16 or not rows:
            continue
        if not _COUNTS.min <= counts.min() <= counts.max() <= _COUNTS.max:
            raise DataError(f"{name} has counts beyond 16 bits.")


def compute_columns(plan: ColumnPlan, drive: DriveCounts) -> FloatArray:
    """Return all columns of a drive, (columns, rows), NaN where missing; raises as `blocks`."""
    columns = np.empty((len(plan.names), len(drive.ticks)))
    for rows, block, _ in Workspace(plan).blocks(drive):
        columns[:, rows] = block
    return columns
