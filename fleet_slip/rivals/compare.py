"""Cross-validates the rivals on the regression's folds, and measures what they cost."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.evaluation.errors import ErrorFigures, error_figures
from fleet_slip.evaluation.estimators import TABLE_ONE, Signals
from fleet_slip.grams.cohort import Cohort
from fleet_slip.rivals.learners import LEARNERS, Fitted, Learner, one_thread
from fleet_slip.rivals.sample import Sample, draw_sample
from fleet_slip.selection.model_list import load_model_list
from fleet_slip.warehouse.tables import Warehouse

GROUP = "rivals"

TWO_SIGNALS = ("ay", "yaw_rate")
"""The inputs of the first neural network that the paper cites, [5]."""

FOLDS = 5
SINGLE_ESTIMATES = 200
MANY_ROWS = 10_000


def all_signals() -> tuple[str, ...]:
    """Return the signals of model 4 of Table I, which the paper settles on."""
    models = load_model_list(TABLE_ONE).model
    return next(model.signals for model in models if model.name == "4")


@dataclass(frozen=True)
class TrainedRival:
    """One learner on one set of signals.

    Attributes:
        name: learner and number of signals.
        learner: what was fitted.
        signals: its inputs.
        fitted: fit to the whole sample.
        cross_validated: figures on drives that it was not fitted on, pooled over the folds.
        rows: rows of the sample.
        training_s: time to fit the whole sample.
        one_estimate_us: time of one estimate by itself, as on board; the median of many.
        each_of_many_us: time of each of many estimates at once.
    """

    name: str
    learner: Learner
    signals: tuple[str, ...]
    fitted: Fitted
    cross_validated: ErrorFigures
    rows: int
    training_s: float
    one_estimate_us: float
    each_of_many_us: float

    def estimate(self, signals: Signals) -> FloatArray:
        """Estimate side-slip in rad of a drive; NaN where an input is null."""
        inputs = np.stack([signals[catalogue()[name].column] for name in self.signals], axis=1)
        complete = np.isfinite(inputs).all(axis=1)
        estimates = np.full(len(inputs), np.nan)
        if complete.any():
            with one_thread():
                estimates[complete] = self.fitted.predict(inputs[complete])
        return estimates

    def description(self) -> dict[str, Any]:
        """Return what a JSON document says of it as an estimator."""
        return {"kind": "rival", "group": GROUP, "signals": list(self.signals)}

    def as_dict(self) -> dict[str, Any]:
        """Return what a JSON document says of its accuracy and cost."""
        return {
            "name": self.name,
            "learner": self.learner.description,
            "signals": list(self.signals),
            "rows": self.rows,
            "cross_validated": self.cross_validated.as_dict(),
            "training_s": self.training_s,
            "size_bytes": self.fitted.size_bytes,
            "one_estimate_us": self.one_estimate_us,
            "each_of_many_us": self.each_of_many_us,
        }


def train_rivals(warehouse: Warehouse, cohort: Cohort) -> tuple[TrainedRival, ...]:
    """Fit and cross-validate every learner on both sets of signals."""
    sample = draw_sample(warehouse, cohort, all_signals())
    sets = (TWO_SIGNALS, all_signals())
    with one_thread():
        return tuple(train(learner, sample, signals) for learner in LEARNERS for signals in sets)


def train(learner: Learner, sample: Sample, signals: tuple[str, ...]) -> TrainedRival:
    """Fit and cross-validate one learner, and measure it."""
    inputs = sample.of(tuple(catalogue()[name].column for name in signals))
    started = time.perf_counter()
    fitted = learner.fit(inputs, sample.sideslip_rad)
    training_s = time.perf_counter() - started
    many = inputs[:MANY_ROWS]
    singles = [
        _seconds(fitted.predict, inputs[i : i + 1]) for i in range(min(SINGLE_ESTIMATES, len(many)))
    ]
    return TrainedRival(
        name=f"{learner.name}_{len(signals)}",
        learner=learner,
        signals=signals,
        fitted=fitted,
        cross_validated=cross_validate_learner(learner, inputs, sample),
        rows=len(inputs),
        training_s=training_s,
        one_estimate_us=float(np.median(singles)) * 1e6,
        each_of_many_us=_seconds(fitted.predict, many) / len(many) * 1e6,
    )


def cross_validate_learner(learner: Learner, inputs: FloatArray, sample: Sample) -> ErrorFigures:
    """Return the figures on rows of drives that each fold's fit has not seen."""
    folds = sample.folds(FOLDS)
    estimates = np.full(len(inputs), np.nan)
    for fold in range(len(folds.names)):
        test = folds.fold == fold
        fitted = learner.fit(inputs[~test], sample.sideslip_rad[~test])
        estimates[test] = fitted.predict(inputs[test])
    return error_figures(estimates, sample.sideslip_rad, np.ones(len(inputs), dtype=np.bool_))


def _seconds(predict: Callable[[FloatArray], FloatArray], rows: FloatArray) -> float:
    started = time.perf_counter()
    predict(rows)
    return time.perf_counter() - started
