"""What looks wrong in a drive whose values are all well formed: a sign, a unit, swapped wheels.

Nothing here is certain: a suspicion is a relation of vehicle dynamics that a drive contradicts,
with the figure that shows it, and what to try. Axes and signs are ISO 8855.
"""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.catalog.course import COURSE, LARGEST_RAD, SATELLITE_SPEED
from fleet_slip.catalog.signals import SAMPLE_TIME_S, SignalCatalog
from fleet_slip.quality.checks import Fault
from fleet_slip.quality.course_relation import CourseRelation, relate
from fleet_slip.quality.moments import MeanMoments
from fleet_slip.quality.turning import WITNESSES, axes_swapped, find_reversed_or_swapped

# How signals of a drive go with one another: slopes and fits.

SECOND = round(1 / float(SAMPLE_TIME_S))
FEWEST_TICKS = 200
MOVING_MPS = 2.0


def moving(speed: FloatArray | None) -> BoolArray:
    """Return where the car drives; everywhere if its speed is not known."""
    if speed is None:
        return np.ones(1, dtype=np.bool_)
    return np.asarray(np.nan_to_num(speed) > MOVING_MPS)


def slope_of(values: FloatArray, expected: FloatArray, rows: BoolArray) -> tuple[float, float]:
    """Return values over expected, by least squares about their means, and their correlation.

    Both are 0 where there is too little to judge.
    """
    (slope,), _, explained = fit(values, expected[None], rows)
    return float(slope), math.copysign(math.sqrt(max(explained, 0.0)), slope)


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


# What looks wrong in a course: it turns as the yaw rate does, and slips as a car does.

APART = 4 * SECOND
SOUND = (0.8, 1.25)
"""Of the course's change to the yaw rate's integral, and of the receiver's speed to the wheels'."""
LEAST_OF_THEIR_OWN = 0.9
MOST_SCALE_ERROR = 0.02
LEAST_SPEED_MPS = 3.0


def _course(signals: "Signals") -> Iterator[Fault]:
    """Compare a course with the yaw rate, and with how a car slips; the first fault says most."""
    if not {"course", "yaw_rate"} <= set(signals):
        return
    course, turned = signals["course"], np.cumsum(signals["yaw_rate"]) * float(SAMPLE_TIME_S)
    change, heading = wrapped(course[SECOND:] - course[:-SECOND]), turned[SECOND:]
    slope, correlation = slope_of(change, heading - turned[:-SECOND], np.isfinite(change))
    if correlation:
        figure = f"over 1 s it changes by {slope:+.2f} times the integral of the yaw rate"
        if correlation < -LEAST_CORRELATION:
            remedy = "Invert clockwise_from_north, or swap north and east."
            yield Fault("reversed", (COURSE,), figure, remedy)
        elif correlation < LEAST_CORRELATION:
            figure = f"its change over 1 s hardly correlates with the yaw rate ({correlation:+.2f})"
            yield Fault("values", (COURSE,), figure, "Is it a course over ground, and of this car?")
        elif not SOUND[0] <= slope <= SOUND[1]:
            yield Fault("scaled", (COURSE,), figure, "Check its unit, and that of the yaw rate.")
    fast = signals.get(SATELLITE_SPEED, np.zeros(0)) > LEAST_SPEED_MPS
    own = float(np.isfinite(course[fast]).mean()) if fast.any() else 1.0
    if own < LEAST_OF_THEIR_OWN:
        figure = f"{1 - own:.0%} of its fixes repeat the last in a turn, or are from reversing"
        remedy = "They are left out. Map it as the receiver reports it."
        yield Fault("values", (COURSE,), figure, remedy)
    relation = _relation(signals, turned)
    if relation and (fault := relation.fault or relation.misplaced):
        yield replace(fault, signals=(COURSE,))
    elif relation and abs(relation.scale - 1) > MOST_SCALE_ERROR:
        figure = f"it changes by {relation.scale:.3f} times the integral of the yaw rate"
        remedy = "The scale of the gyroscope is off; learning corrects it."
        yield Fault("scale", (COURSE,), figure, remedy)


