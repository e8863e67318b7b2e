"""Signals of a drive, predicted from one another, compared with other drives of its cohort.

Each signal is predicted from the others by the cohort's least squares. Three figures of a drive
describe its relation to the prediction: the mean of the residual (offset), the slope through the
origin of the signal on its prediction (gain), and the logarithm of the residual's standard
deviation (noise). Each is compared with the cohort's drives by median and median absolute
deviation, which a faulty minority does not move (Huber, Robust Statistics, 1981).

A faulty sensor also spoils the predictions of the others. It is the one without which all others
agree with theirs: structured residuals (Gertler, Fault Detection and Diagnosis in Engineering
Systems, 1998).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.config import Config, load_config
from fleet_slip.quality.checks import CHECKS, Fault
from fleet_slip.quality.drive_signals import DriveBatches, MeanMoments
from fleet_slip.regression.gram import GramTable
from fleet_slip.resources import Configs

# The thresholds of `configs/monitor.toml`.


class StatusThresholds(Config):
    """Thresholds of `status`."""

    min_free_fraction: float = Field(ge=0, lt=1)
    """Smallest free share of the disk that holds the data root."""


class QualityThresholds(Config):
    """Thresholds of `quality`.

    Attributes
    ----------
    min_rows
        Shorter drives are not checked.
    min_drives
        Smallest number of sound drives of a vehicle model to compare others with.
    min_correlation
        A sign of turning contradicts the others below minus this.
    limit
        Largest distance of a figure from the cohort's median, in standard deviations.
    offset_floor_counts, gain_floor, noise_floor
        Smallest standard deviation of the figures
        between drives; noise_floor is of the logarithm of the noise.
    max_saturated_per_row
        Largest number of values at the end of their range, per row.
    """

    min_rows: int = Field(gt=0)
    min_drives: int = Field(ge=8)
    min_correlation: float = Field(gt=0, lt=1)
    limit: float = Field(gt=0)
    offset_floor_counts: float = Field(gt=0)
    gain_floor: float = Field(gt=0)
    noise_floor: float = Field(gt=0)
    max_saturated_per_row: float = Field(gt=0)


class MonitorThresholds(Config):
    """Thresholds of `monitor`.

    Attributes
    ----------
    min_training_days
        Smallest number of days to learn usual figures from.
    false_alarms_per_day
        Probability that a usual day is beyond a figure's limits.
    """

    min_training_days: int = Field(ge=3)
    false_alarms_per_day: float = Field(gt=0, lt=0.5)


class Thresholds(Config):
    """All thresholds."""

    status: StatusThresholds
    quality: QualityThresholds
    monitor: MonitorThresholds


def thresholds(configs: Configs) -> Thresholds:
    """Return the thresholds of `monitor.toml`. Raises `ConfigError`."""
    return load_config(configs.file("monitor.toml"), Thresholds)


PAIRS = (("wheel_fl", "wheel_fr"), ("wheel_rl", "wheel_rr"), ("steer_fl", "steer_fr"))
"""Signals whose plugs may be exchanged."""

MAD_TO_STD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""

ROUNDS = 5


@dataclass(frozen=True)
class Prediction:
    """The cohort's prediction of some signals, and the figures of its drives.

    Attributes
    ----------
    targets
        Positions in u of the signals that are predicted.
    weights
        Shape (targets, k+1): the prediction is weights @ u.
    median, scale
        Of each figure over the cohort's drives, shape (targets, 3).
    """

    targets: NDArray[np.intp]
    weights: FloatArray
    median: FloatArray
    scale: FloatArray

    @classmethod
    def fit(
        cls,
        reference: DriveBatches,
        targets: Sequence[int],
        predictors: Sequence[int],
        limits: QualityThresholds,
    ) -> "Prediction":
        """Fit on sound drives; all have equal weight."""
        total = reference.mean
        at = np.array(targets, dtype=np.intp)
        weights = np.zeros((len(at), len(total)))
        for row, target in enumerate(at.tolist()):
            used = [0, *(p for p in predictors if p != target)]
            weights[row, used] = solve(total[np.ix_(used, used)], total[used, target])
        bare = cls(at, weights, np.zeros((len(at), 3)), np.ones((len(at), 3)))
        figures = reference.evaluate(bare.figures)
        median, scale = _median_and_scale(figures)
        floors = [limits.offset_floor_counts, limits.gain_floor, limits.noise_floor]
        return cls(at, weights, median, np.maximum(scale, floors))

    def figures(self, moments: MeanMoments) -> FloatArray:
        """Return offset in counts, gain and log noise of drives, shape (drives, targets, 3)."""
        m, w = moments.matrices, self.weights
        residual = -w.copy()
        residual[np.arange(len(w)), self.targets] += 1
        offset = m[:, 0] @ residual.T
        square = _quadratic(m, residual)
        with_own = np.take_along_axis(m @ w.T, self.targets[None, None, :], axis=1)[:, 0]
        predicted = np.maximum(_quadratic(m, w), np.finfo(np.float64).tiny)
        # A residual below a tenth of a count is rounding.
        noise = 0.5 * np.log(np.maximum(square - offset**2, 0.01))
        return np.stack([offset, with_own / predicted, noise], axis=2)

    def scores(self, moments: MeanMoments) -> FloatArray:
        """Return standard deviations from the median, (drives, targets, 3); above it for noise."""
        scores = (self.figures(moments) - self.median) / self.scale
        scores[:, :, :2] = np.abs(scores[:, :, :2])
        return np.asarray(scores)


@dataclass(frozen=True)
class Peers:
    """Predictions of a cohort: from all other signals, and without each of them."""

    reference: DriveBatches
    label: str
    limits: QualityThresholds

    @cached_property
    def full(self) -> Prediction:
        """Every signal, from all the others but the label."""
        return self._prediction(without=None)

    @cached_property
    def without(self) -> dict[str, Prediction]:
        """For each signal: every signal but that one, from the others but that one."""
        return {name: self._prediction(without=name) for name in self.reference.table.signals}

    def _prediction(self, without: str | None) -> Prediction:
        columns = self.reference.table.signals
        signals = [name for name in columns if name != without]

        def position(name: str) -> int:
            return columns.index(name) + 1

        return Prediction.fit(
            self.reference,
            [position(name) for name in signals],
            [position(name) for name in signals if name != self.label],
            self.limits,
        )

    def suspects(self, drives: DriveBatches) -> BoolArray:
        """Return a mask of the drives with a figure beyond the limit."""
        worst = drives.evaluate(lambda batch: self.worst(self.full, batch))
        return np.asarray(worst > self.limits.limit)

    def worst(self, prediction: Prediction, moments: MeanMoments) -> FloatArray:
        """Return the largest score of each drive."""
        return np.asarray(prediction.scores(moments).max(axis=(1, 2)))

    def explain(self, drives: DriveBatches) -> list[Fault]:
        """Return the fault of each drive: the repair that brings other figures within the limit.

        A repair exchanges two signals, or leaves one out. Without a repair the fault is
        unexplained.
        """
        return [fault for batch in drives for fault in self._explain(batch)]

    def _explain(self, moments: MeanMoments) -> list[Fault]:
        signals = moments.signals
        pairs = [pair for pair in PAIRS if set(pair) <= set(signals)]
        exchanged = [self.worst(self.full, moments.exchanged(*pair)) for pair in pairs]
        without = [self.worst(self.without[name], moments) for name in signals]
        scores = self.full.scores(moments).max(axis=2)
        figures = self.full.figures(moments)
        faults = []
        for drive in range(len(moments)):
            after = [float(worst[drive]) for worst in exchanged]
            if after and min(after) <= self.limits.limit:
                faults.append(CHECKS["exchanged signals"].fault(*pairs[int(np.argmin(after))]))
                continue
            is_explained = np.array([worst[drive] for worst in without]) <= self.limits.limit
            if not is_explained.any():
                worst = int(scores[drive].argmax())
                score = scores[drive, worst]
                faults.append(CHECKS["several signals"].fault(signals[worst], score=score))
                continue
            # The sensor that explains all others, and is itself furthest off.
            target = int(np.where(is_explained, scores[drive], -np.inf).argmax())
            faults.append(self._fault(target, drive, moments, figures))
        return faults

    def _fault(self, target: int, drive: int, moments: MeanMoments, figures: FloatArray) -> Fault:
        """Return the fault of a sensor by its repair: a sign, an offset or a factor."""
        name = moments.signals[target]
        offset, gain, log_noise = figures[drive, target]
        noise = np.exp(log_noise - self.full.median[target, 2])
        usual = np.exp(2 * self.full.median[target, 2])
        w = self.full.weights[target]
        m = moments.matrices[drive]
        square = m[target + 1, target + 1]
        if gain < CHECKS["sign among drives"].low:
            return CHECKS["sign among drives"].fault(name, gain=gain)
        without_offset = np.exp(2 * log_noise)
        without_factor = square - gain**2 * (w @ m @ w)
        max_noise = usual * np.exp(2 * self.limits.limit * self.limits.noise_floor)
        if min(without_offset, without_factor) > max_noise:
            return CHECKS["noise among drives"].fault(name, noise=noise, gain=gain)
        if without_factor < without_offset:
            return CHECKS["scale among drives"].fault(name, gain=gain)
        return CHECKS["offset among drives"].fault(name, offset=offset)


def settle(
    table: GramTable, in_order: BoolArray, label: str, limits: QualityThresholds
) -> tuple[Peers, BoolArray]:
    """Fit peers on sound drives without suspects, until these stay the same; return both."""
    suspects = ~in_order
    for _ in range(ROUNDS):
        peers = Peers(DriveBatches.from_table(table, ~suspects), label, limits)
        beyond = peers.suspects(DriveBatches.from_table(table)) | ~in_order
        if (beyond == suspects).all() or (~beyond).sum() < limits.min_drives:
            break
        suspects = beyond
    return peers, suspects & in_order


def _median_and_scale(figures: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return median and scaled MAD of each figure over the drives, one by one to save memory."""
    median, scale = np.empty(figures.shape[1:]), np.empty(figures.shape[1:])
    for at in np.ndindex(*figures.shape[1:]):
        column = figures[(slice(None), *at)]
        median[at] = np.median(column)
        scale[at] = MAD_TO_STD * np.median(np.abs(column - median[at]))
    return median, scale


def solve(inputs: FloatArray, with_label: FloatArray) -> FloatArray:
    """Return the weights of least squares, solved with scaled units."""
    scale = np.sqrt(np.maximum(np.diagonal(inputs), np.finfo(np.float64).tiny))
    solution, *_ = np.linalg.lstsq(inputs / np.outer(scale, scale), with_label / scale, rcond=1e-12)
    return np.asarray(solution / scale)


def _quadratic(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return v'Mv for each matrix and each vector."""
    return np.asarray(np.einsum("dti,ti->dt", vectors @ matrices, vectors))
