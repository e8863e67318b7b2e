"""Best models of every size among all 2^k subsets of the signals, and selection criteria.

Each signal doubles a list of moments into copies without it and with it (Schur complement), until
2^k residual sums of squares remain, by bit mask: float64 on correlations. The best are ordered
exactly.

A selection criterion gives a value per model, and the smallest wins.

Criteria are functions of the excess x = (RSS - RSS_full) / sigma^2 of a model with j of k signals
and of the effective rows n, without constants that all models share. With nu = n - k - 1,
RSS / RSS_full = 1 + x / nu.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray
from fleet_slip.base import Record
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.regression.gram import Gram
from fleet_slip.regression.inference import Evidence
from fleet_slip.regression.least_squares import Fit, correlation_matrix, dependence, fit


@dataclass(frozen=True)
class Problem:
    """The input of a criterion: excess and size of each model, effective rows n, k inputs."""

    excess: FloatArray
    size: FloatArray
    rows: float
    inputs: int

    @property
    def log_rss(self) -> FloatArray:
        """ln(RSS / RSS_full)."""
        return np.asarray(np.log1p(self.excess / (self.rows - self.inputs - 1)))


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
    # Adjusted R^2, to be maximised: ln(RSS / RSS_full) - ln(n - j - 1) (Theil 1961)
    "adjusted-r2": lambda p: p.log_rss - np.log(p.rows - p.size - 1),
}


def criterion_values(name: str, evidence: Evidence, rss: FloatArray | None = None) -> FloatArray:
    """Return the values of a selection criterion for k + 1 models of 0 to k signals.

    Parameters
    ----------
    name : str
        One of `CRITERIA`.
    evidence : Evidence
    rss : float array, shape (k + 1,), optional
        Residual sums of squares of the models, in counts^2. Default: the nested models.

    Returns
    -------
    float array, shape (k + 1,)
        The smallest value is the best.

    Raises
    ------
    QuestionError
        For an unknown criterion.
    """
    if name not in CRITERIA:
        raise QuestionError(f"unknown criterion {name!r}. Known criteria: {', '.join(CRITERIA)}.")
    excess = evidence.excess() if rss is None else evidence.excess_of(rss)
    size = np.arange(evidence.inputs + 1, dtype=np.float64)
    return CRITERIA[name](Problem(excess, size, evidence.rows, evidence.inputs))


def best_size(name: str, evidence: Evidence) -> int:
    """Return j of the nested model that the criterion picks; the smaller one of equals."""
    return int(np.argmin(criterion_values(name, evidence)))


MAX_SUBSET_INPUTS = 22
"""Maximum number of signals for all subsets: 2^22 take about two seconds."""

_SPARE = 3


@dataclass(frozen=True)
class SizeResult(Record):
    """Exact fits of the best models of one size, best first; signals in declared order."""

    DOCUMENT = "size=best.size signals=best.model.signals r_squared=best.r_squared gap"

    fits: tuple[Fit, ...]

    @property
    def best(self) -> Fit:
        """The best model of this size."""
        return self.fits[0]

    @property
    def gap(self) -> float | None:
        """Relative distance of the second best residual sum of squares."""
        if len(self.fits) < 2 or self.best.rss == 0:
            return None
        return float(self.fits[1].rss / self.best.rss - 1)


def best_subsets(gram: Gram, inputs: Sequence[str], label: str, count: int = 2) -> list[SizeResult]:
    """Return the best models of each size, ordered exactly; equal ones in declared order.

    Parameters
    ----------
    gram : Gram
    inputs : sequence of str
        The k signals, at most `MAX_SUBSET_INPUTS`.
    label : str
    count : int
        Number of models of each size.

    Returns
    -------
    list of SizeResult, length k + 1

    Raises
    ------
    DataError
        If inputs are linearly dependent, or the label is constant.
    QuestionError
        If there are too many inputs.
    """
    relations = dependence(gram, inputs)
    if relations:
        raise DataError(relations)
    if len(inputs) > MAX_SUBSET_INPUTS:
        raise QuestionError(
            f"all subsets of {len(inputs)} signals are too many: give at most {MAX_SUBSET_INPUTS}, "
            "or search among them with: search exchange."
        )
    part = gram.restrict([*inputs, label])
    matrix = correlation_matrix(part)
    if matrix[-1, -1] == 0:
        raise DataError(f"{label} is constant: there is nothing to explain.")
    masks_by_size = candidates(matrix, count + _SPARE)
    return [_exact_best(part, inputs, label, masks, count) for masks in masks_by_size]


def pick_sizes(results: Sequence[SizeResult], evidence: Evidence) -> dict[str, int]:
    """Return the size that each criterion chooses; the evidence is that of the full model."""
    rss = np.array([float(result.best.rss) for result in results])
    return {name: int(np.argmin(criterion_values(name, evidence, rss))) for name in CRITERIA}


def candidates(matrix: FloatArray, count: int) -> list[list[int]]:
    """Return bit masks of the `count` best subsets of each size, by float64 RSS."""
    k = len(matrix) - 1
    rss = all_rss(matrix)
    sizes = subset_sizes(k)
    result = []
    order = np.argsort(sizes, kind="stable")
    stops = np.cumsum(np.bincount(sizes, minlength=k + 1))
    for start, stop in zip([0, *stops[:-1]], stops, strict=True):
        masks = order[start:stop]
        if len(masks) > count:
            masks = masks[np.argpartition(rss[masks], count - 1)[:count]]
        result.append(masks.tolist())
    return result


def subset_sizes(k: int) -> NDArray[np.uint8]:
    """Return the number of signals of each of the 2^k bit masks."""
    return np.bitwise_count(np.arange(2**k, dtype=np.uint32))


def all_rss(matrix: FloatArray) -> FloatArray:
    """Return the residual sums of squares of all 2^k subsets.

    Parameters
    ----------
    matrix : float array, shape (k + 1, k + 1)
        Moments of the inputs and the label, which is last.

    Returns
    -------
    float array, shape (2^k,)
        Element m is that of the inputs whose bits are set in m.
    """
    work: FloatArray = np.asarray(matrix, dtype=np.float64)[:, :, None]
    # Signals are taken from the last to the first, so that the first ends in the lowest bit.
    # The label moves to the front, out of the way.
    order = [len(matrix) - 1, *range(len(matrix) - 1)]
    work = work[np.ix_(order, order)]
    while len(work) > 1:
        row, trailing = work[-1, :-1], work[:-1, :-1]
        size = len(trailing)
        doubled = np.empty((size, size, 2 * work.shape[2]))
        doubled[:, :, 0::2] = trailing
        scaled = row / work[-1, -1]
        for i in range(size):
            doubled[i, : i + 1, 1::2] = trailing[i, : i + 1] - scaled[i] * row[: i + 1]
            doubled[: i + 1, i, 1::2] = doubled[i, : i + 1, 1::2]
        work = doubled
    return np.asarray(np.maximum(work[0, 0], 0.0))


def signals_of(mask: int, inputs: Sequence[str]) -> list[str]:
    """Return the signals whose bit is set, in declared order."""
    return [name for i, name in enumerate(inputs) if mask >> i & 1]


def _exact_best(
    gram: Gram, inputs: Sequence[str], label: str, masks: Sequence[int], count: int
) -> SizeResult:
    fits = [fit(gram, signals_of(mask, inputs), label) for mask in masks]

    def rank(fitted: Fit) -> tuple[Fraction, list[int]]:
        return fitted.rss, [inputs.index(name) for name in fitted.model.signals]

    return SizeResult(tuple(sorted(fits, key=rank)[:count]))
