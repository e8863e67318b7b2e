"""Ranking and criterion together: which of the k+1 nested models, and how well that choice does.

A choice made on the data flatters the figures of its winner. The honest figures come from making
the whole choice again inside every training fold: ranking, evidence, criterion and fit.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fleet_slip.arrays import IntArray
from fleet_slip.errors import QuestionError
from fleet_slip.regression.criteria import best_size, criterion_values
from fleet_slip.regression.crossval import (
    CrossValidation,
    assemble,
    cross_validate,
    held_out_errors,
    least_squares,
)
from fleet_slip.regression.drive_moments import DriveMoments
from fleet_slip.regression.evidence import Evidence
from fleet_slip.regression.exact import Fit, Scales
from fleet_slip.regression.folds import Folds
from fleet_slip.regression.nested import nested_fits
from fleet_slip.regression.ranking import rank
from fleet_slip.regression.winner import DEFAULT_WORTH, Worth, choose

CROSS_VALIDATION = "cross-validation"
"""The criterion that cross-validates all nested models; the smallest that is nearly best wins."""


FEWEST_FOLDS = 3
"""To make a choice again inside the training folds, two of them must be left."""


@dataclass(frozen=True)
class Rule:
    """How to choose: a name in `RANKINGS`, and one in `CRITERIA` or `CROSS_VALIDATION`.

    `worth` is what a signal must gain for cross-validation to keep it.
    """

    ranking: str
    criterion: str
    worth: Worth = DEFAULT_WORTH


@dataclass(frozen=True)
class NestedChoice:
    """A choice among the nested models of an order.

    Attributes:
        order: the ranked signals.
        size: how many of them are chosen.
        fit: exact fit of the chosen ones, in counts.
        evidence: what the criterion looked at.
        values: of the criterion for 0..k signals, smaller is better; for cross-validation the
            negative correlations.
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
            "contributions": list(self.evidence.contributions),
            "distances_to_full": self.evidence.excess().tolist(),
            "expected_distances": list(self.evidence.distances()),
            "evidence": self.evidence.kind,
            "effective_rows": self.evidence.rows,
            "design_effect": self.evidence.design_effect,
        }


@dataclass(frozen=True)
class Training:
    """The rows to choose on.

    Attributes:
        folds: their folds; the criteria use the total, cross-validation the folds.
        drives: per-drive moments of the same rows; None takes rows for independent.
        scales: physical value of one count of each signal.
    """

    folds: Folds
    drives: DriveMoments | None
    scales: Scales


def select_nested(
    training: Training, inputs: Sequence[str], label: str, rule: Rule
) -> NestedChoice:
    """Rank the inputs, and choose one of the nested models.

    Raises `DataError` for dependent signals or a label without noise, and `QuestionError` for an
    unknown rule.
    """
    total = training.folds.total
    order = rank(rule.ranking, total, inputs, label)
    fits = nested_fits(total, order, label)
    if training.drives is None:
        evidence = Evidence.naive(fits)
    else:
        evidence = Evidence.clustered(fits, training.drives)
    if rule.criterion == CROSS_VALIDATION:
        models = cross_validate_nested(training.folds, order, label, training.scales)
        size = len(choose(models, rule.worth).model.signals)
        values = tuple(-model.correlation for model in models)
    else:
        size = best_size(rule.criterion, evidence)
        values = tuple(criterion_values(rule.criterion, evidence).tolist())
    return NestedChoice(order, size, fits[size], evidence, values)


def cross_validate_nested(
    folds: Folds, order: Sequence[str], label: str, scales: Scales
) -> list[CrossValidation]:
    """Cross-validate the k+1 nested models of a given order; model j is called "first j"."""
    return [
        cross_validate(f"first {size}", folds, least_squares(order[:size], label), scales)
        for size in range(len(order) + 1)
    ]


def cross_validate_selection(
    name: str,
    training: Training,
    fold: IntArray,
    inputs: Sequence[str],
    label: str,
    rule: Rule,
) -> CrossValidation:
    """Cross-validate the choice itself: nothing of a fold is seen in choosing for it.

    `fold` says the fold of each of the drives. Raises `DataError` as `select_nested` does.
    """
    folds = training.folds
    tests = []
    for number, test in enumerate(folds.grams):
        rest = _without(training, fold, number)
        model = select_nested(rest, inputs, label, rule).fit.model
        tests.append(held_out_errors(model, rest.folds.total, test))
    chosen = select_nested(training, inputs, label, rule).fit.model
    return assemble(name, folds, tests, chosen, training.scales)


def _without(training: Training, fold: IntArray, number: int) -> Training:
    if len(training.folds.grams) < FEWEST_FOLDS:
        raise QuestionError("choosing inside the training folds needs at least three folds.")
    drives = training.drives
    rest = training.folds.without(number, int(np.count_nonzero(fold != number)))
    return Training(
        rest, drives.take(fold != number) if drives is not None else None, training.scales
    )
