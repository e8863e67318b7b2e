"""NIST Statistical Reference Datasets, linear regression: at least 14 certified digits."""

from decimal import Decimal
from fractions import Fraction
from math import inf, log10
from typing import Any

import numpy as np
import pytest

from fleet_slip.regression.gram import Gram
from fleet_slip.regression.inference import infer
from fleet_slip.regression.least_squares import fit
from tests.support.counts import columns_to_counts, evidence

PROBLEMS = ["norris", "noint1", "noint2", "longley", "wampler1", "wampler2", "wampler3"]
DIGITS = 14


def correct_digits(computed: float, certified: str) -> float:
    """Return the log relative error (McCullough 1998): how many certified digits agree."""
    exact = Fraction(Decimal(certified))
    error = abs(Fraction(computed) - exact)
    if error == 0:
        return inf
    return -log10(error / abs(exact)) if exact else -log10(error)


def polynomial(counts: Any, scales: list[Fraction], degree: int) -> tuple[Any, list[Fraction]]:
    """Return y and the powers of x as integer columns with their scales."""
    y, x = counts[:, 0], counts[:, 1]
    powers = [x**d for d in range(1, degree + 1)]
    return np.column_stack([y, *powers]), [
        scales[0],
        *(scales[1] ** d for d in range(1, degree + 1)),
    ]


@pytest.mark.parametrize("name", PROBLEMS)
def test_certified_digits(name: str) -> None:
    problem = evidence("nist/nist_strd_linear.json")[name]
    counts, scales = columns_to_counts(problem["rows"])
    degree = problem["model"]["polynomial_degree"]
    if degree is not None:
        counts, scales = polynomial(counts, scales, degree)
    signals = ("y", *(f"x{i}" for i in range(1, len(scales))))
    gram = Gram.from_counts(signals, counts)
    gram = gram if problem["model"]["intercept"] else gram.about_origin()
    fitted = fit(gram, signals[1:], "y")
    result = infer(fitted, dict(zip(signals, scales, strict=True)))
    certified = problem["certified"]
    assert len(result.estimates) == len(certified["coef"])
    for estimate, value, error in zip(
        result.estimates, certified["coef"], certified["se"], strict=True
    ):
        assert correct_digits(estimate.value, value) >= DIGITS
        assert correct_digits(estimate.standard_error, error) >= DIGITS
    assert correct_digits(result.residual_std, certified["resid_sd"]) >= DIGITS
    assert correct_digits(fitted.r_squared, certified["r2"]) >= DIGITS
