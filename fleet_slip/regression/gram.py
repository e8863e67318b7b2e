"""Gram matrices of integer counts: the exact sufficient statistics of every linear model.

Sums and products are integers, so Grams add and subtract without rounding: training on all minus a
fold is, bit for bit, training on the rest.
"""

import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import BoolArray, FloatArray, IntArray
from fleet_slip.errors import DataError

SomeSize = TypeVar("SomeSize", int, IntArray)


def packed_size(k: SomeSize) -> SomeSize:
    """Return k(k+1)/2, the number of entries of a packed lower triangle."""
    return k * (k + 1) // 2


def packed_position(i: int, j: int) -> int:
    """Return the position of the product of signals i and j: (0,0), (1,0), (1,1), (2,0), ..."""
    return packed_size(max(i, j)) + min(i, j)


@dataclass(frozen=True)
class Gram:
    """Sums and products of rows of integer counts: the sufficient statistics of linear models.

    Attributes
    ----------
    signals : tuple of str
        The k signals.
    n : int
        Number of rows.
    sums : tuple of int, shape (k,)
    products : tuple of int, shape (k(k+1)/2,)
        Sums of products, the lower triangle by rows.
    has_mean : bool
        False for moments about the origin: models have no intercept.
    """

    signals: tuple[str, ...]
    n: int
    sums: tuple[int, ...]
    products: tuple[int, ...]
    has_mean: bool = True

    def __post_init__(self) -> None:
        k = len(self.signals)
        if len(set(self.signals)) != k:
            raise ValueError(f"a signal is repeated in {self.signals}")
        if len(self.sums) != k or len(self.products) != packed_size(k):
            raise ValueError(f"{k} signals need {k} sums and {packed_size(k)} products")

    @classmethod
    def zero(cls, signals: Sequence[str]) -> "Gram":
        """Return the Gram of no rows."""
        k = len(signals)
        return cls(tuple(signals), 0, (0,) * k, (0,) * packed_size(k))

    @classmethod
    def from_counts(cls, signals: Sequence[str], counts: NDArray[Any]) -> "Gram":
        """Sum up rows of integer counts, exactly.

        Parameters
        ----------
        signals : sequence of str
            The k signals.
        counts : integer array, shape (n, k)
            Counts of any size.

        Returns
        -------
        Gram

        Raises
        ------
        ValueError
            For numbers that are not integers.
        """
        if counts.dtype.kind not in "iuO":
            raise ValueError(f"counts must be integers, not {counts.dtype}")
        largest = max(-int(counts.min()), int(counts.max())) if counts.size else 0
        fits = len(counts) * largest**2 < 2**63
        exact: NDArray[Any] = counts.astype(np.int64 if fits else object)
        products = (exact.T @ exact)[np.tril_indices(len(signals))]
        sums = exact.sum(axis=0)
        return cls(tuple(signals), len(exact), tuple(map(int, sums)), tuple(map(int, products)))

    def __add__(self, other: "Gram") -> "Gram":
        """Return the Gram of both sets of rows. Raises `DataError` if the signals differ."""
        self._require_same_signals(other)
        return Gram(
            self.signals,
            self.n + other.n,
            tuple(map(operator.add, self.sums, other.sums)),
            tuple(map(operator.add, self.products, other.products)),
        )

    def __sub__(self, other: "Gram") -> "Gram":
        """Return the Gram of the rows without those of `other`.

        Raises
        ------
        DataError
            If the signals differ, or `other` is not part of this Gram.
        """
        self._require_same_signals(other)
        difference = Gram(
            self.signals,
            self.n - other.n,
            tuple(map(operator.sub, self.sums, other.sums)),
            tuple(map(operator.sub, self.products, other.products)),
        )
        squares = [difference.products[packed_position(i, i)] for i in range(len(self.signals))]
        if difference.n < 0 or min(squares, default=0) < 0:
            raise DataError(
                "cannot subtract a Gram that is not part of the total: a sum of squares would be "
                "negative. Rebuild the Gram rows from the logs."
            )
        return difference

    def scaled(self, count: int) -> "Gram":
        """Return the Gram in which each row counts `count` times."""
        return Gram(
            self.signals,
            self.n * count,
            tuple(total * count for total in self.sums),
            tuple(total * count for total in self.products),
        )

    def restrict(self, signals: Sequence[str]) -> "Gram":
        """Return the Gram of some signals, in this order. Raises `DataError` if one is missing."""
        index = positions(self.signals, signals)
        return Gram(
            tuple(signals),
            self.n,
            tuple(self.sums[i] for i in index),
            tuple(self.products[p] for p in packed_positions(tuple(index))),
            self.has_mean,
        )

    def about_origin(self) -> "Gram":
        """Return the Gram with all sums zero, that of rows and their mirror image: no intercept."""
        return Gram(self.signals, self.n, (0,) * len(self.sums), self.products, has_mean=False)

    def centered(self) -> "Gram":
        """Return n times the Gram of the rows minus their mean, with n = 0: no effect on means."""
        return Gram(
            self.signals,
            0,
            (0,) * len(self.sums),
            tuple(
                product
                for i, row in enumerate(self.centered_products())
                for product in row[: i + 1]
            ),
        )

    def combine(self, combinations: Mapping[str, Mapping[str, int]]) -> "Gram":
        """Return the Gram of integer combinations of signals.

        Parameters
        ----------
        combinations : mapping of str to mapping of str to int
            Weights of signals by the name of the combination, such as
            ``{"difference": {"a": 1, "b": -1}}``.

        Returns
        -------
        Gram

        Raises
        ------
        DataError
            For a signal that the Gram lacks.
        """
        weights = [
            dict(zip(positions(self.signals, [*old]), old.values(), strict=True))
            for old in combinations.values()
        ]
        products = tuple(
            sum(
                u * v * self.products[packed_position(a, b)]
                for a, u in weights[i].items()
                for b, v in weights[j].items()
            )
            for i in range(len(weights))
            for j in range(i + 1)
        )
        sums = tuple(sum(u * self.sums[a] for a, u in new.items()) for new in weights)
        return Gram(tuple(combinations), self.n, sums, products)

    def sum(self, signal: str) -> int:
        """Return the sum of a signal's counts."""
        return self.sums[positions(self.signals, [signal])[0]]

    def product(self, a: str, b: str) -> int:
        """Return the sum of the products of two signals' counts."""
        i, j = positions(self.signals, [a, b])
        return self.products[packed_position(i, j)]

    def raw(self) -> list[list[int]]:
        """Return the k x k matrix of product sums about zero, as integers."""
        return _mirrored([self._packed_row(i) for i in range(len(self.signals))])

    def centered_products(self) -> list[list[int]]:
        """Return n S_ab = n sum(a b) - sum(a) sum(b), with S the product sums about the means."""
        return _mirrored(
            [
                [
                    self.n * product - row_sum * column_sum
                    for product, column_sum in zip(self._packed_row(i), self.sums, strict=False)
                ]
                for i, row_sum in enumerate(self.sums)
            ]
        )

    def _packed_row(self, i: int) -> Sequence[int]:
        """Return the products of a signal with those up to itself."""
        return self.products[packed_size(i) : packed_size(i + 1)]

    def _require_same_signals(self, other: "Gram") -> None:
        if self.signals != other.signals:
            raise DataError(
                f"Grams of different signals cannot be combined: {', '.join(self.signals)} and "
                f"{', '.join(other.signals)}. Restrict both to the signals that they share."
            )


