"""Pace regression: adaptive shrinkage of orthogonal responses (Wang 2000, Wang and Witten 2002).

The effects A_j of an order are samples from a mixture; the mixing distribution G, estimated from
all of them, says how much each one is worth. Names follow Wang: pace1 truncates the nested
sequence, pace3 selects dimensions, pace5 shrinks, by a chi-square mixture that is known; pace2,
pace4 and pace6 do the same by the one that is estimated from the very effects. eb shrinks by a
normal mixture of signed effects.
"""

from collections.abc import Callable, Sequence

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.regression.choice.signal_orders import backward
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.regression.exact.least_squares import LinearModel
from fleet_slip.regression.exact.special import normal_density
from fleet_slip.regression.shrinkage.mixture import (
    ChiSquareKernel,
    Mixture,
    NormalKernel,
    fit_mixture,
    folded_density,
    posterior,
    signed_density,
)
from fleet_slip.regression.shrinkage.orthogonal import OrthogonalResponses

Estimator = Callable[[FloatArray], FloatArray]

_NEGLIGIBLE_SQUARE = 0.5
_NEGLIGIBLE = 0.7
_CERTAIN_SQUARE = 100.0
_CERTAIN = 10.0


def shrink(gram: Gram, inputs: Sequence[str], label: str, estimator: Estimator) -> LinearModel:
    """Return the model of counts whose orthogonal responses an estimator has changed.

    The order is that of backward elimination. The constant is estimated as it is. Raises
    `DataError` for dependent signals or a label without noise.
    """
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


def pace2(a: FloatArray) -> FloatArray:
    """Do the same by the estimated mixture."""
    return pace1(a, estimate_mixture(a))


def pace3(a: FloatArray, mixture: Mixture) -> FloatArray:
    """Keep the dimensions whose expected contribution H(A) is positive."""
    return np.where(_contributions(a, mixture) > 0, a, 0.0)


def pace4(a: FloatArray) -> FloatArray:
    """Do the same by the estimated mixture."""
    return pace3(a, estimate_mixture(a))


def pace5(a: FloatArray, mixture: Mixture) -> FloatArray:
    """Shrink to the squared posterior mean of |a*|; the mixture's points are squared effects."""
    size = np.abs(a)
    roots = np.sqrt(mixture.points)
    square = np.array([float(posterior_root(mixture, x) @ roots) ** 2 for x in size])
    square = np.where(a**2 > _CERTAIN_SQUARE, a**2, square)
    return np.where(square <= _NEGLIGIBLE_SQUARE, 0.0, np.sign(a) * np.sqrt(square))


def pace6(a: FloatArray) -> FloatArray:
    """Do the same by the estimated mixture."""
    return pace5(a, estimate_mixture(a))


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
    "pace2": pace2,
    "pace4": pace4,
    "pace6": pace6,
    "eb": empirical_bayes,
}
