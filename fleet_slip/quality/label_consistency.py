"""Labels that contradict those of other drives: sign, factor and zero.

In one drive the car, its tyres and the road hide a label that is half as large again. But a mapping
or a logger that changes does so for many cars at once: the median over the drives of a day shows
what no single drive does. So each drive's label is compared with the prediction by the relation of
all drives, and the medians of a day, and of a file, with those of all others.
"""

import math
from collections.abc import Iterator, Sequence
from operator import itemgetter

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import BoolArray, FloatArray, IntArray
from fleet_slip.catalog.signals import RECEIVED, SAMPLE_TIME_S, SignalCatalog
from fleet_slip.quality.checks import CHECKS, Fault
from fleet_slip.quality.drive_signals import DriveBatches, MeanMoments
from fleet_slip.quality.peers import MAD_TO_STD, QualityThresholds, solve
from fleet_slip.regression.gram import GramTable
from fleet_slip.resources import read_sql
from fleet_slip.warehouse.database import open_scratch

# Reversed labels. A few drives with a reversed label are unlike their peers. Among halves, as after
# a car was logged again with another sign, no drive is usual. But each drive follows one relation
# between the signals and the label, or its opposite. So signs and relation are estimated in turns:
# least squares over all drives with their signs, then the sign that agrees with it.

ROUNDS = 20
MIN_EXPLAINED = 0.5
"""Share of the label's variance that the relation must explain, else signs mean nothing."""


def find_reversed_labels(table: GramTable, in_order: BoolArray, label: str) -> dict[int, Fault]:
    """Return otherwise sound drives whose label contradicts that of the others, with the fault.

    The smaller group is reversed. Of two halves it is the one without the first drive: drives are
    in the order of their names, which begin with the day.
    """
    if label not in table.signals or len(table.signals) < 2 or in_order.sum() < 2:
        return {}
    drives = DriveBatches.from_table(table, in_order)
    gains = _gains(drives, table.signals.index(label))
    if gains is None:
        return {}
    return {
        int(drive): CHECKS["sign among labels"].fault(label, gain=gain)
        for drive, gain in zip(drives.rows, gains, strict=True)
        if gain < CHECKS["sign among labels"].low
    }


def _gains(drives: DriveBatches, label: int) -> FloatArray | None:
    """Return the gain of each drive's label on the common relation; None without one."""
    inputs, with_label, variances = _label_moments(drives, label)
    starts = [np.ones(len(drives)), _leading_signs(inputs.sum(axis=0), with_label)]
    fits = [_fit_signs(inputs, with_label, start) for start in starts]
    explained = [float(weights @ (signs @ with_label)) for signs, weights, _ in fits]
    signs, _, gains = fits[int(np.argmax(explained))]
    if not max(explained) > MIN_EXPLAINED * float(variances.sum()):
        return None
    majority = np.sign(signs.sum()) or signs[0]
    return np.asarray(gains * majority)


def _fit_signs(
    inputs: FloatArray, with_label: FloatArray, signs: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return signs that agree with the relation fitted with them, the relation, and the gains."""
    total = inputs.sum(axis=0)
    for _ in range(ROUNDS):
        weights = solve(total, signs @ with_label)
        gains = with_label @ weights / _predicted(inputs, weights)
        agreeing = np.where(gains < 0, -1.0, 1.0)
        if (agreeing == signs).all():
            break
        signs = agreeing
    return signs, weights, gains


def _label_moments(drives: DriveBatches, label: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return each drive's covariances of inputs, those with the label, and the label's variance."""
    covariances = drives.evaluate(MeanMoments.covariances)
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
"""Of a day or file, and of the others: a median of fewer cars shows their differences."""

OFFSET, GAIN = 0, 1
"""Columns of a drive's figures: the mean residual in counts, and the logarithm of the gain."""

MIN_GAIN = 1e-3
"""Of a label that does not follow its prediction at all, so that it has a logarithm."""


def find_odd_days(
    signals: SignalCatalog,
    table: GramTable,
    in_order: BoolArray,
    groups: Sequence[IntArray],
    cars: IntArray,
    limits: QualityThresholds,
) -> dict[int, Fault]:
    """Return the drives of days or files whose labels are unlike the others', with the fault.

    `groups` are numberings of the drives of the table, such as by day. The most unlike group is
    removed and the others are compared again. A group of more than half of the drives is usual.
    """
    label = signals.label
    if label not in table.signals or len(table.signals) < 2:
        return {}
    # The gain comes first: it decides where a group differs in both.
    scale = float(signals[label].scale)
    max_offset_rad = math.radians(CHECKS["zero of a day or file"].high)
    bounds = {GAIN: math.log(CHECKS["scale of a day or file"].high), OFFSET: max_offset_rad / scale}
    faults: dict[int, Fault] = {}
    usual = in_order.copy()
    while usual.sum() >= limits.min_drives:
        figures = _figures(DriveBatches.from_table(table, usual), table.signals.index(label))
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


def _figures(drives: DriveBatches, label: int) -> FloatArray | None:
    """Return offset and gain of each drive's label; None if the others hardly explain labels."""
    inputs, with_label, variances = _label_moments(drives, label)
    weights = solve(inputs.sum(axis=0), with_label.sum(axis=0))
    explained, predicted = with_label @ weights, _predicted(inputs, weights)
    least = np.finfo(np.float64).tiny
    if np.median(explained**2 / np.maximum(predicted * variances, least)) < MIN_EXPLAINED:
        return None
    gains = explained / predicted
    means = drives.evaluate(lambda batch: batch.matrices[:, 0, 1:])
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


# Drives of one car that overlap in time: a car drives once, so that their rows count twice.


def find_repeated(drives: pa.Table) -> dict[str, Fault]:
    """Return the fault of each drive during which another one of its car was under way.

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
