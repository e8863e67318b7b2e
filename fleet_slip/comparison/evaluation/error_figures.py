"""Figures of an estimator's error on a drive: estimate minus truth, in degrees, as in Table II."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from fleet_slip.arrays import BoolArray, FloatArray


@dataclass(frozen=True)
class ErrorFigures:
    """How far estimates are off on some rows.

    Attributes:
        rows: number of rows that ask for an estimate.
        coverage: share of them with an estimate; all else is over these.
        correlation: of estimate and truth; None if one of them is constant or there are none.
        error_mean_deg, error_std_deg: as in Table II; None, like all that follows, without rows.
        rmse_deg: root mean square error.
        error_median_deg, error_p95_deg, error_p99_deg, error_max_deg: of the absolute error.
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

    def as_dict(self) -> dict[str, Any]:
        """Return the figures for a JSON document."""
        return asdict(self)


def error_figures(
    estimate_rad: FloatArray, truth_rad: FloatArray, among: BoolArray
) -> ErrorFigures:
    """Return the figures over the rows of a mask. An estimate that is not finite is none.

    All arrays have shape (rows,).
    """
    rows = int(among.sum())
    given = among & np.isfinite(estimate_rad)
    estimate, truth = estimate_rad[given], truth_rad[given]
    if len(truth) < 2:
        return ErrorFigures(rows, len(truth) / rows if rows else 0.0)
    error = np.degrees(estimate - truth)
    size = np.abs(error)
    median, p95, p99 = np.quantile(size, [0.5, 0.95, 0.99]).tolist()
    return ErrorFigures(
        rows=rows,
        coverage=len(truth) / rows,
        correlation=pearson_correlation(estimate, truth),
        error_mean_deg=float(error.mean()),
        error_std_deg=float(error.std(ddof=1)),
        rmse_deg=float(np.sqrt(np.mean(error**2))),
        error_median_deg=median,
        error_p95_deg=p95,
        error_p99_deg=p99,
        error_max_deg=float(size.max()),
    )


def pearson_correlation(first: FloatArray, second: FloatArray) -> float | None:
    """Return Pearson's correlation of two arrays of shape (rows,); None if one is constant."""
    if np.ptp(first) == 0 or np.ptp(second) == 0:
        return None
    return float(np.corrcoef(first, second)[0, 1])
