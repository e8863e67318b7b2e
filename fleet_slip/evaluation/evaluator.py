"""The evaluator: drives × estimators → errors. Pure functions on frozen values."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.errors import DataError


class MissingSignalError(DataError):
    """A drive lacks a signal that an estimator needs."""


class Drive(Protocol):
    """A drive with a reference for its side-slip angle; arrays have shape (ticks,)."""

    @property
    def name(self) -> str:
        """Unique name of the drive."""

    @property
    def sideslip_rad(self) -> FloatArray:
        """True angle, or the label; NaN where there is none."""

    @property
    def evaluated(self) -> BoolArray:
        """Rows on which estimators are compared."""


D = TypeVar("D", bound=Drive)

Estimator = Callable[[D], FloatArray]
"""Side-slip angle in rad at every tick, shape (ticks,); NaN where there is no estimate.

An estimator reads the signals of a drive and the attributes of its vehicle, never the reference. It
raises `MissingSignalError` for a drive without a signal that it needs.
"""


@dataclass(frozen=True)
class ErrorStatistics:
    """Errors of an estimator on a set of rows.

    Attributes
    ----------
    rows
        Number of rows to estimate.
    coverage
        Share of the rows with an estimate. All other statistics are over these rows.
    correlation
        Correlation of estimate and reference. None if one of them is constant or there are no rows.
    error_mean_deg, error_std_deg
        As in Table II. None without rows, as all that follow.
    rmse_deg
        Root mean square error.
    error_median_deg, error_p95_deg, error_p99_deg, error_max_deg
        Quantiles of the absolute error.
    """

    rows: int
    coverage: float
    correlation: float | None = None
    error_mean_deg: float | None = None
    error_std_deg: float | None = None
    rmse_deg: float | None = None
    error_median_deg: float | None = None
    error_p95_deg: float | None = None
    error_p99_deg: float | None = None
    error_max_deg: float | None = None


def error_statistics(
    estimate_rad: FloatArray, reference_rad: FloatArray, rows: BoolArray
) -> ErrorStatistics:
    """Compare estimates with the reference on the rows of a mask; all have shape (ticks,)."""
    count = int(rows.sum())
    estimated = rows & np.isfinite(estimate_rad)
    estimate, reference = estimate_rad[estimated], reference_rad[estimated]
    if len(reference) < 2:
        return ErrorStatistics(count, len(reference) / count if count else 0.0)
    error = np.degrees(estimate - reference)
    size = np.abs(error)
    is_constant = np.ptp(estimate) == 0 or np.ptp(reference) == 0
    median, p95, p99 = np.quantile(size, [0.5, 0.95, 0.99]).tolist()
    return ErrorStatistics(
        rows=count,
        coverage=len(reference) / count,
        correlation=None if is_constant else float(np.corrcoef(estimate, reference)[0, 1]),
        error_mean_deg=float(error.mean()),
        error_std_deg=float(error.std(ddof=1)),
        rmse_deg=float(np.sqrt(np.mean(error**2))),
        error_median_deg=median,
        error_p95_deg=p95,
        error_p99_deg=p99,
        error_max_deg=float(size.max()),
    )


@dataclass(frozen=True)
class EvaluatedDrive(Generic[D]):
    """A drive, the rows on which it is evaluated, and the estimates in rad by estimator."""

    drive: D
    name: str
    rows: BoolArray
    estimates: Mapping[str, FloatArray]

    @cached_property
    def statistics(self) -> dict[str, ErrorStatistics]:
        """Errors by estimator."""
        return pooled_statistics([self])

    @property
    def sideslip_std_deg(self) -> float:
        """Standard deviation of the reference; 0 without rows."""
        reference = self.drive.sideslip_rad[self.rows]
        return float(np.degrees(reference.std())) if len(reference) else 0.0

    def within(self, rows: BoolArray, name: str = "") -> "EvaluatedDrive[D]":
        """Restrict the evaluation to the rows of a mask."""
        return replace(self, name=name or self.name, rows=self.rows & rows)


def evaluate(
    drives: Sequence[D], estimators: Mapping[str, Estimator[D]]
) -> tuple[EvaluatedDrive[D], ...]:
    """Estimate every drive by every estimator, all on the same rows of a drive.

    A drive that lacks a signal has no estimate (NaN); any other error of an estimator is raised.
    """
    return tuple(
        EvaluatedDrive(
            drive,
            drive.name,
            drive.evaluated,
            {name: _estimate(estimator, drive) for name, estimator in estimators.items()},
        )
        for drive in drives
    )


def _estimate(estimator: Estimator[D], drive: D) -> FloatArray:
    try:
        return estimator(drive)
    except MissingSignalError:
        return np.full(len(drive.sideslip_rad), np.nan)


MIN_COMMON_SHARE = 0.9
"""Share of the rows that must remain for an estimator to join a comparison on common rows."""


def on_common_rows(
    drives: Sequence[EvaluatedDrive[D]],
) -> tuple[tuple[EvaluatedDrive[D], ...], dict[str, str]]:
    """Restrict the evaluation to rows that all comparable estimators estimate.

    The estimators with the most rows join first, while `MIN_COMMON_SHARE` of the rows of the first
    remains. Returns the drives with the comparable estimators, and the reason of each other one.
    """
    rows = np.concatenate([evaluated.rows for evaluated in drives])
    estimated = {
        name: rows & np.isfinite(np.concatenate([drive.estimates[name] for drive in drives]))
        for name in drives[0].estimates
    }
    counts = {name: int(mask.sum()) for name, mask in estimated.items()}
    largest = max(counts.values(), default=0)
    common, excluded = rows, dict[str, str]()
    for name in sorted(counts, key=lambda name: -counts[name]):
        remaining = common & estimated[name]
        if largest and remaining.sum() >= MIN_COMMON_SHARE * largest:
            common = remaining
        elif counts[name]:
            share = counts[name] / largest
            excluded[name] = f"it estimates {share:.0%} of the rows, too few to compare"
        else:
            excluded[name] = "no drive has the signals that it needs"
    stops = np.cumsum([len(evaluated.rows) for evaluated in drives])[:-1]
    return tuple(
        replace(
            evaluated,
            rows=mask,
            estimates={n: e for n, e in evaluated.estimates.items() if n not in excluded},
        )
        for evaluated, mask in zip(drives, np.split(common, stops), strict=True)
    ), excluded


def pooled_statistics(drives: Sequence[EvaluatedDrive[D]]) -> dict[str, ErrorStatistics]:
    """Return each estimator's errors over the rows of all drives together."""
    reference = np.concatenate([evaluated.drive.sideslip_rad for evaluated in drives])
    rows = np.concatenate([evaluated.rows for evaluated in drives])
    return {
        name: error_statistics(
            np.concatenate([evaluated.estimates[name] for evaluated in drives]), reference, rows
        )
        for name in drives[0].estimates
    }


