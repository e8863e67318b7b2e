"""Eigenvalues against LAPACK, and against matrices whose eigenvalues are known."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_slip.regression import exact as elimination
from fleet_slip.regression.exact import symmetric_eigenvalues


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
