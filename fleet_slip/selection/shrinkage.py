"""Ridge, lasso and Pace regression beside least squares, cross-validated on the same folds."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import QuestionError
from fleet_slip.grams.cohorts.folding import Folding
from fleet_slip.grams.cohorts.gram_cohort import Cohort
from fleet_slip.grams.cohorts.training_folds import drive_folds
from fleet_slip.regression.choice.lars import fit_lasso
from fleet_slip.regression.choice.nested_choice import FEWEST_FOLDS, nested_fits
from fleet_slip.regression.exact.least_squares import Scales
from fleet_slip.regression.inference.drive_moments import ClusterUnit
from fleet_slip.regression.inference.evidence import Evidence
from fleet_slip.regression.shrinkage.pace import ESTIMATORS, Estimator, shrink
from fleet_slip.regression.shrinkage.ridge import fit_ridge
from fleet_slip.regression.validation.crossval import (
    CrossValidation,
    Procedure,
    assemble,
    cross_validate,
    held_out_errors,
    least_squares,
)
from fleet_slip.regression.validation.folds import Folds
from fleet_slip.selection.search import told_figures

PENALTIES = tuple(float(10.0**exponent) for exponent in np.arange(-6, 0.01, 0.5))
"""Penalties on the correlation matrix that ridge and lasso choose from."""


@dataclass(frozen=True)
class Shrunk:
    """One method: its figures, and the penalty chosen on all rows, if it has one."""

    cross_validation: CrossValidation
    penalty: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return what a JSON document needs."""
        return {**told_figures(self.cross_validation), "penalty": self.penalty}


def compare_shrinkage(
    cohort: Cohort,
    inputs: Sequence[str],
    folding: Folding,
    *,
    naive: bool = False,
    cluster: ClusterUnit | None = None,
) -> tuple[Shrunk, ...]:
    """Cross-validate every method on the drives that have all the inputs.

    Ridge and lasso choose penalties inside each training fold. Pace's noise is larger by the design
    effect of drives or cars, unless `naive`. Raises `QuestionError` for fewer than three folds, and
    `DataError` for dependent signals.
    """
    label = catalogue().label
    ready = drive_folds(cohort, inputs, folding, cluster=cluster)
    folds, scales = ready.training.folds, ready.training.scales
    if len(folds.grams) < FEWEST_FOLDS:
        raise QuestionError("choosing a penalty inside the training folds needs three folds.")
    effect = 1.0
    if not naive:
        fits = nested_fits(folds.total, inputs, label)
        effect = Evidence.clustered(fits, ready.moments).design_effect
    found = [Shrunk(cross_validate("least squares", folds, least_squares(inputs, label), scales))]
    penalised: dict[str, Callable[[float], Procedure]] = {
        "ridge": lambda penalty: lambda gram: fit_ridge(gram, inputs, label, penalty),
        "lasso": lambda penalty: lambda gram: fit_lasso(gram, inputs, label, penalty),
    }
    found += [_penalised(name, folds, make, scales) for name, make in penalised.items()]
    for name, estimator in ESTIMATORS.items():
        procedure = _shrinking(inputs, label, _by_effect(estimator, effect))
        found.append(Shrunk(cross_validate(name, folds, procedure, scales)))
    return tuple(found)


def _shrinking(inputs: Sequence[str], label: str, estimator: Estimator) -> Procedure:
    return lambda gram: shrink(gram, inputs, label, estimator)


def _by_effect(estimator: Estimator, effect: float) -> Estimator:
    """Measure the effects in units of a noise that is larger by the design effect."""
    unit = effect**0.5
    return lambda a: estimator(a / unit) * unit


def _penalised(
    name: str, folds: Folds, make: Callable[[float], Procedure], scales: Scales
) -> Shrunk:
    tests = []
    for i, test in enumerate(folds.grams):
        rest = folds.without(i, folds.drives)
        model = make(_best_penalty(rest, make))(rest.total)
        tests.append(held_out_errors(model, rest.total, test))
    penalty = _best_penalty(folds, make)
    return Shrunk(assemble(name, folds, tests, make(penalty)(folds.total), scales), penalty)


def _best_penalty(folds: Folds, make: Callable[[float], Procedure]) -> float:
    """Return the penalty with the least squared error on held-out folds."""

    def error(penalty: float) -> float:
        procedure = make(penalty)
        total = 0.0
        for training, test in folds.splits():
            total += float(held_out_errors(procedure(training), training, test).squared_error)
        return total

    return min(PENALTIES, key=error)
