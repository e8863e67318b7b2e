"""Which Gram rows no drive of integer counts can have: exact rules, and one in floating point.

Of n rows whose counts x of a signal are whole numbers from l to h, with the sum s and the sum of
squares d, and c the sum of products of two signals x and y,

    n l <= s <= n h                               each count is in its range
    d = s modulo 2                                x^2 and x are both odd or both even
    d <= (l + h) s - n l h                        (x - l) (h - x) >= 0
    d >= (2 a + 1) s - n a (a + 1), a = floor(s/n)  (x - a) (x - a - 1) >= 0, for any whole a
    |c| <= n max|x| max|y|

are exact and in 64 bits: ranges are within 15 bits and n below 2^31, so that nothing reaches 2^63.
And the matrix of n, sums and products is positive semidefinite. That is decided in binary64, on the
matrix scaled to a diagonal of ones, to which `ALLOWANCE` is added: what fails is indefinite beyond
all rounding, and what is indefinite by less passes.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from fleet_slip.arrays import BoolArray, IntArray
from fleet_slip.grams.messages import MOST_ROWS

ALLOWANCE = 1e-10
CHUNK = 4096
"""Matrices that are worked on at once."""

NO_ROWS = "has no rows, or more than a drive can have"
SUMS = "has sums outside the ranges of its signals"
PRODUCTS = "has products that no integer counts can have"
INDEFINITE = "has a matrix that is not positive semidefinite"


def find_impossible(
    rows: IntArray, sums: IntArray, products: IntArray, ranges: Sequence[tuple[int, int]]
) -> list[str | None]:
    """Return why each Gram row is impossible, None where it is not.

    `rows` has shape (m,), `sums` (m, k), `products` (m, k(k+1)/2); `ranges` are those of the counts
    of the k signals.
    """
    told: list[str | None] = [None] * len(rows)
    left: BoolArray = np.ones(len(rows), dtype=np.bool_)
    for reason, rule in (
        (NO_ROWS, lambda n, _s, _p: (n < 1) | (n > MOST_ROWS)),
        (SUMS, lambda n, s, _p: _bad_sums(n, s, ranges)),
        (PRODUCTS, lambda n, s, p: _bad_products(n, s, p, ranges)),
        (INDEFINITE, _indefinite),
    ):
        at = np.flatnonzero(left)
        bad = at[rule(rows[at], sums[at], products[at])] if len(at) else at
        left[bad] = False
        for one in bad.tolist():
            told[one] = reason
    return told


def _bad_sums(n: IntArray, sums: IntArray, ranges: Sequence[tuple[int, int]]) -> BoolArray:
    least, most = _limits(ranges)
    below, above = sums < n[:, None] * least, sums > n[:, None] * most
    found: BoolArray = np.any(below | above, axis=1)
    return found


def _limits(ranges: Sequence[tuple[int, int]]) -> tuple[IntArray, IntArray]:
    both = np.array(ranges, dtype=np.int64).reshape(-1, 2)
    return both[:, 0], both[:, 1]


def _bad_products(
    n: IntArray, sums: IntArray, products: IntArray, ranges: Sequence[tuple[int, int]]
) -> BoolArray:
    least, most = _limits(ranges)
    k = len(least)
    row, column = np.tril_indices(k)
    size = np.maximum(np.abs(least), np.abs(most))
    bound = n[:, None] * (size[row] * size[column])
    bad: BoolArray = np.any((products > bound) | (products < -bound), axis=1)
    squares = products[:, np.flatnonzero(row == column)]
    each = n[:, None]
    below = sums // each
    bad = bad | ((squares ^ sums) & 1 != 0).any(axis=1)
    bad = bad | (squares > (least + most) * sums - each * (least * most)).any(axis=1)
    bad = bad | (squares < (2 * below + 1) * sums - each * (below * (below + 1))).any(axis=1)
    return bad


def _indefinite(n: IntArray, sums: IntArray, products: IntArray) -> BoolArray:
    parts = [slice(first, first + CHUNK) for first in range(0, len(n), CHUNK)]
    return np.concatenate([_not_definite(_scaled(n[at], sums[at], products[at])) for at in parts])


def _scaled(n: IntArray, sums: IntArray, products: IntArray) -> Any:
    """Return matrices of n, sums and products, shape (m, k + 1, k + 1), with a unit diagonal."""
    k = sums.shape[1]
    matrix = np.empty((len(n), k + 1, k + 1))
    matrix[:, 0, 0], matrix[:, 1:, 0], matrix[:, 0, 1:] = n, sums, sums
    row, column = np.tril_indices(k)
    matrix[:, row + 1, column + 1] = products
    matrix[:, column + 1, row + 1] = products
    places = np.arange(k + 1)
    size = np.sqrt(np.maximum(matrix[:, places, places], 1.0))
    matrix /= size[:, :, None] * size[:, None, :]
    return matrix


def _not_definite(matrix: Any) -> BoolArray:
    """Whether a pivot of each matrix is not positive, with the allowance; the matrix is used up."""
    size = matrix.shape[1]
    places = np.arange(size)
    matrix[:, places, places] += ALLOWANCE
    bad: BoolArray = np.zeros(len(matrix), dtype=np.bool_)
    for j in range(size):
        pivot = matrix[:, j, j]
        bad |= pivot <= 0
        column = matrix[:, j + 1 :, j].copy()
        factor = column / np.where(pivot > 0, pivot, 1.0)[:, None]
        matrix[:, j + 1 :, j + 1 :] -= factor[:, :, None] * column[:, None, :]
    return bad
