"""Days and files whose labels have another factor, or another zero, than all others.

In one drive the car, its tyres and the road hide a label that is half as large again. But a mapping
or a logger that changes does so for many cars at once: the median over the drives of a day tells
what none of them does. So each drive's label is compared with what the relation of all drives
predicts, and the medians of a day, and of a file, with those of all others. Where the road is icy
or all cars are laden, medians differ as well, by less than `FACTOR` and `LEAST_OFFSET`.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from fleet_slip.arrays import BoolArray, FloatArray, IntArray
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.monitoring.float_moments import DriveBatches
from fleet_slip.monitoring.peers import MAD_TO_STD
from fleet_slip.monitoring.plausibility import Fault
from fleet_slip.monitoring.reversed_label import LEAST_EXPLAINED, label_parts, solve
from fleet_slip.monitoring.thresholds import QualityThresholds
from fleet_slip.regression.exact.gram_table import GramTable

FACTOR = 1.4
"""A label's median gain on its prediction, over that of others: 0.77 where all cars are laden."""

LEAST_OFFSET = math.radians(0.4)
"""Of a label's median residual, in rad: 0.1 deg on ice and with load."""

FEWEST_CARS = 4

OFFSET, GAIN = 0, 1
"""Of a drive's figures: the mean residual in counts, and the logarithm of the gain."""

LEAST_GAIN = 1e-3
"""Of a label that does not follow its prediction at all."""


@dataclass(frozen=True)
class _Difference:
    """A group of drives beside all others: medians of offset and gain, and how sure they differ."""

    own: FloatArray
    others: FloatArray
    scores: FloatArray

    @classmethod
    def of(cls, own: FloatArray, others: FloatArray, cars: Sequence[int]) -> "_Difference":
        """Compare figures, drives first, of so many cars each."""
        middles = [np.median(figures, axis=0) for figures in (own, others)]
        variance = np.zeros(2)
        for figures, middle, many in zip((own, others), middles, cars, strict=True):
            spread = MAD_TO_STD * np.median(np.abs(figures - middle), axis=0)
            variance += math.pi / 2 * spread**2 / many
        error = np.sqrt(np.maximum(variance, np.finfo(np.float64).tiny))
        return cls(middles[0], middles[1], np.abs(middles[0] - middles[1]) / error)

    def fault(self, label: str, limit: float) -> tuple[int, Fault] | None:
        """Return which figure is odd, and the fault; None if none is."""
        scale = float(catalogue()[label].scale)
        for at, least in ((GAIN, math.log(FACTOR)), (OFFSET, LEAST_OFFSET / scale)):
            difference = float(self.own[at] - self.others[at])
            if abs(difference) > least and self.scores[at] > limit:
                return at, _fault(label, at, difference, "of other days")
        return None

    def is_nearer(self, figures: FloatArray, at: int) -> BoolArray:
        """Say which drives are nearer to the group than to the others, by one figure."""
        own, others = self.own[at], self.others[at]
        return np.asarray(np.abs(figures[:, at] - own) < np.abs(figures[:, at] - others))


def find_odd_days(
    table: GramTable,
    in_order: BoolArray,
    groups: Sequence[IntArray],
    cars: IntArray,
    limits: QualityThresholds,
) -> dict[int, Fault]:
    """Return the drives of days or files whose labels are unlike the others', with the fault.

    `groups` are ways to number the drives of the table, such as by day. The most unlike group is
    taken out and the rest is judged again; a group of more than half of the drives is no odd one.
    """
    label = catalogue().label
    if label not in table.signals or len(table.signals) < 2:
        return {}
    faults: dict[int, Fault] = {}
    usual = in_order.copy()
    while usual.sum() >= limits.min_drives:
        figures = _figures(DriveBatches.of(table, usual), table.signals.index(label))
        if figures is None:
            break
        found = list(_odd(figures, [group[usual] for group in groups], cars[usual], limits.limit))
        if not found:
            rows = np.flatnonzero(usual)
            alone = _alone(figures, label, limits.limit)
            return faults | {int(rows[drive]): fault for drive, fault in alone.items()}
        _, mask, fault = max(found, key=lambda one: one[0])
        rows = np.flatnonzero(usual)[mask]
        faults |= dict.fromkeys(rows.tolist(), fault)
        usual[rows] = False
    return faults


def _figures(drives: DriveBatches, label: int) -> FloatArray | None:
    """Return offset and gain of each drive's label; None if the others hardly explain labels."""
    parts = [label_parts(batch.covariances(), label) for batch in drives]
    inputs, with_label = (np.concatenate([part[at] for part in parts]) for at in (0, 1))
    weights = solve(inputs.sum(axis=0), with_label.sum(axis=0))
    explained = with_label @ weights
    predicted, least = np.einsum("i,dij,j->d", weights, inputs, weights), np.finfo(np.float64).tiny
    variance = predicted * np.concatenate([part[2] for part in parts])
    if np.median(explained**2 / np.maximum(variance, least)) < LEAST_EXPLAINED:
        return None
    gains = explained / np.maximum(predicted, least)
    means = drives.each(lambda batch: batch.matrices[:, 0, 1:])
    offsets = means[:, label] - np.delete(means, label, axis=1) @ weights
    return np.stack([offsets, np.log(np.maximum(gains, LEAST_GAIN))], axis=1)


def _alone(figures: FloatArray, label: str, limit: float) -> dict[int, Fault]:
    """Return single drives that are far off by twice what a group may be."""
    middle = np.median(figures, axis=0)
    apart = figures - middle
    spread = MAD_TO_STD * np.median(np.abs(apart), axis=0)
    least = {OFFSET: LEAST_OFFSET / float(catalogue()[label].scale), GAIN: math.log(FACTOR)}
    return {
        int(drive): _fault(label, at, float(apart[drive, at]), "of other drives")
        for at, bound in least.items()
        for drive in np.flatnonzero(np.abs(apart[:, at]) > max(2 * bound, limit * spread[at]))
    }


def _fault(label: str, at: int, difference: float, of: str) -> Fault:
    if at == GAIN:
        return Fault("scaled", (label,), f"gain {math.exp(difference):.3f} of that {of}")
    return Fault("biased", (label,), f"offset {difference:+.1f} counts from that {of}")


def _odd(
    figures: FloatArray, groups: Sequence[IntArray], cars: IntArray, limit: float
) -> Iterator[tuple[float, BoolArray, Fault]]:
    """Yield how sure it is that a group is odd, which drives are of it, and the fault."""
    several = len(np.unique(cars)) > 1
    for numbers in groups:
        for number in np.unique(numbers):
            mask = numbers == number
            if 2 * mask.sum() > len(mask):
                continue
            many = [len(np.unique(cars[m])) if several else int(m.sum()) for m in (mask, ~mask)]
            if min(many) < FEWEST_CARS:
                continue
            unlike = _Difference.of(figures[mask], figures[~mask], many)
            if found := unlike.fault(catalogue().label, limit):
                at, fault = found
                yield float(unlike.scores[at]), mask & unlike.is_nearer(figures, at), fault