def _relation(signals: "Signals", turned: FloatArray) -> CourseRelation | None:
    """Return what changes over some seconds come to, by the receiver's own speed."""
    if not {"ay", SATELLITE_SPEED} <= set(signals):
        return None
    yaw_rate, speed = signals["yaw_rate"], signals[SATELLITE_SPEED]
    fast = np.where(speed > LEAST_SPEED_MPS, speed, np.nan)
    series = np.array([yaw_rate / fast, signals["ay"], yaw_rate, turned, signals["course"]])
    changes = series[:, APART:] - series[:, :-APART]
    changes[4] = wrapped(changes[4] - changes[3])
    sound = np.isfinite(changes).all(axis=0) & (np.abs(changes[4]) <= float(LARGEST_RAD))
    rows = np.vstack([np.ones(int(sound.sum())), changes[:, sound]])
    return relate(rows @ rows.T)


def wrapped(angle: FloatArray) -> FloatArray:
    """Return the angle from -π on, below π."""
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)


# Finds what turns to one side alone, though the car turns to both: a magnitude without its sign.
#
# Some buses send a rate or an angle as a magnitude, and its sign as a bit of its own.

TURNING = ("ay", "yaw_rate", "steering_wheel", "steer", "steer_fl", "steer_fr", "sideslip")
LEAST_S = 60.0
"""Who drives for less may well turn to one side."""
_SMALL = 0.02
"""Part of the usual largest value that noise and zero points reach on the other side."""


def find_one_sided(signals: "Signals", speed: FloatArray | None) -> Iterator[Fault]:
    """Yield the signals that never change their sign while the car drives.

    Nothing is said of a car whose rear wheels show that it does turn to one side, as on an oval.
    """
    rows = moving(speed)
    rear = ("wheel_rl", "wheel_rr")
    if set(rear) <= set(signals) and _side(signals[rear[1]] - signals[rear[0]], rows):
        return
    for name in TURNING:
        if name in signals and (side := _side(signals[name], rows)):
            never, minutes = ("negative" if side > 0 else "positive"), signals[name].size / 6000
            figure = f"it is never {never} in {minutes:.0f} min"
            remedy = 'Where another column has its sign: sign = { column = "..." }.'
            yield Fault("magnitude", (name,), figure, remedy)


def _side(values: FloatArray, rows: BoolArray) -> int:
    """Return +1 or -1 for values on one side of zero alone, 0 for others, or too few."""
    present = values[np.isfinite(values) & rows]
    if present.size * float(SAMPLE_TIME_S) < LEAST_S:
        return 0
    low, high = np.quantile(present, [0.001, 0.999])
    if max(-low, high) <= 0:
        return 0
    if low >= -_SMALL * high:
        return 1
    return -1 if high <= -_SMALL * low else 0


Signals: TypeAlias = Mapping[str, FloatArray]
"""Values in SI units on consecutive ticks, NaN where there is none; all of one shape (n_ticks,)."""

