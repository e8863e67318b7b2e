"""The best models of every size among all 2^k subsets of the signals.

Up to `DOUBLING_LIMIT` signals, each doubles a list of moments into copies without it and with it
(Schur complement) until 2^k residual sums of squares are left, by bit mask; beyond, leaps and
bounds (Furnival and Wilson 1974). That is float64 on correlations; the best are ordered exactly.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.regression.choice.criteria import CRITERIA, subset_values
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.regression.exact.least_squares import Fit, correlation_matrix, dependence, fit
from fleet_slip.regression.inference.evidence import Evidence

DOUBLING_LIMIT = 22
"""Most signals for which all subsets are computed: 2^22 take about two seconds."""

MOST_INPUTS = 62
"""Most signals of a search: bit masks are 64-bit integers."""

_SPARE = 3


@dataclass(frozen=True)
class SizeResult:
    """Exact fits of the best models of one size, best first; signals in declared order."""

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

    def as_dict(self) -> dict[str, Any]:
        """Return what a JSON document needs."""
        return {
            "size": self.best.size,
            "signals": list(self.best.model.signals),
            "r_squared": self.best.r_squared,
            "gap": self.gap,
        }


def best_subsets(gram: Gram, inputs: Sequence[str], label: str, count: int = 2) -> list[SizeResult]:
    """Return the `count` best models of each size 0..k, ordered exactly; ties as declared.

    Raises `DataError` for dependence or a constant label, `QuestionError` beyond `MOST_INPUTS`.
    """
    relations = dependence(gram, inputs)
    if relations:
        raise DataError(relations)
    if len(inputs) > MOST_INPUTS:
        raise QuestionError(
            f"all subsets of {len(inputs)} signals are too many: give at most {MOST_INPUTS}."
        )
    part = gram.restrict([*inputs, label])
    matrix = correlation_matrix(part)
    if matrix[-1, -1] == 0:
        raise DataError(f"{label} is constant: there is nothing to explain.")
    found = candidates(matrix, count + _SPARE)
    return [_exact_best(part, inputs, label, masks, count) for masks in found]


def pick_sizes(results: Sequence[SizeResult], evidence: Evidence) -> dict[str, int]:
    """Return the size that each criterion picks; the evidence is that of the full model."""
    rss = np.array([float(result.best.rss) for result in results])
    size = np.arange(len(results), dtype=np.float64)
    return {name: int(np.argmin(subset_values(name, evidence, rss, size))) for name in CRITERIA}


def candidates(matrix: FloatArray, count: int) -> list[list[int]]:
    """Return bit masks of the `count` best subsets of each size, by float64 RSS."""
    k = len(matrix) - 1
    if k > DOUBLING_LIMIT:
        # Compiled code, whose library takes longer to start than most selections.
        from fleet_slip.regression.choice.leaps import best_by_leaps  # noqa: PLC0415

        return best_by_leaps(matrix, count)
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
    """Return the RSS of all 2^k subsets of moments, label last; element m has the bits of m."""
    work: FloatArray = np.asarray(matrix, dtype=np.float64)[:, :, None]
    # Signals are taken from the last to the first, so that the first ends in the lowest bit.
    # The label moves to the front, out of the way.
    order = [len(matrix) - 1, *range(len(matrix) - 1)]
    work = work[np.ix_(order, order)]
    while len(work) > 1:
        row, rest = work[-1, :-1], work[:-1, :-1]
        size = len(rest)
        doubled = np.empty((size, size, 2 * work.shape[2]))
        doubled[:, :, 0::2] = rest
        scaled = row / work[-1, -1]
        for i in range(size):
            doubled[i, : i + 1, 1::2] = rest[i, : i + 1] - scaled[i] * row[: i + 1]
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
