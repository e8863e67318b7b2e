"""How much each signal of an order contributes, and how much data says so.

In the orthogonal basis of a nested order, signal j has the squared length A_j in units of the
noise, and every criterion is a price on it. Neighbouring rows at 100 Hz are not independent, so the
evidence that decides is over drives.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import DataError
from fleet_slip.regression.exact.least_squares import Fit
from fleet_slip.regression.inference.drive_moments import DriveMoments
from fleet_slip.regression.inference.standard_errors import (
    cluster_scores,
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
