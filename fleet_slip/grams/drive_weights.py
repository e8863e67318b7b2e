"""Whole-number weights of drives: Gram rows are multiplied by them, so that every sum stays exact.

A weight counts in parts of `FULL`, a power of two. Robust ones take from drives whose label or
signals were lost: those that a model of all drives fits far worse than it fits the usual one.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date

import numpy as np

from fleet_slip.arrays import FloatArray, IntArray
from fleet_slip.base import Record
from fleet_slip.regression.drives import DriveMoments
from fleet_slip.regression.gram import GramTable

FULL = 16
"""The weight of a drive that is as others are."""
USUAL_ERRORS = 3.0
"""Root mean squares of the median drive that a drive may have without losing weight."""
MAX_LOST_SHARE = 0.1
"""Of the weight of all rows: where more is unusual, nothing is usual."""
MAX_ROUNDS = 50


@dataclass(frozen=True)
class DownweightedDrive(Record):
    """A drive that counts less than others.

    Attributes:
        weight: at most 1.
        times: root mean square of its residuals over that of the median drive.
    """

    DOCUMENT = "weight times"

    weight: float
    times: float

    @property
    def reason(self) -> str:
        """Why it lost weight."""
        return (
            f"its error is {self.times:.1f} times that of the median drive: robust "
            f"gives it the weight {self.weight:.2f}"
        )


@dataclass(frozen=True)
class DriveWeights:
    """Weight of each drive in parts of `FULL`, and `DownweightedDrive.times`; shape (drives,)."""

    parts: IntArray
    times: FloatArray

    def of(self, drive: int) -> DownweightedDrive:
        """Return what became of a drive."""
        return DownweightedDrive(float(self.parts[drive]) / FULL, float(self.times[drive]))


def robust_weights(drives: DriveMoments, *, intercept: bool = True) -> DriveWeights:
    """Return weights min(1, c median rms / rms)^2 of drives, fitted and weighed in turn.

    `drives` are the moments of the inputs, the label last. c is `USUAL_ERRORS`, or so large that no
    more than `MAX_LOST_SHARE` of the weight of rows is lost.
    """
    each = drives.moments[:, int(not intercept) :, int(not intercept) :]
    rows, limit = drives.moments[:, 0, 0], USUAL_ERRORS
    found = _weigh(each, rows, limit)
    while float(rows @ (FULL - found.parts)) > MAX_LOST_SHARE * FULL * float(rows.sum()):
        limit *= 1.25
        found = _weigh(each, rows, limit)
    return found


def age_weights(days: Sequence[date], half_life_days: int) -> IntArray:
    """Return weights of drives by day, in parts of `FULL`: half as much for each half-life.

    Ages are before the newest of the days.
    """
    age = np.array([(max(days) - day).days for day in days])
    return np.rint(FULL * 0.5 ** (age / half_life_days)).astype(np.int64)


def weighted(table: GramTable, parts: IntArray) -> GramTable:
    """Return Gram rows, each times a whole number: exact, with Python's integers where need be."""
    largest = np.abs(table.products.astype(np.float64)).max(initial=0) * parts.max(initial=0)
    kind = np.dtype(object) if largest >= 2.0**62 else np.dtype(np.int64)
    n, sums, products = (one.astype(kind) for one in (table.n, table.sums, table.products))
    return GramTable(table.signals, n * parts, sums * parts[:, None], products * parts[:, None])


def _weigh(each: FloatArray, rows: FloatArray, limit: float) -> DriveWeights:
    """Fit and weigh in turn until no weight changes; `each` are moments, the label last."""
    parts = np.full(len(each), FULL, dtype=np.int64)
    for _ in range(MAX_ROUNDS):
        total = np.einsum("d,dij->ij", parts.astype(np.float64), each)
        slopes = np.linalg.pinv(total[:-1, :-1], rcond=1e-13, hermitian=True) @ total[:-1, -1]
        error = np.append(slopes, -1.0)
        squares = np.maximum(np.einsum("i,dij,j->d", error, each, error), 0.0) / rows
        if not (usual := float(np.median(squares))):
            return DriveWeights(np.full(len(each), FULL, dtype=np.int64), np.ones(len(each)))
        times = np.sqrt(squares / usual)
        again = np.rint(FULL * (limit / np.maximum(times, limit)) ** 2)
        if np.array_equal(again, parts):
            break
        parts = again.astype(np.int64)
    return DriveWeights(parts, times)
