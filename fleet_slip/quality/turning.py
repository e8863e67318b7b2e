"""What can be wrong with signals of a drive, and the checks of it that need no other drive.

In a left turn (ISO 8855) ay, yaw rate and every steering angle are positive, and the right wheels
run faster than the left. Each of these is a witness; one that contradicts the others is reversed,
and a reversed difference of two wheels means that the two are swapped. Ingest and publish ask this
of a drive's rows, quality and nights of its Gram row.
"""

from collections.abc import Mapping, Sequence
from itertools import count
from typing import TYPE_CHECKING

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.quality.checks import Fault
from fleet_slip.quality.moments import AT_ONCE, DriveBatches, MeanMoments

if TYPE_CHECKING:
    from fleet_slip.regression.gram import GramTable

# What no car does.

WITNESSES: Mapping[str, Mapping[str, int]] = {
    "ay": {"ay": 1},
    "yaw_rate": {"yaw_rate": 1},
    "steering_wheel": {"steering_wheel": 1},
    "steer": {"steer": 1},
    "steer_fl": {"steer_fl": 1},
    "steer_fr": {"steer_fr": 1},
    "front wheels": {"wheel_fl": -1, "wheel_fr": 1},
    "rear wheels": {"wheel_rl": -1, "wheel_rr": 1},
}
"""What is positive in a left turn, as a combination of signals."""
AXLES = ("front wheels", "rear wheels")
FEWEST_WITNESSES = 3
"""Of a Gram row, which has the rows of a car that stands or drives backwards too."""
_CLEAR = 0.2
"""A loading nearer to zero has no clear sign."""
_ROUNDING = 1e-12
"""Part of the variances of two signals that is left of their difference where they are equal."""

STEERING_RATIO = (0.25, 1.0)
"""Track over wheelbase is about 0.5 to 0.65 in a car; less if steering is nearer to parallel."""

UNBIASED_STEERING = 0.8
"""Part of the drives that must have such a ratio, of either sign, for its sign to mean anything:
the wheels differ by some 0.04 deg in the mean, and sensors by more."""

AGREEING, LONE = 0.8, 0.5
ONE_SIDED, TURNING_BOTH_WAYS = 0.5, 0.3
"""Mean over root mean square: a magnitude has about 0.8, a drive with bends to both sides 0.1."""


def find_implausible(
    table: "GramTable", signals: SignalCatalog, min_correlation: float
) -> dict[int, Fault]:
    """Return the drives whose sensors contradict one another or stand still, with the fault."""
    faults: dict[int, Fault] = {}
    for first, moments in zip(count(0, AT_ONCE), DriveBatches.of(table)):
        found = steering_swapped(moments, signals)
        if len(_witnesses(moments)) >= FEWEST_WITNESSES:
            turning = find_reversed_or_swapped(moments, min_correlation)
            found |= {drive: _joined(several) for drive, several in turning.items()}
            found |= find_magnitudes(moments)
        found |= axes_swapped(moments)
        faults |= {first + drive: fault for drive, fault in found.items()}
    return faults | find_stuck(table)


def _joined(faults: Sequence[Fault]) -> Fault:
    """Return several faults of one drive as one."""
    kind = "swapped" if all(one.kind == "swapped" for one in faults) else "reversed"
    return Fault(kind, tuple(s for one in faults for s in one.signals), faults[0].figure)


def find_stuck(table: "GramTable") -> dict[int, Fault]:
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


