"""Relations that hold on average, from sums of products: exactly, and how single drives move them.

A relation says y = theta_1 x_1 + theta_2 x_2 + ... + noise. Multiplied by instruments z and summed
up, it is as many linear equations. Products z x of three columns are often those of two others, as
(ay/v)(r v) = ay r, so that Gram rows have them although they have no x.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import lcm
from typing import Any

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.regression.exact.elimination import eliminate
from fleet_slip.regression.exact.gram import Gram

ONE = "1"
"""The constant among the terms."""

Terms = Mapping[str, Mapping[str, Fraction]]
"""Linear combinations of columns by name: the weight of each column."""
Product = tuple[str, str]


@dataclass(frozen=True)
class Relation:
    """What is summed up: for each instrument its products with the unknowns' terms, and with y.

    Attributes:
        instruments: names of terms, as many as unknowns.
        left: a row for each instrument, of the products with each unknown's term.
        right: the products with y.
        noise: products that noise of unit variance adds, by row and unknown; that of y is -1.
    """

    instruments: tuple[str, ...]
    left: tuple[tuple[Product, ...], ...]
    right: tuple[Product, ...]
    noise: Mapping[tuple[int, int], Product]

    def system(
        self, sums: Callable[[str, str], Any], variance: Fraction | float
    ) -> list[list[Any]]:
        """Return the rows of the equations, each with its right side last, free of noise.

        Entries are what `sums` gives: fractions, or arrays of drives.
        """
        rows = [
            [sums(a, b) for a, b in (*row, of_y)]
            for row, of_y in zip(self.left, self.right, strict=True)
        ]
        for (row, column), (a, b) in self.noise.items():
            rows[row][column] = rows[row][column] - variance * sums(a, b)
        return rows


class ExactSums:
    """Sums of products of terms over the rows of a Gram, as fractions."""

    def __init__(self, gram: Gram, terms: Terms) -> None:
        """Raises `DataError` for a column that the Gram lacks."""
        self._factors = {
            name: lcm(*(weight.denominator for weight in one.values()))
            for name, one in terms.items()
        }
        self.gram = gram.combine(
            {
                name: {column: int(weight * self._factors[name]) for column, weight in one.items()}
                for name, one in terms.items()
            }
        )

    def __call__(self, a: str, b: str) -> Fraction:
        """Return the sum of the products of two terms."""
        if a == ONE:
            a, b = b, a
        if a == ONE:
            return Fraction(self.gram.n)
        if b == ONE:
            return Fraction(self.gram.sum(a), self._factors[a])
        return Fraction(self.gram.product(a, b), self._factors[a] * self._factors[b])

    def mean(self, name: str) -> Fraction:
        """Return a term's mean."""
        return self(name, ONE) / self.gram.n

    def variance(self, name: str) -> Fraction:
        """Return a term's variance."""
        return self(name, name) / self.gram.n - self.mean(name) ** 2

    def residual_variance(self, name: str, inputs: Sequence[str]) -> Fraction | None:
        """Return what least squares on other terms leave of a variance; None if undetermined."""
        about = self.gram.restrict((*inputs, name)).centred()
        found = eliminate(about)
        if found.singular is not None:
            return None
        return found.residual(len(inputs)) / (self.gram.n * self._factors[name]) ** 2


def solve(rows: Sequence[Sequence[Fraction]]) -> tuple[Fraction, ...] | None:
    """Return the solution of equations whose rows end with the right side; None if singular."""
    work = [list(row) for row in rows]
    for at in range(len(work)):
        pivot = next((i for i in range(at, len(work)) if work[i][at]), None)
        if pivot is None:
            return None
        work[at], work[pivot] = work[pivot], work[at]
        lead = work[at][at]
        work[at] = [value / lead for value in work[at]]
        for i, row in enumerate(work):
            if i != at and row[at]:
                work[i] = [x - row[at] * y for x, y in zip(row, work[at], strict=True)]
    return tuple(row[-1] for row in work)


@dataclass(frozen=True)
class Influence:
    """By drive, how far it moves a combination of unknowns, and its share of the variance."""

    shifts: FloatArray
    shares: FloatArray


def influence(
    relation: Relation,
    sums: Callable[[str, str], FloatArray],
    noise: float,
    gradient: Sequence[float],
) -> Influence | None:
    """Return the influence of drives on a combination of the unknowns; None if singular.

    `sums` gives the sums of each drive, shape (drives,). With the equations A_g of a drive, A of
    all, and h = A'^-1 a, a drive moves a'theta by h'(y_g - A_g theta); its share is h'Z_g'Z_g h.
    """
    each = _stacked(relation.system(sums, noise))
    left, right = each[:, :, :-1], each[:, :, -1]
    total = left.sum(axis=0)
    try:
        unknowns = np.linalg.solve(total, right.sum(axis=0))
        h = np.linalg.solve(total.T, np.asarray(gradient))
    except np.linalg.LinAlgError:
        return None
    squares = _stacked([[sums(a, b) for b in relation.instruments] for a in relation.instruments])
    return Influence(
        shifts=(right - left @ unknowns) @ h,
        shares=np.einsum("i,gij,j->g", h, squares, h),
    )


class DriveTermSums:
    """Sums of products of terms in each of several drives, in floating point."""

    def __init__(self, moments: FloatArray, columns: Sequence[str], terms: Terms) -> None:
        """Take the moments of (1, columns) about zero, shape (drives, k+1, k+1)."""
        self._at = {name: i for i, name in enumerate((ONE, *terms))}
        turn = np.zeros((len(self._at), moments.shape[1]))
        turn[0, 0] = 1.0
        for name, one in terms.items():
            for column, weight in one.items():
                turn[self._at[name], 1 + columns.index(column)] = float(weight)
        self._sums = turn @ moments @ turn.T

    def __call__(self, a: str, b: str) -> FloatArray:
        """Return the sum of the products of two terms in each drive."""
        found: FloatArray = self._sums[:, self._at[a], self._at[b]]
        return found


def _stacked(rows: Sequence[Sequence[Any]]) -> FloatArray:
    """Return entries of each drive as one array, shape (drives, rows, columns)."""
    return np.moveaxis(np.array(rows, dtype=np.float64), -1, 0)
