"""Rankings: the predefined order of the signals of nested models (section II.B of the paper).

All compare exactly; ties are resolved by the declared order.
"""

from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fleet_slip.errors import DataError, QuestionError
from fleet_slip.regression import exact
from fleet_slip.regression.gram import Gram
from fleet_slip.regression.least_squares import dependence, moments

Matrix = list[list[int]]
Ranking = Callable[[Gram, Sequence[str], str], tuple[str, ...]]
"""Orders inputs, given a Gram with them and the label. Raises `DataError` if dependent."""


def declared(gram: Gram, inputs: Sequence[str], label: str) -> tuple[str, ...]:  # noqa: ARG001
    """Keep the declared order, as the paper does."""
    return tuple(inputs)


def correlation(gram: Gram, inputs: Sequence[str], label: str) -> tuple[str, ...]:
    """Order by the absolute correlation with the label, largest first."""
    matrix = _moments(gram, inputs, label)
    scores = [Fraction(matrix[i][-1] ** 2, matrix[i][i]) for i in range(len(inputs))]
    return _descending(inputs, scores)


def t_value(gram: Gram, inputs: Sequence[str], label: str) -> tuple[str, ...]:
    """Order by |t| in the full model, largest first: b_i^2 / (S^-1)_ii."""
    matrix = _moments(gram, inputs, label)
    inverse, denominator = exact.invert([row[:-1] for row in matrix[:-1]])
    slopes = [sum(a * b for a, b in zip(row, matrix[-1], strict=False)) for row in inverse]
    scores = [Fraction(b**2, inverse[i][i] * denominator) for i, b in enumerate(slopes)]
    return _descending(inputs, scores)


def forward(gram: Gram, inputs: Sequence[str], label: str) -> tuple[str, ...]:
    """Add, at each step, the signal that reduces the residual sum of squares most."""
    return _stepwise(gram, inputs, label, "forward")


def backward(gram: Gram, inputs: Sequence[str], label: str) -> tuple[str, ...]:
    """Remove, at each step, the signal whose loss costs least, as Wang and WEKA do."""
    return _stepwise(gram, inputs, label, "backward")


RANKINGS: dict[str, Ranking] = {
    "declared": declared,
    "correlation": correlation,
    "t": t_value,
    "forward": forward,
    "backward": backward,
}


def rank(name: str, gram: Gram, inputs: Sequence[str], label: str) -> tuple[str, ...]:
    """Order the inputs by a ranking.

    Parameters
    ----------
    name : str
        One of `RANKINGS`.
    gram : Gram
    inputs : sequence of str
    label : str

    Returns
    -------
    tuple of str
        The inputs, the first signal of nested models first.

    Raises
    ------
    QuestionError
        For an unknown ranking.
    DataError
        If inputs are linearly dependent.
    """
    if name not in RANKINGS:
        raise QuestionError(f"unknown ranking {name!r}. Known rankings: {', '.join(RANKINGS)}.")
    return RANKINGS[name](gram, inputs, label)


def _moments(gram: Gram, inputs: Sequence[str], label: str) -> Matrix:
    relations = dependence(gram, inputs)
    if relations:
        raise DataError(relations)
    return moments(gram.restrict([*inputs, label]))


def _stepwise(gram: Gram, inputs: Sequence[str], label: str, method: str) -> tuple[str, ...]:
    """Return the order of a search, followed by nearly dependent inputs in declared order."""
    _moments(gram, inputs, label)
    sets = stepwise_order(gram, inputs, label, method, len(inputs))
    order = sets[-1] if sets else ()
    return (*order, *(name for name in inputs if name not in order))


def _descending(inputs: Sequence[str], scores: Sequence[Fraction]) -> tuple[str, ...]:
    order = sorted(range(len(inputs)), key=lambda i: (-scores[i], i))
    return tuple(inputs[i] for i in order)


# Choosing among many inputs: forward, backward, or exchange.
#
# Steps are computed in extended precision (`numpy.longdouble`). Where the two best sums of squares
# differ by less than the rounding error, exact determinants decide, so the order is that of exact
# arithmetic. A column is dependent, and left out, if others explain all but 10^-9 of its variance.