RADIUS_M, TRACK_M = 0.31, 1.55
"""Of a passenger car: what is looked for is a factor of 3.6, 9.8 or 57. Where a wheel of a mapping
has no radius, a tenth more moves the correction of the label by a tenth."""
LONGEST_M, LARGE_RAD = 8.0, 0.15
"""No car's rear axle is so far behind, and a car that slips so often slides."""
LARGEST_COLLINEAR = 0.995
LEAST_LEVER_M, LONGEST_LEVER_M, LONGEST_PART = 0.6, 2.6, 0.75
"""The rear axle is so far behind the centre of gravity, and by this part of the wheelbase."""
STEERING_RATIO = 15.0
WHEELBASE_M = (2.0, 4.5)
"""Beyond, it is the road wheels that are in doubt."""
LARGEST_ZERO_RAD = math.radians(0.7)
"""Real cars have up to 0.4 deg, from a sensor that is not aligned and roads that lean."""
SLOW_MPS, SURE_EXPLAINED = 20.0, 0.85
GENTLE_MPS2, FEWEST_GENTLE_TICKS = 5.0, 500
"""Beyond, a tyre slips more than in proportion: a race car at its limit shows no lever."""
WHEELS = ("wheel_fl", "wheel_fr", "wheel_rl", "wheel_rr")
ROAD_WHEELS = ("steer_fl", "steer")
LEAST_CORRELATION = 0.6
_SOUND_RATIOS = {
    **dict.fromkeys((*WHEELS, "vx", "vehicle_speed"), (0.7, 1.4)),
    SATELLITE_SPEED: SOUND,
}
"""Of a speed to that of the wheels; other quantities are known to a factor of 2.5."""
_FACTORS = {57.3: "degrees and radians", 9.81: "g and m/s^2", 3.6: "km/h and m/s"}


def to_regular_grid(
    catalog: SignalCatalog, ticks: NDArray[np.int32], counts: Mapping[str, FloatArray]
) -> Signals:
    """Return counts at some ticks, NaN for none, in SI units on all ticks from the first."""
    signals = {}
    for name, values in counts.items():
        signals[name] = np.full(int(ticks[-1] - ticks[0]) + 1, np.nan)
        signals[name][ticks - ticks[0]] = values * float(catalog[name].scale)
    return signals


def check_plausibility(catalog: SignalCatalog, signals: Signals) -> list[Fault]:
    """Return what looks wrong in the signals of one drive; little data raises few suspicions."""
    faults = list(_still(catalog, signals))
    usual = _without(signals, faults)
    speed = speed_mps(usual)
    magnitudes = {fault.signals[0]: fault for fault in find_one_sided(usual, speed)}
    sideslip = magnitudes.pop(catalog.label, None)
    faults += magnitudes.values()
    usual = _without(usual, faults)
    faults += _turning(usual, speed)
    label: list[Fault] = []
    if speed is not None:
        faults += [*_scales_differ(usual, speed), *_axles_swapped(usual, speed)]
        if not any({"ay", "yaw_rate"} & set(fault.signals) for fault in faults):
            label = list(_label(catalog.label, usual, speed))  # which is judged by them
    if sideslip and all(fault.kind != "biased" for fault in label):  # else it is off to one side
        label = [sideslip]
    if not any(SATELLITE_SPEED in fault.signals for fault in faults):
        label += itertools.islice(_course(usual), 1)
    return [*faults, *label]


def _without(signals: Signals, faults: Sequence[Fault]) -> Signals:
    wrong = {name for one in faults for name in one.signals}
    return {name: values for name, values in signals.items() if name not in wrong}


def speed_mps(signals: Signals) -> FloatArray | None:
    """Return a rough speed: that of the wheels, else `vx` or the car's own; None without any."""
    wheels = [signals[name] for name in WHEELS if name in signals]
    if wheels:
        return np.asarray(np.median(wheels, axis=0) * RADIUS_M, dtype=np.float64)
    return signals.get("vx", signals.get("vehicle_speed"))


def _still(catalog: SignalCatalog, signals: Signals) -> Iterator[Fault]:
    for name, values in signals.items():
        present = values[np.isfinite(values)]
        if not present.size:
            yield Fault("absent", (name,), "it has no value at all", "Map another column.")
        elif present.size >= FEWEST_TICKS and present.min() == present.max():
            figure = f"it is constant: {present[0]:g} {catalog[name].unit}"
            yield Fault("stuck", (name,), figure, "Map another column.")


