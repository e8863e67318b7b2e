"""Cross-validates the rivals on the regression's folds, and measures what they cost."""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.comparison.evaluation.estimators import TABLE_ONE
from fleet_slip.comparison.evaluation.evaluate import Rival
from fleet_slip.comparison.evaluation.filters import Bank
from fleet_slip.comparison.evaluation.scenario_runs import ErrorFigures, error_figures
from fleet_slip.comparison.rivals.inputs import Inputs, LearnedEstimate, RowSample, draw_sample
from fleet_slip.comparison.rivals.learner import FittedLearner, Learner, one_thread
from fleet_slip.comparison.rivals.learners import LEARNERS, OF_WINDOWS
from fleet_slip.comparison.rivals.tree_filter import BASE, train_tree_filter
from fleet_slip.grams.calibration.calibration import calibrate
from fleet_slip.grams.cohorts.gram_cohort import Cohort
from fleet_slip.models.manifest import Manifest
from fleet_slip.regression.validation.folds import FoldAssignment
from fleet_slip.selection.model_list import load_model_list
from fleet_slip.warehouse.tables import Warehouse

TWO_SIGNALS = ("ay", "yaw_rate")
"""The inputs of the first neural network that the paper cites, [5]."""

FOLDS = 5
SINGLE_ESTIMATES = 200
MANY_ROWS = 10_000


def all_signals() -> tuple[str, ...]:
    """Return the signals of model 4 of Table I, which the paper settles on."""
    models = load_model_list(TABLE_ONE).model
    return next(model.signals for model in models if model.name == "4")


def train_rivals(
    warehouse: Warehouse, cohort: Cohort, manifest: Manifest, bank: Bank
) -> tuple[Rival, ...]:
    """Fit and cross-validate every learner on two sets of signals and on a published model's.

    All are fitted on one sample of rows, whose columns are those of the model's Gram rows. The
    filter with a tree is fitted on the drives that filters are tuned on.
    """
    every = Inputs.of_model(manifest, all_signals())
    numbers = calibrate(warehouse).counts() if every.plan.numbers else None
    sample = draw_sample(warehouse, cohort, every, numbers=numbers)
    sets: list[tuple[str, Inputs, Sequence[Learner]]] = [
        (str(len(names)), Inputs.of_signals(names), LEARNERS)
        for names in (TWO_SIGNALS, all_signals())
    ]
    if set(every.names) != set(all_signals()):
        sets.append(("windows", every, OF_WINDOWS))
    with one_thread(), ThreadPoolExecutor(1) as executor:
        learned = [
            train(learner, sample, inputs, suffix)
            for suffix, inputs, learners in sets
            for learner in learners
        ]
        drives = bank.drives.read()
        return (*learned, train_tree_filter(bank.estimators[BASE], drives, executor))


def train(learner: Learner, sample: RowSample, inputs: Inputs, suffix: str) -> Rival:
    """Fit and cross-validate one learner, and measure it."""
    values = sample.of(inputs.names)
    started = time.perf_counter()
    fitted = learner.fit(values, sample.sideslip_rad, sample.trip)
    training_s = time.perf_counter() - started
    one_us, each_us = time_estimates(fitted, values)
    return Rival(
        name=f"{learner.name}_{suffix}",
        learner=learner.description,
        estimate=LearnedEstimate(inputs, fitted),
        signals=inputs.names,
        cross_validated=cross_validate_learner(learner, values, sample, sample.folds(FOLDS)),
        rows=len(values),
        training_s=training_s,
        size_bytes=fitted.size_bytes,
        one_estimate_us=one_us,
        each_of_many_us=each_us,
    )


def time_estimates(fitted: FittedLearner, values: FloatArray) -> tuple[float, float]:
    """Return the microseconds of one estimate by itself, and of each of many at once."""
    many = values[:MANY_ROWS]
    singles = [
        _seconds(fitted.predict, values[i : i + 1]) for i in range(min(SINGLE_ESTIMATES, len(many)))
    ]
    return float(np.median(singles)) * 1e6, _seconds(fitted.predict, many) / len(many) * 1e6


def cross_validate_learner(
    learner: Learner, inputs: FloatArray, sample: RowSample, folds: FoldAssignment
) -> ErrorFigures:
    """Return the figures on rows that each fold's fit has not seen."""
    estimates = np.full(len(inputs), np.nan)
    for fold in range(len(folds.names)):
        test = folds.fold == fold
        fitted = learner.fit(inputs[~test], sample.sideslip_rad[~test], sample.trip[~test])
        estimates[test] = fitted.predict(inputs[test])
    return error_figures(estimates, sample.sideslip_rad, np.ones(len(inputs), dtype=np.bool_))


def _seconds(predict: Callable[[FloatArray], FloatArray], rows: FloatArray) -> float:
    started = time.perf_counter()
    predict(rows)
    return time.perf_counter() - started
