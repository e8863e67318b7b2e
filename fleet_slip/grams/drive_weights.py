"""Integer weights of drives: Gram rows times a weight keep every sum exact.

Weights are multiples of 1 / `FULL`, a power of two. Robust weights are lower for drives whose error
is far above that of the median drive, such as drives with a lost label or signal.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date

import numpy as np

from fleet_slip.arrays import FloatArray, IntArray
from fleet_slip.base import Record
from fleet_slip.regression.gram import GramTable
from fleet_slip.regression.inference import DriveMoments

FULL = 16
"""Weight of a usual drive."""
USUAL_ERRORS = 3.0
"""Error of a drive over that of the median drive, beyond which its weight is lower."""
MAX_LOST_SHARE = 0.1
"""Maximum share of the weight of all rows that outliers lose."""
MAX_ROUNDS = 50


@dataclass(frozen=True)
class DownweightedDrive(Record):
    """A drive with a robust weight below 1.

    Attributes
    ----------
    weight
        From 0 to 1.
    times
        Root mean square of its residuals over that of the median drive.
    """

    DOCUMENT = "weight times"

    weight: float
    times: float

    @property
    def reason(self) -> str:
        """Explanation for the user."""
        return (
            f"its error is {self.times:.1f} times that of the median drive: robust "
            f"gives it the weight {self.weight:.2f}"
        )


@dataclass(frozen=True)
class DriveWeights:
    """Weight of each drive in parts of `FULL`, and `DownweightedDrive.times`; shape (drives,)."""

    weights: IntArray
    times: FloatArray

    def drive(self, number: int) -> DownweightedDrive:
        """Return weight and error of a drive."""
        return DownweightedDrive(float(self.weights[number]) / FULL, float(self.times[number]))


def robust_weights(drives: DriveMoments, *, intercept: bool = True) -> DriveWeights:
    """Return weights min(1, c median rms / rms)^2 of drives, by reweighted least squares.

    `drives` are the moments of the inputs and the label, which is last. c is `USUAL_ERRORS`, or the
    lowest multiple of it by powers of 1.25 that takes at most `MAX_LOST_SHARE` of the weight.
    """
    moments = drives.moments[:, int(not intercept) :, int(not intercept) :]
    rows, limit = drives.moments[:, 0, 0], USUAL_ERRORS
    result = _reweight(moments, rows, limit)
    while float(rows @ (FULL - result.weights)) > MAX_LOST_SHARE * FULL * float(rows.sum()):
        limit *= 1.25
        result = _reweight(moments, rows, limit)
    return result


def age_weights(days: Sequence[date], half_life_days: int) -> IntArray:
    """Return weights of drives that halve with each half-life of age before the newest day."""
    age = np.array([(max(days) - day).days for day in days])
    return np.rint(FULL * 0.5 ** (age / half_life_days)).astype(np.int64)


def weighted(table: GramTable, weights: IntArray) -> GramTable:
    """Return Gram rows times integer weights, exactly; beyond 62 bits as Python integers."""
    largest = np.abs(table.products.astype(np.float64)).max(initial=0) * weights.max(initial=0)
    kind = np.dtype(object) if largest >= 2.0**62 else np.dtype(np.int64)
    n, sums, products = (values.astype(kind) for values in (table.n, table.sums, table.products))
    column = weights[:, None]
    return GramTable(table.signals, n * weights, sums * column, products * column)


def _reweight(moments: FloatArray, rows: FloatArray, limit: float) -> DriveWeights:
    """Fit and weight in turn until no weight changes; the label is the last of the moments."""
    weights = np.full(len(moments), FULL, dtype=np.int64)
    for _ in range(MAX_ROUNDS):
        total = np.einsum("d,dij->ij", weights.astype(np.float64), moments)
        slopes = np.linalg.pinv(total[:-1, :-1], rcond=1e-13, hermitian=True) @ total[:-1, -1]
        error = np.append(slopes, -1.0)
        squares = np.maximum(np.einsum("i,dij,j->d", error, moments, error), 0.0) / rows
        if not (median := float(np.median(squares))):
            return DriveWeights(np.full(len(moments), FULL, dtype=np.int64), np.ones(len(moments)))
        times = np.sqrt(squares / median)
        update = np.rint(FULL * (limit / np.maximum(times, limit)) ** 2)
        if np.array_equal(update, weights):
            break
        weights = update.astype(np.int64)
    return DriveWeights(weights, times)
