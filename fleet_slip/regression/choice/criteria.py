"""Selection criteria: each is a value per model, and the smallest wins.

All are written in the excess x = (RSS - RSS_full) / sigma^2 of a model with j of k signals, for
nested models and subsets and any effective number of rows n, less constants that models share. With
nu = n - k - 1, RSS / RSS_full = 1 + x / nu.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import QuestionError
from fleet_slip.regression.exact.distributions import normal_cdf, normal_density
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


@cache
def expected_squares(k: int) -> tuple[float, ...]:
    """Return E[Z_(l:k)^2] for l = 1..k, the expected order statistics of k squared normals.

    Integral of z^2 k! / ((l-1)! (k-l)!) (1-F)^(l-1) F^(k-l) dF, F = 2 Phi(z) - 1, by trapezia.
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


def _cic(problem: Problem, squares: Sequence[float]) -> FloatArray:
    """Return x + 2 sum_{l<=j} of squares, which are those that k chance effects have in order."""
    penalties = np.cumsum([0.0, *squares])[problem.size.astype(np.intp)]
    return np.asarray(problem.excess + 2 * penalties)


CRITERIA: dict[str, Callable[[Problem], FloatArray]] = {
    # C_p = RSS / sigma^2 - n + 2(j + 1) = x + 2j - k + 1 (Mallows 1973)
    "cp": lambda p: p.excess + 2 * p.size - p.inputs + 1,
    # Sigma known: x + 2j (Akaike 1973). The same order as C_p.
    "aic": lambda p: p.excess + 2 * p.size,
    # Sigma unknown: n ln(RSS / n) + 2(j + 1)
    "aic-likelihood": lambda p: p.rows * p.log_rss + 2 * (p.size + 1),
    # Sigma known: x + j ln n (Schwarz 1978)
    "bic": lambda p: p.excess + p.size * math.log(p.rows),
    # Sigma unknown: n ln(RSS / n) + (j + 1) ln n
    "bic-likelihood": lambda p: p.rows * p.log_rss + (p.size + 1) * math.log(p.rows),
    # Risk inflation: x + 2 j ln k (Foster and George 1994)
    "ric": lambda p: p.excess + 2 * p.size * math.log(max(p.inputs, 1)),
    # Covariance inflation: x + 2 sum_{l<=j} E[Z_(l:k)^2] (Tibshirani and Knight 1999)
    "cic": lambda p: _cic(p, expected_squares(p.inputs)),
    # The same with E[Z_(l:k)^2] = 2 ln(k / l), about twice the exact penalty
    "cic-log": lambda p: _cic(p, [2 * math.log(p.inputs / i) for i in range(1, p.inputs + 1)]),
    # Adjusted R^2, to be maximised: ln(RSS / RSS_full) - ln(n - j - 1) (Theil 1961)
    "adjusted-r2": lambda p: p.log_rss - np.log(p.rows - p.size - 1),
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


def _criterion(name: str) -> Callable[[Problem], FloatArray]:
    try:
        return CRITERIA[name]
    except KeyError:
        known = ", ".join(CRITERIA)
        raise QuestionError(f"unknown criterion {name!r}. Known criteria: {known}.") from None