def _mirrored(lower: Sequence[Sequence[int]]) -> list[list[int]]:
    return [[*row, *(below[i] for below in lower[i + 1 :])] for i, row in enumerate(lower)]


NAMES_SHOWN = 4


def require_signals(signals: Sequence[str], required: Sequence[str]) -> None:
    """Raise `DataError` for a required signal that is absent."""
    missing = [name for name in required if name not in signals]
    if missing:
        more = len(missing) - NAMES_SHOWN
        *shown, last = missing if more <= 1 else [*missing[:NAMES_SHOWN], f"{more} more"]
        raise DataError(f"these drives lack {', '.join(shown)}{' and ' if shown else ''}{last}.")


def positions(signals: Sequence[str], required: Sequence[str]) -> list[int]:
    """Return the index of each required signal. Raises `DataError` for an absent one."""
    require_signals(signals, required)
    return [signals.index(name) for name in required]


@cache
def packed_positions(index: tuple[int, ...]) -> tuple[int, ...]:
    """Return the positions of the products of some signals, in the order of a packed triangle."""
    places = np.array(index, dtype=np.int64)
    row, column = np.tril_indices(len(index))
    larger = np.maximum(places[row], places[column])
    packed = packed_size(larger) + np.minimum(places[row], places[column])
    return tuple(packed.tolist())


# Gram matrices of many drives side by side, and their exact sums.

_MODULUS = 2**64


