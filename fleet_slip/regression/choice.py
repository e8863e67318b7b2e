"""Choice among cross-validated models, and among the k + 1 nested models of a ranking.

The figures of a chosen model are optimistic, so the choice is repeated in every training fold.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fleet_slip.arrays import IntArray
from fleet_slip.base import Record
from fleet_slip.errors import QuestionError
from fleet_slip.regression.folds import (
    CrossValidation,
    Folds,
    assemble,
    cross_validate,
    error_of_mean,
    held_out_errors,
    least_squares,
)
from fleet_slip.regression.gram import Gram
from fleet_slip.regression.inference import DriveMoments, Evidence
from fleet_slip.regression.least_squares import Fit, Scales, fit_moments, moments
from fleet_slip.regression.orders import rank
from fleet_slip.regression.subsets import best_size, criterion_values

# The winner is the model with the fewest signals whose gap to the best is negligible.
#
# A gain must reach a tolerance, which a user sets. The gap is sqrt(MSE - MSE of the best), in which
# the label's noise cancels: for nested models it is the RMS difference of their estimates. A gain
# must also exceed its standard error, paired over the same folds, whose difficulty cancels
# (Breiman, Friedman, Olshen and Stone 1984, section 3.4.3, take that of the best model's figure).
#
# Without folds, the same rows are divided into groups of independent units, cars or drives. With d
# a group's difference of squared errors and n its rows, the difference of the mean squared errors
# is sum d / sum n, with the standard error of a ratio (Cochran, Sampling Techniques, 1977, section
# 6.4).


@dataclass(frozen=True)
class Tolerance:
    """The smallest gain that justifies a signal.

    Absolute: sqrt(MSE - MSE of the best), in rad. Relative: of RMSEs, as a fraction of the best's.
    """

    amount: float
    relative: bool = False

    def squared(self, rmse: float) -> float:
        """Return the difference of mean squared errors, in rad^2, the best having this RMSE."""
        share = self.amount * (2 + self.amount) * rmse**2  # ((1 + amount) rmse)^2 - rmse^2
        return share if self.relative else self.amount**2

    def __str__(self) -> str:
        if self.relative:
            return f"{100 * self.amount:.3g} % of the best"
        return f"{math.degrees(self.amount):.4g} deg"


DEFAULT_TOLERANCE = Tolerance(math.radians(0.025))
"""A quarter of the accuracy of the best reference sensors, about 0.1 deg."""


ZERO_TOLERANCE = Tolerance(0.0)
"""Any gain that is larger than its standard error."""


@dataclass(frozen=True)
class RmseGap:
    """Difference of a `model`'s RMSE (rad) to the best's, over the same folds.

    `square` is the difference of mean squared errors, rad^2. A gap `within_tolerance` is below the
    smallest gain that justifies a signal.
    """

    model: CrossValidation
    rmse: float
    standard_error: float
    square: float
    within_tolerance: bool

    @property
    def independent_error(self) -> float:
        """The gap in rad without the noise of the label; 0 if this model is better."""
        return math.sqrt(max(self.square, 0.0))

    @property
    def is_significant(self) -> bool:
        """True if it is larger than its standard error."""
        return self.rmse > self.standard_error

    @property
    def negligible(self) -> bool:
        """True if the best model is not relevantly better."""
        return self.within_tolerance or not self.is_significant

    def as_dict(self) -> dict[str, Any]:
        """Return the entries of a JSON document."""
        return {
            "rmse_deg": math.degrees(self.rmse),
            "standard_error_deg": math.degrees(self.standard_error),
            "lacks_deg": math.degrees(self.independent_error),
            "real": self.is_significant,
            "negligible": self.negligible,
        }

    def __str__(self) -> str:
        return f"{math.degrees(self.rmse):.4f} +- {math.degrees(self.standard_error):.2g} deg"


@dataclass(frozen=True)
class Winner:
    """The chosen model, the best-correlated one, the reason, and the gaps of all if any."""

    model: CrossValidation
    best: CrossValidation
    reason: str
    gaps: tuple[RmseGap, ...] = ()


def choose(models: Sequence[CrossValidation], tolerance: Tolerance = DEFAULT_TOLERANCE) -> Winner:
    """Choose among cross-validated models by the one-standard-error rule.

    Of the models that are negligibly worse than the best pooled correlation, those with the fewest
    signals win, then the higher exact correlation, then the declared order.

    Parameters
    ----------
    models : sequence of CrossValidation
        In their declared order.
    tolerance : Tolerance
        Smallest gain that is worth a signal.

    Returns
    -------
    Winner

    Raises
    ------
    QuestionError
        If there are no models.

    References
    ----------
    Breiman, Friedman, Olshen and Stone, Classification and Regression Trees, 1984, section 3.4.3.
    """
    if not models:
        raise QuestionError("no model to choose from: the list of models is empty.")
    best = max(models, key=lambda model: model.sums.signed_r_squared)
    gaps = tuple(measure_gap(model, best, tolerance) for model in models)
    contenders = [gap for gap in gaps if gap.model is best or gap.negligible]
    min_size = min(len(gap.model.signals) for gap in contenders)
    smallest = [gap for gap in contenders if len(gap.model.signals) == min_size]
    winner = max(smallest, key=lambda gap: gap.model.sums.signed_r_squared)
    reason = _reason(winner, best, len(contenders), len(models), tolerance)
    return Winner(winner.model, best, reason, gaps)


def measure_gap(model: CrossValidation, best: CrossValidation, tolerance: Tolerance) -> RmseGap:
    """Return the difference of two models' RMSE, over the same folds."""
    return _gap(model, best, tolerance, _standard_error(model, best))


