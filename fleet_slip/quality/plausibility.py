"""Relations of vehicle dynamics that the rows of a drive contradict: signs, units, delays, swaps.

The values are all well formed. Axes and signs are ISO 8855.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import TypeAlias

import numpy as np

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.catalog.course import COURSE, LARGEST_RAD, SATELLITE_SPEED
from fleet_slip.catalog.signals import SAMPLE_TIME_S, SignalCatalog
from fleet_slip.quality.checks import (
    CONSTANT,
    COURSE_REPEATS,
    COURSE_SENSE,
    COURSE_SIZE,
    COURSE_UNRELATED,
    GYROSCOPE_SCALE,
    LABEL_ONE_SIDED,
    LABEL_ZERO,
    LONGITUDINAL_SIGN,
    NO_VALUE,
    ONE_SIDED,
    SATELLITE_SPEEDS,
    SIZE,
    SPEEDS,
    SWAPPED_AXLES,
    WHEEL_SPEED,
    Fault,
)
from fleet_slip.quality.course_relation import CourseRelation, relate
from fleet_slip.quality.delays import find_delays
from fleet_slip.quality.drive_signals import (
    MIN_TICKS,
    RADIUS_M,
    SIGNED,
    SPEEDS_OF_CAR,
    TICKS_PER_S,
    TRACK_M,
    WHEELS,
    Signals,
    is_moving,
    slope_of,
    speed_mps,
    wheel_speed_mps,
    wrap_angle,
)
from fleet_slip.quality.label_motion import check_label, is_yaw_rate_reversed
from fleet_slip.quality.moments import MeanMoments
from fleet_slip.quality.turning import (
    MIN_MEAN_RATIO,
    WITNESSES,
    find_reversed_or_swapped,
    find_swapped_axes,
)

MIN_CORRELATION = 0.6
"""Of two signals whose sizes are compared; a sound drive on a winding road has 0.9."""


def check_plausibility(
    catalog: SignalCatalog, signals: Signals, *, from_velocities: bool = False
) -> list[Fault]:
    """Run the checks of a drive's rows; too few rows raise no fault.

    Each check passes over signals that an earlier one found faulty. The label of a drive may be
    computed from its velocities, where its remedies concern these.
    """
    faults = list(_without_change(catalog, signals))
    sound = _without(signals, faults)
    moving = is_moving(sound)
    one_sided = list(find_one_sided(sound, moving, catalog.label))
    faults += (fault for fault in one_sided if catalog.label not in fault.signals)
    turning = _turning(_without(sound, faults), moving, catalog.label)
    faults += turning
    faults += find_delays(_without(sound, faults), moving)
    wrong_speeds = list(_speeds(sound, moving))
    faults += wrong_speeds
    speed = speed_mps(_without(sound, wrong_speeds))
    if speed is not None:
        faults += _sizes(_without(sound, faults), speed, moving)
        faults += _axles(_without(sound, faults), speed, moving)
    label = list(
        check_label(
            catalog.label, _without(sound, faults), speed, moving, from_velocities=from_velocities
        )
    )
    if one_sided and catalog.label in one_sided[-1].signals:
        # A biased label is on one side, too.
        label = label if any(fault.kind == LABEL_ZERO.kind for fault in label) else one_sided[-1:]
    faults += label
    return [*faults, *itertools.islice(_course(_without(sound, faults)), 1)]


def _without(signals: Signals, faults: Sequence[Fault]) -> Signals:
    """Return the signals that no fault names."""
    faulty = {name for fault in faults for name in fault.signals}
    return {name: values for name, values in signals.items() if name not in faulty}


def _without_change(catalog: SignalCatalog, signals: Signals) -> Iterator[Fault]:
    for name, values in signals.items():
        present = values[np.isfinite(values)]
        if not present.size:
            yield NO_VALUE.fault(name)
        elif present.size >= MIN_TICKS and present.min() == present.max():
            yield CONSTANT.fault(name, value=f": {present[0]:g} {catalog[name].unit}")


# Signals that stay on one side of zero, though the car turns to both sides. Some buses send the
# magnitude of a rate or an angle, and its sign as a bit of its own.

MIN_ONE_SIDED_S = 60.0
"""In a shorter drive a car may turn to one side."""


def find_one_sided(signals: Signals, moving: BoolArray, label: str) -> Iterator[Fault]:
    """Yield signals that never change their sign while the car drives; the label comes last.

    A car that does turn to one side, as on an oval, shows it by its rear wheels, or by the mean of
    the other signs of turning.
    """
    rear = ("wheel_rl", "wheel_rr")
    if set(rear) <= set(signals) and _side(signals[rear[1]] - signals[rear[0]], moving):
        return
    means = {name: _mean_ratio(signals[name], moving) for name in SIGNED if name in signals}
    for name in (*SIGNED, label):
        if name not in signals or not (side := _side(signals[name], moving)):
            continue
        ratios = [mean for other, mean in means.items() if other != name]
        if ratios and np.median(ratios) > MIN_MEAN_RATIO:
            continue
        sign, minutes = ("negative" if side > 0 else "positive"), signals[name].size / 6000
        check = LABEL_ONE_SIDED if name == label else ONE_SIDED
        yield check.fault(name, evidence=f"it is never {sign} in {minutes:.0f} min")


def _mean_ratio(values: FloatArray, rows: BoolArray) -> float:
    """Return the magnitude of the mean over the root mean square; 0 without values."""
    present = values[np.isfinite(values) & rows]
    square = float(np.mean(present**2)) if present.size else 0.0
    return abs(float(present.mean())) / math.sqrt(square) if square > 0 else 0.0


def _side(values: FloatArray, rows: BoolArray) -> int:
    """Return +1 or -1 for values on one side of zero alone, 0 for others, or too few."""
    present = values[np.isfinite(values) & rows]
    if present.size * float(SAMPLE_TIME_S) < MIN_ONE_SIDED_S:
        return 0
    low, high = np.quantile(present, [0.001, 0.999])
    if max(-low, high) <= 0:
        return 0
    if low >= -ONE_SIDED.low * high:
        return 1
    return -1 if high <= -ONE_SIDED.low * low else 0


def _turning(signals: Signals, moving: BoolArray, label: str) -> list[Fault]:
    """Compare the signs of turning, and both accelerations with the turns, while the car moves."""
    names = {"ax", *(name for parts in WITNESSES.values() for name in parts)}
    used = {name: values for name, values in signals.items() if name in names}
    if not used:
        return []
    rows = moving & np.isfinite(list(used.values())).all(axis=0)
    if rows.sum() < MIN_TICKS:
        return []
    moments = MeanMoments.from_rows(used, rows)
    faults = find_reversed_or_swapped(moments).get(0, [])
    if faults and set(faults[0].signals) == {"ay", "yaw_rate"}:
        faults = [_decide(faults[0], signals, moving, label)]
    return [*faults, *find_swapped_axes(moments).values()]


def _decide(fault: Fault, signals: Signals, moving: BoolArray, label: str) -> Fault:
    """Return which one of ay and yaw rate contradicts the label, too; the fault if none does."""
    reversed_ = is_yaw_rate_reversed(label, signals, moving)
    if reversed_ is None:
        return fault
    return Fault(
        fault.kind,
        ("yaw_rate",) if reversed_ else ("ay",),
        f"it contradicts both {'ay' if reversed_ else 'yaw_rate'} and {label}",
        "Write negate = true.",
    )


# The size of signals by that of others.

STEERING_RATIO = 15.0
ROAD_WHEELS = ("steer_fl", "steer")
FACTORS = {57.3: "degrees and radians", 9.81: "g and m/s^2", 3.6: "km/h and m/s"}
WHEEL_FACTORS = {9.55: "rpm and rad/s", 57.3: "degrees and radians", 3.6: "km/h and m/s"}
"""Factors between units. A wheel's speed may be in km/h or m/s as well."""


