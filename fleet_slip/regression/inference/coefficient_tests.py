"""Do two sets of drives have the same coefficients? Chow's test by rows, Wald's by clusters."""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import DataError
from fleet_slip.regression.exact import special
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.regression.exact.least_squares import Fit, fit
from fleet_slip.regression.inference.drive_moments import DriveMoments
from fleet_slip.regression.inference.standard_errors import cluster_influences


@dataclass(frozen=True)
class FTest:
    """An F test that sets of drives share coefficients; p is of a larger f if they do."""

    f: float
    numerator: int
    denominator: int
    p: float


def chow_test(
    groups: Sequence[Gram], inputs: Sequence[str], label: str, *, intercept: bool = True
) -> FTest:
    """F = ((RSS_pool - sum RSS_p) / ((P-1)(k+1))) / (sum RSS_p / (n - P(k+1))), or `DataError`."""
    count, size = len(groups), len(inputs) + intercept
    if count < 2:
        raise DataError("a Chow test compares at least two groups of drives.")
    total = sum(groups[1:], groups[0])

    def rss(group: Gram) -> Fraction:
        return fit(group, inputs, label, intercept=intercept).rss

    apart, together = sum(map(rss, groups), Fraction(0)), rss(total)
    numerator, denominator = (count - 1) * size, total.n - count * size
    if denominator <= 0 or apart == 0:
        raise DataError("a Chow test needs noise and more rows than coefficients.")
    f = float((together - apart) / numerator / (apart / denominator))
    return FTest(f, numerator, denominator, special.f_upper(f, numerator, denominator))


def wald_test(one: Fit, one_drives: DriveMoments, other: Fit, other_drives: DriveMoments) -> FTest:
    """Compare the coefficients of the same model fitted to two sets of drives.

    F = d'V^-1 d / (k + 1), d the difference and V its cluster-robust covariance, the sum of both
    models' where no car is in both sets; its denominator is the number of clusters minus two
    (Cameron and Miller 2015). Unlike `chow_test`, it does not take neighbouring rows for
    independent. Clusters of the same number are the same car. Raises `DataError` with fewer
    clusters than coefficients.
    """
    unit, first = one_drives.unit, int(not one.has_intercept)
    size = one.size + 1 - first
    here, there = (
        cluster_influences(fitted, drives)[first:]
        for fitted, drives in ((one, one_drives), (other, other_drives))
    )
    if min(here.shape[1], there.shape[1]) <= size:
        raise DataError(
            f"comparing {size} coefficients by {unit}s needs more than {size} {unit}s in each "
            "cohort."
        )
    gap = [a - b for a, b in zip(_numbers(one)[first:], _numbers(other)[first:], strict=True)]
    moved = _side_by_side((here, one_drives), (there, other_drives))
    covariance, drives = moved @ moved.T, moved.shape[1]
    spread = np.sqrt(np.diag(covariance))
    d = np.array([float(x) for x in gap]) / spread
    f = float(d @ np.linalg.solve(covariance / np.outer(spread, spread), d)) / size
    return FTest(f, size, drives - 2, special.f_upper(f, size, drives - 2))


def _side_by_side(
    one: tuple[FloatArray, DriveMoments], other: tuple[FloatArray, DriveMoments]
) -> FloatArray:
    """Return how each cluster moves the difference of two models; a car may be in both."""
    (here, one_drives), (there, other_drives) = one, other
    clusters = [drives.cluster for drives in (one_drives, other_drives)]
    numbers = [np.unique(cluster) for cluster in clusters if cluster is not None]
    if len(numbers) < len(clusters):  # drives, of which none is in both
        return np.concatenate([here, -there], axis=1)
    every = np.union1d(*numbers)
    moved = np.zeros((len(here), len(every)))
    moved[:, np.searchsorted(every, numbers[0])] += here
    moved[:, np.searchsorted(every, numbers[1])] -= there
    return moved


def _numbers(fitted: Fit) -> list[Fraction]:
    return [fitted.model.intercept, *fitted.model.coefficients]