def _gap(
    model: CrossValidation, best: CrossValidation, tolerance: Tolerance, standard_error: float
) -> RmseGap:
    first, second = model.pooled.rmse, best.pooled.rmse
    square = (first - second) * (first + second)
    return RmseGap(
        model, first - second, standard_error, square, square < tolerance.squared(second)
    )


def _standard_error(candidate: CrossValidation, other: CrossValidation) -> float:
    """Return the standard error of the difference of RMSEs over folds, paired where rows agree."""
    first, second = ([fold.rmse for fold in model.folds] for model in (candidate, other))
    rows = [[fold.rows for fold in model.folds] for model in (candidate, other)]
    if candidate.fold_names == other.fold_names and rows[0] == rows[1]:
        return error_of_mean([a - b for a, b in zip(first, second, strict=True)])
    return math.hypot(error_of_mean(first), error_of_mean(second))


def _reason(
    winner: RmseGap, best: CrossValidation, contenders: int, total: int, tolerance: Tolerance
) -> str:
    if winner.model is best and contenders == total == 1:
        return f"Model {best.name} is the only one."
    rmse = f"RMSE {best.pooled.rmse_deg:.4f} deg"
    if winner.model is best:
        rivals = "every other model" if contenders == 1 else "every model with fewer signals"
        larger = f"{tolerance} or more, and by " if tolerance.amount else ""
        return (
            f"Model {best.name} has the best cross-validated correlation, {best.correlation:.4f}, "
            f"with {rmse}. The gain over {rivals} is {larger}more than one standard error, so it "
            "is significant."
        )
    if not tolerance.amount:
        return (
            f"Model {winner.model.name} has the fewest signals ({len(winner.model.signals)}) of "
            f"the {contenders} models within one standard error of the best. The gain of model "
            f"{best.name} ({len(best.signals)} signals, {rmse}), {winner}, is not significant."
        )
    real = (
        "significant, but less than the required"
        if winner.is_significant
        else "not significant; required are"
    )
    lacks_deg = math.degrees(winner.independent_error)
    lacking = (
        ""
        if tolerance.relative
        else f" (root of the difference of the squares: {lacks_deg:.2g} deg)"
    )
    return (
        f"Model {winner.model.name} has the fewest signals ({len(winner.model.signals)}) of the "
        f"{contenders} models that are about as good as model {best.name}, the best "
        f"({len(best.signals)} signals, {rmse}). Its gain, {winner}{lacking}, is {real} "
        f"{tolerance}."
    )


def compare_paired(model: CrossValidation, other: CrossValidation, tolerance: Tolerance) -> RmseGap:
    """Return the difference of two models' RMSE, with a standard error over independent groups.

    Parameters
    ----------
    model, other : CrossValidation
        Tested on the same rows; each fold is an independent group.
    tolerance : Tolerance

    Returns
    -------
    RmseGap

    Raises
    ------
    ValueError
        If the models were not tested on the same rows.

    References
    ----------
    Cochran, Sampling Techniques, 1977, section 6.4.
    """
    rows = [fold.rows for fold in model.folds]
    if model.fold_names != other.fold_names or rows != [fold.rows for fold in other.folds]:
        raise ValueError("the models were not tested on the same rows")
    differences = [
        n * (first.rmse - second.rmse) * (first.rmse + second.rmse)
        for n, first, second in zip(rows, model.folds, other.folds, strict=True)
    ]
    ratio, groups = math.fsum(differences) / sum(rows), len(rows)
    square = math.fsum((d - ratio * n) ** 2 for d, n in zip(differences, rows, strict=True))
    error = math.sqrt(square * groups / (groups - 1)) / sum(rows)
    rmse_sum = model.pooled.rmse + other.pooled.rmse
    return _gap(model, other, tolerance, error / rmse_sum if rmse_sum else 0.0)


