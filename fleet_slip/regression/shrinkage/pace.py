"""Pace regression: adaptive shrinkage of orthogonal responses (Wang 2000, Wang and Witten 2002).

The effects A_j of an order are samples of a mixture, whose estimated distribution G says how much
each is worth. pace1 truncates, pace3 selects, pace5 shrinks by a known chi-square mixture; pace2,
pace4, pace6 by an estimated one; eb by a normal mixture of signed effects.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import DataError
from fleet_slip.regression.choice.signal_orders import backward
from fleet_slip.regression.exact import exact_roots
from fleet_slip.regression.exact.distributions import normal_density
from fleet_slip.regression.exact.elimination import Elimination, eliminate
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.regression.exact.least_squares import LinearModel, dependence, fit_leading, moments
from fleet_slip.regression.inference.standard_errors import noise_variance
from fleet_slip.regression.shrinkage.mixture import (
    ChiSquareKernel,
    Mixture,
    NormalKernel,
    fit_mixture,
    folded_density,
    posterior,
    signed_density,
)


@dataclass(frozen=True)
class OrthogonalResponses:
    """Signed lengths a_0 of the constant, a_1..a_k along an order, in noise; A_j = a_j^2."""

    order: tuple[str, ...]
    responses: FloatArray
    gram: Gram
    triangle: Elimination

    @classmethod
    def of(cls, gram: Gram, order: Sequence[str], label: str) -> "OrthogonalResponses":
        """Rotate a Gram into an order. Raises `DataError` if dependent or without noise."""
        part = gram.restrict([*order, label])
        triangle = eliminate(moments(part))
        if triangle.singular is not None:
            raise DataError(dependence(part, order))
        variance = noise_variance(fit_leading(part, triangle, len(order)))
        if variance == 0:
            raise DataError(f"{label} has no noise around {', '.join(order)}: nothing to shrink.")
        n = part.n
        a = [exact_roots.signed_ratio(Fraction(part.sums[-1]), n * variance)]
        for t, row in enumerate(triangle.rows):
            # Row t of the Cholesky factor of n S is row / sqrt(minor_t minor_{t+1}).
            scale = n * variance * triangle.minors[t] * triangle.minors[t + 1]
            a.append(exact_roots.signed_ratio(Fraction(row[-1]), scale))
        return cls(tuple(order), np.array(a), part, triangle)

    def model(self, shrunk: FloatArray) -> LinearModel:
        """Return the model of counts whose responses are `shrunk`, shape (k+1,).

        R b = sigma a~; equations of the exact triangular system are scaled by a~_j / a_j, so that
        a~ = a is least squares exactly. Signals with a zero coefficient drop out.
        """
        factors = [
            Fraction(float(new / old)) if old else Fraction(0)
            for new, old in zip(shrunk, self.responses, strict=True)
        ]
        b = [Fraction(0)] * len(self.order)
        for i in reversed(range(len(b))):
            row = self.triangle.rows[i]
            right = row[-1] * factors[i + 1]
            right -= sum(row[j - i] * b[j] for j in range(i + 1, len(b)))
            b[i] = right / row[0]
        explained = sum(x * s for x, s in zip(b, self.gram.sums, strict=False))
        intercept = (self.gram.sums[-1] * factors[0] - explained) / self.gram.n
        used = [i for i, x in enumerate(b) if x != 0]
        return LinearModel(
            tuple(self.order[i] for i in used),
            self.gram.signals[-1],
            tuple(b[i] for i in used),
            intercept,
        )


Estimator = Callable[[FloatArray], FloatArray]

_NEGLIGIBLE_SQUARE = 0.5
_NEGLIGIBLE = 0.7
_CERTAIN_SQUARE = 100.0
_CERTAIN = 10.0


def shrink(gram: Gram, inputs: Sequence[str], label: str, estimator: Estimator) -> LinearModel:
    """Return the model whose responses, in backward order, are shrunk. Raises `DataError`."""
    basis = OrthogonalResponses.of(gram, backward(gram, inputs, label), label)
    a = basis.responses
    return basis.model(np.concatenate([a[:1], estimator(a[1:])]))


def james_stein(a: FloatArray) -> FloatArray:
    """Shrink all dimensions alike: positive part of 1 - (k - 2) / sum A (James and Stein 1961)."""
    total, excess = float(np.sum(a**2)), max(len(a) - 2, 0)
    return np.asarray(a * (1 - excess / total)) if total > excess else np.zeros_like(a)


def pace1(a: FloatArray, mixture: Mixture) -> FloatArray:
    """Keep the leading dimensions with the largest sum of expected contributions H(A)."""
    return _leading(a, _contributions(a, mixture))


def pace3(a: FloatArray, mixture: Mixture) -> FloatArray:
    """Keep the dimensions whose expected contribution H(A) is positive."""
    return np.where(_contributions(a, mixture) > 0, a, 0.0)


def pace5(a: FloatArray, mixture: Mixture) -> FloatArray:
    """Shrink to the squared posterior mean of |a*|; the mixture's points are squared effects."""
    size = np.abs(a)
    roots = np.sqrt(mixture.points)
    square = np.array([float(posterior_root(mixture, x) @ roots) ** 2 for x in size])
    square = np.where(a**2 > _CERTAIN_SQUARE, a**2, square)
    return np.where(square <= _NEGLIGIBLE_SQUARE, 0.0, np.sign(a) * np.sqrt(square))


