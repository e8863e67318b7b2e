"""Signs of turning: signals that are positive in a left turn (ISO 8855) and must agree.

They are ay, yaw rate, every steering angle, and the right wheels' speed less the left wheels'. Each
is a witness. One that contradicts the others is reversed; a reversed difference of two wheels means
that the two are swapped. The checks read the moments of a drive, from its rows or its Gram row.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.quality.checks import CHECKS, Fault
from fleet_slip.quality.drive_signals import RADIUS_M, TICKS_PER_S, TRACK_M, MeanMoments, Signals

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
"""Combinations of signals that are positive in a left turn."""
AXLES = ("front wheels", "rear wheels")
MIN_WITNESSES = 3
"""In a Gram row, which includes rows of a car that stands or drives backwards."""
MIN_WHEEL_DIFFERENCE = 0.5
"""Share of track width times yaw rate, in the mean: a smaller difference of two wheels has no
sign. It is of one speed that is logged in place of four, at different delays."""
MIN_LOADING = 0.2
"""A loading nearer to zero has no clear sign."""
ROUNDING = 1e-12
"""Share of the variances of two equal signals that rounding leaves in their difference."""

MAX_STEERING_RATIO = 1.0
"""Maximum multiple of track over wheelbase: beyond it a sensor is biased."""
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
    if not len(table):
        return {}
    moments = MeanMoments.from_table(table).in_si(signals)
    faults = find_swapped_steering(moments)
    if len(_witnesses(moments).signals) >= MIN_WITNESSES:
        turning = find_reversed_or_swapped(moments, min_correlation)
        faults |= {drive: _join(several) for drive, several in turning.items()}
        faults |= find_magnitudes(moments)
    return faults | find_swapped_axes(moments) | find_constant(table)


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
    is in doubt; if there are two witnesses, both are. If at most two contradict both axles, these
    are at fault: their axes are not ISO 8855. A witness is at fault if the median of its
    correlations with the other group is below -`min_correlation`, by default the threshold of the
    check.
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


# Delays between signals of a drive, by least squares over lags, with their standard errors.
#
# The delay of a signal is the lag at which others predict it best. Its standard error is that of a
# jackknife over stretches of the drive (Efron and Tibshirani, An Introduction to the Bootstrap,
# chapter 11), which holds for signals whose noise lasts for seconds, too.

STEP = 5
"""Ticks between lags. Signals are averaged over as many: none of a car is faster."""
STEP_S = STEP / TICKS_PER_S
MAX_LAG = round(2.0 / STEP_S)
"""Steps. Sensors with filters and gateways are late by up to a second."""
MAX_STEPS = 12_000
"""Ten minutes show a delay to some milliseconds."""
BLOCKS = 10
"""Stretches of a drive that are left out one by one."""
MIN_ROWS = 400
"""Twenty seconds: a shorter manoeuvre fits at many lags."""
MIN_EXPLAINED = 0.5
"""Share of the variance that must be explained at the best lag, else the signals are unrelated."""
SMALL_S = 0.15
"""No delay below it is reported, so that its standard error is not computed."""
MIN_IMPROVEMENT = 1.5
"""Unexplained variance without a lag over that at a best lag that is not small. Less shows nothing:
the drive turns too slowly."""
PERIODIC_TOLERANCE = 0.1
"""Share of the variance by which minima may differ: on a sine every period has one."""
MAX_STANDARD_ERRORS = 4.0
"""A delay must exceed so many, for one false alarm in ten thousand drives."""


@dataclass(frozen=True)
class SignalDelay:
    """How late a signal is by others, in s, with its standard error; 0 of a small one."""

    value_s: float
    error_s: float

    def exceeds(self, limit_s: float) -> bool:
        """Return whether it is beyond a limit, and not by chance."""
        return abs(self.value_s) > max(limit_s, MAX_STANDARD_ERRORS * self.error_s)


NO_DELAY = SignalDelay(0.0, 0.0)


def estimate_delay(values: FloatArray, inputs: FloatArray, rows: BoolArray) -> SignalDelay | None:
    """Return how late values are by inputs; None if the drive does not show it.

    `inputs` has the shape (n_inputs, n_ticks); `rows` are those where the inputs are valid.
    """
    y, x = _averaged(values), _averaged(np.where(rows, inputs, np.nan))
    x = x[:, : MAX_STEPS - 2 * MAX_LAG]
    steps = x.shape[1] - 2 * MAX_LAG
    if steps < MIN_ROWS:
        return None
    x = x[:, MAX_LAG : MAX_LAG + steps]
    lags = np.arange(-MAX_LAG, MAX_LAG + 1)
    moments = _moments(y, x, lags, steps)
    total = moments.sum(axis=0)
    unexplained = _unexplained(total)
    best = _lowest(unexplained)
    if best is None or total[:, 0, 0].min() < MIN_ROWS:
        return None
    at_best = unexplained[round(best) + MAX_LAG]
    is_small = abs(best) * STEP_S <= SMALL_S
    is_clear = is_small or unexplained[MAX_LAG] >= MIN_IMPROVEMENT * at_best
    if at_best > 1 - MIN_EXPLAINED or not is_clear:
        return None
    if is_small:
        return SignalDelay(best * STEP_S, 0.0)
    without = [_lowest(_unexplained(total - block)) for block in moments]
    if None in without:
        return None
    lags_s = STEP_S * np.array(without, dtype=np.float64)
    error_s = math.sqrt((BLOCKS - 1) * float(np.mean((lags_s - lags_s.mean()) ** 2)))
    return SignalDelay(best * STEP_S, error_s)


def _averaged(values: FloatArray) -> FloatArray:
    """Return means of `STEP` ticks, along the last axis."""
    blocks = values[..., : values.shape[-1] // STEP * STEP]
    return np.asarray(blocks.reshape(*blocks.shape[:-1], -1, STEP).mean(axis=-1))


def _moments(y: FloatArray, x: FloatArray, lags: NDArray[np.intp], steps: int) -> FloatArray:
    """Return sums of products of (1, inputs, value) by block and lag."""
    size = steps // BLOCKS
    rows = BLOCKS * size
    moments = np.zeros((BLOCKS, len(lags), len(x) + 2, len(x) + 2))
    is_valid = np.asarray(np.isfinite(x[:, :rows]).all(axis=0))
    columns = np.vstack([np.ones(rows), x[:, :rows], np.zeros(rows)])
    for i, lag in enumerate(lags.tolist()):
        columns[-1] = y[MAX_LAG + lag : MAX_LAG + lag + rows]
        used = np.where(is_valid & np.isfinite(columns[-1]), columns, 0.0)
        blocks = used.reshape(len(columns), BLOCKS, size).transpose(1, 0, 2)
        moments[:, i] = blocks @ blocks.transpose(0, 2, 1)
    return moments


def _unexplained(moments: FloatArray) -> FloatArray:
    """Return the share of the value's variance that the inputs leave, by lag."""
    rows = np.maximum(moments[:, 0, 0], 1.0)[:, None]
    means = moments[:, 0, 1:] / rows
    covariances = moments[:, 1:, 1:] / rows[..., None] - means[:, :, None] * means[:, None, :]
    inputs, with_value = covariances[:, :-1, :-1], covariances[:, :-1, -1]
    variance = np.maximum(covariances[:, -1, -1], np.finfo(np.float64).tiny)
    explained = np.einsum("li,lij,lj->l", with_value, np.linalg.pinv(inputs, 1e-9), with_value)
    return np.asarray(np.clip(1 - explained / variance, 1e-9, 1.0))


