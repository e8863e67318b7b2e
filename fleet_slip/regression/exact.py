"""Exact linear algebra of integers, and real numbers rounded once to binary64, by FLINT.

Results are the same bits on every machine: FLINT computes with integers, and encloses each real
number in a ball (Johansson 2017, IEEE Transactions on Computers 66:1281).
"""

import math
from collections.abc import Sequence
from fractions import Fraction
from typing import TypeVar

import numpy as np
from flint import arb, arb_mat, ctx, fmpq, fmpq_mat, fmpz_mat

IntegerMatrix = Sequence[Sequence[int]]
Entry = TypeVar("Entry")


def solve(matrix: IntegerMatrix, right: Sequence[int]) -> tuple[list[int], int] | None:
    """Solve a square system of integer equations exactly.

    Parameters
    ----------
    matrix : sequence of sequences of int, shape (k, k)
    right : sequence of int, shape (k,)

    Returns
    -------
    tuple of (list of int, int) or None
        Numerators of the k unknowns over one common denominator. None if `matrix` is singular.
    """
    size = len(matrix)
    solution = _solve(
        fmpq_mat(fmpz_mat(size, size, _flat(matrix))), fmpq_mat(fmpz_mat(size, 1, list(right)))
    )
    if solution is None:
        return None
    numerators, denominator = solution.numer_denom()
    return list(map(int, numerators.entries())), int(denominator)


def solve_rational(rows: Sequence[Sequence[Fraction]]) -> tuple[Fraction, ...] | None:
    """Solve a square system of rational equations exactly.

    Parameters
    ----------
    rows : sequence of sequences of Fraction, shape (k, k + 1)
        Each equation, with its right-hand side last.

    Returns
    -------
    tuple of Fraction or None
        The k unknowns. None if the equations are singular.
    """
    size = len(rows)
    matrix, right = (
        fmpq_mat(size, width, [fmpq(x.numerator, x.denominator) for x in _flat(part)])
        for width, part in ((size, [row[:-1] for row in rows]), (1, [row[-1:] for row in rows]))
    )
    solution = _solve(matrix, right)
    if solution is None:
        return None
    return tuple(Fraction(int(value.p), int(value.q)) for value in solution.entries())


def _solve(matrix: fmpq_mat, right: fmpq_mat) -> fmpq_mat | None:
    """Return the solution of linear equations; None if they are singular."""
    try:
        return matrix.solve(right)
    except ZeroDivisionError:
        return None


def invert(matrix: IntegerMatrix) -> tuple[list[list[int]], int]:
    """Invert a regular integer matrix exactly.

    Parameters
    ----------
    matrix : sequence of sequences of int, shape (k, k)

    Returns
    -------
    tuple of (list of list of int, int)
        Numerators of the inverse, shape (k, k), over one common denominator.

    Raises
    ------
    ZeroDivisionError
        If `matrix` is singular.
    """
    size = len(matrix)
    augmented = [[*row, *(int(i == j) for j in range(size))] for i, row in enumerate(matrix)]
    reduced, denominator, _ = fmpz_mat(size, 2 * size, _flat(augmented)).rref()
    rows = reduced.tolist()
    if any(row[i] == 0 for i, row in enumerate(rows)):
        raise ZeroDivisionError("the matrix is singular")
    return [[int(entry) for entry in row[size:]] for row in rows], int(denominator)


def determinant(matrix: IntegerMatrix) -> int:
    """Return the determinant of a square integer matrix, shape (k, k)."""
    size = len(matrix)
    return int(fmpz_mat(size, size, _flat(matrix)).det())


def dependent_columns(matrix: IntegerMatrix) -> dict[int, dict[int, Fraction]]:
    """Find the columns that are linear combinations of columns before them.

    Parameters
    ----------
    matrix : sequence of sequences of int, shape (k, k)

    Returns
    -------
    dict of int to dict of int to Fraction
        For each dependent column, the weight of each earlier independent column, zeros left out.
    """
    size = len(matrix)
    reduced, denominator, rank = fmpz_mat(size, size, _flat(matrix)).rref()
    if rank == size:
        return {}
    rows = reduced.tolist()[:rank]
    pivots = [next(j for j, entry in enumerate(row) if entry != 0) for row in rows]
    return {
        j: {
            pivot: Fraction(int(row[j]), int(denominator))
            for pivot, row in zip(pivots, rows, strict=True)
            if row[j] != 0
        }
        for j in range(size)
        if j not in pivots
    }


def _flat(rows: Sequence[Sequence[Entry]]) -> list[Entry]:
    """Return the entries of a matrix row by row."""
    return [entry for row in rows for entry in row]


def sqrt(value: Fraction) -> float:
    """Return the square root of a non-negative rational number, correctly rounded.

    Parameters
    ----------
    value : Fraction

    Returns
    -------
    float

    Raises
    ------
    ValueError
        If `value` is negative.
    """
    if value < 0:
        raise ValueError(f"square root of {value}")
    numerator, denominator = value.as_integer_ratio()
    # The root of value * 4**bits has more bits than a float. A bit more marks it as inexact.
    bits = max(0, 64 - (numerator.bit_length() - denominator.bit_length()) // 2)
    scaled = Fraction(numerator << 2 * bits, denominator)
    root = math.isqrt(int(scaled))
    return float(Fraction(2 * root + (root * root != scaled), 2 << bits))


_EIGENVALUE_PRECISION = 256
"""Bits. Each factor of two in the condition number takes one of them."""


def condition_number(moments: IntegerMatrix) -> float:
    """Return the 2-norm condition number of a correlation matrix, correctly rounded.

    The largest eigenvalues of the matrix and of its inverse are Rayleigh quotients of LAPACK's
    eigenvectors. Their errors are the squares of the vectors' errors (Parlett 1998, section 4.6),
    so that the last bit of the result does not depend on LAPACK.

    Parameters
    ----------
    moments : sequence of sequences of int, shape (k, k)
        Sums of products about the means, times any common factor.

    Returns
    -------
    float
        Infinity if the matrix is singular.
    """
    with ctx.workprec(_EIGENVALUE_PRECISION):
        lengths = [arb(row[i]).sqrt() for i, row in enumerate(moments)]
        if any(length == 0 for length in lengths):
            return math.inf
        matrix = arb_mat(
            [
                [entry / (length * other) for entry, other in zip(row, lengths, strict=True)]
                for row, length in zip(moments, lengths, strict=True)
            ]
        )
        try:
            inverse = matrix.inv()
        except ZeroDivisionError:
            return math.inf
        return float(_largest_eigenvalue(matrix) * _largest_eigenvalue(inverse))


def _largest_eigenvalue(matrix: arb_mat) -> arb:
    """Return the largest eigenvalue of a symmetric matrix."""
    rounded = np.array([[float(entry) for entry in row] for row in matrix.tolist()])
    column = arb_mat([[entry] for entry in np.linalg.eigh(rounded).eigenvectors[:, -1].tolist()])
    row = column.transpose()
    return (row * matrix * column)[0, 0] / (row * column)[0, 0]
