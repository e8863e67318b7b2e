"""Selection criteria: each is a value per model, and the smallest wins.

All are written in the excess x = (RSS - RSS_full) / sigma^2 of a model with j of k signals, so that
the same formulas serve nested models and subsets, naive and effective numbers of rows n. Constants
that all models share are left out. With nu = n - k - 1, RSS / RSS_full = 1 + x / nu.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import QuestionError
from fleet_slip.regression.exact.special import normal_cdf, normal_density
from fleet_slip.regression.inference.evidence import Evidence


@dataclass(frozen=True)
class Problem:
    """What a criterion looks at: x and j of each model, n (effective) rows, k inputs."""

    excess: FloatArray
    size: FloatArray
    rows: float
    inputs: int

    @property
    def log_rss(self) -> FloatArray:
        """ln(RSS / RSS_full)."""
        return np.asarray(np.log1p(self.excess / (self.rows - self.inputs - 1)))


def cp(problem: Problem) -> FloatArray:
    """C_p = RSS / sigma^2 - n + 2(j + 1) = x + 2j - k + 1 (Mallows 1973)."""
    return problem.excess + 2 * problem.size - problem.inputs + 1


def aic(problem: Problem) -> FloatArray:
    """AIC, sigma known: x + 2j (Akaike 1973). The same order as C_p."""
    return problem.excess + 2 * problem.size


def aic_likelihood(problem: Problem) -> FloatArray:
    """AIC, sigma unknown: n ln(RSS / n) + 2(j + 1) (Akaike 1973)."""
    return problem.rows * problem.log_rss + 2 * (problem.size + 1)


def bic(problem: Problem) -> FloatArray:
    """BIC, sigma known: x + j ln n (Schwarz 1978)."""
    return problem.excess + problem.size * math.log(problem.rows)


def bic_likelihood(problem: Problem) -> FloatArray:
    """BIC, sigma unknown: n ln(RSS / n) + (j + 1) ln n (Schwarz 1978)."""
    return problem.rows * problem.log_rss + (problem.size + 1) * math.log(problem.rows)


def ric(problem: Problem) -> FloatArray:
    """Risk inflation criterion: x + 2 j ln k (Foster and George 1994)."""
    return problem.excess + 2 * problem.size * math.log(max(problem.inputs, 1))


def cic(problem: Problem) -> FloatArray:
    """Covariance inflation criterion: x + 2 sum_{l<=j} E[Z_(l:k)^2] (Tibshirani and Knight 1999).

    Z_(l:k)^2 is the l-th largest of k squares of standard normal variables.
    """
    return problem.excess + 2 * _cumulative(expected_squares(problem.inputs))[_index(problem)]


def cic_log(problem: Problem) -> FloatArray:
    """CIC with the approximation E[Z_(l:k)^2] = 2 ln(k / l), about twice the exact penalty."""
    k = problem.inputs
    logs = tuple(2 * math.log(k / rank) for rank in range(1, k + 1))
    return problem.excess + 2 * _cumulative(logs)[_index(problem)]


def adjusted_r2(problem: Problem) -> FloatArray:
    """Adjusted R^2, to be maximised: -(RSS / (n - j - 1)) up to a factor (Theil 1961).

    Returned is ln(RSS / RSS_full) - ln(n - j - 1), whose minimum is its maximum.
    """
    return problem.log_rss - np.log(problem.rows - problem.size - 1)


CRITERIA: dict[str, Callable[[Problem], FloatArray]] = {
    "cp": cp,
    "aic": aic,
    "aic-likelihood": aic_likelihood,
    "bic": bic,
    "bic-likelihood": bic_likelihood,
    "ric": ric,
    "cic": cic,
    "cic-log": cic_log,
    "adjusted-r2": adjusted_r2,
}


def criterion_values(name: str, evidence: Evidence) -> FloatArray:
    """Return a criterion for the k+1 nested models. Raises `QuestionError` for an unknown name."""
    size = np.arange(evidence.inputs + 1, dtype=np.float64)
    return _criterion(name)(Problem(evidence.excess(), size, evidence.rows, evidence.inputs))


def subset_values(name: str, evidence: Evidence, rss: FloatArray, size: FloatArray) -> FloatArray:
    """Return a criterion for subset models, from their RSS in counts^2 and their sizes."""
    problem = Problem(evidence.excess_of(rss), size, evidence.rows, evidence.inputs)
    return _criterion(name)(problem)


def best_size(name: str, evidence: Evidence) -> int:
    """Return j of the nested model that the criterion picks; the smaller one of equals."""
    return int(np.argmin(criterion_values(name, evidence)))


@cache
def expected_squares(k: int) -> tuple[float, ...]:
    """Return E[Z_(l:k)^2] for l = 1..k, the expected order statistics of k squared normals.

    Integral of z^2 k! / ((l-1)! (k-l)!) (1-F)^(l-1) F^(k-l) dF with F = 2 Phi(z) - 1, by the
    trapezoidal rule, which converges geometrically for this integrand.
    """
    z = np.linspace(0.0, 12.0, 6001)
    inside = normal_cdf(z) - normal_cdf(-z)
    outside = 2 * normal_cdf(-z)
    weight = 2 * normal_density(z) * z**2 * (z[1] - z[0])
    result = []
    factor = float(k)
    for rank in range(1, k + 1):
        result.append(float(np.sum(factor * weight * outside ** (rank - 1) * inside ** (k - rank))))
        factor *= (k - rank) / rank
    return tuple(result)


def _criterion(name: str) -> Callable[[Problem], FloatArray]:
    try:
        return CRITERIA[name]
    except KeyError:
        known = ", ".join(CRITERIA)
        raise QuestionError(f"unknown criterion {name!r}. Known criteria: {known}.") from None


def _cumulative(values: tuple[float, ...]) -> FloatArray:
    return np.cumsum([0.0, *values])


def _index(problem: Problem) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    return problem.size.astype(np.intp)
