"""Drives whose label has the sign turned, however many they are.

Where the label of a few drives is reversed, they are unlike their peers. Where it is that of half
of them, as after a car was logged again with another sign, there is no usual drive to be unlike.
But each drive still keeps to one relation between the signals and the label, or to its opposite. So
the sign of each drive is found together with the relation, by turns: least squares over all drives
with their signs, then the sign with which each drive agrees with it.
"""

import numpy as np

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.monitoring.float_moments import DriveBatches
from fleet_slip.monitoring.plausibility import Fault
from fleet_slip.regression.exact.gram_table import GramTable

ROUNDS = 20
LEAST_EXPLAINED = 0.5
"""Part of the label's variance that the relation must explain, else signs mean nothing."""

REVERSED_GAIN = -0.5
"""A label on its prediction: 1 in order, -1 reversed."""


def find_reversed_labels(table: GramTable, in_order: BoolArray, label: str) -> dict[int, Fault]:
    """Return the drives in order whose label contradicts that of the others, with the fault.

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
        int(drive): Fault("reversed", (label,), f"gain {gain:.3f} on what the others tell")
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


def solve(inputs: FloatArray, with_label: FloatArray) -> FloatArray:
    """Return the weights of least squares, scaled so that units do not matter."""
    scale = np.sqrt(np.maximum(np.diagonal(inputs), np.finfo(np.float64).tiny))
    solution, *_ = np.linalg.lstsq(inputs / np.outer(scale, scale), with_label / scale, rcond=1e-12)
    return np.asarray(solution / scale)
