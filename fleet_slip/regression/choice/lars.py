"""Least-angle regression and lasso paths from correlations alone.

Efron, Hastie, Johnstone and Tibshirani (2004), Annals of Statistics 32:407.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import DataError
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.regression.exact.least_squares import (
    LinearModel,
    correlation_matrix,
    from_standardised,
)

_TIE = 1e-12


@dataclass(frozen=True)
class LarsPath:
    """Piecewise linear path of standardised coefficients; `order` is that of first entry.

    Attributes:
        penalties: largest absolute correlation with the residual at each breakpoint, falling.
        coefficients: at each breakpoint, shape (breakpoints, k).
    """

    signals: tuple[str, ...]
    order: tuple[str, ...]
    penalties: FloatArray
    coefficients: FloatArray

    def at(self, penalty: float) -> FloatArray:
        """Return the standardised coefficients at a penalty, by linear interpolation."""
        falling = self.penalties[::-1]
        return np.array(
            [np.interp(penalty, falling, column[::-1]) for column in self.coefficients.T]
        )


def lars_path(gram: Gram, inputs: Sequence[str], label: str) -> LarsPath:
    """Return the path of least-angle regression. Raises `DataError` for dependent signals."""
    return path_of_moments(*_correlations(gram, inputs, label), inputs)


def lasso_path(gram: Gram, inputs: Sequence[str], label: str) -> LarsPath:
    """Return the path of all minimisers of the lasso, |y - Xb|^2 / 2 + penalty |b|_1.

    Ties enter in the declared order. Raises `DataError` for constant or dependent signals.
    """
    return path_of_moments(*_correlations(gram, inputs, label), inputs, drops=True)


def path_of_moments(
    matrix: FloatArray, target: FloatArray, inputs: Sequence[str], *, drops: bool = False
) -> LarsPath:
    """Return the path for moments X'X, shape (k, k), and X'y, shape (k,), in their own units.

    Of least angles, or of the lasso, which `drops` signals again. Raises `DataError`.
    """
    walk = _Walk(matrix, target, drops=drops)
    try:
        while walk.step():
            pass
    except np.linalg.LinAlgError:
        raise DataError(
            f"{', '.join(inputs)} are linearly dependent. Leave one of them out, or take more rows."
        ) from None
    return LarsPath(
        tuple(inputs),
        tuple(inputs[i] for i in walk.entered),
        np.array(walk.penalties),
        np.array(walk.path),
    )


def _correlations(gram: Gram, inputs: Sequence[str], label: str) -> tuple[FloatArray, FloatArray]:
    matrix = correlation_matrix(gram.restrict([*inputs, label]))
    constant = [name for i, name in enumerate([*inputs, label]) if matrix[i, i] == 0]
    if constant:
        raise DataError(f"{', '.join(constant)} is constant: leave it out.")
    k = len(inputs)
    return matrix[:k, :k], matrix[:k, k]


def fit_lasso(gram: Gram, inputs: Sequence[str], label: str, penalty: float) -> LinearModel:
    """Return the lasso of counts; the penalty is in correlations, 0..1."""
    path = lasso_path(gram, inputs, label)
    return from_standardised(gram, inputs, label, path.at(penalty))


class _Walk:
    """The path's state: active signals share the correlation size; the lasso `drops` zeros."""

    def __init__(self, matrix: FloatArray, target: FloatArray, *, drops: bool) -> None:
        self.matrix, self.target, self.drops = matrix, target, drops
        self.beta = np.zeros(len(target))
        self.active: list[int] = []
        self.entered: list[int] = []
        self.dropped: int | None = None
        self.penalties = [float(np.abs(target).max(initial=0.0))]
        self.path = [self.beta.copy()]

    def step(self) -> bool:
        """Move to the next breakpoint. Return whether there is another one."""
        residual = self.target - self.matrix @ self.beta
        penalty = self.penalties[-1]
        self._enter(residual, penalty)
        if not self.active:
            return False
        signs = np.sign(residual[self.active])
        inner = self.matrix[np.ix_(self.active, self.active)]
        direction = np.zeros_like(self.beta)
        direction[self.active] = np.linalg.solve(inner, signs)
        length = min(penalty, self._until_entry(residual, penalty, direction))
        self.dropped = None
        if self.drops:
            length = self._until_zero(direction, length)
        self.beta = self.beta + length * direction
        if self.dropped is not None:
            self.beta[self.dropped] = 0.0
            self.active.remove(self.dropped)
        last = length == penalty
        self.penalties.append(0.0 if last else penalty - length)
        self.path.append(self.beta.copy())
        return not last

    def _inactive(self) -> list[int]:
        return [i for i in range(len(self.beta)) if i not in self.active]

    def _enter(self, residual: FloatArray, penalty: float) -> None:
        if penalty == 0:
            return
        for i in self._inactive():
            if i != self.dropped and abs(residual[i]) >= penalty * (1 - _TIE) - _TIE:
                self.active.append(i)
                if i not in self.entered:
                    self.entered.append(i)

    def _until_entry(self, residual: FloatArray, penalty: float, direction: FloatArray) -> float:
        slope = self.matrix @ direction
        lengths = [np.inf]
        for i in self._inactive():
            for sign in (1, -1):
                gap, speed = penalty - sign * residual[i], 1 - sign * slope[i]
                # A signal that was just dropped has no gap on its old side; it may come back on
                # the other one.
                if speed > _TIE and gap > _TIE:
                    lengths.append(float(gap / speed))
        return min(lengths)

    def _until_zero(self, direction: FloatArray, length: float) -> float:
        """Return how far to go before an active coefficient must be dropped, and note which."""
        for i in self.active:
            if self.beta[i] * direction[i] < 0:
                until = float(-self.beta[i] / direction[i])
                if until < length:
                    length, self.dropped = until, i
        return length
