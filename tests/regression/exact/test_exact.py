"""Exact least squares against dense float64 and exact relations."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_slip.errors import DataError
from fleet_slip.regression import exact as elimination
from fleet_slip.regression import least_squares as exact
from fleet_slip.regression.choice import nested_fits
from fleet_slip.regression.exact import (
    PRIME,
    eliminate,
    inverse_matrix,
    solve_by_lifting,
    sqrt,
    symmetric_eigenvalues,
)
from fleet_slip.regression.gram import Gram
from fleet_slip.regression.least_squares import (
    condition_number,
    correlation_matrix,
    dependence,
    fit,
)
from tests.support.counts import gram_of, names, random_drives


@given(
    st.integers(0, 10**6),
    st.integers(2, 8),
    st.integers(20, 400),
    st.floats(0, 0.99),
    st.lists(st.integers(0, 3), min_size=9, max_size=9),
)
@settings(max_examples=60)
def test_agrees_at_any_size_collinearity_and_scale(
    seed: int, inputs: int, rows: int, share: float, powers: list[int]
) -> None:
    rng = np.random.default_rng(seed)
    x = (1 - share) * rng.normal(size=(rows, inputs)) + share * rng.normal(size=(rows, 1))
    y = x @ rng.normal(size=inputs) + rng.normal(size=rows)
    scale = 10.0 ** np.array(powers[: inputs + 1])
    counts = np.rint(np.column_stack([x, y]) * 3000 * scale + 1000 * scale).astype(np.int64)
    model = fit(gram_of(counts), names(inputs)[:-1], "y").model
    # The reference: QR of centred and scaled columns.
    centred = counts - counts.mean(axis=0)
    spread = centred.std(axis=0)
    q, r = np.linalg.qr(centred[:, :-1] / spread[:-1])
    b = np.linalg.solve(r, q.T @ centred[:, -1] / spread[-1]) * spread[-1] / spread[:-1]
    size = np.abs(b * spread[:-1]).max()
    np.testing.assert_allclose(
        [*model.weights.values()] * spread[:-1] / size, b * spread[:-1] / size, atol=1e-9
    )


def test_a_linear_law_is_recovered_exactly() -> None:
    x = np.array([[1, 7], [2, 5], [9, 4], [4, 4], [0, 3]])
    y = 3 * x[:, 0] - 2 * x[:, 1] + 11
    fitted = fit(gram_of(np.column_stack([x, y])), ["x1", "x2"], "y")
    assert [*fitted.model.coefficients] == [3, -2]
    assert fitted.model.intercept == 11
    assert fitted.rss == 0


def test_physical_units() -> None:
    x = np.array([[1], [2], [5]])
    gram = Gram.from_counts(("ax", "sideslip"), np.column_stack([x, 4 * x + 7]))
    scales = {"ax": Fraction(1, 1000), "sideslip": Fraction(1, 10_000)}
    model = fit(gram, ["ax"], "sideslip").model.physical(scales)
    assert model.coefficients == (Fraction(4, 10),)
    assert model.intercept == Fraction(7, 10_000)
    assert model.weights == {"ax": 0.4}


def test_the_null_model_is_the_mean() -> None:
    fitted = fit(gram_of(np.array([[5, 1], [6, 2], [8, 6]])), [], "y")
    assert fitted.model.intercept == 3
    assert fitted.rss == fitted.tss == 14


@settings(max_examples=25)
@given(st.integers(0, 10**6))
def test_all_nested_models_equal_separate_fits(seed: int) -> None:
    gram = gram_of(np.concatenate(random_drives(seed, drives=2)))
    order = ["x3", "x1", "x4", "x2"]
    for size, nested in enumerate(nested_fits(gram, order, "y")):
        assert nested == fit(gram, order[:size], "y")


def test_dependent_signals_are_named_with_the_relation() -> None:
    rng = np.random.default_rng(1)
    left = rng.integers(-500, 500, 40)
    other, label = rng.integers(-500, 500, (2, 40))
    constant = np.full(40, 6)
    counts = np.column_stack([left, other, 2 * left - other + 3, constant, label])
    gram = Gram.from_counts(("steer_fl", "ay", "steer_fr", "ax", "sideslip"), counts)
    inputs = ["steer_fl", "ay", "steer_fr", "ax"]
    with pytest.raises(DataError) as raised:
        fit(gram, inputs, "sideslip")
    assert "steer_fr is a linear combination of steer_fl, ay" in str(raised.value)
    assert "steer_fr = 2 steer_fl - 1 ay + 3" in str(raised.value)
    assert "ax is constant (6 counts)" in str(raised.value)
    assert "steer_fl is" not in str(raised.value)
    with pytest.raises(DataError, match="steer_fr is a linear"):
        nested_fits(gram, inputs, "sideslip")
    assert dependence(gram, inputs[:2]) == ""


def test_too_few_rows_and_none() -> None:
    gram = gram_of(np.array([[1, 2, 3], [4, 6, 5]]))
    with pytest.raises(DataError, match="only 2 rows"):
        fit(gram, ["x1", "x2"], "y")
    with pytest.raises(DataError, match="no rows"):
        fit(Gram.zero(("x", "y")), ["x"], "y")


@given(st.lists(st.integers(-50, 50), min_size=9, max_size=9))
def test_elimination_gives_determinants_and_inverse(entries: list[int]) -> None:
    a = np.array(entries).reshape(3, 3)
    matrix = (a @ a.T + np.eye(3, dtype=int)).tolist()
    steps = eliminate([*([*row, 0] for row in matrix), [0, 0, 0, 1]])
    for size in range(1, 4):
        minor = np.linalg.det(np.array(matrix)[:size, :size])
        assert steps.minors[size] == pytest.approx(minor, rel=1e-9)
    inverse = inverse_matrix(matrix)
    product = [
        [sum(matrix[i][t] * inverse[t][j] for t in range(3)) for j in range(3)] for i in range(3)
    ]
    assert product == [[int(i == j) for j in range(3)] for i in range(3)]


@given(st.fractions(min_value=0))
def test_square_roots_are_correctly_rounded(value: Fraction) -> None:
    root = sqrt(value)
    if value == 0:
        assert root == 0
        return
    exact = Fraction(root)
    below, above = Fraction(np.nextafter(root, 0)), Fraction(np.nextafter(root, np.inf))
    assert ((below + exact) / 2) ** 2 <= value <= ((exact + above) / 2) ** 2


def test_condition_number_is_that_of_the_correlations() -> None:
    counts = np.concatenate(random_drives(5))
    gram = gram_of(counts)
    correlations = np.corrcoef(counts.T.astype(float))
    np.testing.assert_allclose(correlation_matrix(gram), correlations, atol=1e-12)
    inputs = names(4)[:-1]
    expected = np.linalg.cond(correlations[:4, :4])
    assert condition_number(gram, inputs) == pytest.approx(expected, rel=1e-9)
    assert condition_number(gram, []) == 1.0


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


def test_a_matrix_that_the_prime_divides_is_left_to_elimination() -> None:
    assert lifted([[PRIME, 0, 1], [0, 3, 5], [1, 5, 0]]) is None


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


@given(st.integers(1, 12), st.integers(0, 10**6))
def test_they_are_those_of_lapack(k: int, seed: int) -> None:
    factor = np.random.default_rng(seed).normal(size=(k, k))
    matrix = factor + factor.T
    largest = np.abs(matrix).sum()
    expected = np.linalg.eigvalsh(matrix)
    assert symmetric_eigenvalues(matrix) == pytest.approx(expected, rel=1e-13, abs=1e-15 * largest)


def test_they_are_those_of_second_differences() -> None:
    k = 20
    matrix = 2 * np.eye(k) - np.eye(k, k=1) - np.eye(k, k=-1)
    expected = [2 - 2 * math.cos(math.pi * i / (k + 1)) for i in range(1, k + 1)]
    assert symmetric_eigenvalues(matrix) == pytest.approx(expected, rel=1e-14)


def test_compiled_they_have_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    columns = np.random.default_rng(3).normal(size=(60, 25))
    matrix = np.asarray(np.corrcoef((columns + 9 * columns[:, :1]).T))
    plain = symmetric_eigenvalues(matrix)
    monkeypatch.setattr(elimination, "MANY", 25)
    assert symmetric_eigenvalues(matrix) == plain


@pytest.mark.parametrize("small", [1e-3, 1e-8, 1e-12])
def test_small_ones_are_accurate(small: float) -> None:
    scale = np.diag([1.0, small, small**2])
    matrix = scale @ np.array([[1, 0.5, 0.25], [0.5, 1, 0.5], [0.25, 0.5, 1]]) @ scale
    # The determinant, (3/4)^2 * small^6, is the product of all.
    product = math.prod(symmetric_eigenvalues(matrix))
    assert product == pytest.approx(0.5625 * small**6, rel=1e-14)


def test_a_diagonal_and_a_singular_matrix_are_no_trouble() -> None:
    assert symmetric_eigenvalues(np.diag([3.0, 0.0, -1.0])) == [-1.0, 0.0, 3.0]
    assert symmetric_eigenvalues(np.ones((4, 4))) == pytest.approx([0, 0, 0, 4], abs=1e-14)
    assert symmetric_eigenvalues(np.zeros((2, 2))) == [0.0, 0.0]
