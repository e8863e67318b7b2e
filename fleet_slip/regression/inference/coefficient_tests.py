"""Do two sets of drives have the same coefficients? Chow's test by rows, Wald's by clusters."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np

from fleet_slip.errors import DataError
from fleet_slip.regression.exact import distributions
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.regression.exact.least_squares import Fit, fit
from fleet_slip.regression.inference.drive_moments import DriveMoments
from fleet_slip.regression.inference.few_clusters import hotelling
from fleet_slip.regression.inference.standard_errors import clustered_fit


@dataclass(frozen=True)
class FTest:
    """An F test that sets of drives share coefficients; p is of a larger f if they do."""

    f: float
    numerator: int
    denominator: float
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
    return FTest(f, numerator, denominator, distributions.f_upper(f, numerator, denominator))


def wald_test(one: Fit, one_drives: DriveMoments, other: Fit, other_drives: DriveMoments) -> FTest:
    """Compare the coefficients of the same model fitted to two sets of drives.

    Wald's statistic d'V^-1 d of their difference, V clustered and corrected for few of them, judged
    as Hotelling's T^2 (`few_clusters`); neighbouring rows need not be independent. Clusters of the
    same number are the same car. Raises `DataError` where clusters are too few.
    """
    unit, first = one_drives.unit, int(not one.has_intercept)
    size = one.size + 1 - first
    if min(len(one_drives.clusters), len(other_drives.clusters)) <= size:
        raise DataError(
            f"comparing {size} coefficients by {unit}s needs more than {size} {unit}s in each "
            "cohort."
        )
    gap = [a - b for a, b in zip(_numbers(one)[first:], _numbers(other)[first:], strict=True)]
    fits = clustered_fit(one, one_drives), clustered_fit(other, other_drives)
    if unit == "drive":  # none is in both
        fits = fits[0], replace(fits[1], cluster=fits[1].cluster + 1 + fits[0].cluster.max())
    f, degrees = hotelling(np.array([float(x) for x in gap]), fits)
    return FTest(f, size, degrees, distributions.f_upper(f, size, degrees))


def _numbers(fitted: Fit) -> list[Fraction]:
    return [fitted.model.intercept, *fitted.model.coefficients]
