"""Which Gram rows no drive of integer counts can have, exactly.

Of n rows whose counts x of a signal are whole numbers from l to h, with the sum s and the sum of
squares d, and c the sum of products of two signals x and y,

    n l <= s <= n h                               each count is in its range
    d = s modulo 2                                x^2 and x are both odd or both even
    d <= (l + h) s - n l h                        (x - l) (h - x) >= 0
    d >= (2 a + 1) s - n a (a + 1), a = floor(s/n)  (x - a) (x - a - 1) >= 0, for any whole a
    |c| <= n max|x| max|y|

in 64 bits: n is so small (`most_rows`) that nothing reaches 2^63. And the matrix of n, sums and
products is positive semidefinite. That is decided in binary64 where it can be, on the matrix scaled
to a diagonal of ones: its least eigenvalue is computed to within m^2 u or so, 1e-13 for m = 33
(Higham, Accuracy and Stability of Numerical Algorithms, section 10.1). Beyond `NEAR` of zero its
sign is sure; what is between is decided in whole numbers, 0.1 ms each with 11 signals.
"""

from collections.abc import Sequence

import numpy as np

from fleet_slip.arrays import BoolArray, IntArray
from fleet_slip.grams.received.counted_sets import MOST_ROWS
from fleet_slip.regression.exact.elimination import is_semidefinite

NEAR = 1e-11
LARGEST_SUM = 2**61

NO_ROWS = "has no rows, or more than a drive can have"
SUMS = "has sums outside the ranges of its signals"
PRODUCTS = "has products that no integer counts can have"
INDEFINITE = "has a matrix that is not positive semidefinite"


def find_impossible(
    rows: IntArray, sums: IntArray, products: IntArray, ranges: Sequence[tuple[int, int]]
) -> dict[str, IntArray]:
    """Return impossible Gram rows by reason, of n (m,), sums (m, k), products and k ranges."""
    least, most = np.array(ranges, dtype=np.int64).reshape(-1, 2).T
    found: dict[str, IntArray] = {}
    left = np.arange(len(rows))
    for reason in (NO_ROWS, SUMS, PRODUCTS, INDEFINITE):
        n, s, p = rows[left], sums[left], products[left]
        bad: BoolArray
        if reason == NO_ROWS:
            bad = np.array((n < 1) | (n > most_rows(ranges)), dtype=np.bool_)
        elif reason == SUMS:
            bad = ((s < n[:, None] * least) | (s > n[:, None] * most)).any(axis=1)
        elif reason == PRODUCTS:
            bad = _bad_products(n[:, None], s, p, least, most)
        else:
            bad = _indefinite(n, s, p)
        if bad.any():
            found[reason] = left[bad]
            left = left[~bad]
    return found


def most_rows(ranges: Sequence[tuple[int, int]]) -> int:
    """Return of how many rows a Gram row can be: no sum of their products reaches 2^61."""
    largest = max((abs(end) for one in ranges for end in one), default=1)
    return min(MOST_ROWS, (LARGEST_SUM - 1) // largest**2)


def _bad_products(
    n: IntArray, sums: IntArray, products: IntArray, least: IntArray, most: IntArray
) -> BoolArray:
    row, column = np.tril_indices(len(least))
    size = np.maximum(np.abs(least), np.abs(most))
    bound = n * (size[row] * size[column])
    squares, below = products[:, np.flatnonzero(row == column)], sums // n
    bad: BoolArray = ((products > bound) | (products < -bound)).any(axis=1)
    bad |= ((squares ^ sums) & 1 != 0).any(axis=1)
    bad |= (squares > (least + most) * sums - n * (least * most)).any(axis=1)
    bad |= (squares < (2 * below + 1) * sums - n * (below * (below + 1))).any(axis=1)
    return bad


def _indefinite(n: IntArray, sums: IntArray, products: IntArray) -> BoolArray:
    """Whether each matrix is not positive semidefinite."""
    k = sums.shape[1]
    row, column = np.tril_indices(k)
    matrix = np.zeros((len(n), k + 1, k + 1))
    matrix[:, 0, 0], matrix[:, 1:, 0] = n, sums
    matrix[:, row + 1, column + 1] = products
    scale = 1 / np.sqrt(np.maximum(np.diagonal(matrix, axis1=1, axis2=2), 1.0))
    matrix *= scale[:, :, None] * scale[:, None, :]
    smallest = np.linalg.eigvalsh(matrix)[:, 0]  # of the lower triangle
    bad: BoolArray = smallest < -NEAR
    for at in np.flatnonzero(np.abs(smallest) <= NEAR).tolist():
        packed = products[at].tolist()
        triangle = [[int(n[at])]]
        for i, total in enumerate(sums[at].tolist()):
            triangle.append([total, *packed[i * (i + 1) // 2 : (i + 1) * (i + 2) // 2]])
        bad[at] = not is_semidefinite(triangle)
    return bad