def empirical_bayes(a: FloatArray) -> FloatArray:
    """Shrink to the posterior mean under a normal mixture (eb)."""
    mixture = fit_mixture(a, NormalKernel())
    mean = np.array([float(posterior(mixture, x, signed_density) @ mixture.points) for x in a])
    mean = np.where(np.abs(a) > _CERTAIN, a, mean)
    return np.where(np.abs(mean) <= _NEGLIGIBLE, 0.0, mean)


def _leading(a: FloatArray, contributions: FloatArray) -> FloatArray:
    total = np.concatenate([[0.0], np.cumsum(contributions)])
    kept = int(np.argmax(total))
    return np.where(np.arange(len(a)) < kept, a, 0.0)


def estimate_mixture(a: FloatArray) -> Mixture:
    """Return the mixture of squared effects that the squares of these have come from."""
    return fit_mixture(a**2, ChiSquareKernel())


def posterior_root(mixture: Mixture, size: float) -> FloatArray:
    """Return the posterior of a chi-square mixture's points given |a|."""
    root = Mixture(np.sqrt(mixture.points), mixture.weights)
    return posterior(root, size, folded_density)


def _contributions(a: FloatArray, mixture: Mixture) -> FloatArray:
    """Return H(A) = E[2 a a* - a^2 | A], the sign of a* unknown."""
    return np.asarray(2 * np.abs(a) * half_contributions(a, mixture, np.sqrt))


def half_contributions(
    a: FloatArray, mixture: Mixture, effect: Callable[[FloatArray], FloatArray]
) -> FloatArray:
    """Return int h dG / int [phi(a-m) + phi(a+m)] dG = H / (2a).

    h = (e - a/2) phi(a - m) - (e + a/2) phi(a + m), with the effect e = m by the theory.
    """
    m, e, w = np.sqrt(mixture.points), effect(mixture.points), mixture.weights
    result = []
    for x in np.abs(a):
        h = (e - x / 2) * normal_density(x - m) - (e + x / 2) * normal_density(x + m)
        result.append(float(w @ h / (w @ folded_density(x, m))))
    return np.array(result)


ESTIMATORS: dict[str, Estimator] = {
    "james-stein": james_stein,
    "pace2": lambda a: pace1(a, estimate_mixture(a)),
    "pace4": lambda a: pace3(a, estimate_mixture(a)),
    "pace6": lambda a: pace5(a, estimate_mixture(a)),
    "eb": empirical_bayes,
}
