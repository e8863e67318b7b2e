"""Choosing among many inputs: forward, backward, exchange, or the order of least angles.

Steps are taken in extended precision (`numpy.longdouble`); where the two best sums of squares
differ by less than rounding could make, exact elimination decides. So but for least angles, which
needs roots, an order is that of exact arithmetic. A column that others explain but for 10^-9 of its
variance counts as dependent, and is left out.
"""

from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fleet_slip.errors import QuestionError
from fleet_slip.regression.choice.lars import lars_path_of_moments
from fleet_slip.regression.exact.elimination import eliminate
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.regression.exact.least_squares import moments

LongArray = NDArray[np.longdouble]

DEPENDENT = 1e-9
"""Share of a column's variance that others must leave unexplained."""

ROUNDING = 1e-6
"""Relative difference of two gains below which they are compared exactly: far above what 64-bit
fractions lose where no column is dependent."""

METHODS: Final = ("forward", "backward", "exchange", "lars")


def stepwise_order(
    gram: Gram, inputs: Sequence[str], label: str, method: str, most: int
) -> tuple[tuple[str, ...], ...]:
    """Return the chosen inputs of sizes 1, 2, ... up to `most`; all but exchange's are nested.

    Raises `QuestionError` for an unknown method, `DataError` for no rows.
    """
    if method not in METHODS:
        raise QuestionError(f"unknown search {method!r}. Known: {', '.join(METHODS)}.")
    search = _Search(gram.restrict([*inputs, label]))
    most = min(most, len(search.usable))
    steps: dict[str, Callable[[int], list[list[int]]]] = {
        "forward": search.forward,
        "backward": search.backward,
        "exchange": partial(search.forward, exchanging=True),
        "lars": search.lars,
    }
    return tuple(tuple(inputs[i] for i in chosen) for chosen in steps[method](most))


def sweep(matrix: LongArray, pivot: int) -> LongArray:
    """Return a matrix swept on a pivot (Goodnight 1979), which done again undoes it."""
    row = matrix[pivot] / matrix[pivot, pivot]
    swept = matrix - np.outer(matrix[:, pivot], row)
    swept[pivot] = row
    swept[:, pivot] = matrix[:, pivot] / matrix[pivot, pivot]
    swept[pivot, :] = row
    swept[pivot, pivot] = -1 / matrix[pivot, pivot]
    return swept


class _Search:
    """The correlation matrix of inputs and label, and exact sums of squares where it matters."""

    def __init__(self, gram: Gram) -> None:
        self.exact = moments(gram)
        size = len(self.exact)
        # An integer to 64 bits or more: its float, and what that leaves.
        high = np.array([[float(x) for x in row] for row in self.exact])
        low = np.array([[float(x - int(float(x))) for x in row] for row in self.exact])
        matrix = high.astype(np.longdouble) + low.astype(np.longdouble)
        length = np.sqrt(np.diag(matrix))
        length[length == 0] = 1
        self.matrix: LongArray = matrix / np.outer(length, length)
        self.inputs = size - 1
        self.usable = self._independent()

    def _independent(self) -> list[int]:
        work, left = self.matrix.copy(), set(range(self.inputs))
        taken: list[int] = []
        while left:
            best = max(left, key=lambda i: (work[i, i], -i))
            if work[best, best] < DEPENDENT:
                break
            work = sweep(work, best)
            taken.append(best)
            left.remove(best)
        return sorted(taken)

    def forward(self, most: int, *, exchanging: bool = False) -> list[list[int]]:
        work, chosen = self.matrix.copy(), list[int]()
        sets = []
        for _ in range(most):
            best = self._best_entry(work, chosen)
            if best is None:
                break
            work = sweep(work, best)
            chosen.append(best)
            if exchanging:
                work = self._exchanged(work, chosen)
            sets.append(list(chosen))
        return sets

    def backward(self, most: int) -> list[list[int]]:
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
        return [order[:size] for size in range(1, most + 1)]

    def lars(self, most: int) -> list[list[int]]:
        at = self.usable
        matrix = self.matrix[np.ix_(at, at)].astype(np.float64)
        target = self.matrix[at, -1].astype(np.float64)
        names = [str(i) for i in at]
        order = [int(name) for name in lars_path_of_moments(matrix, target, names).order]
        return [order[:size] for size in range(1, min(most, len(order)) + 1)]

    def _best_entry(self, work: LongArray, chosen: Sequence[int]) -> int | None:
        free = [i for i in self.usable if i not in chosen and work[i, i] >= DEPENDENT]
        if not free:
            return None
        gains = {i: work[i, -1] ** 2 / work[i, i] for i in free}
        best = max(gains.values())
        near = [i for i in free if gains[i] >= best * (1 - ROUNDING)]
        if len(near) == 1:
            return near[0]
        return min(near, key=lambda i: (self._rss([*chosen, i]), i))

    def _least_loss(self, work: LongArray, chosen: Sequence[int]) -> int:
        """Return the chosen input whose loss costs least; of equals, the later declared."""
        losses = {i: work[i, -1] ** 2 / -work[i, i] for i in chosen}
        least = min(losses.values())
        near = [i for i in chosen if losses[i] <= least * (1 + ROUNDING)]
        if len(near) == 1:
            return near[0]
        return min(near, key=lambda i: (self._rss([j for j in chosen if j != i]), -i))

    def _exchanged(self, work: LongArray, chosen: list[int]) -> LongArray:
        """Exchange chosen inputs, in place, while that lowers the residual sum of squares."""
        improved = True
        while improved:
            improved = False
            for position, old in enumerate(chosen):
                without = sweep(work, old)
                others = [*chosen[:position], *chosen[position + 1 :]]
                new = self._best_entry(without, others)
                if new is None or new == old:
                    continue
                trial = sweep(without, new)
                if trial[-1, -1] < work[-1, -1] * (1 - ROUNDING):
                    work, chosen[position], improved = trial, new, True
        return work

    def _rss(self, chosen: Sequence[int]) -> Fraction:
        at = [*chosen, self.inputs]
        found = eliminate([[self.exact[i][j] for j in at] for i in at])
        return found.residual(len(found.rows))
