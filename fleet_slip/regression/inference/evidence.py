"""How much each signal of an order contributes, and how much data says so.

In the orthogonal basis of a nested order, signal j has the squared length A_j in units of the
noise, and every criterion is a price on it. Neighbouring rows at 100 Hz are not independent, so the
evidence that decides is over drives.

Do two sets of drives have the same coefficients? Chow's test by rows, Wald's by clusters.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import DataError
from fleet_slip.regression.exact.figures import f_upper
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.regression.exact.least_squares import Fit, fit
from fleet_slip.regression.inference.drive_moments import DriveMoments
from fleet_slip.regression.inference.standard_errors import (
    cluster_scores,
    clustered_fit,
    hotelling,
    noise_variance,
    small_sample_factor,
)


@dataclass(frozen=True)
class Evidence:
    """What the data says about the k+1 nested models of an order; variances are in counts^2.

    Attributes:
        contributions: A_j of each signal of the order.
        rows: number of independent rows, at most the number of rows.
        design_effect: variance of an estimate over what independent rows would give.
        kind: "rows" if rows count as independent, "drives" or "vehicles" if only those do.
    """

    contributions: tuple[float, ...]
    rows: float
    design_effect: float
    variance: float
    full_rss: float
    kind: Literal["rows", "drives", "vehicles"]

    @classmethod
    def naive(cls, fits: Sequence[Fit]) -> "Evidence":
        """A_j = (RSS_{j-1} - RSS_j) / sigma^2 of k+1 nested fits. Raises `DataError`."""
        full, variance = fits[-1], _variance(fits[-1])
        return cls(
            tuple(float(gain / variance) for gain in _gains(fits)),
            float(full.gram.n),
            1.0,
            float(variance),
            float(full.rss),
            "rows",
        )

    @classmethod
    def clustered(cls, fits: Sequence[Fit], drives: DriveMoments) -> "Evidence":
        """Take drives, or cars, for independent: A_j is a squared cluster-robust t value.

        With q_j the orthogonal direction of signal j and e the full model's residuals, A_j =
        (q_j'y)^2 / (c sum_p (q_j'e)_p^2) over clusters p. Its ratio to the naive A_j is the
        direction's design effect (Kish 1965); rows over the mean effect are effective, at least k +
        2. Raises `DataError`.
        """
        full, variance = fits[-1], _variance(fits[-1])
        at = [0, *(drives.signals.index(name) + 1 for name in full.model.signals)]
        total = drives.matrix(drives.packed.sum(axis=0))[np.ix_(at, at)]
        scores = cluster_scores(full, drives)
        rotated = np.linalg.solve(np.linalg.cholesky(total), scores.T)[1:]
        unit = float(drives.spread[-1]) ** 2
        factor = small_sample_factor(full, len(scores), drives.unit)
        noise = factor * np.sum(rotated**2, axis=1) * unit
        gains = np.array([float(gain) for gain in _gains(fits)])
        effects = noise / float(variance)
        effect = float(effects.mean()) if len(effects) else 1.0
        rows = min(full.gram.n, max(full.gram.n / effect, full.size + 2))
        return cls(
            tuple((gains / noise).tolist()),
            float(rows),
            effect,
            float(variance),
            float(full.rss),
            "vehicles" if drives.unit == "vehicle" else "drives",
        )

    def as_dict(self) -> dict[str, Any]:
        """Return what a JSON document needs."""
        return {
            "contributions": list(self.contributions),
            "distances_to_full": self.excess().tolist(),
            "expected_distances": list(self.distances()),
            "evidence": self.kind,
            "effective_rows": self.rows,
            "design_effect": self.design_effect,
        }

    @property
    def inputs(self) -> int:
        """Number of signals of the order, k."""
        return len(self.contributions)

    def excess(self) -> FloatArray:
        """Return sum_{i>j} A_i for j = 0..k: what leaving out the rest costs."""
        tail = np.cumsum([0.0, *reversed(self.contributions)])[::-1]
        return np.ascontiguousarray(tail)

    def excess_of(self, rss: FloatArray) -> FloatArray:
        """Return the same for any subset models, from their residual sums of squares."""
        return np.asarray((rss - self.full_rss) / (self.variance * self.design_effect))

    def distances(self) -> tuple[float, ...]:
        """Return unbiased D_j = sum_{i>j} A_i + 2j - k of equation (2), j = 0..k (Mallows 1973)."""
        size = np.arange(self.inputs + 1)
        return tuple((self.excess() + 2 * size - self.inputs).tolist())


def _gains(fits: Sequence[Fit]) -> list[Fraction]:
    return [a.rss - b.rss for a, b in pairwise(fits)]


def _variance(full: Fit) -> Fraction:
    variance = noise_variance(full)
    if variance == 0:
        raise DataError(
            f"{full.model.label} is an exact linear combination of "
            f"{', '.join(full.model.signals)}: there is no noise to compare models by. "
            "Leave out the signal that contains the label."
        )
    return variance


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
    return FTest(f, numerator, denominator, f_upper(f, numerator, denominator))


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
    return FTest(f, size, degrees, f_upper(f, size, degrees))


def _numbers(fitted: Fit) -> list[Fraction]:
    return [fitted.model.intercept, *fitted.model.coefficients]
