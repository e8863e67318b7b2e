"""Estimates of a published model, sample by sample in the order of time, from logged counts."""

from dataclasses import dataclass

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.arithmetic import parse
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.grams.column_plan import ColumnPlan
from fleet_slip.grams.columns import DriveCounts
from fleet_slip.grams.numbered_columns import NumberedColumns
from fleet_slip.grams.row_code import RowColumn
from fleet_slip.models.manifest import Manifest


@dataclass(frozen=True)
class Predictor:
    """A published model on counts: the columns that it needs, and what a count of each adds.

    Attributes:
        columns: those of the Gram rows that it was made of.
        intercept: rad.
        coefficients: rad per physical value of each column.
        scales: physical value of a count of each column.
    """

    columns: NumberedColumns
    intercept: float
    coefficients: tuple[float, ...]
    scales: tuple[float, ...]

    @classmethod
    def of(cls, manifest: Manifest) -> "Predictor":
        """Return what a manifest publishes; its features are those that it defines itself.

        Raises `DataError` for definitions that contradict each other, and `RefusedError` if
        counts mean something else now.
        """
        features = {name: RowColumn(name, parse(sql)) for name, sql in manifest.features.items()}
        manifest.require_same_counts()
        coefficients = tuple(term.coefficient for term in manifest.terms)
        scales = tuple(
            float(catalogue()[term.signal].scale if term.logged else term.scale)
            for term in manifest.terms
        )
        columns = NumberedColumns.of(manifest.signals, features, manifest.definitions)
        return cls(columns, manifest.intercept, coefficients, scales)

    @property
    def plan(self) -> ColumnPlan:
        """What the kernel computes of a drive."""
        return self.columns.plan

    def __call__(self, drive: DriveCounts) -> FloatArray:
        """Return the estimate at each row in rad, shape (rows,); NaN where a column is missing.

        Added up from left to right, as `score --sql` does, to the same bits on every machine.
        Raises `DataError` for a drive that cannot be looked back on.
        """
        columns = self.columns.compute(drive)
        estimate: FloatArray = np.full(columns.shape[1], self.intercept)
        for column, coefficient, scale in zip(columns, self.coefficients, self.scales, strict=True):
            estimate += coefficient * (column * scale)
        return estimate