LongArray = NDArray[np.longdouble]

DEPENDENT = 1e-9
"""Minimum share of a column's variance that the others leave unexplained."""

ROUNDING = 1e-6
"""Relative difference of two gains below which they are compared exactly: far above the rounding
error of 64-bit fractions without dependent columns."""

METHODS: Final = ("forward", "backward", "exchange")


def stepwise_order(
    gram: Gram, inputs: Sequence[str], label: str, method: str, max_size: int
) -> tuple[tuple[str, ...], ...]:
    """Search for good subsets of each size.

    Parameters
    ----------
    gram : Gram
    inputs : sequence of str
    label : str
    method : {"forward", "backward", "exchange"}
    max_size : int
        Maximum number of inputs.

    Returns
    -------
    tuple of tuple of str
        The chosen inputs of sizes 1, 2, ... They are nested, except for "exchange".

    Raises
    ------
    QuestionError
        For an unknown method.
    DataError
        If there are no rows.
    """
    if method not in METHODS:
        raise QuestionError(f"unknown search {method!r}. Known: {', '.join(METHODS)}.")
    search = _Search(gram.restrict([*inputs, label]))
    max_size = min(max_size, len(search.usable))
    steps: dict[str, Callable[[int], list[list[int]]]] = {
        "forward": search.forward,
        "backward": search.backward,
        "exchange": partial(search.forward, exchanging=True),
    }
    return tuple(tuple(inputs[i] for i in chosen) for chosen in steps[method](max_size))


def sweep(matrix: LongArray, pivot: int) -> LongArray:
    """Sweep a matrix on a pivot. A second sweep restores it.

    Parameters
    ----------
    matrix : longdouble array, shape (k, k)
    pivot : int

    Returns
    -------
    longdouble array, shape (k, k)

    References
    ----------
    Goodnight, The American Statistician 33, 1979.
    """
    row = matrix[pivot] / matrix[pivot, pivot]
    swept: LongArray = np.multiply.outer(matrix[:, pivot], row)
    np.subtract(matrix, swept, out=swept)
    swept[pivot] = row
    swept[:, pivot] = matrix[:, pivot] / matrix[pivot, pivot]
    swept[pivot, :] = row
    swept[pivot, pivot] = -1 / matrix[pivot, pivot]
    return swept


