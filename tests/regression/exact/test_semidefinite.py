"""Positive semidefinite integer matrices, beside the definition by principal minors."""

from itertools import combinations
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_slip.regression.exact import is_semidefinite


def determinant(matrix: list[list[int]]) -> int:
    """By Laplace: nothing is divided."""
    if not matrix:
        return 1
    total = 0
    for column, value in enumerate(matrix[0]):
        minor = [row[:column] + row[column + 1 :] for row in matrix[1:]]
        total += (-1) ** column * value * determinant(minor)
    return total


def lower(matrix: Any) -> list[list[int]]:
    return [row[: at + 1] for at, row in enumerate(np.asarray(matrix).tolist())]


@settings(max_examples=500)
@given(st.integers(1, 4), st.lists(st.integers(-2, 2), min_size=10, max_size=10))
def test_all_principal_minors_are_not_negative(size: int, values: list[int]) -> None:
    row, column = np.tril_indices(size)
    matrix = np.zeros((size, size), dtype=int)
    matrix[row, column] = matrix[column, row] = values[: len(row)]
    chosen = (c for many in range(1, size + 1) for c in combinations(range(size), many))
    minors = [determinant(matrix[np.ix_(c, c)].tolist()) for c in chosen]
    assert is_semidefinite(lower(matrix)) == (min(minors) >= 0)


@given(st.lists(st.lists(st.integers(-9, 9), min_size=5, max_size=5), min_size=1, max_size=6))
def test_products_of_a_matrix_with_itself_are(rows: list[list[int]]) -> None:
    matrix = np.array(rows)
    squares = matrix.T @ matrix
    assert is_semidefinite(lower(squares))
    squares[4, 4] = -1
    assert not is_semidefinite(lower(squares))