def nested_fits(
    gram: Gram, order: Sequence[str], label: str, *, intercept: bool = True
) -> list[Fit]:
    """Fit the nested models of an order of signals exactly.

    Parameters
    ----------
    gram : Gram
        Sums and products of counts, of at least the order and the label.
    order : sequence of str
        The k signals; model j has the first j of them.
    label : str
    intercept : bool

    Returns
    -------
    list of Fit
        k + 1 fits, of 0 to k signals.

    Raises
    ------
    DataError
        If signals are linearly dependent, or the Gram has no rows.
    """
    matrix = moments(gram.restrict([*order, label]), intercept=intercept)

    def fit_first(size: int) -> Fit:
        at = [*range(size), len(order)]
        part = gram.restrict([*order[:size], label])
        return fit_moments(part, [[matrix[i][j] for j in at] for i in at], intercept=intercept)

    full = fit_first(len(order))  # names all dependent signals
    return [*(fit_first(size) for size in range(len(order))), full]


CROSS_VALIDATION = "cross-validation"
"""Criterion: cross-validate all nested models; the smallest that is nearly best wins."""


MIN_FOLDS = 3
"""Minimum number of folds to repeat a choice in the training folds, of which two must remain."""


@dataclass(frozen=True)
class Rule:
    """A ranking, a criterion or `CROSS_VALIDATION`, and the gain that justifies a signal."""

    ranking: str
    criterion: str
    tolerance: Tolerance = DEFAULT_TOLERANCE


@dataclass(frozen=True)
class NestedChoice(Record):
    """A choice of the first `size` signals of an order, their exact fit and its evidence.

    `values` of the criterion are for 0..k signals, smaller being better; of cross-validation they
    are the negative correlations.
    """

    DOCUMENT = "order signals criterion_values=values *evidence"

    order: tuple[str, ...]
    size: int
    fit: Fit
    evidence: Evidence
    values: tuple[float, ...]

    @property
    def signals(self) -> tuple[str, ...]:
        """The chosen signals."""
        return self.order[: self.size]


@dataclass(frozen=True)
class NestedDistances(Record):
    """Distances D of the nested models of an order; `null` is the model without any signal."""

    DOCUMENT = "order *evidence null"

    order: tuple[str, ...]
    evidence: Evidence
    null: CrossValidation


@dataclass(frozen=True)
class TrainingFolds:
    """The training rows of a choice: their folds, and the moments of each drive.

    `scales` is the physical value of a count of each signal. Without `intercept` moments are about
    zero.
    """

    folds: Folds
    drives: DriveMoments
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
        """Return the evidence for the nested models of an order; raises like `Evidence`."""
        return Evidence.clustered(fits, self.drives)

    def cross_validate(self, name: str, inputs: Sequence[str], label: str) -> CrossValidation:
        """Cross-validate least squares on given inputs."""
        procedure = least_squares(inputs, label, intercept=self.intercept)
        return cross_validate(name, self.folds, procedure, self.scales)


def select_nested(
    training: TrainingFolds, inputs: Sequence[str], label: str, rule: Rule
) -> NestedChoice:
    """Rank the inputs and choose one of the nested models.

    Parameters
    ----------
    training : TrainingFolds
    inputs : sequence of str
        The k candidate signals.
    label : str
    rule : Rule
        Ranking and criterion.

    Returns
    -------
    NestedChoice

    Raises
    ------
    DataError
        If inputs are linearly dependent, or there are too few rows.
    QuestionError
        For an unknown ranking or criterion.
    """
    order = rank(rule.ranking, training.total, inputs, label)
    fits = training.nested_fits(order, label)
    evidence = training.evidence(fits)
    if rule.criterion == CROSS_VALIDATION:
        models = cross_validate_nested(training, order, label)
        size = len(choose(models, rule.tolerance).model.signals)
        values = tuple(-model.correlation for model in models)
    else:
        size = best_size(rule.criterion, evidence)
        values = tuple(criterion_values(rule.criterion, evidence).tolist())
    return NestedChoice(order, size, fits[size], evidence, values)


def measure_distances(training: TrainingFolds, order: Sequence[str], label: str) -> NestedDistances:
    """Return the distances of a given order. Raises `DataError` as `select_nested`."""
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
    """Cross-validate the choice itself: each training set ranks and chooses anew.

    Parameters
    ----------
    name : str
        Name of the result.
    training : TrainingFolds
    fold : integer array, shape (drives,)
        Fold of each drive.
    inputs : sequence of str
    label : str
    rule : Rule

    Returns
    -------
    CrossValidation

    Raises
    ------
    DataError
        If a training set determines no model.
    QuestionError
        If there are fewer than three folds.
    """
    folds = training.folds
    tests = []
    for number, test in enumerate(folds.grams):
        inner = _without(training, fold, number)
        model = select_nested(inner, inputs, label, rule).fit.model
        tests.append(held_out_errors(model, inner.folds.total, test))
    chosen = select_nested(training, inputs, label, rule).fit.model
    return assemble(name, folds, tests, chosen, training.scales)


def _without(training: TrainingFolds, fold: IntArray, number: int) -> TrainingFolds:
    if len(training.folds.grams) < MIN_FOLDS:
        raise QuestionError("choosing inside the training folds needs at least three folds.")
    remaining_folds = training.folds.without(number, int(np.count_nonzero(fold != number)))
    return replace(training, folds=remaining_folds, drives=training.drives.take(fold != number))