def _hint(ratio: float, factors: dict[float, str]) -> str:
    """Return the units that differ by about a ratio, in brackets."""
    large = max(ratio, 1 / ratio)
    factor = min(factors, key=lambda factor: abs(math.log(factor / large)))
    if not 0.6 < factor / large < 1.7:
        return ""
    return f" ({factor:g} is between {factors[factor]})"


def _ratio(values: FloatArray, expected: FloatArray, rows: BoolArray) -> float | None:
    """Return the median of values over expected; None of too few, or where one does not move."""
    rows = rows & np.isfinite(values) & np.isfinite(expected) & (expected != 0)
    if rows.sum() < MIN_TICKS:
        return None
    ratio = float(np.median(values[rows] / expected[rows]))
    return ratio if ratio > 0 else None


def _speeds(signals: Signals, moving: BoolArray) -> Iterator[Fault]:
    """Compare each wheel with all, and each speed with the wheels; ay and yaw rate decide."""
    wheels = wheel_speed_mps(signals)
    if wheels is None:
        return
    for name in (name for name in WHEELS if name in signals):
        ratio = _ratio(signals[name] * RADIUS_M, wheels, moving)
        if ratio and not WHEEL_SPEED.low <= ratio <= WHEEL_SPEED.high:
            yield WHEEL_SPEED.fault(name, ratio=ratio, hint=_hint(ratio, WHEEL_FACTORS))
    for name in (name for name in SPEEDS_OF_CAR if name in signals):
        check = SATELLITE_SPEEDS if name == SATELLITE_SPEED else SPEEDS
        ratio = _ratio(signals[name], wheels, moving)
        if ratio and not check.low <= ratio <= check.high:
            named = [wheel for wheel in WHEELS if wheel in signals]
            of_wheels = _turns_at(wheels, signals, moving)
            of_speed = _turns_at(signals[name], signals, moving)
            if of_wheels and not of_speed:
                named = [name]
            elif of_wheels == of_speed:
                named = [*named, name]
            hint = _hint(ratio, WHEEL_FACTORS)
            yield check.fault(*named, name=name, ratio=ratio, hint=hint)


