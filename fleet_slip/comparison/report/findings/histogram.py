"""True angles and estimates of all training rows, counted in one pass over the logs.

Each drive is estimated by the model that was fitted without its fold, as in cross-validation.
"""

from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import FloatArray, IntArray
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.grams.cohorts.folding import FOLD_KEYS, assign_folds
from fleet_slip.regression.exact.least_squares import LinearModel
from fleet_slip.regression.validation.crossval import CrossValidation, least_squares
from fleet_slip.resources import read_sql
from fleet_slip.selection.select_models import Selection
from fleet_slip.views import connect
from fleet_slip.warehouse.database import reading_files
from fleet_slip.warehouse.tables import Warehouse

ANGLE_DEG = 0.05
ACCELERATION_MPS2 = 0.1

Integers = IntArray


@dataclass(frozen=True)
class Histogram:
    """Numbers of rows by cell, one entry a cell; all arrays have shape (cells,).

    Attributes:
        truth, estimate: lower edge of the cell in units of `ANGLE_DEG`.
        acceleration: lower edge of its |ay| in units of `ACCELERATION_MPS2`.
        rows: number of rows in it.
    """

    truth: Integers
    estimate: Integers
    acceleration: Integers
    rows: Integers

    def reach_deg(self, share: float) -> float:
        """Return the angle that a share of the true angles and estimates stay within."""
        both = np.concatenate([self.truth, self.estimate])
        size = np.maximum(np.abs(both), np.abs(both + 1))
        return _quantile(size, np.tile(self.rows, 2), share) * ANGLE_DEG

    def trained_to_mps2(self, share: float) -> float:
        """Return the size of the lateral acceleration that a share of the rows stay below."""
        return _quantile(self.acceleration + 1, self.rows, share) * ACCELERATION_MPS2

    def cells(self, reach_deg: float) -> FloatArray:
        """Return the rows by cell, shape (estimates, truths), from -reach to +reach."""
        half = round(reach_deg / ANGLE_DEG)
        shown = (np.abs(self.truth + 0.5) < half) & (np.abs(self.estimate + 0.5) < half)
        cells = np.zeros((2 * half, 2 * half))
        np.add.at(
            cells,
            (self.estimate[shown] + half, self.truth[shown] + half),
            self.rows[shown],
        )
        return cells


def _quantile(values: Integers, weights: Integers, share: float) -> int:
    order = np.argsort(values, kind="stable")
    reached = np.cumsum(weights[order]) >= share * weights.sum()
    return int(values[order][np.argmax(reached)])


def held_out_histogram(
    warehouse: Warehouse, selection: Selection, model: CrossValidation
) -> Histogram:
    """Count the rows of a selection's cohort by true angle and held-out estimate of a model."""
    signals = catalogue()
    names = (*model.signals, signals.label)
    terms = [f"held_out.{name} * log.{signals[name].column}" for name in model.signals]
    statement = read_sql("jobs", "held_out.sql").format(
        label=signals[signals.label].column,
        estimate=" + ".join(["held_out.intercept", *terms]),
        complete=" AND ".join(f"{signals[name].column} IS NOT NULL" for name in (*names, "ay")),
    )
    widths = {"angle_deg": ANGLE_DEG, "acceleration_mps2": ACCELERATION_MPS2}
    with (
        connect(warehouse.root) as database,
        reading_files(database, "estimating held-out drives"),
    ):
        database.register("held_out", held_out_coefficients(selection, model))
        found = database.sql(statement, params=widths).to_arrow_table()
    return Histogram(**{name: found[name].to_numpy() for name in found.column_names})


def held_out_coefficients(selection: Selection, model: CrossValidation) -> pa.Table:
    """Return for each drive the model, in SI units, that was fitted without the drive's fold."""
    folding, label = selection.folds, catalogue().label
    drives = selection.cohort.drives
    assignment = assign_folds(drives[FOLD_KEYS[folding.by]].to_pylist(), folding.by, folding.count)
    folds = selection.cohort.folds(folding.by, folding.count).serving(model.signals, label)
    fit = least_squares(model.signals, label)
    scales = {name: catalogue()[name].exact_scale for name in (*model.signals, label)}
    models = [fit(training).physical(scales) for training, _ in folds.splits()]
    fold_of = dict(zip(drives["drive_id"].to_pylist(), assignment.fold.tolist(), strict=True))
    return pa.Table.from_pylist(
        [{"drive_id": drive, **_numbers(models[fold])} for drive, fold in fold_of.items()]
    )


def _numbers(model: LinearModel) -> dict[str, float]:
    return {"intercept": model.offset, **model.weights}
