"""Exact solution of large integer systems by p-adic lifting (Dixon 1982, Numer. Math. 40:137).

It inverts once, modulo a prime, and finds the solution digit by digit with k^2 small products,
where elimination multiplies huge numbers k^3 times. Solutions are proven: they hold modulo a power
of the prime that is greater than what the two sides of any equation could differ by.
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

_BY_CHANCE = 32
"""Bits by which a fraction that is right is shorter than its residue."""

_MORE_THAN_HALF = 16

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
        self.largest = max(abs(entry) for row in matrix for entry in row)
        self.limbs = _limbs(matrix, self.largest)
        self.rest = np.array(right, dtype=object)
        self.digits: list[Integers] = []

    def solution(self) -> tuple[list[int], int]:
        """Lift until the fractions that the digits stand for solve the equations."""
        wanted = FIRST_DIGITS
        while True:
            self._lift(wanted)
            modulus = self.prime ** len(self.digits)
            (residue,) = _joined([digit[:1] for digit in self.digits], self.prime)
            top, bottom = _fraction(residue, modulus, math.isqrt(modulus) >> 1)
            # Else it is what chance gives, and to join the digits of all would be in vain.
            if top.bit_length() + bottom.bit_length() + _BY_CHANCE < modulus.bit_length():
                found = self._over(bottom) or self._fractions(modulus)
                if found is not None:
                    return found
            wanted = int(wanted * GROWTH)

    def _over(self, denominator: int) -> tuple[list[int], int] | None:
        """Return the solution if all of it is over the first unknown's denominator.

        Half of the digits tell the numerators then.
        """
        some = self.digits[: len(self.digits) // 2 + _MORE_THAN_HALF]
        modulus = self.prime ** len(some)
        numerators = []
        for residue in _joined(some, self.prime):
            scaled = residue * denominator % modulus
            numerators.append(scaled if scaled * 2 <= modulus else scaled - modulus)
        return self._proven(numerators, denominator, modulus)

    def _fractions(self, modulus: int) -> tuple[list[int], int] | None:
        found = _fractions(_joined(self.digits, self.prime), modulus)
        return found and self._proven(*found, modulus)

    def _proven(
        self, numerators: list[int], denominator: int, modulus: int
    ) -> tuple[list[int], int] | None:
        """Return what solves the equations modulo a number if both sides are too small to differ.

        Their difference is a multiple of the modulus, and smaller.
        """
        left = len(numerators) * self.largest * max(map(abs, numerators))
        right = denominator * max(map(abs, self.right))
        return (numerators, denominator) if left + right < modulus else None

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
    furthest = 0
    for t in range(size):
        candidates = np.flatnonzero(work[t:, t])
        if not len(candidates):
            return None
        pivot = t + int(candidates[0])
        furthest = max(furthest, pivot)
        work[[t, pivot]] = work[[pivot, t]]
        some = work[:, t : size + furthest + 1]  # before and behind them nothing changes
        some[t] = some[t] * pow(int(some[t, 0]), -1, prime) % prime
        factors = some[:, :1].copy()
        factors[t] = 0
        some -= factors * some[t]
        some %= prime
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