def find_reversed_or_swapped(
    moments: MeanMoments, min_correlation: float = 0.3
) -> dict[int, list[Fault]]:
    """Return the drives in which witnesses of the turning direction contradict the others.

    The first principal component of their correlations parts them in two; the fewer are in doubt.
    Where no more than two are against both axles, it is these: their axes are not ISO 8855. A
    witness is at fault if the median of its correlations with the others' part is below
    -`min_correlation`.
    """
    names = _witnesses(moments)
    if len(names) < 2:
        return {}
    correlations = _correlations(moments, names)
    loadings = np.linalg.eigh(correlations)[1][:, :, -1]
    signs = np.sign(loadings.sum(axis=1))
    axles = loadings[:, [names.index(name) for name in AXLES if name in names]]
    agree = np.abs(np.where(np.abs(axles) > _CLEAR, np.sign(axles), 0).sum(axis=1)) == 2
    if len(names) <= 4:
        signs = np.where(agree, np.sign(axles.sum(axis=1)), signs)
    loadings *= np.where(signs == 0, 1, signs)[:, None]
    found: dict[int, list[Fault]] = {}
    for drive, i in np.argwhere(loadings < -_CLEAR).tolist():
        others = correlations[drive, i, loadings[drive] > _CLEAR]
        if not others.size or np.median(others) > -min_correlation:
            continue
        signals = tuple(WITNESSES[names[i]])
        figure = f"correlation {np.median(others):+.2f} with the other signs of turning"
        if len(signals) == 1:
            fault = Fault("reversed", signals, figure, "Write negate = true.")
        else:
            remedy = "Swap their columns."
            if agree[drive]:
                remedy += " If all others are positive to the right (SAE J670), negate these."
            fault = Fault("swapped", signals, figure, remedy)
        found.setdefault(drive, []).append(fault)
    return found


def find_magnitudes(moments: MeanMoments) -> dict[int, Fault]:
    """Return the drives in which a signal has lost its sign, as from buses that send it apart.

    Such a witness is far from zero in the mean and hardly goes with the others, which agree with
    one another and turn to both sides.
    """
    names = _witnesses(moments)
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
    """Return the drives in which `ax` follows the turns, and `ay` does not."""
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
            f"correlation with the turns: ax {ax[drive]:.2f}, ay {ay[drive]:.2f}",
            "Swap their columns.",
        )
        for drive in np.flatnonzero((ax > AGREEING) & (ay < LONE))
    }


def steering_swapped(moments: MeanMoments, signals: SignalCatalog) -> dict[int, Fault]:
    """Return the drives in which the outer front wheel steers more than the inner one.

    With Ackermann's geometry cot(right) - cot(left) = track / wheelbase in a left turn, so that
    the mean of left - right is about that ratio times the mean of left * right, in radians.
    `STEERING_RATIO` bounds the ratio with the sign turned: beyond it a sensor is biased instead.
    Where the sensors of many drives are, the ratio says nothing of the others.
    """
    left, right = "steer_fl", "steer_fr"
    if not {left, right} <= set(moments.signals):
        return {}
    i, j = moments.position(left), moments.position(right)
    m, scale = moments.matrices, float(signals[left].scale)
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


def _witnesses(moments: MeanMoments) -> list[str]:
    """Return the witnesses of which all signals are there; of equal signals the first alone.

    One angle of both front wheels stands for three signals, and is one witness.
    """
    signals: list[str] = []
    for name in (*WITNESSES, *moments.signals):
        if name in moments.signals and not any(_are_equal(moments, name, o) for o in signals):
            signals.append(name)
    return [name for name, parts in WITNESSES.items() if set(parts) <= set(signals)]


def _are_equal(moments: MeanMoments, a: str, b: str) -> bool:
    """Whether two signals have one column: no product tells them apart, in any drive."""
    i, j, m = moments.position(a), moments.position(b), moments.matrices
    return bool(np.array_equal(m[:, i, :], m[:, j, :]) and m[:, i, i].any())


def _weights(moments: MeanMoments, names: Sequence[str]) -> FloatArray:
    weights = np.zeros((len(names), len(moments.signals)))
    for row, name in enumerate(names):
        for signal, weight in WITNESSES[name].items():
            weights[row, moments.signals.index(signal)] = weight
    return weights


def _correlations(moments: MeanMoments, names: Sequence[str]) -> FloatArray:
    weights = _weights(moments, names)
    of_signals = moments.covariances()
    covariances = weights @ of_signals @ weights.T
    variances = np.diagonal(covariances, axis1=1, axis2=2)
    summed = np.diagonal(of_signals, axis1=1, axis2=2) @ (weights**2).T
    spread = np.sqrt(np.where(variances > _ROUNDING * summed, variances, 0))
    product = spread[:, :, None] * spread[:, None, :]
    return np.asarray(
        np.divide(covariances, product, out=np.zeros_like(covariances), where=product > 0)
    )
