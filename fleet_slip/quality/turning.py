"""Signs of turning: signals that are positive in a left turn (ISO 8855) and must agree.

They are ay, yaw rate, every steering angle, and the right wheels' speed less the left wheels'. Each
is a witness. One that contradicts the others is reversed; a reversed difference of two wheels means
that the two are swapped. The checks read the moments of a drive, from its rows or its Gram row.
"""

from collections.abc import Mapping, Sequence
from itertools import count
from typing import TYPE_CHECKING

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.quality.checks import CHECKS, Fault
from fleet_slip.quality.drive_signals import BATCH, RADIUS_M, TRACK_M, DriveBatches, MeanMoments

if TYPE_CHECKING:
    from fleet_slip.regression.gram import GramTable

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
MIN_WITNESSES = 3
"""In a Gram row, which includes rows of a car that stands or drives backwards."""
MIN_WHEEL_DIFFERENCE = 0.5
"""Of the track width times the yaw rate, in the mean: a smaller difference of two wheels has no
sign. It is of one speed that is logged in place of four, at different delays."""
MIN_LOADING = 0.2
"""A loading nearer to zero has no clear sign."""
ROUNDING = 1e-12
"""Share of the variances of two equal signals that rounding leaves in their difference."""

MAX_STEERING_RATIO = 1.0
"""Of track over wheelbase: beyond it a sensor is biased."""
UNBIASED_STEERING = 0.8
"""Share of drives that must have such a ratio, of either sign, for its sign to mean anything: the
wheels differ by some 0.04 deg in the mean, and sensors by more."""
MIN_AGREEMENT, MAX_LONE_CORRELATION = 0.8, 0.5
"""Correlation of witnesses that agree, and of one that has lost its sign with them."""
MIN_MEAN_RATIO, MAX_TURNING_MEAN_RATIO = 0.5, 0.3
"""Mean over root mean square: a magnitude has about 0.8, a drive with bends to both sides 0.1."""


def check_moments(
    table: "GramTable", signals: SignalCatalog, min_correlation: float
) -> dict[int, Fault]:
    """Return the drives whose signals contradict one another or stand still, with the fault."""
    faults: dict[int, Fault] = {}
    for first, batch in zip(count(0, BATCH), DriveBatches.from_table(table)):
        moments = batch.in_si(signals)
        in_batch = find_swapped_steering(moments)
        if len(_witnesses(moments).signals) >= MIN_WITNESSES:
            turning = find_reversed_or_swapped(moments, min_correlation)
            in_batch |= {drive: _join(several) for drive, several in turning.items()}
            in_batch |= find_magnitudes(moments)
        in_batch |= find_swapped_axes(moments)
        faults |= {first + drive: fault for drive, fault in in_batch.items()}
    return faults | find_constant(table)


def _join(faults: Sequence[Fault]) -> Fault:
    """Return several faults of one drive as one."""
    kind = "swapped" if all(fault.kind == "swapped" for fault in faults) else "reversed"
    return Fault(kind, tuple(s for fault in faults for s in fault.signals), faults[0].figure)


