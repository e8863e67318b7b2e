"""Which Gram rows no drive of integer counts can have, exactly.

Of n rows whose counts x of a signal are whole numbers from l to h, with the sum s and the sum of
squares d, and c the sum of products of two signals x and y,

    n l <= s <= n h                               each count is in its range
    d = s modulo 2                                x^2 and x are both odd or both even
    d <= (l + h) s - n l h                        (x - l) (h - x) >= 0
    d >= (2 a + 1) s - n a (a + 1), a = floor(s/n)  (x - a) (x - a - 1) >= 0, for any whole a
    |c| <= n max|x| max|y|

are exact and in 64 bits: ranges are within 15 bits and n below 2^31, or n is below as much less as
ranges are wider (`most_rows`), so that nothing reaches 2^63.
And the matrix of n, sums and products is positive semidefinite. That is decided in binary64 where
it can be: on the matrix scaled to a diagonal of ones, by whether all pivots are positive. With
`NEAR` taken from the diagonal, they are only if the matrix is positive definite; with `NEAR` added,
one is not only if it is indefinite. For elimination of a matrix of order m with a diagonal of ones
succeeds if its least eigenvalue is beyond m g, and fails if it is below -m g, where g is (m + 1) u
/ (1 - (m + 1) u) (Demmel; Higham, Accuracy and Stability of Numerical Algorithms, theorem 10.7);
scaling moves it by m 10 u at most. For m = 33 both are below 2e-13. What is between is decided in
whole numbers: 0.1 ms each with 11 signals.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from fleet_slip.arrays import BoolArray, IntArray
from fleet_slip.grams.received.messages import MOST_ROWS
from fleet_slip.regression.exact.elimination import is_semidefinite

NEAR = 1e-12
LARGEST_SUM = 2**61
CHUNK = 512
"""Matrices that are worked on at once."""

NO_ROWS = "has no rows, or more than a drive can have"
SUMS = "has sums outside the ranges of its signals"
PRODUCTS = "has products that no integer counts can have"
INDEFINITE = "has a matrix that is not positive semidefinite"


def find_impossible(
    rows: IntArray, sums: IntArray, products: IntArray, ranges: Sequence[tuple[int, int]]
) -> dict[str, IntArray]:
    """Return impossible Gram rows by reason, of n (m,), sums (m, k), products and k ranges."""
    found: dict[str, IntArray] = {}
    left = np.arange(len(rows))
    for reason, rule in (
        (NO_ROWS, lambda n, _s, _p: (n < 1) | (n > most_rows(ranges))),
        (SUMS, lambda n, s, _p: _bad_sums(n, s, ranges)),
        (PRODUCTS, lambda n, s, p: _bad_products(n, s, p, ranges)),
        (INDEFINITE, _indefinite),
    ):
        if not len(left):
            break
        bad = _by_chunks(rule, rows, sums, products, left)
        if bad.any():
            found[reason] = left[bad]
            left = left[~bad]
    return found


def most_rows(ranges: Sequence[tuple[int, int]]) -> int:
    """Return of how many rows a message can be: no sum of their products reaches 2^61."""
    largest = max((abs(end) for one in ranges for end in one), default=1)
    return min(MOST_ROWS, (LARGEST_SUM - 1) // largest**2)


def _by_chunks(
    rule: Callable[[IntArray, IntArray, IntArray], BoolArray],
    rows: IntArray,
    sums: IntArray,
    products: IntArray,
    left: IntArray,
) -> BoolArray:
    """Return which of some rows break a rule; as many at once as a processor's cache holds."""
    if len(left) == len(rows):
        chunks: list[Any] = [slice(at, at + CHUNK) for at in range(0, len(rows), CHUNK)]
    else:
        chunks = [left[at : at + CHUNK] for at in range(0, len(left), CHUNK)]
    return np.concatenate([rule(rows[at], sums[at], products[at]) for at in chunks])


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
    """Whether each matrix is not positive semidefinite."""
    bad: BoolArray = np.zeros(len(n), dtype=np.bool_)
    left = np.flatnonzero(_has_other_pivots(n, sums, products, -NEAR))
    if len(left):
        sure = _has_other_pivots(n[left], sums[left], products[left], NEAR)
        bad[left[sure]] = True
        for at in left[~sure].tolist():
            bad[at] = not is_semidefinite(_lower_triangle(n[at], sums[at], products[at]))
    return bad


def _lower_triangle(n: int, sums: IntArray, products: IntArray) -> list[list[int]]:
    rows = [[int(n)]]
    packed = products.tolist()
    for i, total in enumerate(sums.tolist()):
        rows.append([total, *packed[i * (i + 1) // 2 : (i + 1) * (i + 2) // 2]])
    return rows


def _has_other_pivots(n: IntArray, sums: IntArray, products: IntArray, added: float) -> BoolArray:
    """Whether a pivot of a scaled matrix, with a number added to its diagonal, is not positive."""
    matrix = _scaled(n, sums, products)
    places = np.arange(len(matrix))
    matrix[places, places] += added
    size = len(matrix)
    bad: BoolArray = np.zeros(len(n), dtype=np.bool_)
    for j in range(size):
        pivot = matrix[j, j]
        bad |= pivot <= 0
        below = matrix[j + 1 :, j]
        factor = below / np.where(pivot > 0, pivot, 1.0)
        for i in range(j + 1, size):  # the lower triangle only
            matrix[i, j + 1 : i + 1] -= factor[i - j - 1] * below[: i - j]
    return bad


def _scaled(n: IntArray, sums: IntArray, products: IntArray) -> Any:
    """Return lower triangles of n, sums and products, (k+1, k+1, m), of a unit diagonal."""
    k = sums.shape[1]
    row, column = np.tril_indices(k)
    matrix = np.empty((k + 1, k + 1, len(n)))
    matrix[0, 0], matrix[1:, 0] = n, sums.T
    matrix[row + 1, column + 1] = products.T
    places = np.arange(k + 1)
    scale = 1 / np.sqrt(np.maximum(matrix[places, places], 1.0))
    for i in range(k + 1):
        matrix[i, : i + 1] *= scale[i] * scale[: i + 1]
    return matrix
