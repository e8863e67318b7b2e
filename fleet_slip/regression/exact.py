"""Exact linear algebra of integers, and eigenvalues with the same bits on every machine.

Elimination is fraction-free (Bareiss 1968, Math. Comp. 22:565): every value is a minor, so each
division is exact. Large systems are solved by p-adic lifting (Dixon 1982, Numer. Math. 40:137): an
inverse modulo a prime gives the solution digit by digit. Solutions are proven: they hold modulo a
power of the prime that is greater than what the two sides of any equation could differ by.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray, ObjectArray


@dataclass(frozen=True)
class Elimination:
    """Fraction-free triangular form of a semidefinite integer matrix: k inputs, then the response.

    Attributes:
        rows: row t after t steps, from its diagonal to the right: k rows.
        minors: leading principal minors of order 0..k (order 0 is 1).
        corners: bordered minors of the response after 0..k steps.
        singular: the first input with a zero pivot, at which elimination stopped.
    """

    rows: tuple[tuple[int, ...], ...]
    minors: tuple[int, ...]
    corners: tuple[int, ...]
    singular: int | None

    def solve(self, size: int) -> tuple[list[int], int]:
        """Return x and d with `x / d` the solution for the first `size` inputs (Cramer's rule)."""
        determinant = self.minors[size]
        solution = [0] * size
        for i in reversed(range(size)):
            row = self.rows[i]
            right = determinant * row[-1]
            right -= sum(row[j - i] * solution[j] for j in range(i + 1, size))
            solution[i] = right // row[0]
        return solution, determinant

    def residual(self, size: int) -> Fraction:
        """Return the response's squared distance from `size` inputs, a ratio of determinants."""
        return Fraction(self.corners[size], self.minors[size])


def eliminate(matrix: Sequence[Sequence[int]]) -> Elimination:
    """Eliminate the inputs of a symmetric integer matrix in order, the response last.

    N(t+1)_ab = (N(t)_ab N(t)_tt - N(t)_at N(t)_tb) / p_t, divided without remainder.
    """
    size = len(matrix)
    work = [list(row[i:]) for i, row in enumerate(matrix)]
    rows: list[tuple[int, ...]] = []
    previous, minors, corners = 1, [1], [work[-1][0]]
    for t in range(size - 1):
        pivot_row = work[t]
        pivot = pivot_row[0]
        if pivot == 0:
            return Elimination(tuple(rows), tuple(minors), tuple(corners), t)
        for a in range(t + 1, size):
            factor = pivot_row[a - t]
            row, other = work[a], pivot_row[a - t :]
            work[a] = [
                (x * pivot - factor * y) // previous for x, y in zip(row, other, strict=True)
            ]
        rows.append(tuple(pivot_row))
        minors.append(pivot)
        corners.append(work[-1][0])
        previous = pivot
    return Elimination(tuple(rows), tuple(minors), tuple(corners), None)


def inverse_matrix(matrix: Sequence[Sequence[int]]) -> list[list[Fraction]]:
    """Return the inverse of a regular symmetric integer matrix, exactly.

    By fraction-free Gauss-Jordan: it ends with the adjugate, and the determinant.
    """
    size = len(matrix)
    work = [[*row, *(int(i == j) for j in range(size))] for i, row in enumerate(matrix)]
    previous = 1
    for t in range(size):
        pivot_row = work[t]
        pivot = pivot_row[t]
        for a in range(size):
            if a != t:
                factor = work[a][t]
                work[a] = [
                    (x * pivot - factor * y) // previous
                    for x, y in zip(work[a], pivot_row, strict=True)
                ]
        previous = pivot
    return [[Fraction(entry, previous) for entry in row[size:]] for row in work]


MAX_SWEEPS = 60
"""Convergence is quadratic: five to ten sweeps are usual."""

MANY = 128
"""From so many rows on, compiled code saves more than loading it takes."""

_UNIT_ROUNDOFF = 2.0**-53


def symmetric_eigenvalues(matrix: FloatArray) -> list[float]:
    """Return the eigenvalues of a symmetric matrix, shape (k, k), ascending.

    Cyclic Jacobi rotations (Golub and Van Loan, section 8.5) with relative stopping, by which small
    eigenvalues of positive definite matrices are accurate (Demmel and Veselic 1992).
    """
    a = np.array(matrix, dtype=np.float64)
    sweep = _compiled_sweep() if len(a) >= MANY else _sweep
    for _ in range(MAX_SWEEPS):
        if not sweep(a):
            break
    return sorted(a.diagonal().tolist())


def _sweep(a: FloatArray) -> int:
    """Make each a[p, q] zero in turn, but what is small already; return how many were not."""
    rotations = 0
    for q in range(len(a)):
        for p in range(q):
            app, aqq, apq = a[p, p], a[q, q], a[p, q]
            if abs(apq) <= _UNIT_ROUNDOFF * math.sqrt(abs(app)) * math.sqrt(abs(aqq)):
                continue
            rotations += 1
            cotangent = (aqq - app) / (2 * apq)
            root = math.sqrt(cotangent * cotangent + 1)
            tangent = math.copysign(1 / (abs(cotangent) + root), cotangent)
            cosine = 1 / math.sqrt(tangent * tangent + 1)
            sine = tangent * cosine
            row_p, row_q = a[p].copy(), a[q].copy()
            a[p] = cosine * row_p - sine * row_q
            a[q] = sine * row_p + cosine * row_q
            a[:, p], a[:, q] = a[p], a[q]
            a[p, p], a[q, q] = app - tangent * apq, aqq + tangent * apq
            a[p, q] = a[q, p] = 0.0
    return rotations


@cache
def _compiled_sweep() -> Callable[[FloatArray], int]:
    """Return the same as compiled code, of the same bits."""
    from fleet_slip.compiling import kernel  # noqa: PLC0415 - slow

    return kernel(_sweep)


PRIME = 2**26 - 5

LIMB_BITS = 26
"""A product of two limbs, added up over `MOST_EQUATIONS`, stays below 2^63."""

MOST_EQUATIONS = 2**10

FIRST_DIGITS = 64

_BY_CHANCE = 32
"""Bits by which a fraction that is right is shorter than its residue."""

GROWTH = 1.2
"""How many times more digits each attempt has than the one before."""

Integers = NDArray[np.int64]


def solve_by_lifting(
    matrix: Sequence[Sequence[int]], right: Sequence[int]
) -> tuple[list[int], int] | None:
    """Return x, d > 0 with `matrix @ x == d * right`, symmetric.

    None if the matrix is too large, or singular modulo `PRIME`, as one that is singular is.
    """
    size = len(matrix)
    if not 0 < size <= MOST_EQUATIONS or (inverse := _inverse(matrix)) is None:
        return None
    largest = max(abs(entry) for row in matrix for entry in row)
    limbs, rest = _limbs(matrix, largest), np.array(right, dtype=object)
    digits: list[Integers] = []
    wanted = FIRST_DIGITS
    while True:
        while len(digits) < wanted:
            digit = inverse @ (rest % PRIME).astype(np.int64) % PRIME
            product = (limbs @ digit).reshape(-1, size).astype(object)
            total = product[-1]
            for limb in product[-2::-1]:
                total = (total << LIMB_BITS) + limb
            rest = (rest - total) // PRIME
            digits.append(digit)
        modulus = PRIME ** len(digits)
        (residue,) = _joined([digit[:1] for digit in digits])
        top, bottom = _fraction(residue, modulus, math.isqrt(modulus) >> 1)
        # Else it is what chance gives, and to join the digits of all would be in vain.
        if top.bit_length() + bottom.bit_length() + _BY_CHANCE < modulus.bit_length():
            found = _fractions(_joined(digits), modulus)
            if found is not None:
                left = size * largest * max(map(abs, found[0]))
                # The two sides differ by a multiple of the modulus: so small, they are the same.
                if left + found[1] * max(map(abs, right)) < modulus:
                    return found
        wanted = int(wanted * GROWTH)


def _inverse(matrix: Sequence[Sequence[int]]) -> Integers | None:
    """Return the inverse modulo `PRIME`; None of what is singular there."""
    size = len(matrix)
    left = [[entry % PRIME for entry in row] for row in matrix]
    work = np.hstack([np.array(left, dtype=np.int64), np.eye(size, dtype=np.int64)])
    furthest = 0
    for t in range(size):
        candidates = np.flatnonzero(work[t:, t])
        if not len(candidates):
            return None
        pivot = t + int(candidates[0])
        furthest = max(furthest, pivot)
        work[[t, pivot]] = work[[pivot, t]]
        some = work[:, t : size + furthest + 1]  # before and behind them nothing changes
        some[t] = some[t] * pow(int(some[t, 0]), -1, PRIME) % PRIME
        factors = some[:, :1].copy()
        factors[t] = 0
        some -= factors * some[t]
        some %= PRIME
    return np.ascontiguousarray(work[:, size:])


def _limbs(matrix: Sequence[Sequence[int]], largest: int) -> Integers:
    """Return the matrix as limbs with its signs, shape (limbs * k, k), lowest first."""
    mask = (1 << LIMB_BITS) - 1
    return np.array(
        [
            [((abs(entry) >> shift) & mask) * (1 if entry >= 0 else -1) for entry in row]
            for shift in range(0, max(1, largest.bit_length()), LIMB_BITS)
            for row in matrix
        ],
        dtype=np.int64,
    )


def _joined(digits: Sequence[Integers]) -> list[int]:
    """Return the numbers that digits of base `PRIME` stand for."""
    parts: list[ObjectArray] = [digit.astype(object) for digit in digits]
    base = PRIME
    while len(parts) > 1:
        if len(parts) % 2:
            parts.append(np.zeros_like(parts[0]))
        parts = [low + high * base for low, high in list(pairwise(parts))[::2]]
        base *= base
    return [int(number) for number in parts[0]]


def _fractions(residues: Sequence[int], modulus: int) -> tuple[list[int], int] | None:
    """Return numerators over one denominator that have these residues; None if they need more."""
    half = math.isqrt(modulus) >> 1
    denominator = 1
    numerators: list[int] = []
    for residue in residues:
        scaled = residue * denominator % modulus
        near = scaled if scaled * 2 <= modulus else scaled - modulus
        if abs(near) <= half >> 64:
            numerators.append(near)
            continue
        top, bottom = _fraction(scaled, modulus, half)
        denominator *= bottom
        if denominator > half:
            return None
        numerators = [number * bottom for number in numerators]
        numerators.append(top)
    return numerators, denominator


def _fraction(residue: int, modulus: int, half: int) -> tuple[int, int]:
    """Return the fraction of small numbers with a residue: Euclid's algorithm, half way."""
    old, new = modulus, residue
    before, after = 0, 1
    while new > half:
        quotient, rest = divmod(old, new)
        old, new = new, rest
        before, after = after, before - quotient * after
    return (new, after) if after > 0 else (-new, -after)


# Square roots and logarithms of exact rationals, rounded once at the end.

_BITS = 160


def sqrt(value: Fraction) -> float:
    """Return the square root of a non-negative rational, correctly rounded to binary64."""
    if value < 0:
        raise ValueError(f"square root of {value}")
    return _root_of_ratio(value.numerator, value.denominator)


def _root_of_ratio(numerator: int, denominator: int) -> float:
    """Return the root of a ratio in any terms: the lowest take longer to find than the root."""
    if numerator == 0:
        return 0.0
    bits = numerator.bit_length() - denominator.bit_length()
    shift = max(0, _BITS - bits) // 2 * 2
    shifted = numerator << shift
    root = math.isqrt(shifted // denominator)
    # A trailing one stands for all that was cut off: rounding then sees "more than half".
    sticky = int(root * root * denominator != shifted)
    return (2 * root + sticky) / (1 << (shift // 2 + 1))


def signed_ratio(product: Fraction | int, squares: Fraction | int) -> float:
    """Return `product / sqrt(squares)`, correctly rounded: a correlation from exact sums."""
    if squares <= 0:
        return 0.0
    magnitude = _root_of_ratio(
        product.numerator**2 * squares.denominator, product.denominator**2 * squares.numerator
    )
    return -magnitude if product < 0 else magnitude
