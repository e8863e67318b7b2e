"""Searches: orders of the signals of nested models (paper, section II.B), and best subsets.

All compare exactly; ties are resolved by the declared order.
"""

from collections.abc import Sequence
from fractions import Fraction
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.regression import exact
from fleet_slip.regression.gram import Gram
from fleet_slip.regression.least_squares import Fit, correlation_matrix, dependence, fit, moments

RANKINGS = ("declared", "forward", "backward")
"""Rankings: the declared order, as in the paper; adding the signal that reduces the residual sum of
squares most; removing the one whose loss costs least, as Wang and WEKA do."""


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
    if name == "declared":
        return tuple(inputs)
    _require_independent(gram, inputs)
    sets = stepwise_order(gram, inputs, label, name, len(inputs))
    order = sets[-1] if sets else ()
    # Nearly dependent inputs follow in their declared order.
    return (*order, *(name for name in inputs if name not in order))


def _require_independent(gram: Gram, inputs: Sequence[str]) -> None:
    if relations := dependence(gram, inputs):
        raise DataError(relations)


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
    if method == "backward":
        sets = search.backward(max_size)
    else:
        sets = search.forward(max_size, exchanging=method == "exchange")
    return tuple(tuple(inputs[i] for i in chosen) for chosen in sets)


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
        matrix = np.array(self.exact, dtype=np.longdouble)
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
        independent = list[int]()
        while work[best := int(np.argmax(work.diagonal())), best] >= DEPENDENT:
            independent.append(int(names[best]))
            work -= np.multiply.outer(work[:, best], work[best] / work[best, best])
            work[best, best] = -1  # taken
            is_open = work.diagonal() > -0.5
            if is_open.any() and 8 * is_open.sum() < 7 * len(names):
                work, names = work[np.ix_(is_open, is_open)], names[is_open]
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


# All 2^k subsets: each signal doubles a list of moments into copies without it and with it (Schur
# complement), until 2^k residual sums of squares remain, by bit mask: float64 on correlations.

MAX_SUBSET_INPUTS = 22
"""Maximum number of signals for all subsets: 2^22 take about two seconds."""

_SPARE = 4
"""Subsets of a size, the best by float64, that are compared exactly."""


def best_subsets(gram: Gram, inputs: Sequence[str], label: str) -> list[Fit]:
    """Return the best model of each size, compared exactly; of equal ones the first declared.

    Parameters
    ----------
    gram : Gram
    inputs : sequence of str
        The k signals, at most `MAX_SUBSET_INPUTS`.
    label : str

    Returns
    -------
    list of Fit, length k + 1

    Raises
    ------
    DataError
        If inputs are linearly dependent, or the label is constant.
    QuestionError
        If there are too many inputs.
    """
    _require_independent(gram, inputs)
    if len(inputs) > MAX_SUBSET_INPUTS:
        raise QuestionError(
            f"all subsets of {len(inputs)} signals are too many: give at most {MAX_SUBSET_INPUTS}, "
            "or search among them with: search exchange."
        )
    part = gram.restrict([*inputs, label])
    matrix = correlation_matrix(part)
    if matrix[-1, -1] == 0:
        raise DataError(f"{label} is constant: there is nothing to explain.")
    rss, sizes = all_rss(matrix), subset_sizes(len(inputs))
    results = []
    for size in range(len(inputs) + 1):
        masks = np.flatnonzero(sizes == size)
        best = masks[np.argsort(rss[masks], kind="stable")[:_SPARE]].tolist()
        fits = [fit(part, signals_of(mask, inputs), label) for mask in best]
        results.append(
            min(fits, key=lambda fitted: (fitted.rss, [*map(inputs.index, fitted.model.signals)]))
        )
    return results


def subset_sizes(k: int) -> NDArray[np.uint8]:
    """Return the number of signals of each of the 2^k bit masks."""
    return np.bitwise_count(np.arange(2**k, dtype=np.uint32))


def all_rss(matrix: FloatArray) -> FloatArray:
    """Return the residual sums of squares of all 2^k subsets.

    Parameters
    ----------
    matrix : float array, shape (k + 1, k + 1)
        Moments of the inputs and the label, which is last.

    Returns
    -------
    float array, shape (2^k,)
        Element m is that of the inputs whose bits are set in m.
    """
    work: FloatArray = np.asarray(matrix, dtype=np.float64)[:, :, None]
    # Signals are taken from the last to the first, so that the first ends in the lowest bit.
    # The label moves to the front, out of the way.
    order = [len(matrix) - 1, *range(len(matrix) - 1)]
    work = work[np.ix_(order, order)]
    while len(work) > 1:
        row, trailing = work[-1, :-1], work[:-1, :-1]
        size = len(trailing)
        doubled = np.empty((size, size, 2 * work.shape[2]))
        doubled[:, :, 0::2] = trailing
        scaled = row / work[-1, -1]
        for i in range(size):
            doubled[i, : i + 1, 1::2] = trailing[i, : i + 1] - scaled[i] * row[: i + 1]
            doubled[: i + 1, i, 1::2] = doubled[i, : i + 1, 1::2]
        work = doubled
    return np.asarray(np.maximum(work[0, 0], 0.0))


def signals_of(mask: int, inputs: Sequence[str]) -> list[str]:
    """Return the signals whose bit is set, in declared order."""
    return [name for i, name in enumerate(inputs) if mask >> i & 1]
