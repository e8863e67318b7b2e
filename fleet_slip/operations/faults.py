"""What every car does, whatever the cohort: its sensors move, and agree on which way it turns.

In a left turn (ISO 8855) ay, yaw rate and every steering angle are positive, and the right wheels
run faster than the left. Each of these is a witness; one that contradicts the others is reversed,
and a reversed difference of two wheels means that the two are swapped.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import count

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.catalogue.course import WITNESSES
from fleet_slip.catalogue.faults import Fault
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.regression.gram import GramTable

# Mean moments of each drive in float64, for statistics that compare drives with one another.

AT_ONCE = 2**12
"""Drives whose matrices are held at once: some 1.4 KB each."""


@dataclass(frozen=True)
class MeanMoments:
    """Mean of u u' over each drive's rows, with u = (1, counts).

    Attributes:
        signals: k names.
        matrices: shape (drives, k+1, k+1).
    """

    signals: tuple[str, ...]
    matrices: FloatArray

    @classmethod
    def of(cls, table: GramTable) -> "MeanMoments":
        """Divide the sums of a table by its rows."""
        k = len(table.signals)
        n = table.n.astype(np.float64)[:, None]
        matrices = np.ones((len(table), k + 1, k + 1))
        matrices[:, 0, 1:] = matrices[:, 1:, 0] = table.sums / n
        i, j = np.tril_indices(k)
        matrices[:, i + 1, j + 1] = matrices[:, j + 1, i + 1] = table.products / n
        return cls(table.signals, matrices)

    def __len__(self) -> int:
        """Return the number of drives."""
        return len(self.matrices)

    def position(self, signal: str) -> int:
        """Return where a signal stands in u."""
        return self.signals.index(signal) + 1

    def exchanged(self, a: str, b: str) -> "MeanMoments":
        """Return the moments as they would be with two signals exchanged."""
        order = np.arange(len(self.signals) + 1)
        i, j = self.position(a), self.position(b)
        order[[i, j]] = order[[j, i]]
        return MeanMoments(self.signals, self.matrices[:, order][:, :, order])

    def covariances(self) -> FloatArray:
        """Return the covariance matrices of the counts, shape (drives, k, k)."""
        mean = self.matrices[:, 0, 1:]
        return np.asarray(self.matrices[:, 1:, 1:] - mean[:, :, None] * mean[:, None, :])


@dataclass(frozen=True)
class DriveBatches:
    """The mean moments of some drives of a table, a batch of drives at a time.

    Attributes:
        table: Gram rows, which are half as large as the matrices.
        rows: which of them, in this order.
    """

    table: GramTable
    rows: NDArray[np.intp]

    @classmethod
    def of(cls, table: GramTable, wanted: BoolArray | None = None) -> "DriveBatches":
        """Take all drives of a table, or those of a mask."""
        return cls(table, np.arange(len(table)) if wanted is None else np.flatnonzero(wanted))

    def __len__(self) -> int:
        """Return the number of drives."""
        return len(self.rows)

    def __iter__(self) -> Iterator[MeanMoments]:
        """Yield the moments of the drives in their order."""
        for first in range(0, len(self), AT_ONCE):
            yield MeanMoments.of(self.table.take(self.rows[first : first + AT_ONCE]))

    @cached_property
    def mean(self) -> FloatArray:
        """The mean matrix, added up in the order of the drives; every drive counts the same."""
        size = len(self.table.signals) + 1
        total = np.zeros((size, size))
        for batch in self:
            total = np.concatenate([total[None], batch.matrices]).sum(axis=0)
        return np.asarray(total / len(self))

    def each(self, figures: Callable[[MeanMoments], FloatArray]) -> FloatArray:
        """Return the figures of all drives, from those of each batch, drives first."""
        return np.concatenate([figures(batch) for batch in self])


FEWEST_WITNESSES = 3

STEERING_RATIO = (0.25, 1.0)
"""Track over wheelbase is about 0.5 to 0.65 in a car; less if steering is nearer to parallel."""

UNBIASED_STEERING = 0.8
"""Part of the drives that must have such a ratio, of either sign, for its sign to mean anything:
the wheels differ by some 0.04 deg in the mean, and sensors by more."""

AGREEING, LONE = 0.8, 0.5
ONE_SIDED, TURNING_BOTH_WAYS = 0.5, 0.3
"""Mean over root mean square: a magnitude has about 0.8, a drive with bends to both sides 0.1."""


def find_implausible(table: GramTable, min_correlation: float) -> dict[int, Fault]:
    """Return the drives whose sensors contradict one another or stand still, with the fault."""
    faults: dict[int, Fault] = {}
    for first, moments in zip(count(0, AT_ONCE), DriveBatches.of(table)):
        turning = find_reversed_or_swapped(moments, min_correlation)
        found = steering_swapped(moments) | turning | find_magnitudes(moments)
        found |= axes_swapped(moments)
        faults |= {first + drive: fault for drive, fault in found.items()}
    return faults | find_stuck(table)


def find_stuck(table: GramTable) -> dict[int, Fault]:
    """Return drives in which a signal, unlike most others, never changed: its variance is 0."""
    at = [row * (row + 3) // 2 for row in range(len(table.signals))]
    squares = table.products[:, at]
    # n sum(x^2) may not fit 64 bits, the difference from sum(x)^2 is right modulo 2^64.
    constant = table.n[:, None] * squares - table.sums * table.sums == 0
    moving = constant.mean(axis=1) < 0.5
    faults = {}
    for drive in np.flatnonzero(constant.any(axis=1) & moving).tolist():
        names = tuple(np.array(table.signals)[constant[drive]].tolist())
        faults[drive] = Fault("stuck", names, "variance 0")
    return faults


def find_reversed_or_swapped(moments: MeanMoments, min_correlation: float) -> dict[int, Fault]:
    """Return the drives in which witnesses of the turning direction contradict the majority.

    A witness is reversed if the median of its correlations with the others is below
    -`min_correlation`. A drive with a majority reversed has the others reversed.
    """
    names = [name for name, parts in WITNESSES.items() if set(parts) <= set(moments.signals)]
    if len(names) < FEWEST_WITNESSES:
        return {}
    correlations = _correlations(moments, names)
    others = ~np.eye(len(names), dtype=bool)
    medians = np.stack(
        [np.median(correlations[:, i, others[i]], axis=1) for i in range(len(names))], axis=1
    )
    against = medians < -min_correlation
    return {
        int(drive): _fault(names, against[drive], medians[drive])
        for drive in np.flatnonzero(against.any(axis=1))
    }


def find_magnitudes(moments: MeanMoments) -> dict[int, Fault]:
    """Return the drives in which a signal has lost its sign, as from buses that send it apart.

    Such a witness is far from zero in the mean and hardly goes with the others, which agree with
    one another and turn to both sides.
    """
    names = [name for name, parts in WITNESSES.items() if set(parts) <= set(moments.signals)]
    if len(names) < FEWEST_WITNESSES:
        return {}
    weights = _weights(moments, names)
    m = moments.matrices
    means = m[:, 0, 1:] @ weights.T
    squares = np.diagonal(weights @ m[:, 1:, 1:] @ weights.T, axis1=1, axis2=2)
    away = np.divide(np.abs(means), np.sqrt(squares), out=np.zeros_like(means), where=squares > 0)
    agreement = np.abs(_correlations(moments, names))
    others = ~np.eye(len(names), dtype=bool)
    found = {}
    for i, name in enumerate(names):
        if len(WITNESSES[name]) == 2:
            continue
        rest = others[i]
        within = agreement[:, rest][:, :, rest]
        agree = np.median(within[:, ~np.eye(rest.sum(), dtype=bool)], axis=1) > AGREEING
        lone = agreement[:, i, rest].max(axis=1) < LONE
        signed = np.median(away[:, rest], axis=1) < TURNING_BOTH_WAYS
        for drive in np.flatnonzero(agree & lone & signed & (away[:, i] > ONE_SIDED)):
            figure = f"mean {away[drive, i]:.0%} of its size, and the others turn to both sides"
            found[int(drive)] = Fault("magnitude", tuple(WITNESSES[name]), figure)
    return found


def axes_swapped(moments: MeanMoments) -> dict[int, Fault]:
    """Return the drives in which `ax` tells the turns, and `ay` does not."""
    rest = [name for name in ("yaw_rate", "steering_wheel") if name in moments.signals]
    if not {"ax", "ay"} <= set(moments.signals) or not rest:
        return {}
    at = [moments.signals.index(name) for name in ("ax", "ay", *rest)]
    covariances = moments.covariances()[:, at][:, :, at]
    spread = np.sqrt(np.maximum(np.diagonal(covariances, axis1=1, axis2=2), 0))
    product = spread[:, :2, None] * spread[:, None, 2:]
    shared = np.abs(covariances[:, :2, 2:])
    agreement = np.divide(shared, product, out=np.zeros_like(shared), where=product > 0)
    ax, ay = agreement[:, 0].min(axis=1), agreement[:, 1].max(axis=1)
    return {
        int(drive): Fault(
            "swapped",
            ("ax", "ay"),
            f"ax goes with the turns by {ax[drive]:.2f}, ay {ay[drive]:.2f}",
        )
        for drive in np.flatnonzero((ax > AGREEING) & (ay < LONE))
    }


def steering_swapped(moments: MeanMoments) -> dict[int, Fault]:
    """Return the drives in which the outer front wheel steers more than the inner one.

    With Ackermann's geometry cot(right) - cot(left) = track / wheelbase in a left turn, so that
    the mean of left - right is about that ratio times the mean of left * right, in radians.
    `STEERING_RATIO` bounds the ratio with the sign turned: beyond it a sensor is biased instead.
    Where the sensors of many drives are, the ratio tells nothing of the others.
    """
    left, right = "steer_fl", "steer_fr"
    if not {left, right} <= set(moments.signals):
        return {}
    i, j = moments.position(left), moments.position(right)
    m, scale = moments.matrices, float(catalogue()[left].scale)
    product = m[:, i, j] * scale**2
    difference = (m[:, 0, i] - m[:, 0, j]) * scale
    ratio = np.divide(difference, product, out=np.zeros_like(product), where=product > 0)
    low, high = STEERING_RATIO
    if ((np.abs(ratio) > low) & (np.abs(ratio) < high)).mean() < UNBIASED_STEERING:
        return {}
    return {
        int(drive): Fault(
            "swapped", (left, right), f"inner wheel over outer {ratio[drive]:+.2f}, not +0.5"
        )
        for drive in np.flatnonzero((-ratio > low) & (-ratio < high))
    }


def _weights(moments: MeanMoments, names: Sequence[str]) -> FloatArray:
    weights = np.zeros((len(names), len(moments.signals)))
    for row, name in enumerate(names):
        for signal, weight in WITNESSES[name].items():
            weights[row, moments.signals.index(signal)] = weight
    return weights


def _correlations(moments: MeanMoments, names: Sequence[str]) -> FloatArray:
    weights = _weights(moments, names)
    covariances = weights @ moments.covariances() @ weights.T
    spread = np.sqrt(np.maximum(np.diagonal(covariances, axis1=1, axis2=2), 0))
    product = spread[:, :, None] * spread[:, None, :]
    return np.asarray(
        np.divide(covariances, product, out=np.zeros_like(covariances), where=product > 0)
    )


def _fault(names: Sequence[str], against: BoolArray, medians: FloatArray) -> Fault:
    contrary = [name for name, yes in zip(names, against, strict=True) if yes]
    figure = f"correlation {medians[against].min():+.2f} with the other signs of turning"
    swapped = [name for name in contrary if len(WITNESSES[name]) == 2]
    if swapped and len(contrary) == len(swapped):
        return Fault("swapped", tuple(s for name in swapped for s in WITNESSES[name]), figure)
    return Fault("reversed", tuple(s for name in contrary for s in WITNESSES[name]), figure)
