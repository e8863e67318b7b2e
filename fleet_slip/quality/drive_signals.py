"""The signals of one drive on a regular grid of ticks, and fits among them."""

import math
from collections.abc import Mapping
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.catalog.course import SATELLITE_SPEED
from fleet_slip.catalog.signals import SAMPLE_TIME_S, SignalCatalog

Signals: TypeAlias = Mapping[str, FloatArray]
"""Values in SI units on consecutive ticks, NaN where there is none; all of one shape (n_ticks,)."""

TICKS_PER_S = round(1 / float(SAMPLE_TIME_S))
MIN_TICKS = 200
"""Fewest ticks of a fit: 2 s."""
MOVING_MPS = 2.0
"""Below, satellite and optical sensors measure no angle, and receivers freeze the course."""
RADIUS_M, TRACK_M = 0.31, 1.55
"""Rolling radius and track width of a passenger car."""
WHEELS = ("wheel_fl", "wheel_fr", "wheel_rl", "wheel_rr")
SIGNED = ("ay", "yaw_rate", "steering_wheel", "steer", "steer_fl", "steer_fr")
"""Positive in a left turn."""
SPEEDS_OF_CAR = ("vx", "vehicle_speed", SATELLITE_SPEED)


def to_regular_grid(
    catalog: SignalCatalog, ticks: NDArray[np.int32], counts: Mapping[str, FloatArray]
) -> Signals:
    """Return counts at some ticks, NaN for none, in SI units on all ticks from the first."""
    signals = {}
    for name, values in counts.items():
        signals[name] = np.full(int(ticks[-1] - ticks[0]) + 1, np.nan)
        signals[name][ticks - ticks[0]] = values * float(catalog[name].scale)
    return signals


def wheel_speed_mps(signals: Signals) -> FloatArray | None:
    """Return the median speed of the wheels; None without wheels."""
    wheels = [signals[name] for name in WHEELS if name in signals]
    if not wheels:
        return None
    return np.asarray(np.median(wheels, axis=0) * RADIUS_M, dtype=np.float64)


def speed_mps(signals: Signals) -> FloatArray | None:
    """Return a rough speed: that of the wheels, else `vx` or the car's own; None without any."""
    wheels = wheel_speed_mps(signals)
    return signals.get("vx", signals.get("vehicle_speed")) if wheels is None else wheels


def is_moving(signals: Signals) -> BoolArray:
    """Return where any speed is above `MOVING_MPS`; everywhere without a speed.

    A speed in a wrong unit does not hide that the car drives.
    """
    speeds = [signals[name] for name in SPEEDS_OF_CAR if name in signals]
    wheels = wheel_speed_mps(signals)
    speeds += [] if wheels is None else [wheels]
    if not speeds:
        return np.ones(1, dtype=np.bool_)
    return np.asarray(np.any([np.nan_to_num(speed) > MOVING_MPS for speed in speeds], axis=0))


def slope_of(values: FloatArray, expected: FloatArray, rows: BoolArray) -> tuple[float, float]:
    """Return values over expected, by least squares about their means, and their correlation.

    Both are 0 where there is too little to judge.
    """
    (slope,), _, explained = fit(values, expected[None], rows)
    return float(slope), math.copysign(math.sqrt(max(explained, 0.0)), slope)


def fit(y: FloatArray, inputs: FloatArray, rows: BoolArray) -> tuple[FloatArray, float, float]:
    """Return coefficients of inputs, the constant, and the share of variance that they explain."""
    rows = rows & np.isfinite(y) & np.isfinite(inputs).all(axis=0)
    if rows.sum() < MIN_TICKS:
        return np.zeros(len(inputs)), 0.0, 0.0
    means, mean = inputs[:, rows].mean(axis=1), y[rows].mean()
    x, centred = inputs[:, rows] - means[:, None], y[rows] - mean
    total = float(centred @ centred)
    if not total > 0:
        return np.zeros(len(inputs)), 0.0, 0.0
    coefficients = np.linalg.lstsq(x @ x.T, x @ centred, rcond=1e-12)[0]
    residual = centred - coefficients @ x
    constant = float(mean - coefficients @ means)
    return coefficients, constant, 1 - float(residual @ residual) / total


def wrap_angle(angle: FloatArray) -> FloatArray:
    """Return the angle from -π on, below π."""
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)
