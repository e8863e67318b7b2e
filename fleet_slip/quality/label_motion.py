"""The label with the motion of the car, within one drive: size, delay, sign, scale and zero.

No other drive is needed, so that a fault of all drives shows.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.quality.checks import CHECKS, Fault
from fleet_slip.quality.drive_signals import MIN_TICKS, Signals, fit, speed_mps
from fleet_slip.quality.turning import estimate_delay

ROAD_WHEELS = ("steer_fl", "steer")
FAST_MPS, SLOW_MPS = 8.0, 20.0
"""Above the first a car hardly has a large angle; below the second it has its lever."""
GENTLE_MPS2, MIN_GENTLE_TICKS = 5.0, 500
"""Beyond, a tyre slips more than in proportion: a race car at its limit shows no lever."""
MAX_COLLINEARITY = 0.995
"""Correlation of curvature and curvature times squared speed. Below, speeds differ by 5 % and more.
At one speed ay and curvature differ by phase alone, and relaxing tyres bias the lever."""
SLIDING_M, SLIDING_RAD = 8.0, 0.15
"""No car's rear axle is so far behind; a car that often slips so much slides."""
MIN_EXPLAINED, MIN_SURE_EXPLAINED = 0.6, 0.85
"""Share of the variance that shows a sign, and one that shows a scale and a zero."""
WHEELBASE_M, MAX_WHEELBASE_SHARE = (2.0, 4.5), 0.75
"""Wheelbases of cars, and the largest share of it between centre of gravity and rear axle."""
MAX_COMPLIANCE = 0.012
"""Side-slip of the rear axle in rad per m/s²: twice that of a usual car."""

Contradiction: TypeAlias = tuple[str, Mapping[str, float]]
"""Name of a check that the label fails, and its figures."""
NONE: Contradiction = ("", {})


def check_label(
    label: str,
    signals: Signals,
    speed: FloatArray | None,
    moving: BoolArray,
    *,
    from_velocities: bool,
) -> list[Fault]:
    """Return the first fault of a label that the motion of its car shows."""
    if not {label, "yaw_rate"} <= set(signals):
        return []
    name, figures = _contradiction(label, signals, speed, moving)
    if not name:
        return []
    check = CHECKS[name]
    if from_velocities:
        check = replace(check, remedy=check.remedy_of_velocities or check.remedy)
    return [check.fault(label, **figures)]


def _contradiction(
    label: str, signals: Signals, speed: FloatArray | None, moving: BoolArray
) -> Contradiction:
    angle = np.where(moving, signals[label], np.nan)
    curvature = signals["yaw_rate"]
    if speed is not None:
        large = np.abs(angle[(speed > FAST_MPS) & np.isfinite(angle)])
        median_deg = float(np.degrees(np.median(large))) if large.size >= MIN_TICKS else 0.0
        if median_deg > CHECKS["size of the label"].high:
            return "size of the label", {"median_deg": median_deg}
        with np.errstate(divide="ignore", invalid="ignore"):
            curvature = curvature / speed
    inputs = np.array([curvature, *([signals["ay"]] if "ay" in signals else [])])
    delay = estimate_delay(angle, inputs, moving & np.isfinite(inputs).all(axis=0))
    if delay is not None and delay.exceeds(CHECKS["delay of the label"].high):
        return "delay of the label", {"delay_s": delay.value_s, "error_s": delay.error_s}
    if speed is not None and len(inputs) == 2:
        sliding = large.size >= MIN_TICKS and float(np.quantile(large, 0.9)) > SLIDING_RAD
        return _lever(signals[label], signals, speed, moving, sliding=sliding)
    return NONE


def is_yaw_rate_reversed(label: str, signals: Signals, moving: BoolArray) -> bool | None:
    """Return True if the label contradicts the yaw rate, False if not; None if it does not show."""
    speed = speed_mps(signals)
    if speed is None or not {label, "yaw_rate", "ay"} <= set(signals):
        return None
    lever_m, _, explained = _fit_lever(signals[label], signals, speed, moving)
    if explained <= MIN_EXPLAINED or abs(lever_m) < -CHECKS["sign of the label"].low:
        return None
    return lever_m < 0