def find_constant(table: "GramTable") -> dict[int, Fault]:
    """Return drives in which a signal, unlike most others, never changed: its variance is 0."""
    at = [row * (row + 3) // 2 for row in range(len(table.signals))]
    squares = table.products[:, at]
    # n sum(x^2) may not fit 64 bits, the difference from sum(x)^2 is right modulo 2^64.
    constant = table.n[:, None] * squares - table.sums * table.sums == 0
    moving = constant.mean(axis=1) < 0.5
    names, check = np.array(table.signals), CHECKS["constant signal"]
    return {
        drive: check.fault(*names[constant[drive]].tolist(), value=": its variance is 0")
        for drive in np.flatnonzero(constant.any(axis=1) & moving).tolist()
    }


def find_reversed_or_swapped(
    moments: MeanMoments, min_correlation: float | None = None
) -> dict[int, list[Fault]]:
    """Return the drives in which witnesses of the turning direction contradict the others.

    The first principal component of their correlations divides them in two groups. The smaller one
    is in doubt; of two witnesses both are. Where no more than two contradict both axles, it is
    these: their axes are not ISO 8855. A witness is at fault if the median of its correlations with
    the other group is below -`min_correlation`, by default the threshold of the check.
    """
    witnesses = _witnesses(moments)
    names = witnesses.signals
    if len(names) < 2:
        return {}
    lowest = CHECKS["sign of turning"].low if min_correlation is None else -min_correlation
    correlations = _without_equal_wheels(witnesses)
    if len(names) == 2:
        between = correlations[:, 0, 1]
        both = [signal for name in names for signal in WITNESSES[name]]
        return {
            drive: [CHECKS["contradicting signs"].fault(*both, correlation=between[drive])]
            for drive in np.flatnonzero(between < lowest).tolist()
        }
    loadings = np.linalg.eigh(correlations)[1][:, :, -1]
    signs = np.sign(loadings.sum(axis=1))
    axles = loadings[:, [names.index(name) for name in AXLES if name in names]]
    agree = np.abs(np.where(np.abs(axles) > MIN_LOADING, np.sign(axles), 0).sum(axis=1)) == 2
    if len(names) <= 4:
        signs = np.where(agree, np.sign(axles.sum(axis=1)), signs)
    loadings *= np.where(signs == 0, 1, signs)[:, None]
    faults: dict[int, list[Fault]] = {}
    for drive, i in np.argwhere(loadings < -MIN_LOADING).tolist():
        opposed = correlations[drive, i, loadings[drive] > MIN_LOADING]
        if not opposed.size or np.median(opposed) > lowest:
            continue
        signals, correlation = WITNESSES[names[i]], float(np.median(opposed))
        if len(signals) == 1:
            fault = CHECKS["sign of turning"].fault(*signals, correlation=correlation)
        else:
            hint = " If all others are positive to the right (SAE J670), negate these."
            fault = CHECKS["left and right wheel"].fault(
                *signals, correlation=correlation, others=hint if agree[drive] else ""
            )
        faults.setdefault(drive, []).append(fault)
    return faults


def find_magnitudes(moments: MeanMoments) -> dict[int, Fault]:
    """Return the drives in which a signal has lost its sign, which some buses send separately.

    The mean of such a witness is far from zero. It hardly correlates with the others, which agree
    with one another and turn to both sides.
    """
    witnesses = _witnesses(moments)
    names, m = witnesses.signals, witnesses.matrices
    means, squares = m[:, 0, 1:], np.diagonal(m, axis1=1, axis2=2)[:, 1:]
    away = np.divide(np.abs(means), np.sqrt(squares), out=np.zeros_like(means), where=squares > 0)
    agreement = np.abs(witnesses.correlations())
    is_peer = ~np.eye(len(names), dtype=bool)
    faults = {}
    for i, name in enumerate(names):
        if len(WITNESSES[name]) == 2:
            continue
        peers = is_peer[i]
        within = agreement[:, peers][:, :, peers]
        agree = np.median(within[:, ~np.eye(peers.sum(), dtype=bool)], axis=1) > MIN_AGREEMENT
        lone = agreement[:, i, peers].max(axis=1) < MAX_LONE_CORRELATION
        signed = np.median(away[:, peers], axis=1) < MAX_TURNING_MEAN_RATIO
        for drive in np.flatnonzero(agree & lone & signed & (away[:, i] > MIN_MEAN_RATIO)).tolist():
            evidence = f"mean {away[drive, i]:.0%} of its size, and the others turn to both sides"
            faults[drive] = CHECKS["lost sign"].fault(*WITNESSES[name], evidence=evidence)
    return faults


def find_swapped_axes(moments: MeanMoments) -> dict[int, Fault]:
    """Return the drives in which `ax` follows the turns, and `ay` does not."""
    turning = [name for name in ("yaw_rate", "steering_wheel") if name in moments.signals]
    if not {"ax", "ay"} <= set(moments.signals) or not turning:
        return {}
    at = [moments.signals.index(name) for name in ("ax", "ay", *turning)]
    agreement = np.abs(moments.correlations()[:, at][:, :2, at[2:]])
    ax, ay = agreement[:, 0].min(axis=1), agreement[:, 1].max(axis=1)
    check = CHECKS["axes of the accelerometer"]
    return {
        drive: check.fault("ax", "ay", ax=ax[drive], ay=ay[drive])
        for drive in np.flatnonzero((ax > check.high) & (ay < check.low)).tolist()
    }


def find_swapped_steering(moments: MeanMoments) -> dict[int, Fault]:
    """Return the drives in which the outer front wheel steers more than the inner one.

    With Ackermann's geometry cot(right) - cot(left) = track / wheelbase in a left turn, so that
    the mean of left - right is about that ratio times the mean of left * right, in radians. Where
    the sensors of many drives are biased, the ratio shows nothing.
    """
    fl, fr = "steer_fl", "steer_fr"
    if not {fl, fr} <= set(moments.signals):
        return {}
    i, j = moments.position(fl), moments.position(fr)
    m = moments.matrices
    product = m[:, i, j]
    ratio = np.divide(
        m[:, 0, i] - m[:, 0, j], product, out=np.zeros_like(product), where=product > 0
    )
    low, high = -CHECKS["left and right road wheel"].low, MAX_STEERING_RATIO
    if ((np.abs(ratio) > low) & (np.abs(ratio) < high)).mean() < UNBIASED_STEERING:
        return {}
    return {
        drive: CHECKS["left and right road wheel"].fault(fl, fr, ratio=ratio[drive])
        for drive in np.flatnonzero((-ratio > low) & (-ratio < high)).tolist()
    }


def _witnesses(moments: MeanMoments) -> MeanMoments:
    """Return the moments of the witnesses that have all their signals; of equal ones the first.

    One angle of both front wheels fills three signals, and is one witness. The difference of two
    equal signals is 0, not what rounding leaves.
    """
    signals: list[str] = []
    for name in (*WITNESSES, *moments.signals):
        if name in moments.signals and not any(_are_equal(moments, name, o) for o in signals):
            signals.append(name)
    names = [name for name, parts in WITNESSES.items() if set(parts) <= set(signals)]
    weights = np.zeros((1 + len(names), 1 + len(moments.signals)))
    weights[0, 0] = 1
    for row, name in enumerate(names, start=1):
        for signal, weight in WITNESSES[name].items():
            weights[row, moments.position(signal)] = weight
    matrices = weights @ moments.matrices @ weights.T
    squares, parts_squares = (
        np.diagonal(m, axis1=1, axis2=2) for m in (matrices, moments.matrices)
    )
    differ = squares > ROUNDING * parts_squares @ (weights**2).T
    return MeanMoments(tuple(names), matrices * (differ[:, :, None] & differ[:, None, :]))


def _are_equal(moments: MeanMoments, a: str, b: str) -> bool:
    """Return True if two signals have equal products in all drives: they are one column."""
    i, j, m = moments.position(a), moments.position(b), moments.matrices
    return bool(np.array_equal(m[:, i, :], m[:, j, :]) and m[:, i, i].any())


def _without_equal_wheels(witnesses: MeanMoments) -> FloatArray:
    """Return correlations, zero for wheels whose difference is too small for the turns."""
    names, correlations = witnesses.signals, witnesses.correlations()
    if "yaw_rate" not in names:
        return correlations
    at = names.index("yaw_rate")
    shared = np.abs(witnesses.covariances()[:, at])
    expected = MIN_WHEEL_DIFFERENCE * TRACK_M / RADIUS_M * shared[:, at]
    for i in (names.index(name) for name in AXLES if name in names):
        correlations[shared[:, i] < expected, i] = 0.0
        correlations[shared[:, i] < expected, :, i] = 0.0
    return correlations