@dataclass(frozen=True)
class GramTable:
    """Grams of the same k signals, one per drive.

    Sums and products that exceed int64 are Python integers in arrays of objects.

    Attributes
    ----------
    signals : tuple of str
        The k signals.
    n : integer array, shape (drives,)
    sums : integer array, shape (drives, k)
    products : integer array, shape (drives, k(k+1)/2)
    """

    signals: tuple[str, ...]
    n: IntArray
    sums: IntArray
    products: IntArray

    def __post_init__(self) -> None:
        drives, k = len(self.n), len(self.signals)
        if self.sums.shape != (drives, k) or self.products.shape != (drives, packed_size(k)):
            raise ValueError(f"sums or products are not those of {drives} drives of {k} signals")
        kinds = {self.n.dtype, self.sums.dtype, self.products.dtype}
        if not kinds <= {np.dtype(np.int64), np.dtype(object)}:
            raise ValueError("a GramTable holds int64, or integers of Python")

    def __len__(self) -> int:
        return len(self.n)

    def row(self, index: int) -> Gram:
        """Return one drive's Gram."""
        sums, products = self.sums[index].tolist(), self.products[index].tolist()
        return Gram(self.signals, int(self.n[index]), tuple(sums), tuple(products))

    def take(self, rows: NDArray[Any] | slice) -> "GramTable":
        """Return the drives at a slice, an index array or a boolean mask."""
        return GramTable(self.signals, self.n[rows], self.sums[rows], self.products[rows])

    def total(self) -> Gram:
        """Return the exact sum over all drives."""
        return Gram(
            self.signals,
            exact_sum(self.n[:, None])[0],
            tuple(exact_sum(self.sums)),
            tuple(exact_sum(self.products)),
        )

    def totals(self, groups: NDArray[Any], count: int) -> list[Gram]:
        """Return the exact sum of each group of drives.

        Parameters
        ----------
        groups : integer array, shape (drives,)
            Group of each drive, in 0..count-1.
        count : int
            Number of groups.

        Returns
        -------
        list of Gram, length count
        """
        order = np.argsort(groups, kind="stable")
        stops = np.cumsum(np.bincount(groups, minlength=count))
        return [self.take(rows).total() for rows in np.split(order, stops[:-1])]

    def merged(self, numbers: IntArray) -> "GramTable":
        """Return a Gram for each number 0, 1, ..., the sum of the rows that have it."""
        order = np.argsort(numbers, kind="stable")
        first = np.searchsorted(numbers[order], np.arange(numbers.max() + 1))
        parts = (self.n, self.sums, self.products)
        return GramTable(self.signals, *(np.add.reduceat(part[order], first) for part in parts))

    def moments(self) -> FloatArray:
        """Return the sums of products of (1, signals) of each drive.

        Returns
        -------
        float array, shape (drives, k + 1, k + 1)
        """
        k = len(self.signals)
        moments = np.empty((len(self), k + 1, k + 1))
        moments[:, 0, 0] = self.n
        moments[:, 0, 1:] = moments[:, 1:, 0] = self.sums
        i, j = np.tril_indices(k)
        moments[:, i + 1, j + 1] = moments[:, j + 1, i + 1] = self.products
        return moments

    def restrict(self, signals: Sequence[str]) -> "GramTable":
        """Return the drives with some of the signals. Raises `DataError` if one is missing."""
        index = positions(self.signals, signals)
        packed = list(packed_positions(tuple(index)))
        return GramTable(tuple(signals), self.n, self.sums[:, index], self.products[:, packed])

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


def exact_sum(values: IntArray) -> list[int]:
    """Return the exact sums of the columns of an int64 array.

    The int64 sum is right modulo 2^64; the float64 sum gives the number of wrap-arounds.

    Parameters
    ----------
    values : integer array, shape (rows, columns)
        Fewer than 2^26 rows.

    Returns
    -------
    list of int, length columns
    """
    wrapped = values.sum(axis=0)
    totals: list[int] = [int(total) for total in wrapped.tolist()]
    if values.dtype != object:
        approximate = values.sum(axis=0, dtype=np.float64)
        turns = np.rint((approximate - wrapped.astype(np.float64)) / _MODULUS)
        for index in np.flatnonzero(turns).tolist():
            totals[index] += int(turns[index]) * _MODULUS
    return totals


def missing_signals_error(signals: Sequence[str]) -> DataError:
    """Return the error for a cohort without a drive that has all signals."""
    return DataError(
        f"no drive of the cohort has all of {', '.join(signals)}. Use fewer signals, or another "
        "cohort."
    )


def complete_cases(
    tables: Sequence[GramTable], signals: Sequence[str]
) -> tuple[GramTable, BoolArray]:
    """Return the drives that have all signals.

    Parameters
    ----------
    tables : sequence of GramTable
        Drives by set of signals.
    signals : sequence of str

    Returns
    -------
    tuple of (GramTable, bool array)
        The drives, and their mask among all drives of `tables`.

    Raises
    ------
    DataError
        If there are none.
    """
    is_complete = [set(signals) <= set(table.signals) for table in tables]
    if not any(is_complete):
        raise missing_signals_error(signals)
    parts = [
        table.restrict(signals)
        for table, complete in zip(tables, is_complete, strict=True)
        if complete
    ]
    mask = np.repeat(is_complete, [len(table) for table in tables])
    if len(parts) == 1:
        return parts[0], mask
    stacked = GramTable(
        tuple(signals),
        np.concatenate([part.n for part in parts]),
        np.concatenate([part.sums for part in parts]),
        np.concatenate([part.products for part in parts]),
    )
    return stacked, mask