def variation_between_drives(drives: Sequence[EvaluatedDrive[D]], name: str) -> dict[str, Any]:
    """Return the standard error of an estimator's RMSE over drives, and its worst drive.

    The mean squared error is a quotient of sums over drives, Σ Sd / Σ nd, whose variance is that
    of Sd − MSE nd (Cochran, "Sampling Techniques" (1977), section 6.4). None for a single drive.
    """
    units = [
        (evaluated.name, errors.rows * errors.coverage, errors.rmse_deg)
        for evaluated in drives
        for errors in [evaluated.statistics[name]]
        if errors.rmse_deg
    ]
    rows, rmse = np.array([count for _, count, _ in units]), np.array([deg for *_, deg in units])
    standard_error = None
    if len(units) > 1:
        mean_square = float(rows @ rmse**2 / rows.sum())
        residual = rows * (rmse**2 - mean_square)
        variance = len(units) / (len(units) - 1) * float(residual @ residual)
        variance /= float(rows.sum()) ** 2
        standard_error = math.sqrt(variance) / (2 * math.sqrt(mean_square))
    worst = max(units, key=lambda unit: unit[2], default=None)
    return {
        "rmse_standard_error_deg": standard_error,
        "worst_drive": worst and worst[0],
        "worst_drive_rmse_deg": worst and worst[2],
    }
