"""Choice among cross-validated models, and among the k + 1 nested models of a ranking."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.base import Record
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.regression.folds import (
    CrossValidation,
    Folds,
    cross_validate,
    error_of_mean,
    least_squares,
)
from fleet_slip.regression.gram import Gram
from fleet_slip.regression.inference import DriveMoments, Evidence
from fleet_slip.regression.least_squares import Fit, Scales, fit_moments, moments
from fleet_slip.regression.orders import rank

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


DEFAULT_TOLERANCE = math.radians(0.025)
"""The smallest gain that justifies a signal, sqrt(MSE - MSE of the best) in rad: a quarter of the
accuracy of the best reference sensors, about 0.1 deg."""


@dataclass(frozen=True)
class RmseGap:
    """Difference of a `model`'s RMSE (rad) to the best's, over the same folds.

    The `independent_error` is the gap in rad without the noise of the label, 0 for a better model.
    A `negligible` gap does not justify a signal: it is small, or no larger than its standard error.
    """

    model: CrossValidation
    rmse: float
    standard_error: float
    independent_error: float
    is_significant: bool
    negligible: bool

    def as_dict(self) -> dict[str, Any]:
        """Return the entries of a JSON document."""
        return {
            "rmse_deg": math.degrees(self.rmse),
            "standard_error_deg": math.degrees(self.standard_error),
            "lacks_deg": math.degrees(self.independent_error),
            "real": self.is_significant,
            "negligible": self.negligible,
        }


@dataclass(frozen=True)
class Winner:
    """The chosen model, the best-correlated one, the reason, and the gaps of all if any."""

    model: CrossValidation
    best: CrossValidation
    reason: str
    gaps: tuple[RmseGap, ...] = ()


def choose(models: Sequence[CrossValidation], tolerance: float = DEFAULT_TOLERANCE) -> Winner:
    """Choose among cross-validated models by the one-standard-error rule.

    Of the models that are negligibly worse than the best pooled correlation, those with the fewest
    signals win, then the higher exact correlation, then the declared order.

    Parameters
    ----------
    models : sequence of CrossValidation
        In their declared order.
    tolerance : float
        Smallest gain that is worth a signal, in rad; 0 for any gain above its standard error.

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
    best = best_correlated(models)
    gaps = []
    for model in models:
        folds = zip(model.folds, best.folds, strict=True)
        error = error_of_mean([fold.rmse - best_fold.rmse for fold, best_fold in folds])
        gaps.append(_gap(model, best, tolerance, error))
    contenders = [gap.model for gap in gaps if gap.model is best or gap.negligible]
    min_size = min(len(model.signals) for model in contenders)
    winner = best_correlated([model for model in contenders if len(model.signals) == min_size])
    return Winner(winner, best, _reason(winner, best, len(contenders), len(models)), tuple(gaps))


def best_correlated(models: Sequence[CrossValidation]) -> CrossValidation:
    """Return the model with the best pooled correlation, compared exactly; the first of equals."""
    return max(models, key=lambda model: model.sums.signed_r_squared)


def _gap(
    model: CrossValidation, best: CrossValidation, tolerance: float, standard_error: float
) -> RmseGap:
    first, second = model.pooled.rmse, best.pooled.rmse
    square, is_significant = (first - second) * (first + second), first - second > standard_error
    negligible = square < tolerance**2 or not is_significant
    independent_error = math.sqrt(max(square, 0.0))
    return RmseGap(
        model, first - second, standard_error, independent_error, is_significant, negligible
    )


def _reason(winner: CrossValidation, best: CrossValidation, contenders: int, total: int) -> str:
    if total == 1:
        return f"Model {best.name} is the only one."
    rmse = f"RMSE {best.pooled.rmse_deg:.4f} deg"
    if winner is best:
        return (
            f"Model {best.name} has the best cross-validated correlation, {best.correlation:.4f}, "
            f"with {rmse}, and no model with fewer signals is negligibly worse."
        )
    gap_deg = winner.pooled.rmse_deg - best.pooled.rmse_deg
    return (
        f"Model {winner.name} has the fewest signals ({len(winner.signals)}) of the {contenders} "
        f"models that are about as good as model {best.name}, the best ({len(best.signals)} "
        f"signals, {rmse}). Its gain, {gap_deg:.4f} deg, is below the tolerance or one standard "
        "error."
    )


