"""How signals of a drive go with one another: slopes, fits, a label's delay."""

from collections.abc import Sequence

import numpy as np

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.catalogue.signals import SAMPLE_TIME_S

FEWEST_TICKS = 200
MOVING_MPS = 2.0

MOST_TICKS = 20_000
FEWEST_DELAY_TICKS = 1000
MOST_LAG, FAR_LAG = 50, 150
"""A label is looked for this many ticks before and after its inputs; from the first on roughly."""
HALF_CHANGE = 25
"""The lateral velocity changes over twice so many ticks: the label's noise matters less."""
EACH = 5
"""Of what is that smooth, each fifth tick tells as much."""

LEAST_EXPLAINED = 0.6
"""Where accelerations explain less of the change of lateral velocity, they are no witness."""
LEAST_KINEMATIC_LAG, LEAST_KINEMATIC_GAIN = 5, 0.1
"""Simulated drives without a delay reach 11 ticks and .04, one of these at a time."""
LEAST_LAG, LEAST_GAIN = 3, 0.3
"""A delay explains away this part of a label's variance: a car's own lag of 0.1 s does 0.23."""


def moving(speed: FloatArray | None) -> BoolArray:
    """Return where the car drives; everywhere if its speed is not known."""
    if speed is None:
        return np.ones(1, dtype=np.bool_)
    return np.asarray(np.nan_to_num(speed) > MOVING_MPS)


def slope_of(values: FloatArray, expected: FloatArray, rows: BoolArray) -> tuple[float, float]:
    """Return values over expected, by least squares about their means, and their correlation."""
    rows = rows & np.isfinite(values) & np.isfinite(expected)
    if rows.sum() < FEWEST_TICKS:
        return 1.0, 0.0
    y, x = values[rows] - values[rows].mean(), expected[rows] - expected[rows].mean()
    xx, yy, xy = x @ x, y @ y, x @ y
    if not xx > 0 or not yy > 0:
        return 1.0, 0.0
    return float(xy / xx), float(xy / np.sqrt(xx * yy))


def fit(y: FloatArray, inputs: FloatArray, rows: BoolArray) -> tuple[FloatArray, float, float]:
    """Return coefficients of inputs, the constant, and what part of the variance they explain."""
    rows = rows & np.isfinite(y) & np.isfinite(inputs).all(axis=0)
    nothing = np.zeros(len(inputs)), 0.0, 0.0
    if rows.sum() < FEWEST_TICKS:
        return nothing
    middle, mean = inputs[:, rows].mean(axis=1), y[rows].mean()
    x, centred = inputs[:, rows] - middle[:, None], y[rows] - mean
    total = float(centred @ centred)
    if not total > 0:
        return nothing
    coefficients = np.linalg.lstsq(x @ x.T, x @ centred, rcond=1e-12)[0]
    left = centred - coefficients @ x
    constant = float(mean - coefficients @ middle)
    return coefficients, constant, 1 - float(left @ left) / total


def find_delay(
    angle_rad: FloatArray,
    ay_mps2: FloatArray,
    yaw_rate_rad_s: FloatArray,
    speed_mps: FloatArray,
    inputs: Sequence[FloatArray],
) -> tuple[float, float] | None:
    """Return the delay of a side-slip angle in s, and what part of its variance it explains away.

    All are of one shape, (n_ticks,). The lateral velocity changes with ay - yaw_rate * speed, at
    the same moment whatever car it is (Rajamani, Vehicle Dynamics and Control, eq. 2.9): where that
    can be seen, it settles the matter. Else the delay is that at which the inputs explain the angle
    best; a car that lags behind its inputs has one, too, so that it must be large. None if there is
    none to be seen.
    """
    rows = moving(speed_mps)
    if rows.sum() < FEWEST_DELAY_TICKS:
        return None
    n = min(angle_rad.size, MOST_TICKS)
    angle, speed, rows = angle_rad[:n], speed_mps[:n], np.broadcast_to(rows, angle_rad.shape)[:n]
    turning = yaw_rate_rad_s[:n] * speed
    moves = np.array([_mean(ay_mps2[:n]), _mean(turning), _mean(speed)])
    smooth = rows & (np.arange(n) % EACH == 0)
    left = _unexplained(_change(speed * np.tan(angle)), moves, smooth)
    if 1 - min(left.values()) > LEAST_EXPLAINED:
        return _judged(left, LEAST_KINEMATIC_LAG, LEAST_KINEMATIC_GAIN)
    left = _unexplained(angle, np.array([*(one[:n] for one in inputs), speed]), rows)
    return None if min(left.values()) > 1 / 2 else _judged(left, LEAST_LAG, LEAST_GAIN)


def is_in_time(angle_rad: FloatArray, course_rad: FloatArray, yaw_rate_rad_s: FloatArray) -> bool:
    """Return whether a side-slip angle changes when the course does beyond the heading."""
    n, apart = min(angle_rad.size, MOST_TICKS), 4 * HALF_CHANGE
    turned = np.cumsum(np.nan_to_num(yaw_rate_rad_s)) * float(SAMPLE_TIME_S)
    series = np.array([angle_rad, course_rad - turned, turned])[:, :n]
    changes = series[:, apart:] - series[:, :-apart]
    angle, slip = (changes[:2] + np.pi) % (2 * np.pi) - np.pi
    left = _unexplained(angle, np.array([slip, changes[2]]), np.ones(angle.size, dtype=np.bool_))
    best = min(left, key=lambda lag: left[lag])
    return 1 - left[best] > LEAST_EXPLAINED and abs(best) < LEAST_KINEMATIC_LAG


def _unexplained(label: FloatArray, inputs: FloatArray, rows: BoolArray) -> dict[int, float]:
    """Return what part of a label's variance its inputs leave, by how many ticks it is late."""
    n, m = label.size, FAR_LAG
    within = slice(m, n - m)
    some = rows & (np.arange(n) % EACH == 0)
    near = dict.fromkeys(range(-MOST_LAG, MOST_LAG + 1), rows)
    return {
        lag: 1 - fit(label[m + lag : n - m + lag], inputs[:, within], chosen[within])[2]
        for lag, chosen in (dict.fromkeys(range(-m, m + 1, EACH), some) | near).items()
    }


def _judged(
    left: dict[int, float], least_lag: int, least_gain: float
) -> tuple[float, float] | None:
    best = min(left, key=lambda lag: left[lag])
    gain = 1 - left[best] / left[0] if left[0] > 0 else 0.0
    if not least_lag <= abs(best) < FAR_LAG or gain < least_gain:
        return None
    return best * float(SAMPLE_TIME_S), gain


def _change(velocity_mps: FloatArray) -> FloatArray:
    """Return the mean rate of change around each tick, NaN at both ends."""
    change = np.full(velocity_mps.size, np.nan)
    width = 2 * HALF_CHANGE
    change[HALF_CHANGE:-HALF_CHANGE] = velocity_mps[width:] - velocity_mps[:-width]
    return change / (width * float(SAMPLE_TIME_S))


def _mean(values: FloatArray) -> FloatArray:
    """Return the mean over the same ticks."""
    width = 2 * HALF_CHANGE
    return np.convolve(values, np.ones(width) / width, "same")
