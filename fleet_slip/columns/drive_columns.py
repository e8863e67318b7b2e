"""From the counts of one drive to the integer columns of a feature set, sample by sample.

Gram rows, scores, evaluations and predictions come through it, and it computes what
the SQL of `fleet_slip.columns.sql` says.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.catalogue.definitions import limit_of
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.columns.kernel import GAPS, run
from fleet_slip.columns.operations import CarFact
from fleet_slip.columns.plan import BLOCK_ROWS, ColumnPlan, Region
from fleet_slip.errors import DataError

_EXACT = 2**53
_COUNTS = np.iinfo(np.int16)


@dataclass(frozen=True)
class DriveCounts:
    """One drive in the order of time.

    Attributes:
        ticks: rising, shape (rows,).
        counts, present: by signal, shape (rows,); a signal that never is missing has no `present`.
        facts: what the car knows of itself, by drive column.
        numbers: counts of what the car's drives before determined; those that are known.
    """

    ticks: NDArray[Any]
    counts: Mapping[str, NDArray[Any]]
    present: Mapping[str, BoolArray] = field(default_factory=dict)
    facts: Mapping[str, Any] = field(default_factory=dict)
    numbers: Mapping[str, int] = field(default_factory=dict)

    @property
    def whole(self) -> bool:
        """Whether no tick between the first and the last is missing."""
        return bool(int(self.ticks[-1]) - int(self.ticks[0]) + 1 == len(self.ticks))

    def part(
        self, rows: Any, facts: Mapping[str, Any], numbers: Mapping[str, int]
    ) -> "DriveCounts":
        """Return some of the rows, as those of a drive of which that is known."""
        counts = {name: values[rows] for name, values in self.counts.items()}
        present = {name: values[rows] for name, values in self.present.items()}
        return DriveCounts(self.ticks[rows], counts, present, facts, numbers)


def as_counts(
    values: Mapping[str, FloatArray], names: Sequence[str], facts: Mapping[str, Any]
) -> DriveCounts:
    """Return the counts of some signals of a drive that has a row for every tick.

    The values are by SI column, shape (ticks,), NaN where null.
    """
    counts, present = {}, {}
    for name in names:
        given = values[catalogue()[name].column]
        present[name] = np.isfinite(given)
        scaled = np.where(present[name], given, 0.0) / float(catalogue()[name].scale)
        counts[name] = np.rint(scaled).astype(np.int64)
    ticks = np.arange(len(next(iter(counts.values()))))
    return DriveCounts(ticks, counts, present, facts)


class Workspace:
    """The memory of a plan's columns, for one drive after the other and one thread.

    `rows` are of the drive loaded last, `rows_at_most` those that memory was taken for.
    """

    def __init__(self, plan: ColumnPlan) -> None:
        """Take a plan; memory is taken when a drive comes."""
        self.plan, self._program = plan, plan.program
        self.rows_at_most = -1
        self.rows = 0

    def load(self, drive: DriveCounts) -> None:
        """Take a drive. Raises `DataError` for one that cannot be looked back on."""
        _require_exact(self.plan, drive)
        program, self.rows = self._program, len(drive.ticks)
        if self.rows > self.rows_at_most:
            self.rows_at_most = self.rows
            self._steps, self._regions = program.steps(self.rows), program.regions(self.rows)
            self._memory = np.zeros(self._regions[-1, 0])
        for number, name in enumerate(program.signals):
            counts = self._part(Region.SIGNAL, number, self.rows)
            counts[:] = drive.counts[name]
            if name in drive.present:
                counts[~drive.present[name]] = np.nan
        self._part(Region.TICK, 0, self.rows)[:] = drive.ticks
        for number, one in enumerate(program.of_car):
            known = (
                one.count(drive.facts[one.name])
                if isinstance(one, CarFact)
                else drive.numbers.get(one.name)
            )
            self._part(Region.OF_CAR, number, 1)[:] = np.nan if known is None else known
        self._flags = np.zeros((2, max(program.slots, program.kinds, 1)), dtype=np.bool_)
        self._flags[GAPS] = not drive.whole

    def block(self, first: int) -> tuple[FloatArray, FloatArray]:
        """Return the last block's columns, (columns, rows) with NaN, and its clipping."""
        place, stride = self._regions[Region.REGISTER]
        rows, columns = min(BLOCK_ROWS, self.rows - first), len(self.plan.names)
        registers = self._memory[place : place + columns * stride].reshape(columns, stride)
        return registers[:, :rows], self._memory[:rows]

    def compute_block(self, first: int) -> None:
        """Compute the block that begins with a row; blocks are computed in the order of time."""
        program, ticks = (self._steps, self._program.ratios), self._regions[Region.TICK, 0]
        run(*program, self._memory, self._flags, self.rows, ticks, first)

    def _part(self, region: Region, number: int, size: int) -> FloatArray:
        begin, stride = self._regions[region]
        return self._memory[begin + number * stride :][:size]


def _require_exact(plan: ColumnPlan, drive: DriveCounts) -> None:
    """Raise `DataError` for a drive of which not every sum would be exact."""
    rows = len(drive.ticks)
    if (drive.ticks[1:] <= drive.ticks[:-1]).any():
        raise DataError(
            "the ticks of a drive do not increase: it has no windows. Run: fleet-slip verify"
        )
    for one in plan.windows.values():
        summed = one.over not in {None, "lag"}
        if summed and 2 * (rows + 1) * limit_of(one.of_bits) * one.ratio.numerator >= _EXACT:
            raise DataError(f"the drive has {rows:,} rows: too many for windows.")
    if rows > plan.most_rows:
        raise DataError(f"the drive has {rows:,} rows: too many for windows.")
    for name in plan.program.signals:
        counts = drive.counts[name]
        if counts.dtype == np.int16 or not rows:
            continue
        if not _COUNTS.min <= counts.min() <= counts.max() <= _COUNTS.max:
            raise DataError(f"{name} has counts beyond 16 bits.")


class DriveColumns:
    """The columns of one drive; `clipped`, (rows,), counts those that `compute` clipped."""

    def __init__(self, plan: ColumnPlan, drive: DriveCounts) -> None:
        """Take a drive. Raises `DataError` for one that cannot be looked back on."""
        self._workspace = Workspace(plan)
        self._workspace.load(drive)
        self.clipped = np.zeros(len(drive.ticks))

    def compute(self) -> FloatArray:
        """Return all columns, shape (columns, rows), NaN where missing; count what was clipped."""
        out = np.empty((len(self._workspace.plan.names), len(self.clipped)))
        for first in range(0, len(self.clipped), BLOCK_ROWS):
            self._workspace.compute_block(first)
            block, clipped = self._workspace.block(first)
            out[:, first : first + block.shape[1]] = block
            self.clipped[first : first + block.shape[1]] = clipped
        return out
