"""Mixing distributions of normal means and of noncentral chi-squares, by minimum distance.

G is a nonnegative measure on the data that matches the mass of intervals around them (Wang 2000,
Wang and Witten 2002): w >= 0 without a constraint on the sum, lest the many absorb the few.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.regression.exact.distributions import normal_cdf, normal_density


def nonnegative_least_squares(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return x >= 0 that minimises |a x - b|, for a of shape (rows, columns)."""
    columns = a.shape[1]
    x = np.zeros(columns)
    passive = np.zeros(columns, dtype=bool)
    tolerance = 10 * np.finfo(float).eps * max(a.shape) * float(np.abs(a).sum(axis=0).max())
    for _ in range(3 * columns + 10):
        gradient = np.where(passive, -np.inf, a.T @ (b - a @ x))
        entering = int(np.argmax(gradient))
        if gradient[entering] <= tolerance:
            break
        passive[entering] = True
        x = _settle(a, b, x, passive)
    return x


def _settle(
    a: FloatArray, b: FloatArray, x: FloatArray, passive: np.ndarray[tuple[int], np.dtype[np.bool_]]
) -> FloatArray:
    """Solve for the passive variables, moving those that would go negative back to zero."""
    while passive.any():
        trial = np.zeros_like(x)
        trial[passive] = np.linalg.lstsq(a[:, passive], b, rcond=None)[0]
        negative = passive & (trial <= 0)
        if not negative.any():
            return trial
        step = float(np.min(x[negative] / (x[negative] - trial[negative])))
        x = x + step * (trial - x)
        passive &= x > 1e-15
        x = np.where(passive, x, 0.0)
    return np.zeros_like(x)


SEPARABLE = 0.05
"""Groups of points whose summed overlap is below this are fitted apart."""

_NEAR_ZERO = 0.5
"""Squared effects below this count as zero."""


@dataclass(frozen=True)
class Mixture:
    """A discrete distribution: probabilities `weights` at `points`."""

    points: FloatArray
    weights: FloatArray


class NormalKernel:
    """X ~ N(point, 1): signed effects."""

    def position(self, x: FloatArray) -> FloatArray:
        """Return where a datum is on a scale of unit noise: itself."""
        return x

    def support(self, data: FloatArray) -> FloatArray:
        """Return the candidate points of the mixing distribution, for sorted data: the data."""
        return data

    def intervals(self, data: FloatArray) -> FloatArray:
        """Return the intervals to match, (r, 2): three deviations to either side of each datum."""
        return np.concatenate(
            [np.column_stack([data, data + 3]), np.column_stack([data - 3, data])]
        )

    def cdf(self, x: FloatArray, points: FloatArray) -> FloatArray:
        """Return P(X <= x | point) = Phi(x - point), x of shape (r, 1), points of shape (m,)."""
        return normal_cdf(x - points)


@dataclass(frozen=True)
class ChiSquareKernel:
    """X ~ noncentral chi-square, one degree of freedom, noncentrality `point`.

    `reach`: how far intervals go above the data, as roots; WEKA's slip makes it 0.5.
    """

    reach: float = 3.0

    def position(self, x: FloatArray) -> FloatArray:
        """Return the root, which has unit noise."""
        return np.sqrt(x)

    def support(self, data: FloatArray) -> FloatArray:
        """Return the data that are not near zero, and zero if there are any near it."""
        zero = [0.0] if data[0] < _NEAR_ZERO else []
        return np.array([*zero, *data[data > _NEAR_ZERO]])

    def intervals(self, data: FloatArray) -> FloatArray:
        """Return an interval below and one above each datum, widths on the scale of roots."""
        root = np.sqrt(data)
        low = np.where(root - 3 < _NEAR_ZERO, 0.0, (root - 3) ** 2)
        below = np.column_stack([low, np.maximum(data, _NEAR_ZERO)])
        start = np.where(data < _NEAR_ZERO, 0.0, data)
        above = np.column_stack([start, (root + self.reach) ** 2])
        return np.concatenate([below, above])

    def cdf(self, x: FloatArray, points: FloatArray) -> FloatArray:
        """Return Phi(a - m) - Phi(-a - m), with a and m the roots of x and the point."""
        a, m = np.sqrt(x), np.sqrt(points)
        return normal_cdf(a - m) - normal_cdf(-a - m)


Kernel = NormalKernel | ChiSquareKernel
"""How data scatter around a point of the mixing distribution."""


def fit_mixture(data: FloatArray, kernel: Kernel) -> Mixture:
    """Estimate the mixing distribution of some data."""
    points, weights = [], []
    for group in separable_groups(np.sort(data), kernel):
        support, mass = _fit_group(group, kernel)
        points.append(support)
        weights.append(mass * len(group))
    total = np.concatenate(weights)
    return Mixture(np.concatenate(points), total / total.sum())


def separable_groups(data: FloatArray, kernel: Kernel) -> list[FloatArray]:
    """Cut sorted data where neither side overlaps with the nearest point of the other."""
    at = kernel.position(data)
    groups, start = [], 0
    for i in range(len(data) - 1):
        left = normal_cdf(-np.abs(at[i + 1] - at[start : i + 1])).sum()
        right = normal_cdf(-np.abs(at[i] - at[i + 1 :])).sum()
        if left < SEPARABLE and right < SEPARABLE:
            groups.append(data[start : i + 1])
            start = i + 1
    return [*groups, data[start:]]


def _fit_group(data: FloatArray, kernel: Kernel) -> tuple[FloatArray, FloatArray]:
    if len(data) == 1:
        return data, np.ones(1)
    support, intervals = kernel.support(data), kernel.intervals(data)
    low, high = intervals[:, :1], intervals[:, 1:]
    mass = kernel.cdf(high, support) - kernel.cdf(low, support)
    # The share of the data in each interval; a point on an end counts half.
    inside, on_end = (data > low) & (data < high), (data == low) | (data == high)
    weights = nonnegative_least_squares(mass, (inside + 0.5 * on_end).mean(axis=1))
    return support, weights / weights.sum()


Moment = Callable[[FloatArray, FloatArray], FloatArray]


def posterior(mixture: Mixture, x: float, density: Moment) -> FloatArray:
    """Return the probabilities of the mixture's points given a datum."""
    likely = mixture.weights * density(np.array(x), mixture.points)
    return np.asarray(likely / likely.sum())


def signed_density(a: FloatArray, m: FloatArray) -> FloatArray:
    """Return phi(a - m)."""
    return normal_density(a - m)


def folded_density(a: FloatArray, m: FloatArray) -> FloatArray:
    """Return phi(a - m) + phi(a + m), the density of |N(m, 1)| at a."""
    return normal_density(a - m) + normal_density(a + m)
