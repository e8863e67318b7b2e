"""Per-drive moments in float64 for what needs every drive: clusters and resampling.

They are about the cohort's mean, rounded to a count, while integers: nothing cancels.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import BoolArray, FloatArray, IntArray
from fleet_slip.errors import DataError
from fleet_slip.regression.gram import GramTable, packed_position, packed_size
from fleet_slip.regression.least_squares import LinearModel

ClusterUnit = Literal["drive", "vehicle"]
"""What counts as one independent piece of evidence."""


def missing_signals_error(signals: Sequence[str]) -> DataError:
    """Return the error that no drive of a cohort has all of some signals."""
    return DataError(
        f"no drive of the cohort has all of {', '.join(signals)}. Use fewer signals, or another "
        "cohort."
    )


def serving_drives(
    tables: Sequence[GramTable], signals: Sequence[str]
) -> tuple[GramTable, BoolArray]:
    """Return one table of drives with all signals, and their mask. Raises `DataError` for none."""
    served = [set(signals) <= set(table.signals) for table in tables]
    if not any(served):
        raise missing_signals_error(signals)
    parts = [table.restrict(signals) for table, yes in zip(tables, served, strict=True) if yes]
    mask = np.repeat(served, [len(table) for table in tables])
    if len(parts) == 1:
        return parts[0], mask
    stacked = GramTable(
        tuple(signals),
        np.concatenate([part.n for part in parts]),
        np.concatenate([part.sums for part in parts]),
        np.concatenate([part.products for part in parts]),
    )
    return stacked, mask


@dataclass(frozen=True)
class DriveMoments:
    """Moments of u = (1, (count - centre) / spread) of each drive; the label is last.

    Attributes:
        centre: mean count of each signal over all drives, rounded to an integer.
        spread: standard deviation of each signal's counts; 1 for a constant.
        packed: lower triangle of the (k+1) x (k+1) moments of u, shape (drives, (k+1)(k+2)/2).
        cluster: number of each drive's piece of evidence, shape (drives,); None: its own.
        unit: what a piece of evidence is: drives of a car share its biases and tyres.
    """

    signals: tuple[str, ...]
    centre: tuple[int, ...]
    spread: FloatArray
    packed: FloatArray
    cluster: IntArray | None = None
    unit: ClusterUnit = "drive"

    @classmethod
    def of(
        cls, table: GramTable, cluster: IntArray | None = None, unit: ClusterUnit = "drive"
    ) -> "DriveMoments":
        """Scale a table of drives. Raises `DataError` without rows."""
        total = table.total()
        if total.n == 0:
            raise DataError(f"no rows have all of {', '.join(table.signals)}.")
        k = len(table.signals)
        centre = tuple(round(s / total.n) for s in total.sums)
        squares = np.array([total.centred()[i][i] for i in range(k)], dtype=np.float64)
        spread = np.where(squares > 0, np.sqrt(squares) / total.n, 1.0)
        about = table.about(centre)
        row, column = np.tril_indices(k)
        packed = np.empty((len(table), packed_size(k + 1)))
        packed[:, 0] = about.n
        for i in range(k):
            start = packed_position(i + 1, 0)
            packed[:, start] = about.sums[:, i] / spread[i]
        inner = [
            packed_position(i, j)
            for i, j in zip((row + 1).tolist(), (column + 1).tolist(), strict=True)
        ]
        packed[:, inner] = about.products / (spread[row] * spread[column])
        return cls(table.signals, centre, spread, packed, cluster, unit)

    def __len__(self) -> int:
        return len(self.packed)

    @property
    def size(self) -> int:
        """Length of u: the constant, the inputs and the label."""
        return len(self.signals) + 1

    def take(self, rows: NDArray[Any]) -> "DriveMoments":
        """Return the drives at an index array or a mask, with the same centre and spread."""
        cluster = None if self.cluster is None else self.cluster[rows]
        return replace(self, packed=self.packed[rows], cluster=cluster)

    @property
    def clusters(self) -> "DriveMoments":
        """The moments of each independent piece of evidence, in the order of their numbers."""
        if self.cluster is None:
            return self
        numbers = np.unique(self.cluster)
        return replace(self, packed=self.sum_clusters(self.packed), cluster=numbers)

    def sum_clusters(self, values: FloatArray) -> FloatArray:
        """Add up what is given for each drive, shape (drives, columns), over each cluster."""
        if self.cluster is None:
            return values
        order = np.argsort(self.cluster, kind="stable")
        _, first = np.unique(self.cluster[order], return_index=True)
        return np.add.reduceat(values[order], first, axis=0)

    def matrix(self, packed: FloatArray) -> FloatArray:
        """Unpack moments, shape (..., p), to symmetric matrices, shape (..., k+1, k+1)."""
        k = range(self.size)
        at = np.array([[packed_position(i, j) for j in k] for i in k])
        return packed[..., at]

    def direction(self, model: LinearModel) -> FloatArray:
        """Return w with w'u = prediction minus label, in spreads of the label; model in counts."""
        if model.label != self.signals[-1]:
            raise ValueError(f"the moments end with {self.signals[-1]}, not {model.label}")
        weights = dict(zip(model.signals, model.coefficients, strict=True))
        inputs = self.signals[:-1]
        level = model.intercept - self.centre[-1]
        level += sum(weights.get(s, 0) * c for s, c in zip(inputs, self.centre, strict=False))
        unit = self.spread[-1]
        slopes = [
            float(weights.get(s, 0)) * spread / unit
            for s, spread in zip(inputs, self.spread, strict=False)
        ]
        return np.array([float(level) / unit, *slopes, -1.0])

    def products_with(self, w: FloatArray) -> FloatArray:
        """Return sum over a drive's rows of u times w'u, shape (drives, k+1)."""
        k = self.size
        expand = np.zeros((self.packed.shape[1], k))
        for i in range(k):
            for j in range(k):
                expand[packed_position(i, j), i] += w[j]
        return self.packed @ expand


# The cluster bootstrap over drives, in float64 on centred and scaled moments.

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
        root = np.sqrt((pp - p * p / n) * (yy - y * y / n))
        return np.asarray((py - p * y / n) / root, dtype=np.float64)


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
