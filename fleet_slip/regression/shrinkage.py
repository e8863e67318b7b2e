"""Estimates for the members of a group, each drawn towards the group's mean.

A member's number is the kind's mean, what the member differs by (variance A), and an error of known
variance V. A is where A times its likelihood, of residuals about the mean, is largest: so it is
never 0, where numbers happen to differ no more than their errors do. Members are drawn by B =
V / (V + A), and their standard errors have what the uncertainties of A and of the mean add:
C. N. Morris and R. Tang, "Estimating random effects via adjustment for density maximization",
Statistical Science 26 (2011), 271-287.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fleet_slip.arrays import FloatArray

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
