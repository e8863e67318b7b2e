"""Lifting gives the fractions of elimination, or says that there are none."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_slip.errors import DataError
from fleet_slip.regression import least_squares as exact
from fleet_slip.regression.exact import PRIMES, eliminate, solve_by_lifting
from tests.support.counts import gram_of, names


def near_collinear(seed: int, size: int, bits: int) -> list[list[int]]:
    """Sums of products of columns that differ little, label last."""
    rng = np.random.default_rng(seed)
    common = rng.integers(-(2**bits), 2**bits, size=(2 * size + 2, 1)).astype(object)
    columns = common + rng.integers(-9, 10, size=(2 * size + 2, size + 1))
    return [[int(entry) for entry in row] for row in columns.T @ columns]


def lifted(matrix: list[list[int]]) -> list[Fraction] | None:
    found = solve_by_lifting([row[:-1] for row in matrix[:-1]], [row[-1] for row in matrix[:-1]])
    return None if found is None else [Fraction(x, found[1]) for x in found[0]]


@given(st.integers(0, 10**6), st.integers(1, 12), st.integers(1, 60))
def test_lifting_gives_the_fractions_of_elimination(seed: int, size: int, bits: int) -> None:
    matrix = near_collinear(seed, size, bits)
    triangle = eliminate(matrix)
    if triangle.singular is not None:
        assert lifted(matrix) is None
        return
    numerators, determinant = triangle.solve(size)
    assert lifted(matrix) == [Fraction(x, determinant) for x in numerators]


@pytest.mark.parametrize("prime", PRIMES)
def test_a_matrix_that_one_prime_divides_is_lifted_by_another(prime: int) -> None:
    assert lifted([[prime, 0, 1], [0, 3, 5], [1, 5, 0]]) == [Fraction(1, prime), Fraction(5, 3)]


@given(st.integers(0, 10**6), st.integers(2, 9))
def test_rows_change_places_where_a_pivot_is_zero(seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    half = rng.integers(-3, 4, size=(size, size)) * rng.integers(0, 2, size=(size, size))
    matrix = (half + half.T + 99 * np.eye(size, dtype=np.int64)[::-1]) * (1 - np.eye(size))
    rows, right = matrix.astype(int).tolist(), list(range(1, size + 1))
    found = solve_by_lifting(rows, right)
    if found is None:
        assert abs(np.linalg.det(matrix)) < 0.5
        return
    numerators, denominator = found
    assert denominator > 0
    for row, b in zip(rows, right, strict=True):
        assert sum(a * x for a, x in zip(row, numerators, strict=True)) == denominator * b


def test_zeros_negative_and_huge_solutions() -> None:
    huge = 7**500
    found = lifted([[1, 0, huge], [0, 2, -huge], [huge, -huge, 0]])
    assert found == [Fraction(huge), Fraction(-huge, 2)]
    assert lifted([[1, 0, 0], [0, 2, 0], [0, 0, 0]]) == [Fraction(0), Fraction(0)]
    assert lifted([[0, 1], [1, 0]]) is None


@pytest.mark.parametrize("intercept", [True, False])
def test_a_fit_of_many_inputs_is_the_same_by_both_ways(
    monkeypatch: pytest.MonkeyPatch, intercept: bool
) -> None:
    counts = np.random.default_rng(5).integers(-30000, 30000, size=(200, 42))
    gram, inputs = gram_of(counts), names(41)[:-1]
    fitted = exact.fit(gram, inputs, "y", intercept=intercept)
    monkeypatch.setattr(exact, "MANY_INPUTS", 1000)
    assert fitted == exact.fit(gram, inputs, "y", intercept=intercept)


def test_of_many_inputs_too_a_dependent_one_is_named() -> None:
    counts = np.random.default_rng(5).integers(-300, 300, size=(200, 42))
    counts[:, 40] = counts[:, 3] + 2 * counts[:, 4]
    with pytest.raises(DataError, match=r"x41 is a linear combination of x4, x5"):
        exact.fit(gram_of(counts), names(41)[:-1], "y")