def _gentle(signals: Signals, speed: FloatArray, moving: BoolArray) -> BoolArray:
    """Return where the car turns gently and slowly, or not at all."""
    slow = (speed < SLOW_MPS) & (speed > 0) & (np.abs(signals["ay"]) < GENTLE_MPS2)
    return moving & slow & np.isfinite(signals["yaw_rate"])


def _fit_lever(
    angle: FloatArray, signals: Signals, speed: FloatArray, moving: BoolArray
) -> tuple[float, float, float]:
    """Return the slope on the curvature in m, the constant and the explained share.

    The curvature has no effect on ay of its own: both are inputs. All are 0 at one speed.
    """
    rows = _gentle(signals, speed, moving)
    with np.errstate(divide="ignore", invalid="ignore"):
        inputs = np.array([signals["yaw_rate"] / speed, signals["ay"]])
    if rows.sum() < MIN_GENTLE_TICKS or _is_one_speed(inputs[0, rows], speed[rows]):
        return 0.0, 0.0, 0.0
    (lever_m, _), zero, explained = fit(angle, inputs, rows)
    return float(lever_m), zero, explained


def _is_one_speed(curvature: FloatArray, speed: FloatArray) -> bool:
    """Return True if the speed differs too little to part curvature and ay."""
    squared = curvature * speed**2
    if not (curvature.std() > 0 and squared.std() > 0):
        return True
    return bool(abs(np.corrcoef(curvature, squared)[0, 1]) > MAX_COLLINEARITY)


def _lever(
    angle: FloatArray, signals: Signals, speed: FloatArray, moving: BoolArray, *, sliding: bool
) -> Contradiction:
    """Compare the label's slope on the curvature with the places of rear axles, and its zero."""
    lever_m, zero, explained = _fit_lever(angle, signals, speed, moving)
    check, sign = CHECKS["scale of the label"], CHECKS["sign of the label"]
    low, high = check.low, check.high
    if explained:
        high = min(high, MAX_WHEELBASE_SHARE * _wheelbase_m(signals, speed, moving))
        is_reversed = explained > MIN_EXPLAINED and lever_m < sign.low
        is_large = explained > MIN_EXPLAINED and lever_m > SLIDING_M and sliding
        is_scaled = explained > MIN_SURE_EXPLAINED and not low < lever_m < high
    else:
        lever_m, mean_square, explained = _fit_one_speed(angle, signals, speed, moving)
        low -= MAX_COMPLIANCE * mean_square
        is_sure = explained > MIN_SURE_EXPLAINED
        is_reversed = is_sure and lever_m < min(low, 0) + sign.low
        is_large = is_sure and lever_m > SLIDING_M
        is_scaled = is_sure and 0 < lever_m < low
    bounds = {"lever_m": lever_m, "low": low, "high": high}
    if is_reversed:
        return "sign of the label", bounds
    if is_large or is_scaled:
        return "scale of the label", bounds
    zero_deg = math.degrees(zero)
    if explained > MIN_SURE_EXPLAINED and not CHECKS["zero of the label"].passes(zero_deg):
        return "zero of the label", {"zero_deg": zero_deg, "offset_rad": -zero}
    return NONE


def _wheelbase_m(signals: Signals, speed: FloatArray, moving: BoolArray) -> float:
    """Return the wheelbase that the road wheels show, infinity if they show none."""
    angle = next((signals[name] for name in ROAD_WHEELS if name in signals), None)
    if angle is None:
        return math.inf
    wheelbase_m, _, explained = _fit_lever(angle, signals, speed, moving)
    shortest, longest = WHEELBASE_M
    is_sure = explained > MIN_SURE_EXPLAINED and shortest < wheelbase_m < longest
    return wheelbase_m if is_sure else math.inf


def _fit_one_speed(
    angle: FloatArray, signals: Signals, speed: FloatArray, moving: BoolArray
) -> tuple[float, float, float]:
    """Return the slope on the curvature in m, the mean squared speed and the explained share.

    At one speed the slope is the lever less the compliance times the squared speed.
    """
    rows = _gentle(signals, speed, moving)
    if rows.sum() < MIN_GENTLE_TICKS:
        return 0.0, 0.0, 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        (slope,), _, explained = fit(angle, (signals["yaw_rate"] / speed)[None], rows)
    return float(slope), float(np.mean(speed[rows] ** 2)), explained
