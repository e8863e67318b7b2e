"""Repeated k-fold cross-validation and the cluster bootstrap over drives.

Both work in float64 on centred and scaled moments: thousands of refits are matrix products.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import DataError
from fleet_slip.regression.exact.least_squares import LinearModel
from fleet_slip.regression.inference.drive_moments import DriveMoments
from fleet_slip.words import number_of

_BATCH_BYTES = 2**26


@dataclass(frozen=True)
class Interval:
    """A percentile interval of so many resampled figures, of which the share `level` is inside."""

    low: float
    high: float
    level: float
    replicates: int


def percentile_interval(values: FloatArray) -> Interval:
    """Return the central 95 % percentile interval of finite values."""
    level = 0.95
    finite = values[np.isfinite(values)]
    low, high = np.quantile(finite, [(1 - level) / 2, (1 + level) / 2])
    return Interval(float(low), float(high), level, len(finite))


def held_out_products(
    drives: DriveMoments,
    fold: np.ndarray[tuple[int], np.dtype[np.int64]],
    models: Sequence[LinearModel],
) -> FloatArray:
    """Return each cluster's moments of (1, error, label) under the fold's model that left it out.

    Shape (clusters, 6), packed lower triangle, in spreads of the label.
    """
    result = np.empty((len(drives), 6))
    label = drives.size - 1
    for number, model in enumerate(models):
        rows = np.flatnonzero(fold == number)
        part = drives.packed[rows]
        change = np.zeros((3, drives.size))
        change[0, 0] = change[2, label] = 1.0
        change[1] = drives.direction(model)
        result[rows] = part @ _congruence(change)
    return drives.sum_clusters(result)


def bootstrap_correlations(products: FloatArray, replicates: int, seed: int) -> FloatArray:
    """Return pooled correlations of resampled `held_out_products`. Raises `DataError`."""
    totals = _resampled_totals(products, replicates, seed)
    n, e, ee, y, ye, yy = totals.T
    # The prediction is the label plus the error.
    p, py, pp = y + e, yy + ye, yy + 2 * ye + ee
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(_correlation(n, p, pp, py, y, yy))


def _correlation(n: Any, p: Any, pp: Any, py: Any, y: Any, yy: Any) -> Any:
    return (py - p * y / n) / np.sqrt((pp - p * p / n) * (yy - y * y / n))


def solve(totals: FloatArray, *, intercept: bool = True) -> FloatArray:
    """Solve for (constant, inputs) in each moment matrix, label last; the constant may be zero."""
    if not intercept:
        slopes = solve(totals[..., 1:, 1:])
        return np.concatenate([np.zeros_like(slopes[..., :1]), slopes], axis=-1)
    try:
        return np.asarray(np.linalg.solve(totals[..., :-1, :-1], totals[..., :-1, -1:])[..., 0])
    except np.linalg.LinAlgError:
        raise DataError(
            "a resampled cohort cannot be fitted: too few drives have these signals."
        ) from None


@dataclass(frozen=True)
class RepeatedCrossValidation:
    """Pooled figures of k-fold cross-validation, one a repeat; the RMSE in counts of the label."""

    correlations: FloatArray
    rmse: FloatArray

    @property
    def mean(self) -> float:
        """Mean correlation."""
        return float(self.correlations.mean())

    @property
    def spread(self) -> float:
        """Standard deviation of the correlation between repeats."""
        return float(self.correlations.std(ddof=1)) if len(self.correlations) > 1 else 0.0


def repeated_cross_validation(
    drives: DriveMoments, folds: int, repeats: int, seed: int, *, intercept: bool = True
) -> RepeatedCrossValidation:
    """Cross-validate least squares with `repeats` random deals into folds. Raises `DataError`."""
    if len(drives) < folds:
        raise DataError(
            f"{number_of(len(drives), 'drive')} cannot fill {number_of(folds, 'fold')}."
        )
    rng = np.random.default_rng(seed)
    batch = max(1, _BATCH_BYTES // (8 * folds * len(drives)))
    figures = []
    for start in range(0, repeats, batch):
        size = min(batch, repeats - start)
        fold = np.stack([rng.permutation(len(drives)) % folds for _ in range(size)])
        member = (fold[:, None, :] == np.arange(folds)[:, None]).astype(np.float64)
        totals = member.reshape(size * folds, -1) @ drives.packed
        for tests in drives.matrix(totals).reshape(size, folds, drives.size, drives.size):
            solutions = solve(tests.sum(axis=0) - tests, intercept=intercept)
            figures.append(_correlation_and_rmse(tests, solutions))
    correlations, rmse = np.array(figures).T
    return RepeatedCrossValidation(correlations, rmse * float(drives.spread[-1]))


def _correlation_and_rmse(tests: FloatArray, solutions: FloatArray) -> tuple[float, float]:
    """Return the figures of models, one a fold, on the moments of their test rows together."""
    inputs, cross = tests[:, :-1, :-1], tests[:, :-1, -1]
    n, y, yy = tests[:, 0, 0].sum(), tests[:, 0, -1].sum(), tests[:, -1, -1].sum()
    p = np.einsum("fi,fi->", tests[:, 0, :-1], solutions)
    pp = np.einsum("fi,fij,fj->", solutions, inputs, solutions)
    py = np.einsum("fi,fi->", cross, solutions)
    v = np.concatenate([solutions, -np.ones((len(solutions), 1))], axis=1)
    error = np.einsum("fi,fij,fj->", v, tests, v)
    return float(_correlation(n, p, pp, py, y, yy)), math.sqrt(max(float(error), 0.0) / n)


def _congruence(change: FloatArray) -> FloatArray:
    """Return the map from packed moments of u to packed moments of `change @ u`."""
    new, old = change.shape
    i, j = np.tril_indices(old)
    columns = []
    for a, b in zip(*np.tril_indices(new), strict=True):
        both = change[a, i] * change[b, j]
        other = change[a, j] * change[b, i]
        columns.append(np.where(i == j, both, both + other))
    return np.column_stack(columns)


def _resampled_totals(values: FloatArray, replicates: int, seed: int) -> FloatArray:
    """Return sums over as many drives drawn with replacement, shape (replicates, columns)."""
    drives = len(values)
    if drives < 2:
        raise DataError("a bootstrap needs at least two drives, or cars, to draw from.")
    # SFC64 and 64-bit draws are the fastest that bincount takes without a copy.
    rng = np.random.Generator(np.random.SFC64(seed))
    batch = max(1, _BATCH_BYTES // (8 * drives))
    totals = []
    for start in range(0, replicates, batch):
        size = min(batch, replicates - start)
        times = np.empty((size, drives))
        for row in times:
            row[:] = np.bincount(rng.integers(0, drives, drives), minlength=drives)
        totals.append(times @ values)
    return np.concatenate(totals)