def _turns_at(speed: FloatArray, signals: Signals, moving: BoolArray) -> bool:
    """Return True if ay is the yaw rate times this speed."""
    if not {"ay", "yaw_rate"} <= set(signals):
        return False
    slope, correlation = slope_of(signals["ay"], signals["yaw_rate"] * speed, moving)
    return abs(correlation) > MIN_CORRELATION and SPEEDS.low <= abs(slope) <= SPEEDS.high


Comparison: TypeAlias = tuple[tuple[str, ...], str, float, float]
"""Signals; what predicts the first; its ratio to that, and its correlation with it."""


def _compared(signals: Signals, speed: FloatArray, moving: BoolArray) -> Iterator[Comparison]:
    """Yield pairs of quantities of a moving car that must have the same size."""
    yaw_rate, ay = signals.get("yaw_rate"), signals.get("ay")
    if yaw_rate is not None and {"wheel_rl", "wheel_rr"} <= set(signals):
        turn = (signals["wheel_rr"] - signals["wheel_rl"]) * RADIUS_M / TRACK_M
        expected = "the yaw rate of the rear wheels"
        yield ("yaw_rate",), expected, *slope_of(yaw_rate, turn, moving)
    if yaw_rate is not None and ay is not None:
        yield ("ay", "yaw_rate"), "yaw rate times speed", *slope_of(ay, yaw_rate * speed, moving)
    if "ax" in signals and speed.size >= 4 * MIN_TICKS:
        half = TICKS_PER_S // 2
        change = np.full(speed.size, np.nan)
        change[half:-half] = speed[TICKS_PER_S:] - speed[:-TICKS_PER_S]
        smooth = np.convolve(np.nan_to_num(signals["ax"]), np.ones(2 * half) / (2 * half), "same")
        yield ("ax",), "the change of speed", *slope_of(smooth, change, moving)
    wheel = signals.get("steering_wheel")
    angle = next((name for name in ROAD_WHEELS if name in signals), None)
    if wheel is not None and angle is not None:
        column = STEERING_RATIO * signals[angle]
        yield ("steering_wheel", angle), "15 times the other", *slope_of(wheel, column, moving)


def _sizes(signals: Signals, speed: FloatArray, moving: BoolArray) -> Iterator[Fault]:
    """Compare the sizes of signals with those that others predict; and the sign of `ax`."""
    for names, expected, slope, correlation in _compared(signals, speed, moving):
        if names == ("ax",) and correlation < LONGITUDINAL_SIGN.low:
            yield LONGITUDINAL_SIGN.fault(*names, correlation=correlation)
            continue
        ratio = slope if correlation > 0 else -slope
        if abs(correlation) > MIN_CORRELATION and not SIZE.low <= ratio <= SIZE.high:
            yield SIZE.fault(*names, ratio=ratio, expected=expected, hint=_hint(ratio, FACTORS))


