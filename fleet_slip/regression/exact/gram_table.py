"""Gram matrices of many drives side by side, and their exact sums."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import IntArray
from fleet_slip.regression.exact.gram import Gram, packed_positions, packed_size, positions

_MODULUS = 2**64


@dataclass(frozen=True)
class GramTable:
    """Many Grams of the same k signals, one a drive: packed products are (drives, k(k+1)/2).

    Numbers are int64; sums and products that need more bits are integers of Python.
    """

    signals: tuple[str, ...]
    n: IntArray
    sums: IntArray
    products: IntArray

    def __post_init__(self) -> None:
        drives, k = len(self.n), len(self.signals)
        if self.sums.shape != (drives, k) or self.products.shape != (drives, packed_size(k)):
            raise ValueError(
                f"{drives} drives of {k} signals do not have sums of shape {self.sums.shape} and "
                f"products of shape {self.products.shape}"
            )
        kinds = {self.n.dtype, self.sums.dtype, self.products.dtype}
        if not kinds <= {np.dtype(np.int64), np.dtype(object)}:
            raise ValueError("a GramTable holds int64, or integers of Python")

    def __len__(self) -> int:
        return len(self.n)

    def row(self, index: int) -> Gram:
        """Return one drive's Gram."""
        sums, products = self.sums[index].tolist(), self.products[index].tolist()
        return Gram(self.signals, int(self.n[index]), tuple(sums), tuple(products))

    def take(self, rows: NDArray[Any]) -> "GramTable":
        """Return the drives at an index array or a boolean mask."""
        return GramTable(self.signals, self.n[rows], self.sums[rows], self.products[rows])

    def total(self, rows: NDArray[Any] | None = None) -> Gram:
        """Return the exact sum over all drives, or over those at an index array or a mask."""
        return self._sum() if rows is None else self.take(rows)._sum()

    def totals(self, groups: NDArray[Any], count: int) -> list[Gram]:
        """Return the exact sum over each group of drives; `groups` says each one's, 0..count-1."""
        if groups.shape != self.n.shape:
            raise ValueError(f"{len(self)} drives need as many groups, not {groups.shape}")
        if len(groups) and not 0 <= groups.min() <= groups.max() < count:
            raise ValueError(f"groups must lie in 0..{count - 1}")
        order = np.argsort(groups, kind="stable")
        stops = np.cumsum(np.bincount(groups, minlength=count))
        return [self.take(rows)._sum() for rows in np.split(order, stops[:-1])]

    def restrict(self, signals: Sequence[str]) -> "GramTable":
        """Return the drives with some of the signals. Raises `DataError` if one is missing."""
        at = positions(self.signals, signals)
        packed = list(packed_positions(tuple(at)))
        return GramTable(tuple(signals), self.n, self.sums[:, at], self.products[:, packed])

    def about(self, origin: Sequence[int]) -> "GramTable":
        """Return the table of the counts minus an integer origin, exactly.

        sum((a - u)(b - v)) = sum(ab) - u sum(b) - v sum(a) + n u v; wrap-around on the way cancels.
        """
        u = np.array(origin, dtype=np.int64)
        i, j = np.tril_indices(len(self.signals))
        n = self.n[:, None]
        products = (
            self.products - u[i] * self.sums[:, j] - u[j] * self.sums[:, i] + n * (u[i] * u[j])
        )
        return GramTable(self.signals, self.n, self.sums - n * u, products)

    def about_origin(self) -> "GramTable":
        """Return the table of `Gram.about_origin` of each drive."""
        return GramTable(self.signals, self.n, np.zeros_like(self.sums), self.products)

    def _sum(self) -> Gram:
        return Gram(
            self.signals,
            exact_sum(self.n[:, None])[0],
            tuple(exact_sum(self.sums)),
            tuple(exact_sum(self.products)),
        )


def exact_sum(values: IntArray) -> list[int]:
    """Return the sums of an int64 array's columns, shape (rows < 2^26, columns), exactly.

    The int64 sum is right modulo 2^64; the float64 sum tells how often it wrapped around.
    """
    wrapped = values.sum(axis=0)
    totals: list[int] = [int(total) for total in wrapped.tolist()]
    if values.dtype != object:
        near = values.sum(axis=0, dtype=np.float64)
        turns = np.rint((near - wrapped.astype(np.float64)) / _MODULUS)
        for at in np.flatnonzero(turns).tolist():
            totals[at] += int(turns[at]) * _MODULUS
    return totals
