"""Between standardised coefficients (unit length, zero mean) and models of counts."""

from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.regression.exact import exact_roots
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.regression.exact.least_squares import LinearModel


def lengths(gram: Gram) -> FloatArray:
    """Return the root of the centred sum of squares of each signal, sqrt(S_aa), in counts."""
    matrix = gram.centred()
    return np.array([exact_roots.sqrt(Fraction(row[i], gram.n)) for i, row in enumerate(matrix)])


def from_standardised(
    gram: Gram, inputs: Sequence[str], label: str, coefficients: FloatArray
) -> LinearModel:
    """Return the model of counts b_j = beta_j d_y / d_j; signals with beta_j = 0 drop out."""
    d = lengths(gram.restrict([*inputs, label]))
    slopes = {
        name: Fraction(float(beta * d[-1] / d[j]))
        for j, (name, beta) in enumerate(zip(inputs, coefficients, strict=True))
        if beta != 0
    }
    return through_means(gram, label, slopes)


def through_means(gram: Gram, label: str, slopes: dict[str, Fraction]) -> LinearModel:
    """Return the model with given slopes whose intercept makes the mean error zero."""
    intercept = Fraction(gram.sum(label)) - sum(b * gram.sum(s) for s, b in slopes.items())
    return LinearModel(tuple(slopes), label, tuple(slopes.values()), intercept / gram.n)
