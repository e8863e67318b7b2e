"""What the training drives tell: coefficients, the order of variables, held-out estimates."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import FloatArray, IntArray
from fleet_slip.catalogue.features import features, input_scales
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.grams.cohorts.folding import FOLD_KEYS, assign_folds
from fleet_slip.grams.cohorts.gram_cohort import Cohort
from fleet_slip.grams.cohorts.training_folds import clustered_moments
from fleet_slip.regression.choice.nested_choice import nested_fits
from fleet_slip.regression.choice.signal_orders import RANKINGS, rank
from fleet_slip.regression.choice.subsets import best_subsets
from fleet_slip.regression.exact.least_squares import fit
from fleet_slip.regression.inference.drive_moments import ClusterUnit
from fleet_slip.regression.inference.standard_errors import (
    INTERCEPT,
    Estimate,
    infer_by_clusters,
    infer_classically,
    variance_inflation,
)
from fleet_slip.regression.validation.crossval import CrossValidation, least_squares
from fleet_slip.resources import read_sql
from fleet_slip.selection.select_models import Selection
from fleet_slip.views import connect
from fleet_slip.warehouse.database import reading_files
from fleet_slip.warehouse.tables import Warehouse


@dataclass(frozen=True)
class Coefficient:
    """One row of a coefficient table.

    Attributes:
        estimate: of a signal or the intercept, with drives, or cars, as the independent pieces of
            evidence.
        unit: of the value.
        row_error: standard error as if every row were independent.
        share_deg: degrees of estimate for one standard deviation of the signal; None of a constant.
        inflation: variance inflation factor; None of the intercept.
    """

    estimate: Estimate
    unit: str
    row_error: float
    share_deg: float | None
    inflation: float | None


@dataclass(frozen=True)
class Coefficients:
    """The coefficients of one model, and the data that they are from."""

    model: str
    rows: Sequence[Coefficient]
    drives: int
    cluster: ClusterUnit
    log_rows: int


def coefficient_table(
    cohort: Cohort, model: str, inputs: Sequence[str], *, intercept: bool = True
) -> Coefficients:
    """Fit the label on the inputs over a cohort. Raises `DataError` for fewer than two drives."""
    label = catalogue().label
    served = cohort.serving(inputs)
    moments = clustered_moments(served, intercept=intercept)
    fitted = fit(served.table.total(), inputs, label, intercept=intercept)
    scales = input_scales()
    robust, naive = infer_by_clusters(fitted, moments, scales), infer_classically(fitted, scales)
    inflation = variance_inflation(fitted.gram, inputs)
    spread = dict(zip(moments.signals, moments.spread.tolist(), strict=True))
    rows = []
    for estimate, other in zip(robust.estimates, naive.estimates, strict=True):
        constant = estimate.name == INTERCEPT
        unit = "rad" if constant else f"rad per {features().of(estimate.name).unit}"
        share = None
        if not constant:
            deviation = spread[estimate.name] * float(scales[estimate.name])
            share = math.degrees(estimate.value * deviation)
        found = inflation.get(estimate.name)
        rows.append(Coefficient(estimate, unit, other.standard_error, share, found))
    return Coefficients(model, tuple(rows), len(moments), moments.unit, served.table.total().n)


CLOSE = 0.001
"""A model explains nearly all if it leaves no more than this of the variance to the full one."""


@dataclass(frozen=True)
class Ordering:
    """How many signals each ranking, and the best of all subsets, needs to explain nearly all."""

    signals: tuple[str, ...]
    needed: dict[str, int]
    best: int
    subsets: int


def compare_orders(cohort: Cohort, signals: Sequence[str]) -> Ordering:
    """Rank signals in every way beside all subsets. Raises `DataError` if no drive has them all."""
    label = catalogue().label
    total = cohort.serving(signals).table.total()
    best = best_subsets(total, signals, label, count=1)
    enough = best[-1].best.r_squared - CLOSE
    needed = {}
    for ranking in RANKINGS:
        fits = nested_fits(total, rank(ranking, total, signals, label), label)
        needed[ranking] = next(fit.size for fit in fits if fit.r_squared >= enough)
    return Ordering(
        signals=tuple(signals),
        needed=needed,
        best=next(size.best.size for size in best if size.best.r_squared >= enough),
        subsets=2 ** len(signals),
    )


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
        np.add.at(cells, (self.estimate[shown] + half, self.truth[shown] + half), self.rows[shown])
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
    with connect(warehouse.root) as database, reading_files(database, "estimating held-out drives"):
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
        [
            {"drive_id": drive, "intercept": models[fold].offset, **models[fold].weights}
            for drive, fold in fold_of.items()
        ]
    )
