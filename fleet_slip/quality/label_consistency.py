"""Days and files whose labels have another factor, or another zero, than all others.

In one drive the car, its tyres and the road hide a label that is half as large again. But a mapping
or a logger that changes does so for many cars at once: the median over the drives of a day shows
what none of them does. So each drive's label is compared with what the relation of all drives
predicts, and the medians of a day, and of a file, with those of all others. Where the road is icy
or all cars are laden, medians differ as well, by less than `FACTOR` and `LEAST_OFFSET`.
"""

import math
from collections.abc import Iterator, Sequence

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import BoolArray, FloatArray, IntArray
from fleet_slip.catalog.drive_sources import RECEIVED
from fleet_slip.catalog.signals import SAMPLE_TIME_S, SignalCatalog
from fleet_slip.quality.checks import Fault
from fleet_slip.quality.moments import DriveBatches
from fleet_slip.quality.peers import MAD_TO_STD, QualityThresholds, solve
from fleet_slip.regression.gram import GramTable
from fleet_slip.resources import read_sql
from fleet_slip.warehouse.database import open_scratch

# Drives whose label has the sign turned, however many they are.
#
# Where the label of a few drives is reversed, they are unlike their peers. Where it is that of
# half of them, as after a car was logged again with another sign, there is no usual drive to be
# unlike. But each drive still keeps to one relation between the signals and the label, or to its
# opposite. So the sign of each drive is found together with the relation, by turns: least squares
# over all drives with their signs, then the sign with which each drive agrees with it.

ROUNDS = 20
LEAST_EXPLAINED = 0.5
"""Part of the label's variance that the relation must explain, else signs mean nothing."""

REVERSED_GAIN = -0.5
"""A label on its prediction: 1 without a fault, -1 reversed."""


def find_reversed_labels(table: GramTable, in_order: BoolArray, label: str) -> dict[int, Fault]:
    """Return otherwise sound drives whose label contradicts that of the others, with the fault.

    The fewer drives are the reversed ones; of two halves, the one without the first drive, since
    drives come in the order of their names, which begin with the day.
    """
    if label not in table.signals or len(table.signals) < 2 or in_order.sum() < 2:
        return {}
    drives = DriveBatches.of(table, in_order)
    gains = _gains(drives, table.signals.index(label))
    if gains is None:
        return {}
    return {
        int(drive): Fault("reversed", (label,), f"gain {gain:.3f} on the prediction from others")
        for drive, gain in zip(drives.rows, gains, strict=True)
        if gain < REVERSED_GAIN
    }


def _gains(drives: DriveBatches, label: int) -> FloatArray | None:
    """Return the gain of each drive's label on the relation that most keep to; None without one."""
    parts = [label_parts(batch.covariances(), label) for batch in drives]
    inputs = sum(part[0].sum(axis=0) for part in parts)
    with_label = np.concatenate([part[1] for part in parts])
    variance = float(sum(part[2].sum() for part in parts))
    starts = [np.ones(len(drives)), _leading_signs(inputs, with_label)]
    found = [_settle(drives, label, inputs, with_label, start) for start in starts]
    explained = [float(weights @ (signs @ with_label)) for signs, weights, _ in found]
    signs, _, gains = found[int(np.argmax(explained))]
    if not max(explained) > LEAST_EXPLAINED * variance:
        return None
    majority = np.sign(signs.sum()) or signs[0]
    return np.asarray(gains * majority)


