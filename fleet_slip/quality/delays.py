"""Delays between signals of a drive, by least squares over lags, with their standard errors.

The delay of a signal is the lag at which others predict it best. Its standard error is that of a
jackknife over stretches of the drive (Efron and Tibshirani, An Introduction to the Bootstrap,
chapter 11), which holds for signals whose noise lasts for seconds, too.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.quality.checks import CHECKS, Fault
from fleet_slip.quality.drive_signals import TICKS_PER_S, Signals
from fleet_slip.quality.turning import MIN_WITNESSES, WITNESSES

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
        # The reference itself has no error; that of the others' median stands for it.
        late = SignalDelay(delay.value_s - middle, max(delay.error_s, errors[len(errors) // 2]))
        if _is_late(name, late, check.high):
            yield check.fault(*WITNESSES[name], delay_s=late.value_s, error_s=late.error_s)


def _is_late(name: str, delay: SignalDelay, limit_s: float) -> bool:
    return delay.exceeds(limit_s) and (name not in STEERING or delay.value_s > 0)
