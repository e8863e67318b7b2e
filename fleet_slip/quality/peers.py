"""How a drive's signals relate to one another, compared with the other drives of its cohort.

Each signal is predicted from the others by the cohort's own least squares. In a drive three
figures say how the signal keeps to that: the mean of the residual (offset), the slope through the
origin of the signal on its prediction (gain), and the logarithm of the residual's standard
deviation (noise). Each is compared with the cohort's drives by median and median absolute
deviation, which a faulty minority does not move (Huber, Robust Statistics, 1981).

A faulty sensor also spoils the predictions of the others. It is the one without which all the
others keep to theirs: structured residuals (Gertler, Fault Detection and Diagnosis in Engineering
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
from fleet_slip.quality.checks import Fault
from fleet_slip.quality.moments import DriveBatches, MeanMoments
from fleet_slip.regression.gram import GramTable
from fleet_slip.resources import Configs

# The thresholds of `configs/monitor.toml`.


class StatusThresholds(Config):
    """When `status` calls for attention."""

    min_free_fraction: float = Field(ge=0, lt=1)
    """Least free part of the disk that holds the data root."""


class QualityThresholds(Config):
    """When `quality` finds a drive's sensors faulty.

    Attributes:
        min_rows: shorter drives are not examined.
        min_drives: fewest drives without faults of a vehicle model to compare others with.
        min_correlation: a sign of turning contradicts the others at less than minus this.
        limit: how many spreads from the cohort's median a figure may be.
        offset_floor_counts, gain_floor, noise_floor: least spread of the figures between drives;
            noise_floor is of the logarithm of the noise.
        max_saturated_per_row: most values at the end of their range, per row.
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
    """When `monitor` calls a day an alarm.

    Attributes:
        min_training_days: fewest days to learn from what is usual.
        false_alarms_per_day: probability that a usual day is beyond a figure's limits.
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
    """The cohort's prediction of some signals, and how its drives keep to it.

    Attributes:
        targets: positions in u of the signals that are predicted.
        weights: shape (targets, k+1): the prediction is weights @ u.
        middle, spread: of each figure over the cohort's drives, shape (targets, 3).
    """

    targets: NDArray[np.intp]
    weights: FloatArray
    middle: FloatArray
    spread: FloatArray

    @classmethod
    def fit(
        cls,
        reference: DriveBatches,
        targets: Sequence[int],
        predictors: Sequence[int],
        limits: QualityThresholds,
    ) -> "Prediction":
        """Fit on drives without faults; every drive counts the same."""
        total = reference.mean
        at = np.array(targets, dtype=np.intp)
        weights = np.zeros((len(at), len(total)))
        for row, target in enumerate(at.tolist()):
            used = [0, *(p for p in predictors if p != target)]
            weights[row, used] = solve(total[np.ix_(used, used)], total[used, target])
        bare = cls(at, weights, np.zeros((len(at), 3)), np.ones((len(at), 3)))
        figures = reference.evaluate(bare.figures)
        middle, spread = _middle_and_spread(figures)
        floors = [limits.offset_floor_counts, limits.gain_floor, limits.noise_floor]
        return cls(at, weights, middle, np.maximum(spread, floors))

    def figures(self, moments: MeanMoments) -> FloatArray:
        """Return offset in counts, gain and log noise of drives, shape (drives, targets, 3)."""
        m, w = moments.matrices, self.weights
        residual = -w.copy()
        residual[np.arange(len(w)), self.targets] += 1
        offset = m[:, 0] @ residual.T
        square = _quadratic(m, residual)
        own = np.take_along_axis(m @ w.T, self.targets[None, None, :], axis=1)[:, 0]
        predicted = np.maximum(_quadratic(m, w), np.finfo(np.float64).tiny)
        # A residual below a tenth of a count is rounding.
        noise = 0.5 * np.log(np.maximum(square - offset**2, 0.01))
        return np.stack([offset, own / predicted, noise], axis=2)

    def scores(self, moments: MeanMoments) -> FloatArray:
        """Return the spreads from the middle, (drives, targets, 3); of noise upwards only."""
        scores = (self.figures(moments) - self.middle) / self.spread
        scores[:, :, :2] = np.abs(scores[:, :, :2])
        return np.asarray(scores)


@dataclass(frozen=True)
class Peers:
    """What is normal in a cohort: predictions from all other signals, and without each of them."""

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
        known = self.reference.table.signals
        signals = [name for name in known if name != without]

        def position(name: str) -> int:
            return known.index(name) + 1

        return Prediction.fit(
            self.reference,
            [position(name) for name in signals],
            [position(name) for name in signals if name != self.label],
            self.limits,
        )

    def suspects(self, drives: DriveBatches) -> BoolArray:
        """Say which drives have a figure beyond the limit."""
        worst = drives.evaluate(lambda batch: self.worst(self.full, batch))
        return np.asarray(worst > self.limits.limit)

    def worst(self, prediction: Prediction, moments: MeanMoments) -> FloatArray:
        """Return the largest score of each drive."""
        return np.asarray(prediction.scores(moments).max(axis=(1, 2)))

    def explain(self, drives: DriveBatches) -> list[Fault]:
        """Return the fault of each drive: the repair that leaves the least to explain.

        Two signals exchanged back, or one signal left out. If neither brings all other figures
        within the limit, the fault is unexplained.
        """
        return [fault for batch in drives for fault in self._explain(batch)]

    def _explain(self, moments: MeanMoments) -> list[Fault]:
        signals = moments.signals
        pairs = [pair for pair in PAIRS if set(pair) <= set(signals)]
        exchanged = [self.worst(self.full, moments.exchanged(*pair)) for pair in pairs]
        left_out = [self.worst(self.without[name], moments) for name in signals]
        scores = self.full.scores(moments)
        figures = self.full.figures(moments)
        faults = []
        for drive in range(len(moments)):
            after = [float(worst[drive]) for worst in exchanged]
            if after and min(after) <= self.limits.limit:
                pair = pairs[int(np.argmin(after))]
                faults.append(Fault("swapped", pair, "exchanged, they match other drives"))
                continue
            rest = np.array([worst[drive] for worst in left_out])
            # Of the sensors that explain all the rest, the one that is itself furthest off.
            own = np.where(rest <= self.limits.limit, scores[drive].max(axis=1), -np.inf)
            if np.isinf(own).all():
                worst = int(scores[drive].max(axis=1).argmax())
                figure = f"{scores[drive].max():.1f} spreads from the cohort"
                faults.append(Fault("unexplained", (signals[worst],), figure))
            else:
                faults.append(self._kind(int(own.argmax()), drive, moments, figures))
        return faults

    def _kind(self, target: int, drive: int, moments: MeanMoments, figures: FloatArray) -> Fault:
        """Name the fault of a sensor by what would mend it: a sign, an offset, a factor."""
        name = (moments.signals[target],)
        offset, gain, log_noise = figures[drive, target]
        noise = np.exp(log_noise - self.full.middle[target, 2])
        usual = np.exp(2 * self.full.middle[target, 2])
        w = self.full.weights[target]
        m = moments.matrices[drive]
        own = m[target + 1, target + 1]
        shifted = np.exp(2 * log_noise)
        scaled = own - gain**2 * (w @ m @ w)
        if gain < -0.5:
            return Fault("reversed", name, f"gain {gain:.3f}")
        if min(shifted, scaled) > usual * np.exp(2 * self.limits.limit * self.limits.noise_floor):
            return Fault("noisy", name, f"{noise:.1f} times the usual noise, gain {gain:.3f}")
        if scaled < shifted:
            return Fault("scaled", name, f"gain {gain:.4f}")
        return Fault("biased", name, f"offset {offset:+.1f} counts")


def settle(
    table: GramTable, in_order: BoolArray, label: str, limits: QualityThresholds
) -> tuple[Peers, BoolArray]:
    """Fit peers on plausible drives, leaving suspects out until they stay; return both."""
    suspects = ~in_order
    for _ in range(ROUNDS):
        peers = Peers(DriveBatches.of(table, ~suspects), label, limits)
        now = peers.suspects(DriveBatches.of(table)) | ~in_order
        if (now == suspects).all() or (~now).sum() < limits.min_drives:
            break
        suspects = now
    return peers, suspects & in_order


def _middle_and_spread(figures: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return median and scaled MAD of each figure over the drives, one by one: each is copied."""
    middle, spread = np.empty(figures.shape[1:]), np.empty(figures.shape[1:])
    for at in np.ndindex(*figures.shape[1:]):
        column = figures[(slice(None), *at)]
        middle[at] = np.median(column)
        spread[at] = MAD_TO_STD * np.median(np.abs(column - middle[at]))
    return middle, spread


def solve(inputs: FloatArray, with_label: FloatArray) -> FloatArray:
    """Return the weights of least squares, scaled so that units do not matter."""
    scale = np.sqrt(np.maximum(np.diagonal(inputs), np.finfo(np.float64).tiny))
    solution, *_ = np.linalg.lstsq(inputs / np.outer(scale, scale), with_label / scale, rcond=1e-12)
    return np.asarray(solution / scale)


def _quadratic(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return v'Mv for each matrix and each vector."""
    return np.asarray(np.einsum("dti,ti->dt", vectors @ matrices, vectors))
