"""Exact solution of large integer systems by p-adic lifting (Dixon 1982, Numer. Math. 40:137).

It inverts once, modulo a prime, and finds the solution digit by digit with k^2 small products,
where elimination multiplies huge numbers k^3 times. Solutions are proven by the equations.
"""

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import ObjectArray

PRIMES = (2**26 - 5, 2**26 - 27, 2**26 - 45)
"""A matrix that is singular modulo all of them is taken for singular."""

LIMB_BITS = 26
"""A product of two limbs, added up over `MOST_EQUATIONS`, stays below 2^63."""

MOST_EQUATIONS = 2**10

FIRST_DIGITS = 64

GROWTH = 1.2
"""How many times more digits each attempt has than the one before."""

Integers = NDArray[np.int64]


def solve_by_lifting(
    matrix: Sequence[Sequence[int]], right: Sequence[int]
) -> tuple[list[int], int] | None:
    """Return x, d > 0 with `matrix @ x == d * right`, symmetric; None if singular or too large."""
    if not 0 < len(matrix) <= MOST_EQUATIONS:
        return None
    for prime in PRIMES:
        inverse = _inverse(matrix, prime)
        if inverse is not None:
            return _Lifting(matrix, right, prime, inverse).solution()
    return None


class _Lifting:
    def __init__(
        self, matrix: Sequence[Sequence[int]], right: Sequence[int], prime: int, inverse: Integers
    ) -> None:
        self.matrix, self.right = matrix, right
        self.prime, self.inverse = prime, inverse
        self.limbs = _limbs(matrix)
        self.rest = np.array(right, dtype=object)
        self.digits: list[Integers] = []

    def solution(self) -> tuple[list[int], int]:
        """Lift until the fractions that the digits stand for solve the equations."""
        wanted = FIRST_DIGITS
        while True:
            self._lift(wanted)
            modulus = self.prime ** len(self.digits)
            found = _fractions(_joined(self.digits, self.prime), modulus)
            if found is not None:
                numerators, denominator = found
                if all(
                    sum(a * x for a, x in zip(row, numerators, strict=True)) == denominator * b
                    for row, b in zip(self.matrix, self.right, strict=True)
                ):
                    return found
            wanted = int(wanted * GROWTH)

    def _lift(self, wanted: int) -> None:
        size = len(self.matrix)
        while len(self.digits) < wanted:
            low = (self.rest % self.prime).astype(np.int64)
            digit = self.inverse @ low % self.prime
            product = (self.limbs @ digit).reshape(-1, size).astype(object)
            total = product[-1]
            for limb in product[-2::-1]:
                total = (total << LIMB_BITS) + limb
            self.rest = (self.rest - total) // self.prime
            self.digits.append(digit)


def _inverse(matrix: Sequence[Sequence[int]], prime: int) -> Integers | None:
    size = len(matrix)
    left = [[entry % prime for entry in row] for row in matrix]
    work = np.hstack([np.array(left, dtype=np.int64), np.eye(size, dtype=np.int64)])
    for t in range(size):
        candidates = np.flatnonzero(work[t:, t])
        if not len(candidates):
            return None
        pivot = t + int(candidates[0])
        work[[t, pivot]] = work[[pivot, t]]
        work[t] = work[t] * pow(int(work[t, t]), -1, prime) % prime
        factors = work[:, t].copy()
        factors[t] = 0
        work = (work - factors[:, None] * work[t]) % prime
    return np.ascontiguousarray(work[:, size:])


def _limbs(matrix: Sequence[Sequence[int]]) -> Integers:
    """Return the matrix as limbs with its signs, shape (limbs * k, k), lowest first."""
    largest = max(abs(entry) for row in matrix for entry in row)
    mask = (1 << LIMB_BITS) - 1
    return np.array(
        [
            [((abs(entry) >> shift) & mask) * (1 if entry >= 0 else -1) for entry in row]
            for shift in range(0, max(1, largest.bit_length()), LIMB_BITS)
            for row in matrix
        ],
        dtype=np.int64,
    )


def _joined(digits: Sequence[Integers], prime: int) -> list[int]:
    """Return the numbers that digits of base `prime` stand for."""
    parts: list[ObjectArray] = [digit.astype(object) for digit in digits]
    base = prime
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
