"""Estimates of a published model, sample by sample in the order of time, from logged counts."""

from dataclasses import dataclass

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.arithmetic import parse
from fleet_slip.catalogue.features import input_scales
from fleet_slip.grams.columns import ColumnPlan, DriveColumns, DriveCounts, RowColumn
from fleet_slip.models.counts_model import counts_model
from fleet_slip.models.manifest import Manifest


@dataclass(frozen=True)
class Predictor:
    """A published model on counts: the columns that it needs, and what a count of each adds.

    Attributes:
        plan: the columns, those of the Gram rows that it was made of.
        intercept: rad.
        weights: rad per count of each column, shape (columns,).
    """

    plan: ColumnPlan
    intercept: float
    weights: FloatArray

    @classmethod
    def of(cls, manifest: Manifest) -> "Predictor":
        """Return what a manifest publishes; its features are those that it defines itself.

        Raises `DataError` for definitions that contradict each other, and `RefusedError` if
        counts mean something else now.
        """
        features = {name: RowColumn(name, parse(sql)) for name, sql in manifest.features.items()}
        unit = input_scales()[manifest.label.signal]
        weights = [float(coefficient * unit) for coefficient in counts_model(manifest).coefficients]
        plan = ColumnPlan.of(manifest.signals, features, manifest.definitions)
        return cls(plan, manifest.intercept, np.array(weights))

    def __call__(self, drive: DriveCounts) -> FloatArray:
        """Return the estimate at each row in rad, shape (rows,); NaN where a column is missing.

        Raises `DataError` for a drive that cannot be looked back on.
        """
        columns: FloatArray = DriveColumns(self.plan, drive).compute()
        estimates: FloatArray = self.intercept + self.weights @ columns
        return estimates
