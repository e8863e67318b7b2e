"""Estimates for the members of a group, each drawn towards the group's mean.

A member's number is the kind's mean, what the member differs by (variance A), and an error of known
variance V. A is where A times its likelihood, of residuals about the mean, is largest: so it is
never 0, where numbers happen to differ no more than their errors do. Members are drawn by B =
V / (V + A), and their standard errors have what the uncertainties of A and of the mean add:
C. N. Morris and R. Tang, "Estimating random effects via adjustment for density maximization",
Statistical Science 26 (2011), 271-287.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.regression.exact import eliminate
from fleet_slip.regression.figures import ErrorSums
from fleet_slip.regression.gram import Gram
from fleet_slip.regression.least_squares import (
    LinearModel,
    Scales,
    dependence,
    moments,
    through_means,
)

FEWEST_MEMBERS = 4
"""Of fewer nothing says how much they differ."""
_HALVINGS, _STEP = 60, 1e-4


@dataclass(frozen=True)
class Pooled:
    """A kind, and its members as they are known together.

    Attributes:
        mean, mean_error: of the kind, with its standard error.
        spread, spread_error: the same of the standard deviation of what members differ by, sqrt(A).
        values, errors: of each member, shape (members,).
    """

    mean: float
    mean_error: float
    spread: float
    spread_error: float
    values: FloatArray
    errors: FloatArray


def pool(values: FloatArray, variances: FloatArray) -> Pooled | None:
    """Return numbers of the members of a kind, drawn towards their mean; None of too few.

    `values` and `variances` have the shape (members,); variances are above 0.
    """
    if len(values) < FEWEST_MEMBERS:
        return None

    def slope(log_between: float) -> float:
        """Return the derivative of log(A L(A)) by log(A)."""
        between = math.exp(log_between)
        weights = 1 / (variances + between)
        squares = weights**2 * (values - _mean(values, weights)) ** 2
        steep = squares - weights + weights**2 / weights.sum()
        return 1 + between / 2 * float(steep.sum())

    most = math.log(float(np.ptp(values)) ** 2 * len(values) + float(variances.max()) * 16)
    log_between = _root(slope, math.log(float(variances.min())) - 16, most)
    information = (slope(log_between - _STEP) - slope(log_between + _STEP)) / (2 * _STEP)
    weights = 1 / (variances + math.exp(log_between))
    mean, drawn = _mean(values, weights), variances * weights
    mean_variance = 1 / float(weights.sum())
    left = drawn * (1 - drawn)
    of_drawn = left**2 / (information + left)
    squares = variances * (1 - drawn) + drawn**2 * mean_variance + of_drawn * (values - mean) ** 2
    spread = math.exp(log_between / 2)
    return Pooled(
        mean=mean,
        mean_error=math.sqrt(mean_variance),
        spread=spread,
        spread_error=spread / (2 * math.sqrt(information)),
        values=values + drawn * (mean - values),
        errors=np.sqrt(squares),
    )


def _mean(values: FloatArray, weights: FloatArray) -> float:
    return float((weights * values).sum() / weights.sum())


def _root(falling: Callable[[float], float], least: float, most: float) -> float:
    for _ in range(_HALVINGS):
        middle = (least + most) / 2
        least, most = (middle, most) if falling(middle) > 0 else (least, middle)
    return (least + most) / 2


# What sensor bias and noise do to a model's error, in closed form (the paper's section III-A).
#
# With biases d_j and noise v_j, the prediction changes by b'd + sum b_j v_j: every sum follows. The
# best model for noise to come solves (S + Lambda) b = S_xy, Lambda n times its variance (Bishop
# 1995): ridge regression.


def fit_noise_matched(
    gram: Gram, inputs: Sequence[str], label: str, noise: Mapping[str, float], scales: Scales
) -> LinearModel:
    """Return the model of counts that is best with independent noise to come, in SI units.

    Raises `QuestionError` for noise of another signal, and as `fit_penalised`.
    """
    unknown = [name for name in noise if name not in inputs]
    if unknown:
        raise QuestionError(
            f"noise is given for {', '.join(unknown)}, which the model does not use. "
            f"It uses {', '.join(inputs)}."
        )
    variances = [(Fraction(noise.get(name, 0)) / scales[name]) ** 2 for name in inputs]
    return fit_penalised(gram, inputs, label, [gram.n * one for one in variances])


def fit_penalised(
    gram: Gram, inputs: Sequence[str], label: str, penalties: Sequence[Fraction]
) -> LinearModel:
    """Solve (S + diag(penalties)) b = S_xy exactly, penalties >= 0 in counts^2, or `DataError`."""
    part = gram.restrict([*inputs, label])
    common = math.lcm(*(penalty.denominator for penalty in penalties))
    matrix = [[common * entry for entry in row] for row in moments(part)]
    for i, penalty in enumerate(penalties):
        matrix[i][i] += int(part.n * common * penalty)
    triangle = eliminate(matrix)
    if triangle.singular is not None:
        raise DataError(dependence(part, inputs))
    numerators, determinant = triangle.solve(len(inputs))
    slopes = {name: Fraction(x, determinant) for name, x in zip(inputs, numerators, strict=True)}
    return through_means(part, label, slopes)


def disturb(
    sums: ErrorSums,
    model: LinearModel,
    scales: Scales,
    *,
    bias: Mapping[str, float] | None = None,
    noise: Mapping[str, float] | None = None,
) -> ErrorSums:
    """Return the error sums to expect once bias and white noise are added to the signals.

    MSE' = MSE + 2 e (b'd) + (b'd)^2 + sum b_j^2 s_j^2, e the mean error. Model and sums are of
    counts; `bias` and `noise` (deviations) physical. Raises `QuestionError` for an unused signal.
    """
    shift = sum(
        (model.coefficients[i] * value for i, value in _counts(model, scales, bias or {})),
        Fraction(0),
    )
    variance = sum(
        ((model.coefficients[i] * value) ** 2 for i, value in _counts(model, scales, noise or {})),
        Fraction(0),
    )
    return replace(
        sums,
        p=sums.p + sums.n * shift,
        pp=sums.pp + 2 * shift * sums.p + sums.n * (shift**2 + variance),
        py=sums.py + shift * sums.y,
    )


def _counts(
    model: LinearModel, scales: Scales, values: Mapping[str, float]
) -> list[tuple[int, Fraction]]:
    unused = [name for name in values if name not in model.signals]
    if unused:
        raise QuestionError(
            f"the model does not use {', '.join(unused)}: it uses {', '.join(model.signals)}."
        )
    return [
        (model.signals.index(name), Fraction(value) / scales[name])
        for name, value in values.items()
    ]
