"""Comparisons of estimators stretch by stretch of a drive."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.comparison.evaluation.scenario_runs import EvaluatedScenario
from fleet_slip.regression.exact.special import student_t_two_sided
from fleet_slip.simulation.sensing.sensors import SAMPLE_RATE_HZ

BLOCK_S = 5.0
"""Errors of neighbouring samples depend on each other; over this time they nearly do not."""


@dataclass(frozen=True)
class ErrorDifference:
    """Whether one estimator's squared error is smaller than another's.

    Attributes:
        t: mean difference over its standard error; positive where the first is better.
        blocks: number of blocks.
        p: two-sided probability of a larger |t| if both were as good.
    """

    t: float
    blocks: int
    p: float


def mean_squares(run: EvaluatedScenario, estimator: str) -> FloatArray:
    """Return the mean squared error in deg² of each block of a drive, shape (blocks,)."""
    error = np.degrees(run.estimates[estimator] - run.drive.sideslip_rad)[run.drive.evaluated]
    size = int(BLOCK_S * SAMPLE_RATE_HZ)
    whole = len(error) // size
    squares: FloatArray = (error[: whole * size].reshape(whole, size) ** 2).mean(axis=1)
    return squares


def difference(run: EvaluatedScenario, first: str, second: str) -> ErrorDifference:
    """Compare the squared errors of two estimators by a paired t test over blocks."""
    gain = mean_squares(run, second) - mean_squares(run, first)
    t = float(gain.mean() / (gain.std(ddof=1) / math.sqrt(len(gain))))
    return ErrorDifference(t, len(gain), student_t_two_sided(t, len(gain) - 1))


def blocks_won(run: EvaluatedScenario, estimators: Sequence[str]) -> dict[str, int]:
    """Return in how many blocks of a drive each estimator has the smallest squared error."""
    squares = np.stack([mean_squares(run, name) for name in estimators])
    best = np.bincount(squares.argmin(axis=0), minlength=len(estimators))
    return dict(zip(estimators, best.tolist(), strict=True))
