"""Columns of one drive, row by row, those times a number of its car among them.

The kernel computes what they are made of; the numbers come after it, exactly: products of two
whole numbers below 2^53.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.definitions import Definition, Number
from fleet_slip.columns.blocks.column_plan import ColumnPlan
from fleet_slip.columns.blocks.drive_columns import DriveColumns, DriveCounts
from fleet_slip.columns.blocks.row_code import RowColumn

_OF, _RUNNING = "_of_number", "_for_number"
"""What the names of the columns end in that a calibrated column is made of."""


@dataclass(frozen=True)
class NumberedColumns:
    """What to compute of a drive.

    Attributes:
        names: the columns, in order.
        factors: the number of each calibrated column.
        plan: what the kernel computes.
    """

    names: tuple[str, ...]
    factors: Mapping[str, Number]
    plan: ColumnPlan

    @classmethod
    def of(
        cls,
        names: Sequence[str],
        features: Mapping[str, RowColumn],
        definitions: Mapping[str, Definition],
    ) -> "NumberedColumns":
        """Plan columns as `ColumnPlan.of` does, which raises what it raises."""
        plain = {name: one for name, one in definitions.items() if one.number is None}
        factors = {name: one.number for name, one in definitions.items() if one.number}
        wanted = [name for name in names if name not in factors]
        for name, number in factors.items():
            plain[name + _OF] = definitions[name].model_copy(update={"number": None})
            wanted.append(name + _OF)
            if number.running is not None:
                plain[name + _RUNNING] = number.running
                wanted.append(name + _RUNNING)
        return cls(tuple(names), factors, ColumnPlan.of(wanted, features, plain))

    @property
    def numbers(self) -> tuple[str, ...]:
        """What the drives of a car must have told of it, or running means stand for."""
        return tuple(dict.fromkeys(number.name for number in self.factors.values()))

    def compute(self, drive: DriveCounts) -> FloatArray:
        """Return the columns, shape (columns, rows); missing is NaN. Raises `DataError`."""
        return self.complete(DriveColumns(self.plan, drive).compute(), drive)

    def complete(self, computed: FloatArray, drive: DriveCounts) -> FloatArray:
        """Return the columns, given those of the plan on some rows of a drive, as it has them."""
        if not self.factors:
            return computed
        found = dict(zip(self.plan.names, computed, strict=True))
        for name, number in self.factors.items():
            of = found[name + _OF]
            factor = self._factor(name, number, drive, found)
            found[name] = np.where(np.isnan(of), np.nan, factor) if number.alone else of * factor
        return np.stack([found[name] for name in self.names])

    def _factor(
        self, name: str, number: Number, drive: DriveCounts, found: Mapping[str, FloatArray]
    ) -> FloatArray | float:
        """Return a number of the car; what stands for it, if the car has none yet."""
        if number.name in drive.numbers:
            return float(drive.numbers[number.name] - number.less)
        return found.get(name + _RUNNING, 0.0)  # a usual car's is 0