def _settle(
    drives: DriveBatches,
    label: int,
    inputs: FloatArray,
    with_label: FloatArray,
    signs: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return signs that agree with the relation that they make, the relation, and the gains."""
    for _ in range(ROUNDS):
        weights = solve(inputs, signs @ with_label)
        gains = np.concatenate([_gain(b.covariances(), label, weights) for b in drives])
        agreeing = np.where(gains < 0, -1.0, 1.0)
        if (agreeing == signs).all():
            break
        signs = agreeing
    return signs, weights, gains


def label_parts(covariances: FloatArray, label: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the covariances of the inputs, theirs with the label, and the label's variances."""
    others = np.delete(np.arange(covariances.shape[1]), label)
    inputs = covariances[:, others[:, None], others]
    return inputs, covariances[:, others, label], covariances[:, label, label]


def _gain(covariances: FloatArray, label: int, weights: FloatArray) -> FloatArray:
    inputs, with_label, _ = label_parts(covariances, label)
    predicted = np.einsum("i,dij,j->d", weights, inputs, weights)
    least = np.finfo(np.float64).tiny
    return np.asarray(with_label @ weights / np.maximum(predicted, least))


def _leading_signs(inputs: FloatArray, with_label: FloatArray) -> FloatArray:
    """Return on which side of the direction that most drives share each of them is."""
    scale = np.sqrt(np.maximum(np.diagonal(inputs), np.finfo(np.float64).tiny))
    directions = with_label / scale
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    directions = directions / np.where(lengths > 0, lengths, 1.0)
    _, vectors = np.linalg.eigh(directions.T @ directions)
    return np.where(directions @ vectors[:, -1] < 0, -1.0, 1.0)


FACTOR = 1.4
"""A label's median gain on its prediction, over that of others: 0.77 where all cars are laden."""

LEAST_OFFSET = math.radians(0.4)
"""Of a label's median residual, in rad: 0.1 deg on ice and with load."""

FEWEST_CARS = 4

OFFSET, GAIN = 0, 1
"""Of a drive's figures: the mean residual in counts, and the logarithm of the gain."""

LEAST_GAIN = 1e-3
"""Of a label that does not follow its prediction at all."""


def find_odd_days(
    signals: SignalCatalog,
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
    label = signals.label
    if label not in table.signals or len(table.signals) < 2:
        return {}
    # The gain comes first: it decides where a group differs in both.
    least = {GAIN: math.log(FACTOR), OFFSET: LEAST_OFFSET / float(signals[label].scale)}
    faults: dict[int, Fault] = {}
    usual = in_order.copy()
    while usual.sum() >= limits.min_drives:
        figures = _figures(DriveBatches.of(table, usual), table.signals.index(label))
        if figures is None:
            break
        chosen = [group[usual] for group in groups]
        found = list(_odd(figures, chosen, cars[usual], label, least, limits.limit))
        if not found:
            rows = np.flatnonzero(usual)
            alone = _alone(figures, label, least, limits.limit)
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
    means = drives.evaluate(lambda batch: batch.matrices[:, 0, 1:])
    offsets = means[:, label] - np.delete(means, label, axis=1) @ weights
    return np.stack([offsets, np.log(np.maximum(gains, LEAST_GAIN))], axis=1)


def _alone(
    figures: FloatArray, label: str, least: dict[int, float], limit: float
) -> dict[int, Fault]:
    """Return single drives that are far off by twice what a group may be."""
    apart = figures - np.median(figures, axis=0)
    spread = MAD_TO_STD * np.median(np.abs(apart), axis=0)
    found: dict[int, Fault] = {}
    for at in reversed(least):
        far = np.abs(apart[:, at]) > max(2 * least[at], limit * spread[at])
        for drive in np.flatnonzero(far).tolist():
            found[drive] = _fault(label, at, float(apart[drive, at]), "of other drives")
    return found


def _fault(label: str, at: int, difference: float, of: str) -> Fault:
    if at == GAIN:
        return Fault("scaled", (label,), f"gain {math.exp(difference):.3f} of that {of}")
    return Fault("biased", (label,), f"offset {difference:+.1f} counts from that {of}")


def _odd(
    figures: FloatArray,
    groups: Sequence[IntArray],
    cars: IntArray,
    label: str,
    least: dict[int, float],
    limit: float,
) -> Iterator[tuple[float, BoolArray, Fault]]:
    """Yield how sure it is that a group is odd, which drives are of it, and the fault.

    Medians of the group and of all others are compared, with the standard error of a median.
    """
    several = len(np.unique(cars)) > 1
    for mask in (numbers == number for numbers in groups for number in np.unique(numbers)):
        parts = mask, ~mask
        many = [len(np.unique(cars[part])) if several else int(part.sum()) for part in parts]
        if 2 * mask.sum() > len(mask) or min(many) < FEWEST_CARS:
            continue
        own, others = middles = [np.median(figures[part], axis=0) for part in parts]
        variance = np.full(2, np.finfo(np.float64).tiny)
        for part, middle, number in zip(parts, middles, many, strict=True):
            spread = MAD_TO_STD * np.median(np.abs(figures[part] - middle), axis=0)
            variance += math.pi / 2 * spread**2 / number
        scores = np.abs(own - others) / np.sqrt(variance)
        for at, difference in least.items():
            if abs(own[at] - others[at]) > difference and scores[at] > limit:
                fault = _fault(label, at, float(own[at] - others[at]), "of other days")
                to_own, to_others = (np.abs(figures[:, at] - one[at]) for one in (own, others))
                yield float(scores[at]), mask & (to_own < to_others), fault
                break


# Drives of one car that overlap in time: a car drives once, so that their rows count twice.

LEAST_OVERLAP_S = 1.0
"""Clocks of two loggers differ by less."""


def find_repeated(drives: pa.Table) -> dict[str, Fault]:
    """Return what is wrong with each drive during which another one of its car was under way.

    `drives` has the columns that `jobs/repeated_drives.sql` reads, a row or more for each drive.
    """
    given = {
        "received": RECEIVED,
        "least_s": LEAST_OVERLAP_S,
        "sample_time_s": float(SAMPLE_TIME_S),
    }
    with open_scratch() as database:
        database.register("drives", drives)
        found = database.execute(read_sql("jobs", "repeated_drives.sql"), given).fetchall()
    return {
        named: Fault("repeated", (), f"{common_s:.0f} s overlap with {other}")
        for named, common_s, other in found
    }