MAX_BEND_MPS, MIN_BEND_PER_M = 12.0, 0.05
"""Bends of 20 m and less, at a speed at which the tyres hardly slip."""


def _axles(signals: Signals, speed: FloatArray, moving: BoolArray) -> Iterator[Fault]:
    """Compare axles in tight bends: the front one drives the longer way."""
    if not {"yaw_rate", *WHEELS} <= set(signals):
        return
    front, rear = (signals[f"wheel_{axle}l"] + signals[f"wheel_{axle}r"] for axle in "fr")
    with np.errstate(divide="ignore", invalid="ignore"):
        tightness, longer = (signals["yaw_rate"] / speed) ** 2, front / rear - 1
    rows = moving & (speed < MAX_BEND_MPS)
    tightest = np.nanmax(tightness, initial=0, where=rows & np.isfinite(tightness))
    if tightest < MIN_BEND_PER_M**2:
        return
    slope, correlation = slope_of(longer, tightness, rows)
    if correlation < SWAPPED_AXLES.low and slope < -1:
        yield SWAPPED_AXLES.fault(*WHEELS, correlation=correlation)


# The course changes as the car turns and slips.

COURSE_CHANGE_TICKS = 4 * TICKS_PER_S
MIN_COURSE_MPS = 3.0
"""Below, fixes of receivers are too noisy."""


def _course(signals: Signals) -> Iterator[Fault]:
    """Compare a course with the yaw rate, and with how a car slips; the first fault is decisive."""
    if not {"course", "yaw_rate"} <= set(signals):
        return
    course, turned = signals["course"], np.cumsum(signals["yaw_rate"]) * float(SAMPLE_TIME_S)
    change = wrap_angle(course[TICKS_PER_S:] - course[:-TICKS_PER_S])
    scale, correlation = slope_of(
        change, turned[TICKS_PER_S:] - turned[:-TICKS_PER_S], np.isfinite(change)
    )
    if correlation:
        if correlation < -MIN_CORRELATION:
            yield COURSE_SENSE.fault(COURSE, scale=scale)
        elif correlation < COURSE_UNRELATED.low:
            yield COURSE_UNRELATED.fault(COURSE, correlation=correlation)
        elif not COURSE_SIZE.low <= scale <= COURSE_SIZE.high:
            yield COURSE_SIZE.fault(COURSE, scale=scale)
    fast = signals.get(SATELLITE_SPEED, np.zeros(0)) > MIN_COURSE_MPS
    share = 1 - float(np.isfinite(course[fast]).mean()) if fast.any() else 0.0
    if share > COURSE_REPEATS.high:
        yield COURSE_REPEATS.fault(COURSE, share=share)
    relation = _relation(signals, turned)
    if relation and (fault := relation.fault or relation.misplaced):
        yield Fault(fault.kind, (COURSE,), fault.figure, fault.remedy)
    elif relation and not GYROSCOPE_SCALE.low <= relation.scale <= GYROSCOPE_SCALE.high:
        yield GYROSCOPE_SCALE.fault(COURSE, scale=relation.scale)


def _relation(signals: Signals, turned: FloatArray) -> CourseRelation | None:
    """Return the relation of changes over some seconds, by the receiver's own speed."""
    if not {"ay", SATELLITE_SPEED} <= set(signals):
        return None
    yaw_rate, speed = signals["yaw_rate"], signals[SATELLITE_SPEED]
    fast = np.where(speed > MIN_COURSE_MPS, speed, np.nan)
    series = np.array([yaw_rate / fast, signals["ay"], yaw_rate, turned, signals["course"]])
    changes = series[:, COURSE_CHANGE_TICKS:] - series[:, :-COURSE_CHANGE_TICKS]
    changes[4] = wrap_angle(changes[4] - changes[3])
    sound = np.isfinite(changes).all(axis=0) & (np.abs(changes[4]) <= float(LARGEST_RAD))
    rows = np.vstack([np.ones(int(sound.sum())), changes[:, sound]])
    return relate(rows @ rows.T)