def _lowest(unexplained: FloatArray) -> float | None:
    """Return the lag of the minimum next to 0 by a parabola; None at the end of the range."""
    inner, before, after = unexplained[1:-1], unexplained[:-2], unexplained[2:]
    is_low = inner <= unexplained.min() + PERIODIC_TOLERANCE
    minima = np.flatnonzero((inner <= before) & (inner <= after) & is_low) + 1
    if not minima.size:
        return None
    at = int(minima[np.argmin(np.abs(minima - MAX_LAG))])
    first, middle, last = unexplained[at - 1 : at + 2].tolist()
    curvature = first - 2 * middle + last
    shift = 0.5 * (first - last) / curvature if curvature > 0 else 0.0
    return at - MAX_LAG + shift


STEERING = {"steering_wheel", "steer", "steer_fl", "steer_fr"}
"""The car follows it, by up to half a second: it can be late, never early."""


def find_delays(signals: Signals, rows: BoolArray) -> Iterator[Fault]:
    """Compare the delays of the signs of turning with one another; yield what is late."""
    witnesses = {
        name: sum(weight * signals[part] for part, weight in parts.items())
        for name, parts in WITNESSES.items()
        if set(parts) <= set(signals)
    }
    if len(witnesses) < 2:
        return
    reference = "yaw_rate" if "yaw_rate" in witnesses else next(iter(witnesses))
    x = np.asarray(witnesses.pop(reference))[None]
    delays = {reference: NO_DELAY}
    for name, values in witnesses.items():
        if delay := estimate_delay(np.asarray(values), x, rows & np.isfinite(x[0])):
            delays[name] = delay
    if len(delays) == 2:
        second, late = list(delays.items())[1]
        check = CHECKS["delay between two signals"]
        if _is_late(second, late, check.high):
            pair = (second, reference) if late.value_s > 0 else (reference, second)
            names = [signal for name in pair for signal in WITNESSES[name]]
            yield check.fault(*names, delay_s=abs(late.value_s), error_s=late.error_s)
        return
    # All angles of the steering are one witness: its first.
    steering = [name for name in delays if name in STEERING]
    lags_s = [delay.value_s for name, delay in delays.items() if name not in steering[1:]]
    if len(lags_s) < MIN_WITNESSES:
        return
    middle = float(np.median(lags_s))
    errors = sorted(delay.error_s for delay in delays.values())
    check = CHECKS["delay of a signal"]
    for name, delay in delays.items():
        # The reference has no error of its own: use the median error of the other signals.
        late = SignalDelay(delay.value_s - middle, max(delay.error_s, errors[len(errors) // 2]))
        if _is_late(name, late, check.high):
            yield check.fault(*WITNESSES[name], delay_s=late.value_s, error_s=late.error_s)


def _is_late(name: str, delay: SignalDelay, limit_s: float) -> bool:
    return delay.exceeds(limit_s) and (name not in STEERING or delay.value_s > 0)
