"""Signals and labels of a drive, compared with those of other drives.

Each signal of a drive is predicted from the others by the cohort's least squares. Three figures
describe its relation to the prediction: the mean of the residual (offset), the slope through the
origin of the signal on its prediction (gain), and the logarithm of the residual's standard
deviation (noise). Each is compared with the cohort's drives by median and median absolute
deviation, which a faulty minority does not move (Huber, Robust Statistics, 1981).

A faulty sensor also spoils the predictions of other sensors. It is the sensor without which all
other signals agree with their predictions: structured residuals (Gertler, Fault Detection and
Diagnosis in Engineering Systems, 1998).
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import itemgetter

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pydantic import Field

from fleet_slip.arrays import BoolArray, FloatArray, IntArray
from fleet_slip.catalog.signals import RECEIVED, SAMPLE_TIME_S, SignalCatalog
from fleet_slip.config import Config, load_config
from fleet_slip.quality.checks import CHECKS, Fault
from fleet_slip.quality.drive_signals import MeanMoments
from fleet_slip.regression.gram import GramTable
from fleet_slip.resources import Configs, read_sql
from fleet_slip.warehouse.database import open_scratch

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
        A sign of turning contradicts the others if its correlation is below minus this value.
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
"""Pairs of signals whose plugs may be exchanged."""

MAD_TO_STD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""

ROUNDS = 5


@dataclass(frozen=True)
class Prediction:
    """The cohort's prediction of some signals, and the figures of its drives.

    Attributes
    ----------
    targets
        Positions of the predicted signals in u, see `MeanMoments`.
    weights
        Shape (targets, k+1): the prediction is weights @ u.
    median, scale
        Median and scale of each figure over the cohort's drives, shape (targets, 3).
    """

    targets: NDArray[np.intp]
    weights: FloatArray
    median: FloatArray
    scale: FloatArray

    @classmethod
    def fit(
        cls,
        reference: MeanMoments,
        targets: Sequence[int],
        predictors: Sequence[int],
        limits: QualityThresholds,
    ) -> "Prediction":
        """Fit on sound drives; all have equal weight."""
        total = reference.matrices.mean(axis=0)
        at = np.array(targets, dtype=np.intp)
        weights = np.zeros((len(at), len(total)))
        for row, target in enumerate(at.tolist()):
            used = [0, *(p for p in predictors if p != target)]
            weights[row, used] = solve(total[np.ix_(used, used)], total[used, target])
        unscaled = cls(at, weights, np.zeros((len(at), 3)), np.ones((len(at), 3)))
        figures = unscaled.figures(reference)
        median = np.median(figures, axis=0)
        scale = MAD_TO_STD * np.median(np.abs(figures - median), axis=0)
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
        """Return distances from the median in standard deviations, shape (drives, targets, 3).

        The distance of the noise has a sign.
        """
        scores = (self.figures(moments) - self.median) / self.scale
        scores[:, :, :2] = np.abs(scores[:, :, :2])
        return np.asarray(scores)

    def worst(self, moments: MeanMoments) -> FloatArray:
        """Return the largest score of each drive."""
        return np.asarray(self.scores(moments).max(axis=(1, 2)))


@dataclass(frozen=True)
class Peers:
    """Predictions of a cohort: from all other signals, and without each of them."""

    reference: MeanMoments
    label: str
    limits: QualityThresholds

    @cached_property
    def full(self) -> Prediction:
        """Prediction of every signal from all other signals but the label."""
        return self._prediction(without=None)

    @cached_property
    def without(self) -> dict[str, Prediction]:
        """For each signal, the prediction of all other signals without it."""
        return {name: self._prediction(without=name) for name in self.reference.signals}

    def _prediction(self, without: str | None) -> Prediction:
        names = [name for name in self.reference.signals if name != without]
        position = self.reference.position
        predictors = [position(name) for name in names if name != self.label]
        targets = [position(name) for name in names]
        return Prediction.fit(self.reference, targets, predictors, self.limits)

    def explain(self, moments: MeanMoments) -> list[Fault]:
        """Return the fault of each drive: the repair that brings other figures within the limit.

        A repair exchanges two signals, or leaves one out. Without a repair the fault is
        unexplained.
        """
        signals = moments.signals
        pairs = [pair for pair in PAIRS if set(pair) <= set(signals)]
        exchanged = [self.full.worst(moments.exchanged(*pair)) for pair in pairs]
        without = [self.without[name].worst(moments) for name in signals]
        scores = self.full.scores(moments).max(axis=2)
        figures = self.full.figures(moments)
        faults = []
        for drive in range(len(moments.matrices)):
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
            # The sensor with the largest score among those that explain all others.
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
    moments: MeanMoments, in_order: BoolArray, label: str, limits: QualityThresholds
) -> tuple[Peers, BoolArray]:
    """Fit peers on the drives that are not suspects, until the suspects stay the same.

    Returns the peers, and the mask of suspects among the drives `in_order`.
    """
    suspects = ~in_order
    for _ in range(ROUNDS):
        peers = Peers(moments.take(~suspects), label, limits)
        beyond = (peers.full.worst(moments) > limits.limit) | ~in_order
        if (beyond == suspects).all() or (~beyond).sum() < limits.min_drives:
            break
        suspects = beyond
    return peers, suspects & in_order


def solve(inputs: FloatArray, with_label: FloatArray) -> FloatArray:
    """Return the weights of least squares, solved with scaled units."""
    scale = np.sqrt(np.maximum(np.diagonal(inputs), np.finfo(np.float64).tiny))
    solution, *_ = np.linalg.lstsq(inputs / np.outer(scale, scale), with_label / scale, rcond=1e-12)
    return np.asarray(solution / scale)


def _quadratic(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return v'Mv for each matrix and each vector."""
    return np.asarray(np.einsum("dti,ti->dt", vectors @ matrices, vectors))


