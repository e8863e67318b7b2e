"""Least squares on two inputs and a constant, exactly, and how sure it is by independent pieces."""

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from math import lcm

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.regression.exact.gram import Gram

Combination = Mapping[str, Fraction]
"""A linear combination of signals: the weight of each."""


@dataclass(frozen=True)
class PlaneShape:
    """The model y = intercept + first * x1 + second * x2 of combinations of signals."""

    y: Combination
    x1: Combination
    x2: Combination

    @property
    def signals(self) -> tuple[str, ...]:
        """The signals in it."""
        return tuple(dict.fromkeys([*self.y, *self.x1, *self.x2]))


@dataclass(frozen=True)
class Plane:
    """An exact fit: its coefficients, and means and variances of y, x1 and x2."""

    intercept: Fraction
    first: Fraction
    second: Fraction
    means: tuple[Fraction, Fraction, Fraction]
    variances: tuple[Fraction, Fraction, Fraction]


def fit_plane(gram: Gram, shape: PlaneShape) -> Plane | None:
    """Fit a plane to the rows of a Gram; None if undetermined. Raises `DataError`."""
    if gram.n == 0:
        return None
    factors = [lcm(*(w.denominator for w in one.values())) for one in _parts(shape)]
    whole = {
        name: {signal: int(weight * factor) for signal, weight in one.items()}
        for name, one, factor in zip(("y", "x1", "x2"), _parts(shape), factors, strict=True)
    }
    g = gram.combine(whole)
    (yy, y1, y2), (_, a11, a12), (_, _, a22) = g.centred()
    determinant = a11 * a22 - a12 * a12
    if determinant == 0:
        return None
    of_y, of_1, of_2 = factors
    first = Fraction((y1 * a22 - y2 * a12) * of_1, determinant * of_y)
    second = Fraction((y2 * a11 - y1 * a12) * of_2, determinant * of_y)
    means = [Fraction(total, g.n * f) for total, f in zip(g.sums, factors, strict=True)]
    squares = zip((yy, a11, a22), factors, strict=True)
    variances = [Fraction(square, (g.n * f) ** 2) for square, f in squares]
    intercept = means[0] - first * means[1] - second * means[2]
    return Plane(
        intercept,
        first,
        second,
        (means[0], means[1], means[2]),
        (variances[0], variances[1], variances[2]),
    )


@dataclass(frozen=True)
class Influence:
    """By drive, how far it moves a combination of coefficients, and its share of the variance."""

    shifts: FloatArray
    shares: FloatArray


def influence(
    moments: FloatArray, shape: PlaneShape, signals: tuple[str, ...], gradient: FloatArray
) -> Influence | None:
    """Return the influence of drives on a combination of the coefficients; None if singular.

    `moments` are of (1, signals), shape (drives, k+1, k+1), about any origin; `gradient` is for the
    intercept there and the slopes. With h = (X'X)^-1 a, a drive moves a'b by h'(X_g'y_g - X_g'X_g
    b), and its share is h'X_g'X_g h.
    """
    turn = np.zeros((4, moments.shape[1]))
    turn[0, 0] = 1.0
    for row, one in zip((1, 2, 3), (shape.x1, shape.x2, shape.y), strict=True):
        for signal, weight in one.items():
            turn[row, 1 + signals.index(signal)] = float(weight)
    each = turn @ moments @ turn.T
    total = each.sum(axis=0)
    try:
        solved = np.linalg.solve(total[:3, :3], np.column_stack([total[:3, 3], gradient]))
    except np.linalg.LinAlgError:
        return None
    coefficients, h = solved[:, 0], solved[:, 1]
    scores = each[:, :3, 3] - each[:, :3, :3] @ coefficients
    return Influence(scores @ h, np.einsum("i,gij,j->g", h, each[:, :3, :3], h))


def _parts(shape: PlaneShape) -> tuple[Combination, Combination, Combination]:
    return shape.y, shape.x1, shape.x2
