"""Fraction-free elimination of integer matrices (Bareiss 1968, Math. Comp. 22:565).

Every value is a minor, so each division is exact and numbers stay as small as can be.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction


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
    """Return the inverse of a regular symmetric integer matrix, exactly."""
    entries, determinant = adjugate(matrix)
    return [[Fraction(entry, determinant) for entry in row] for row in entries]


def adjugate(matrix: Sequence[Sequence[int]]) -> tuple[list[list[int]], int]:
    """Return adjugate and determinant, whose ratio is the inverse (fraction-free Gauss-Jordan)."""
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
    return [row[size:] for row in work], previous


def is_semidefinite(lower: Sequence[Sequence[int]]) -> bool:
    """Whether a symmetric integer matrix, of rows of i + 1 values, is positive semidefinite.

    Each pivot must be positive, or zero with zeros below it; then it is left out.
    """
    work = [list(row) for row in lower]
    previous = 1
    for t, row in enumerate(work):
        pivot = row[t]
        below = [other[t] for other in work[t + 1 :]]
        if pivot < 0 or (pivot == 0 and any(below)):
            return False
        if pivot:
            for i, factor in enumerate(below):
                other = work[t + 1 + i]
                for j in range(i + 1):
                    column = t + 1 + j
                    other[column] = (other[column] * pivot - factor * below[j]) // previous
            previous = pivot
    return True