# Labels that contradict those of other drives: sign, factor and zero.
#
# In a single drive, differences of car, tyres and road hide a label that is 50 % too large. But a
# changed mapping or logger affects many cars at once, so that the median over the drives of a day
# reveals it. Each drive's label is compared with the prediction by the relation of all drives; the
# medians of a day, and of a file, are compared with those of all other drives.

# Reversed labels. A few drives with a reversed label differ from their peers. If half of the labels
# are reversed, there is no usual drive. But each drive follows one relation between the signals and
# the label, or its opposite. So signs and relation are estimated alternately: least squares over
# all drives with their signs, then the sign of each drive that agrees with it.

SIGN_ROUNDS = 20
MIN_EXPLAINED = 0.5
"""Minimum share of the label's variance that the relation explains, to judge signs."""


def find_reversed_labels(table: GramTable, in_order: BoolArray, label: str) -> dict[int, Fault]:
    """Return otherwise sound drives whose label contradicts that of the others, with the fault.

    The smaller group is reversed. If both have the same size, it is the group without the first
    drive: drives are in the order of their names, which begin with the day.
    """
    if label not in table.signals or len(table.signals) < 2 or in_order.sum() < 2:
        return {}
    drives = MeanMoments.from_table(table.take(in_order))
    gains = _gains(drives, table.signals.index(label))
    if gains is None:
        return {}
    return {
        int(drive): CHECKS["sign among labels"].fault(label, gain=gain)
        for drive, gain in zip(np.flatnonzero(in_order), gains, strict=True)
        if gain < CHECKS["sign among labels"].low
    }


def _gains(drives: MeanMoments, label: int) -> FloatArray | None:
    """Return the gain of each drive's label on the common relation; None without one."""
    inputs, with_label, variances = _label_moments(drives, label)
    total = inputs.sum(axis=0)
    signs = _leading_signs(total, with_label)
    for _ in range(SIGN_ROUNDS):
        weights = solve(total, signs @ with_label)
        gains = with_label @ weights / _predicted(inputs, weights)
        agreeing = np.where(gains < 0, -1.0, 1.0)
        if (agreeing == signs).all():
            break
        signs = agreeing
    if not weights @ (signs @ with_label) > MIN_EXPLAINED * variances.sum():
        return None
    majority = np.sign(signs.sum()) or signs[0]
    return np.asarray(gains * majority)