def compare_paired(model: CrossValidation, other: CrossValidation, tolerance: float) -> RmseGap:
    """Return the difference of two models' RMSE, with a standard error over independent groups.

    Parameters
    ----------
    model, other : CrossValidation
        Tested on the same rows; each fold is an independent group.
    tolerance : float
        In rad.

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


def nested_fits(gram: Gram, order: Sequence[str], label: str) -> list[Fit]:
    """Fit the nested models of an order of signals exactly.

    Parameters
    ----------
    gram : Gram
        Sums and products of counts, of at least the order and the label.
    order : sequence of str
        The k signals; model j has the first j of them.
    label : str

    Returns
    -------
    list of Fit
        k + 1 fits, of 0 to k signals.

    Raises
    ------
    DataError
        If signals are linearly dependent, or the Gram has no rows.
    """
    matrix = moments(gram.restrict([*order, label]))

    def fit_first(size: int) -> Fit:
        at = [*range(size), len(order)]
        part = gram.restrict([*order[:size], label])
        return fit_moments(part, [[matrix[i][j] for j in at] for i in at])

    full = fit_first(len(order))  # names all dependent signals
    return [*(fit_first(size) for size in range(len(order))), full]


PRICES: dict[str, Callable[[float], float]] = {"aic": lambda _: 2.0, "bic": math.log}
"""Criteria: the price of a signal in units of the noise, given the effective rows (Akaike 1973, for
a known noise variance, which orders as Mallows' C_p; Schwarz 1978)."""

CRITERIA = ("cv", *PRICES)
"""`cv` cross-validates all nested models; the smallest that is nearly best wins."""


def criterion_values(name: str, evidence: Evidence) -> FloatArray:
    """Return the values of a criterion of `PRICES` for the k + 1 nested models.

    Parameters
    ----------
    name : str
    evidence : Evidence

    Returns
    -------
    float array, shape (k + 1,)
        The smallest value is the best.
    """
    size = np.arange(evidence.inputs + 1)
    return np.asarray(np.array(evidence.excess) + PRICES[name](evidence.rows) * size)


@dataclass(frozen=True)
class Rule:
    """A ranking, a criterion, and the gain in rad that justifies a signal."""

    ranking: str = "declared"
    criterion: str = "cv"
    tolerance: float = DEFAULT_TOLERANCE


@dataclass(frozen=True)
class NestedChoice(Record):
    """The choice of the first signals of a ranking.

    `values` of the criterion are for 0..k signals, smaller being better; of cross-validation they
    are the negative correlations. `models` are those of 1..k signals.
    """

    DOCUMENT = (
        "ranking=rule.ranking criterion=rule.criterion order signals=winner.model.signals "
        "criterion_values=values *evidence"
    )

    rule: Rule
    order: tuple[str, ...]
    evidence: Evidence
    values: tuple[float, ...]
    models: tuple[CrossValidation, ...]
    winner: Winner


def choose_nested(
    folds: Folds,
    drives: DriveMoments,
    inputs: Sequence[str],
    label: str,
    scales: Scales,
    rule: Rule,
) -> NestedChoice:
    """Rank the inputs and choose one of the nested models.

    Parameters
    ----------
    folds : Folds
        Rows with all inputs and the label.
    drives : DriveMoments
        Of the same rows, the independent clusters of the evidence; about zero without intercept.
    inputs : sequence of str
        The k candidate signals.
    label : str
    scales : mapping of str to Fraction
        Physical value of one count of each signal.
    rule : Rule
        Ranking and criterion.

    Returns
    -------
    NestedChoice

    Raises
    ------
    DataError
        If inputs are linearly dependent, there are too few rows, or the criterion keeps no signal.
    QuestionError
        For an unknown ranking or criterion.
    """
    if rule.criterion not in CRITERIA:
        criteria = ", ".join(CRITERIA)
        raise QuestionError(f"unknown criterion {rule.criterion!r}. Known criteria: {criteria}.")
    order = rank(rule.ranking, folds.total, inputs, label)
    fits = nested_fits(folds.total, order, label)
    evidence = Evidence.measure(fits, drives)
    null, *models = (
        cross_validate(
            f"first {size}",
            folds,
            least_squares(order[:size], label),
            scales,
        )
        for size in range(len(order) + 1)
    )
    if rule.criterion == "cv":
        values = [-model.correlation for model in (null, *models)]
        winner = choose(models, rule.tolerance)
    else:
        values = criterion_values(rule.criterion, evidence).tolist()
        size = int(np.argmin(values))
        if size == 0:
            raise DataError(
                f"the criterion {rule.criterion} selects no signal: none is better than chance. "
                "Choose more drives, other signals, or the criterion cv."
            )
        reason = (
            f"{rule.criterion} keeps {size} of {len(models)} signals of the order by "
            f"{rule.ranking}, with {evidence.kind} as independent."
        )
        winner = Winner(models[size - 1], best_correlated(models), reason)
    return NestedChoice(rule, order, evidence, tuple(values), tuple(models), winner)