class _Search:
    """The correlation matrix of inputs and label, with exact sums of squares for ties."""

    def __init__(self, gram: Gram) -> None:
        self.exact = moments(gram)
        size = len(self.exact)
        # Each integer as the sum of two floats: 64 bits or more.
        half = [x for i, row in enumerate(self.exact) for x in row[: i + 1]]
        high = np.array([float(x) for x in half])
        low = np.array(
            [
                float(x - int(approximate))
                for x, approximate in zip(half, high.tolist(), strict=True)
            ]
        )
        matrix = np.empty((size, size), dtype=np.longdouble)
        matrix[np.tril_indices(size)] = high.astype(np.longdouble) + low.astype(np.longdouble)
        matrix.T[np.tril_indices(size)] = matrix[np.tril_indices(size)]
        length = np.sqrt(np.diag(matrix))
        length[length == 0] = 1
        self.matrix: LongArray = matrix / np.outer(length, length)
        self.inputs = size - 1
        self.usable = self._independent()

    def _independent(self) -> list[int]:
        """Return independent inputs, found by pivoting on the largest remaining variance."""
        if self._far_from_dependent():
            return list(range(self.inputs))
        work, names = self.matrix[:-1, :-1].copy(), np.arange(self.inputs)
        buffer, independent = np.empty_like(work), list[int]()
        is_remaining = np.ones(self.inputs, dtype=np.bool_)
        while is_remaining.any():
            best = int(np.argmax(np.where(is_remaining, work.diagonal(), -1)))
            if work[best, best] < DEPENDENT:
                break
            np.multiply.outer(work[:, best], work[best] / work[best, best], out=buffer)
            work -= buffer
            independent.append(int(names[best]))
            is_remaining[best] = False
            if 8 * is_remaining.sum() < 7 * len(is_remaining):  # drop the inputs that were taken
                work, names = work[np.ix_(is_remaining, is_remaining)], names[is_remaining]
                buffer, is_remaining = np.empty_like(work), np.ones(len(work), dtype=np.bool_)
        return sorted(independent)

    def _far_from_dependent(self) -> bool:
        """Return True if no combination of inputs has twice as little variance as `DEPENDENT`.

        The unexplained share of an input is at least the smallest eigenvalue of the matrix.
        """
        correlation = self.matrix[:-1, :-1].astype(np.float64)
        try:
            np.linalg.cholesky(correlation - 2 * DEPENDENT * np.eye(self.inputs))
        except np.linalg.LinAlgError:
            return False
        return True

    def forward(self, max_size: int, *, exchanging: bool = False) -> list[list[int]]:
        work, chosen = self.matrix.copy(), list[int]()
        sets = []
        for _ in range(max_size):
            best = self._best_entry(work.diagonal(), work[:, -1], chosen)
            if best is None:
                break
            work = sweep(work, best)
            chosen.append(best)
            if exchanging:
                work = self._exchanged(work, chosen)
            sets.append(list(chosen))
        return sets

    def backward(self, max_size: int) -> list[list[int]]:
        work, chosen = self.matrix.copy(), list(self.usable)
        for i in chosen:
            work = sweep(work, i)
        removed: list[int] = []
        while chosen:
            worst = self._least_loss(work, chosen)
            work = sweep(work, worst)
            chosen.remove(worst)
            removed.append(worst)
        order = removed[::-1]
        return [order[:size] for size in range(1, max_size + 1)]

    def _best_entry(
        self, variance: LongArray, with_label: LongArray, chosen: Sequence[int]
    ) -> int | None:
        """Return the input that explains most of what the chosen ones leave unexplained."""
        eligible = np.zeros(len(variance), dtype=np.bool_)
        eligible[self.usable] = True
        eligible[chosen] = False
        free = np.flatnonzero(eligible & (variance >= DEPENDENT))
        if not len(free):
            return None
        gains = with_label[free] ** 2 / variance[free]
        tied: list[int] = free[gains >= gains.max() * (1 - ROUNDING)].tolist()
        if len(tied) == 1:
            return tied[0]
        return min(tied, key=lambda i: (self._rss([*chosen, i]), i))

    def _least_loss(self, work: LongArray, chosen: Sequence[int]) -> int:
        """Return the chosen input whose loss costs least; of equals, the later declared."""
        losses = work[chosen, -1] ** 2 / -work.diagonal()[chosen]
        cheap = np.flatnonzero(losses <= losses.min() * (1 + ROUNDING))
        tied = [chosen[int(place)] for place in cheap]
        if len(tied) == 1:
            return tied[0]
        return min(tied, key=lambda i: (self._rss([j for j in chosen if j != i]), -i))

    def _exchanged(self, work: LongArray, chosen: list[int]) -> LongArray:
        """Exchange chosen inputs, in place, while that lowers the residual sum of squares."""
        improved = True
        while improved:
            improved = False
            for position, old in enumerate(chosen):
                # Before an exchange, only these entries of the swept matrix are needed.
                row = work[old] / work[old, old]
                variance = work.diagonal() - work[:, old] * row
                with_label = work[:, -1] - work[:, old] * row[-1]
                variance[old], with_label[old] = -1 / work[old, old], row[-1]
                other_inputs = [*chosen[:position], *chosen[position + 1 :]]
                new = self._best_entry(variance, with_label, other_inputs)
                if new is None or new == old:
                    continue
                gain = with_label[new] ** 2 / variance[new]
                if variance[-1] - gain < work[-1, -1] * (1 - ROUNDING):
                    work = sweep(sweep(work, old), new)
                    chosen[position], improved = new, True
        return work

    def _rss(self, chosen: Sequence[int]) -> Fraction:
        bordered, inner = (
            exact.determinant([[self.exact[i][j] for j in columns] for i in columns])
            for columns in ([*chosen, self.inputs], chosen)
        )
        return Fraction(bordered, inner)