def _label_moments(drives: MeanMoments, label: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return each drive's covariances of inputs, those with the label, and the label's variance."""
    covariances = drives.covariances()
    at = np.delete(np.arange(covariances.shape[1]), label)
    return covariances[:, at[:, None], at], covariances[:, at, label], covariances[:, label, label]


def _predicted(inputs: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the variance of each drive's prediction."""
    variances = np.einsum("i,dij,j->d", weights, inputs, weights)
    return np.asarray(np.maximum(variances, np.finfo(np.float64).tiny))


def _leading_signs(inputs: FloatArray, with_label: FloatArray) -> FloatArray:
    """Return the sign of each drive's projection on the leading direction."""
    scale = np.sqrt(np.maximum(np.diagonal(inputs), np.finfo(np.float64).tiny))
    directions = with_label / scale
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    directions = directions / np.where(lengths > 0, lengths, 1.0)
    _, vectors = np.linalg.eigh(directions.T @ directions)
    return np.where(directions @ vectors[:, -1] < 0, -1.0, 1.0)


MIN_CARS = 4
"""Minimum number of cars of a day or file, and of the others: fewer differ in their median."""

OFFSET, GAIN = 0, 1
"""Columns of a drive's figures: the mean residual in counts, and the logarithm of the gain."""

MIN_GAIN = 1e-3
"""Gain of a label that does not follow its prediction, so that its logarithm exists."""


def find_odd_days(
    signals: SignalCatalog,
    table: GramTable,
    in_order: BoolArray,
    groups: Sequence[IntArray],
    cars: IntArray,
    limits: QualityThresholds,
) -> dict[int, Fault]:
    """Return the drives of days or files whose labels are unlike the others', with the fault.

    `groups` contains arrays with the group of each drive, such as its day. The most different group
    is removed and the others are compared again. A group of more than half of the drives is usual.
    """
    label = signals.label
    if label not in table.signals or len(table.signals) < 2:
        return {}
    # The gain comes first: it decides where a group differs in both.
    scale = float(signals[label].scale)
    max_offset_rad = math.radians(CHECKS["zero of a day or file"].high)
    bounds = {GAIN: math.log(CHECKS["scale of a day or file"].high), OFFSET: max_offset_rad / scale}
    faults: dict[int, Fault] = {}
    usual, moments = in_order.copy(), MeanMoments.from_table(table)
    while usual.sum() >= limits.min_drives:
        figures = _figures(moments.take(usual), table.signals.index(label))
        if figures is None:
            break
        chosen = [group[usual] for group in groups]
        odd = list(_odd_groups(figures, chosen, cars[usual], label, bounds, limits.limit))
        if not odd:
            rows = np.flatnonzero(usual)
            alone = _odd_drives(figures, label, bounds, limits.limit)
            return faults | {int(rows[drive]): fault for drive, fault in alone.items()}
        _, mask, fault = max(odd, key=itemgetter(0))
        rows = np.flatnonzero(usual)[mask]
        faults |= dict.fromkeys(rows.tolist(), fault)
        usual[rows] = False
    return faults


def _figures(drives: MeanMoments, label: int) -> FloatArray | None:
    """Return offset and log gain of each drive's label; None if signals hardly explain labels."""
    inputs, with_label, variances = _label_moments(drives, label)
    weights = solve(inputs.sum(axis=0), with_label.sum(axis=0))
    explained, predicted = with_label @ weights, _predicted(inputs, weights)
    least = np.finfo(np.float64).tiny
    if np.median(explained**2 / np.maximum(predicted * variances, least)) < MIN_EXPLAINED:
        return None
    gains = explained / predicted
    means = drives.matrices[:, 0, 1:]
    offsets = means[:, label] - np.delete(means, label, axis=1) @ weights
    return np.stack([offsets, np.log(np.maximum(gains, MIN_GAIN))], axis=1)


def _odd_drives(
    figures: FloatArray, label: str, bounds: dict[int, float], limit: float
) -> dict[int, Fault]:
    """Return single drives that differ by twice the bounds of a group."""
    differences = figures - np.median(figures, axis=0)
    scale = MAD_TO_STD * np.median(np.abs(differences), axis=0)
    faults: dict[int, Fault] = {}
    for column in reversed(bounds):
        is_odd = np.abs(differences[:, column]) > max(2 * bounds[column], limit * scale[column])
        for drive in np.flatnonzero(is_odd).tolist():
            faults[drive] = _fault(label, column, float(differences[drive, column]), "drives")
    return faults


def _fault(label: str, column: int, difference: float, reference: str) -> Fault:
    if column == GAIN:
        gain = math.exp(difference)
        return CHECKS["scale of a day or file"].fault(label, gain=gain, others=reference)
    return CHECKS["zero of a day or file"].fault(label, offset=difference, others=reference)


def _odd_groups(
    figures: FloatArray,
    groups: Sequence[IntArray],
    cars: IntArray,
    label: str,
    bounds: dict[int, float],
    limit: float,
) -> Iterator[tuple[float, BoolArray, Fault]]:
    """Yield the standard errors by which a group is odd, its drives, and the fault.

    Medians of the group and of all others are compared, with the standard error of a median.
    """
    has_cars = len(np.unique(cars)) > 1
    for mask in (numbers == number for numbers in groups for number in np.unique(numbers)):
        sides = mask, ~mask
        sizes = [len(np.unique(cars[side])) if has_cars else int(side.sum()) for side in sides]
        if 2 * mask.sum() > len(mask) or min(sizes) < MIN_CARS:
            continue
        medians = [np.median(figures[side], axis=0) for side in sides]
        variance = np.full(2, np.finfo(np.float64).tiny)
        for side, median, size in zip(sides, medians, sizes, strict=True):
            scale = MAD_TO_STD * np.median(np.abs(figures[side] - median), axis=0)
            variance += math.pi / 2 * scale**2 / size
        differences = medians[0] - medians[1]
        scores = np.abs(differences) / np.sqrt(variance)
        for column, bound in bounds.items():
            if abs(differences[column]) > bound and scores[column] > limit:
                fault = _fault(label, column, float(differences[column]), "days")
                to_group, to_others = (np.abs(figures[:, column] - m[column]) for m in medians)
                yield float(scores[column]), mask & (to_group < to_others), fault
                break


# Drives of one car that overlap in time: their rows count twice.


def find_repeated(drives: pa.Table) -> dict[str, Fault]:
    """Return the fault of each drive that overlaps another drive of its car in time.

    `drives` has the columns that `jobs/repeated_drives.sql` reads, a row or more for each drive.
    """
    parameters = {
        "received": RECEIVED,
        "least_s": CHECKS["drives at once"].high,
        "sample_time_s": float(SAMPLE_TIME_S),
    }
    with open_scratch() as database:
        database.register("drives", drives)
        query = read_sql("jobs", "repeated_drives.sql")
        overlaps = database.execute(query, parameters).fetchall()
    return {
        drive: CHECKS["drives at once"].fault(overlap_s=overlap_s, other=other)
        for drive, overlap_s, other in overlaps
    }
