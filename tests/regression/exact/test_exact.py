"""Exact least squares against dense float64 and exact relations."""

import math
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_slip.errors import DataError
from fleet_slip.regression import exact
from fleet_slip.regression.choice import nested_fits
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


@settings(max_examples=25)
@given(st.integers(0, 10**6))
def test_all_nested_models_equal_separate_fits(seed: int) -> None:
    gram = gram_of(np.concatenate(random_drives(seed, drives=2)))
    order = ["x3", "x1", "x4", "x2"]
    for size, nested in enumerate(nested_fits(gram, order, "y")):
        assert nested == fit(gram, order[:size], "y")


def test_dependent_signals_are_named_with_the_relation() -> None:
    rng = np.random.default_rng(1)
    first = rng.integers(-500, 500, 40)
    other, label = rng.integers(-500, 500, (2, 40))
    constant = np.full(40, 6)
    counts = np.column_stack([first, other, 2 * first - other + 3, constant, label])
    gram = Gram.from_counts(("steer_fl", "ay", "steer_fr", "ax", "sideslip"), counts)
    inputs = ["steer_fl", "ay", "steer_fr", "ax"]
    with pytest.raises(DataError) as raised:
        fit(gram, inputs, "sideslip")
    assert "steer_fr is a linear combination of steer_fl, ay" in str(raised.value)
    assert "ax is constant" in str(raised.value)
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
def test_determinant_and_inverse_are_exact(entries: list[int]) -> None:
    a = np.array(entries).reshape(3, 3)
    matrix = (a @ a.T + np.eye(3, dtype=int)).tolist()
    assert exact.determinant(matrix) == pytest.approx(np.linalg.det(np.array(matrix)), rel=1e-9)
    inverse, denominator = exact.invert(matrix)
    product = [
        [sum(matrix[i][t] * inverse[t][j] for t in range(3)) for j in range(3)] for i in range(3)
    ]
    assert product == [[denominator * (i == j) for j in range(3)] for i in range(3)]


def test_a_singular_matrix_has_no_solution() -> None:
    singular = [[1, 2], [2, 4]]
    assert exact.solve(singular, [1, 2]) is None
    assert exact.solve_rational([[Fraction(1), Fraction(2), Fraction(3)]] * 2) is None
    with pytest.raises(ZeroDivisionError):
        exact.invert(singular)


@given(st.fractions(min_value=0))
def test_square_roots_are_correctly_rounded(value: Fraction) -> None:
    root = exact.sqrt(value)
    if value == 0:
        assert root == 0
        return
    middle = Fraction(root)
    below, above = Fraction(np.nextafter(root, 0)), Fraction(np.nextafter(root, np.inf))
    assert ((below + middle) / 2) ** 2 <= value <= ((middle + above) / 2) ** 2


def test_condition_number_is_that_of_the_correlations() -> None:
    counts = np.concatenate(random_drives(5))
    gram = gram_of(counts)
    correlations = np.corrcoef(counts.T.astype(float))
    np.testing.assert_allclose(correlation_matrix(gram), correlations, atol=1e-12)
    inputs = names(4)[:-1]
    expected = np.linalg.cond(correlations[:4, :4])
    assert condition_number(gram, inputs) == pytest.approx(expected, rel=1e-9)
    assert condition_number(gram, []) == 1.0


def solved(matrix: list[list[int]]) -> list[Fraction] | None:
    solution = exact.solve([row[:-1] for row in matrix], [row[-1] for row in matrix])
    return None if solution is None else [Fraction(x, solution[1]) for x in solution[0]]


@given(st.integers(0, 10**6), st.integers(1, 12), st.integers(1, 60))
def test_solutions_of_nearly_dependent_equations_hold(seed: int, size: int, bits: int) -> None:
    rng = np.random.default_rng(seed)
    common = rng.integers(-(2**bits), 2**bits, size=(2 * size + 2, 1)).astype(object)
    columns = common + rng.integers(-9, 10, size=(2 * size + 2, size + 1))
    moments = columns.T @ columns
    equations = [[int(entry) for entry in row] for row in moments[:-1]]
    solution = solved(equations)
    if solution is None:
        assert exact.determinant([row[:-1] for row in equations]) == 0
        return
    for *row, right in equations:
        assert sum(a * x for a, x in zip(row, solution, strict=True)) == right


SECOND_DIFFERENCES = [[2 * (i == j) - (abs(i - j) == 1) for j in range(20)] for i in range(20)]
EXTREMES = [2 - 2 * math.cos(math.pi * i / 21) for i in (1, 20)]
HILBERT = [[360360 // (i + j + 1) for j in range(8)] for i in range(8)]


@pytest.mark.parametrize(
    ("matrix", "expected"),
    [
        (SECOND_DIFFERENCES, pytest.approx(EXTREMES[1] / EXTREMES[0], rel=1e-14)),
        # By mpmath's eigsy with 60 digits, of the matrix scaled to a unit diagonal.
        (HILBERT, 5933993485.836007),
        # Eigenvalues of the correlations: 1 + (n - 1) / n and 1 / n.
        *(([[n, n - 1], [n - 1, n]], float(2 * n - 1)) for n in (3, 10**8, 10**20)),
        *((matrix, math.inf) for matrix in ([[1, 1], [1, 1]], [[0, 0], [0, 0]], [[4, 6], [6, 9]])),
    ],
)
def test_condition_numbers_are_correctly_rounded(matrix: list[list[int]], expected: float) -> None:
    assert exact.condition_number(matrix) == expected


def test_the_last_bits_of_eigenvectors_do_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    columns = np.random.default_rng(3).integers(-9, 10, size=(60, 25))
    columns += 9 * columns[:, :1]
    matrix = (columns.T @ columns).tolist()
    expected = exact.condition_number(matrix)
    eigh = np.linalg.eigh

    def eigh_of_another_machine(a: np.ndarray) -> SimpleNamespace:
        vectors = eigh(a).eigenvectors
        noise = np.random.default_rng(4).normal(size=vectors.shape)
        return SimpleNamespace(eigenvectors=vectors + 1e-14 * noise)

    monkeypatch.setattr(np.linalg, "eigh", eigh_of_another_machine)
    assert exact.condition_number(matrix) == expected
