"""Ranking and criterion together: which of the k+1 nested models, and how well that choice does.

A choice flatters its winner, so that it is made again inside every training fold.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fleet_slip.arrays import IntArray
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.regression.choice.signal_orders import rank
from fleet_slip.regression.choice.subsets import best_size, criterion_values
from fleet_slip.regression.choice.winner import DEFAULT_WORTH, Worth, choose
from fleet_slip.regression.exact.elimination import eliminate
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.regression.exact.least_squares import Fit, Scales, dependence, fit_leading, moments
from fleet_slip.regression.inference.drive_moments import DriveMoments
from fleet_slip.regression.inference.evidence import Evidence
from fleet_slip.regression.validation.crossval import (
    CrossValidation,
    assemble,
    cross_validate,
    held_out_errors,
    least_squares,
)
from fleet_slip.regression.validation.folds import Folds


def nested_fits(
    gram: Gram, order: Sequence[str], label: str, *, intercept: bool = True
) -> list[Fit]:
    """Return the exact fits of the first 0..k signals. Raises `DataError` for dependent ones."""
    part = gram.restrict([*order, label])
    triangle = eliminate(moments(part, intercept=intercept))
    if triangle.singular is not None:
        raise DataError(dependence(part, order, intercept=intercept))
    sizes = range(len(order) + 1)
    return [fit_leading(part, triangle, size, intercept=intercept) for size in sizes]


CROSS_VALIDATION = "cross-validation"
"""The criterion that cross-validates all nested models; the smallest that is nearly best wins."""


FEWEST_FOLDS = 3
"""To make a choice again inside the training folds, two of them must be left."""


@dataclass(frozen=True)
class Rule:
    """A ranking, a criterion or `CROSS_VALIDATION`, and what a signal must gain to be kept."""

    ranking: str
    criterion: str
    worth: Worth = DEFAULT_WORTH


@dataclass(frozen=True)
class NestedChoice:
    """A choice of the first `size` signals of an order, their exact fit and its evidence.

    `values` of the criterion are for 0..k signals, smaller being better; of cross-validation they
    are the negative correlations.
    """

    order: tuple[str, ...]
    size: int
    fit: Fit
    evidence: Evidence
    values: tuple[float, ...]

    @property
    def signals(self) -> tuple[str, ...]:
        """The chosen signals."""
        return self.order[: self.size]

    def as_dict(self) -> dict[str, Any]:
        """Return what a JSON document needs."""
        return {
            "order": list(self.order),
            "signals": list(self.signals),
            "criterion_values": list(self.values),
            **self.evidence.as_dict(),
        }


@dataclass(frozen=True)
class NestedDistances:
    """Distances D of the nested models of an order; `null` is the model without any signal."""

    order: tuple[str, ...]
    evidence: Evidence
    null: CrossValidation

    def as_dict(self) -> dict[str, Any]:
        """Return what a JSON document needs."""
        return {"order": list(self.order), **self.evidence.as_dict(), "null": self.null.as_dict()}


@dataclass(frozen=True)
class TrainingFolds:
    """The rows to choose on: their folds, and per-drive moments of them (None: rows independent).

    `scales` is the physical value of a count of each signal. Without `intercept` moments are about
    zero.
    """

    folds: Folds
    drives: DriveMoments | None
    scales: Scales
    intercept: bool = True

    @property
    def total(self) -> Gram:
        """The Gram to rank and search on."""
        return self.folds.total if self.intercept else self.folds.total.about_origin()

    def nested_fits(self, order: Sequence[str], label: str) -> list[Fit]:
        """Return the k+1 nested fits of an order. Raises `DataError` for dependent signals."""
        return nested_fits(self.folds.total, order, label, intercept=self.intercept)

    def evidence(self, fits: Sequence[Fit]) -> Evidence:
        """Return what the rows say of the nested models of an order; raises like `Evidence`."""
        if self.drives is None:
            return Evidence.naive(fits)
        return Evidence.clustered(fits, self.drives)

    def cross_validate(self, name: str, inputs: Sequence[str], label: str) -> CrossValidation:
        """Cross-validate least squares on given inputs."""
        procedure = least_squares(inputs, label, intercept=self.intercept)
        return cross_validate(name, self.folds, procedure, self.scales)


def select_nested(
    training: TrainingFolds, inputs: Sequence[str], label: str, rule: Rule
) -> NestedChoice:
    """Rank the inputs and choose a nested model. Raises `DataError` and `QuestionError`."""
    order = rank(rule.ranking, training.total, inputs, label)
    fits = training.nested_fits(order, label)
    evidence = training.evidence(fits)
    if rule.criterion == CROSS_VALIDATION:
        models = cross_validate_nested(training, order, label)
        size = len(choose(models, rule.worth).model.signals)
        values = tuple(-model.correlation for model in models)
    else:
        size = best_size(rule.criterion, evidence)
        values = tuple(criterion_values(rule.criterion, evidence).tolist())
    return NestedChoice(order, size, fits[size], evidence, values)


def measure_distances(training: TrainingFolds, order: Sequence[str], label: str) -> NestedDistances:
    """Return the distances of an order as it is given. Raises `DataError` as `select_nested`."""
    evidence = training.evidence(training.nested_fits(order, label))
    null = training.cross_validate("none", (), label)
    return NestedDistances(tuple(order), evidence, null)


def cross_validate_nested(
    training: TrainingFolds, order: Sequence[str], label: str
) -> list[CrossValidation]:
    """Cross-validate the k+1 nested models of a given order; model j is called "first j"."""
    return [
        training.cross_validate(f"first {size}", order[:size], label)
        for size in range(len(order) + 1)
    ]


def cross_validate_selection(
    name: str,
    training: TrainingFolds,
    fold: IntArray,
    inputs: Sequence[str],
    label: str,
    rule: Rule,
) -> CrossValidation:
    """Cross-validate the choice itself, `fold` saying each drive's fold. Raises `DataError`."""
    folds = training.folds
    tests = []
    for number, test in enumerate(folds.grams):
        rest = _without(training, fold, number)
        model = select_nested(rest, inputs, label, rule).fit.model
        tests.append(held_out_errors(model, rest.folds.total, test))
    chosen = select_nested(training, inputs, label, rule).fit.model
    return assemble(name, folds, tests, chosen, training.scales)


def _without(training: TrainingFolds, fold: IntArray, number: int) -> TrainingFolds:
    if len(training.folds.grams) < FEWEST_FOLDS:
        raise QuestionError("choosing inside the training folds needs at least three folds.")
    drives = training.drives
    rest = training.folds.without(number, int(np.count_nonzero(fold != number)))
    return replace(
        training, folds=rest, drives=drives.take(fold != number) if drives is not None else None
    )