def _turning(signals: Signals, speed: FloatArray | None) -> Iterator[Fault]:
    """Compare the signs of all that is positive to the left, and both accelerations with the turns.

    The checks are those of Gram rows, here of the rows in which the car moves.
    """
    names = {"ax", *(name for parts in WITNESSES.values() for name in parts)}
    some = {name: values for name, values in signals.items() if name in names}
    if not some:
        return
    rows = moving(speed) & np.isfinite(list(some.values())).all(axis=0)
    if rows.sum() >= FEWEST_TICKS:
        moments = MeanMoments.of_rows(some, rows)
        yield from find_reversed_or_swapped(moments).get(0, ())
        yield from axes_swapped(moments).values()


Comparison: TypeAlias = tuple[tuple[str, ...], str, float, float]
"""Signals; what the first should be; its ratio to that, and its correlation with it."""


def _compared(signals: Signals, speed: FloatArray) -> Iterator[Comparison]:
    """Yield what the signals of a moving car have to do with one another."""
    rows = moving(speed)
    for name in (*WHEELS, "vx", "vehicle_speed", SATELLITE_SPEED):
        if name in signals:
            own = signals[name] * (RADIUS_M if name in WHEELS else 1.0)
            both = rows & np.isfinite(own) & np.isfinite(speed)
            if both.sum() >= FEWEST_TICKS:
                ratio = float(np.median(own[both] / speed[both]))
                yield (name,), "the speed of the wheels", ratio, 1.0
    yaw_rate, ay = signals.get("yaw_rate"), signals.get("ay")
    if yaw_rate is not None and {"wheel_rl", "wheel_rr"} <= set(signals):
        turn = (signals["wheel_rr"] - signals["wheel_rl"]) * RADIUS_M / TRACK_M
        named = "the yaw rate of the rear wheels"
        yield ("yaw_rate",), named, *slope_of(yaw_rate, turn, rows)
    if yaw_rate is not None and ay is not None:
        yield ("ay", "yaw_rate"), "yaw rate times speed", *slope_of(ay, yaw_rate * speed, rows)
    if "ax" in signals and speed.size >= 4 * FEWEST_TICKS:
        change = np.full(speed.size, np.nan)
        change[SECOND // 2 : -SECOND // 2] = speed[SECOND:] - speed[:-SECOND]
        smooth = np.convolve(np.nan_to_num(signals["ax"]), np.ones(SECOND) / SECOND, "same")
        yield ("ax",), "the change of speed", *slope_of(smooth, change, rows)
    wheel = signals.get("steering_wheel")
    angle = next((name for name in ROAD_WHEELS if name in signals), None)
    if wheel is not None and angle is not None:
        expected = STEERING_RATIO * signals[angle]
        yield ("steering_wheel", angle), "15 times the other", *slope_of(wheel, expected, rows)


def _scales_differ(signals: Signals, speed: FloatArray) -> Iterator[Fault]:
    """Compare the size of signals with that of others of the same; and the sign of `ax`."""
    for names, expected, slope, correlation in _compared(signals, speed):
        low, high = _SOUND_RATIOS.get(names[0], (0.4, 2.5))
        if names == ("ax",) and correlation < -LEAST_CORRELATION:
            figure = f"its correlation with the change of speed is {correlation:+.2f}"
            yield Fault("reversed", names, figure, "Write negate = true.")
            continue
        ratio = slope if correlation > 0 else -slope
        if abs(correlation) <= LEAST_CORRELATION or ratio <= 0 or low <= ratio <= high:
            continue
        large = max(ratio, 1 / ratio)
        factor = min(_FACTORS, key=lambda f: abs(np.log(f / large)))
        near = f" ({factor:g} is between {_FACTORS[factor]})" if 0.6 < factor / large < 1.7 else ""
        figure = f"it is {ratio:.3g} times {expected}{near}"
        yield Fault("scaled", names, figure, "Check the units.")


def _axles_swapped(signals: Signals, speed: FloatArray) -> Iterator[Fault]:
    """Compare axles in tight bends: the front one drives the longer way."""
    if not {"yaw_rate", *WHEELS} <= set(signals):
        return
    front, rear = (signals[f"wheel_{a}l"] + signals[f"wheel_{a}r"] for a in "fr")
    with np.errstate(divide="ignore", invalid="ignore"):
        tightness, longer = (signals["yaw_rate"] / speed) ** 2, front / rear - 1
    rows = moving(speed) & (speed < 12)
    if np.nanmax(tightness, initial=0, where=rows & np.isfinite(tightness)) < 0.05**2:
        return
    slope, correlation = slope_of(longer, tightness, rows)
    if correlation < -LEAST_CORRELATION and slope < -1:
        figure = f"in tight bends the front wheels are slower (correlation {correlation:+.2f})"
        yield Fault("swapped", WHEELS, figure, "Swap the front columns with the rear ones.")


def _label(label: str, signals: Signals, speed: FloatArray) -> Iterator[Fault]:
    """Look for the label's sign, unit and offset."""
    if not {label, "yaw_rate", "ay"} <= set(signals):
        return
    rows = moving(speed)
    angle = signals[label]
    large = np.abs(angle[rows & (speed > 8) & np.isfinite(angle)])
    if large.size >= FEWEST_TICKS and np.median(large) > 0.5:
        figure = f"its median magnitude is {np.degrees(np.median(large)):.0f} deg"
        yield Fault("scaled", (label,), figure, "Check its unit: degrees or radians?")
        return
    with np.errstate(divide="ignore", invalid="ignore"):
        inputs = np.array([signals["ay"], signals["yaw_rate"] / speed])
    many = large.size >= FEWEST_TICKS and np.quantile(large, 0.9) > LARGE_RAD
    slow = rows & (speed < SLOW_MPS) & (np.abs(signals["ay"]) < GENTLE_MPS2)
    yield from _lever(label, signals, inputs, slow, many=bool(many))


def _lever(
    label: str, signals: Signals, inputs: FloatArray, slow: BoolArray, *, many: bool
) -> Iterator[Fault]:
    """Compare the label with what any car does: it needs no peers, where all are wrong alike.

    Turning slowly it is the distance to the rear axle times the yaw rate over the speed, less what
    the rear tyres slip, and 0 on a straight (Milliken and Milliken, Race Car Vehicle Dynamics,
    chapter 5). The same fit of the road wheels gives the wheelbase, which is longer. At one speed
    the two inputs are one, and nothing is said.
    """
    ay, curvature = inputs[:, slow & np.isfinite(inputs).all(axis=0)]
    if ay.size < FEWEST_GENTLE_TICKS or abs(np.corrcoef(ay, curvature)[0, 1]) > LARGEST_COLLINEAR:
        return
    (_, lever), zero, explained = fit(signals[label], inputs, slow)
    figure = f"in slow turns it is {lever:+.2f} m times the curvature, should be +1 to +2"
    if explained <= LEAST_CORRELATION:
        return
    if lever < -LEAST_LEVER_M / 2:
        yield Fault("reversed", (label,), figure, "Write negate = true.")
        return
    longest = LONGEST_LEVER_M
    for name in ROAD_WHEELS:
        if name in signals:
            (_, base), _, sure = fit(signals[name], inputs, slow)
            if sure > SURE_EXPLAINED and WHEELBASE_M[0] < base < WHEELBASE_M[1]:
                longest = min(longest, LONGEST_PART * base)
                break
    unit = "Check its unit, degrees or radians, its factor, and where its sensor is: sensor_x_m."
    if lever > LONGEST_M and many:
        yield Fault("scaled", (label,), figure, unit)
    elif explained <= SURE_EXPLAINED:
        return
    elif not LEAST_LEVER_M < lever < longest:
        yield Fault("scaled", (label,), figure, unit)
    elif abs(zero) > LARGEST_ZERO_RAD:
        figure = f"on a straight it is {np.degrees(zero):+.2f} deg, should be 0"
        yield Fault("biased", (label,), figure, f"Write offset = {-zero:.4f} (rad).")
