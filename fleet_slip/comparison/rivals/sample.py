"""A sample of a cohort's rows: what a Gram matrix does without, and these rivals cannot."""

from dataclasses import dataclass, replace

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.comparison.rivals.inputs import Inputs
from fleet_slip.comparison.rivals.learner import Names
from fleet_slip.errors import DataError
from fleet_slip.grams.cohorts.expansion import CarCounts
from fleet_slip.grams.cohorts.folding import assign_folds
from fleet_slip.grams.cohorts.gram_cohort import Cohort
from fleet_slip.grams.cohorts.reader import cohort_files
from fleet_slip.grams.rows.drive_rows import read_drives
from fleet_slip.regression.validation.folds import FoldAssignment
from fleet_slip.warehouse.tables import Warehouse

SAMPLE_ROWS = 60_000
"""Rows of a sample, about. Neighbours at 100 Hz say almost the same, so that little is lost."""


@dataclass(frozen=True)
class RowSample:
    """Rows evenly spaced in time over all drives.

    Attributes:
        names: of the inputs.
        inputs: physical values, shape (rows, inputs).
        sideslip_rad: shape (rows,).
        trip: the trip of each row, called by its first drive.
    """

    names: tuple[str, ...]
    inputs: FloatArray
    sideslip_rad: FloatArray
    trip: Names

    def of(self, names: tuple[str, ...]) -> FloatArray:
        """Return some of the inputs, shape (rows, inputs)."""
        return self.inputs[:, [self.names.index(name) for name in names]]

    def folds(self, count: int) -> FoldAssignment:
        """Divide the rows as the regression's cross-validation divides the drives."""
        return assign_folds(self.trip.tolist(), "drive", count)


def draw_sample(
    warehouse: Warehouse,
    cohort: Cohort,
    inputs: Inputs,
    rows: int = SAMPLE_ROWS,
    numbers: CarCounts | None = None,
) -> RowSample:
    """Draw about so many rows of a cohort that have all inputs and the label.

    The columns are those of the cohort's Gram rows, computed over whole drives by the same code;
    `numbers` are what the cars' drives told of them. Raises `DataError` if there is no such row.
    """
    with_label = inputs.beside(catalogue().label)
    plan = with_label.columns.plan
    trips = dict(zip(*(cohort.drives[n].to_pylist() for n in ("drive_id", "trip")), strict=True))
    stride = max(1, cohort.rows // rows)
    parts: list[FloatArray] = []
    names: list[str] = []
    files = cohort_files(warehouse, cohort.condition)
    for file in (one for one in warehouse.logs.snapshot().files if one.path in files):
        for drive in read_drives(warehouse, file, plan):
            if drive.drive_id not in trips:
                continue
            told = (numbers or {}).get(str(drive.metadata["vehicle_id"]), {})
            values = with_label.values(replace(drive.counts, numbers=told))
            values = values[drive.counts.ticks % stride == 0]
            parts.append(values[np.isfinite(values).all(axis=1)])
            names.extend([drive.drive_id] * len(parts[-1]))
    if not names:
        raise DataError(
            f"no row of {cohort.condition.text!r} has all of {', '.join(with_label.names)}."
        )
    order = np.argsort(np.array(names), kind="stable")
    found = np.concatenate(parts)[order]
    trip = np.array([trips[names[at]] for at in order])
    return RowSample(inputs.names, found[:, :-1], found[:, -1], trip)
