"""What looks wrong in a drive whose values are all well formed: a sign, a unit, swapped wheels, a
label that comes late.

Nothing here is certain: a suspicion is a relation of vehicle dynamics that a drive contradicts,
with the figure that shows it, and what to try. Axes and signs are ISO 8855.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.catalogue.signals import SAMPLE_TIME_S, catalogue
from fleet_slip.catalogue.turning import WITNESSES
from fleet_slip.ingest.drives.course_suspicion import course_fault
from fleet_slip.ingest.drives.one_sided import find_one_sided
from fleet_slip.ingest.drives.relations import (
    FEWEST_TICKS,
    find_delay,
    fit,
    is_in_time,
    moving,
    slope_of,
)

Signals: TypeAlias = Mapping[str, FloatArray]
"""Values in SI units on consecutive ticks, NaN where there is none; all of one shape (n_ticks,)."""

RADIUS_M, TRACK_M = 0.31, 1.55
"""Of a passenger car: what is looked for is a factor of 3.6, 9.8 or 57."""
LONGEST_M, LARGE_RAD = 8.0, 0.15
"""No car's rear axle is so far behind, and a car that slips so often slides."""
LEAST_LEVER_M, LONGEST_LEVER_M, LONGEST_PART = 0.6, 2.6, 0.75
"""The rear axle is so far behind the centre of gravity, and by this part of the wheelbase."""
WHEELBASE_M = (2.0, 4.5)
"""Beyond, it is the road wheels that are in doubt."""
LARGEST_ZERO_RAD = math.radians(0.7)
"""Real cars have up to 0.4 deg, from a sensor that is not aligned and roads that lean."""
SLOW_MPS, SURE_EXPLAINED = 20.0, 0.85
WHEELS = ("wheel_fl", "wheel_fr", "wheel_rl", "wheel_rr")
ROAD_WHEELS = ("steer_fl", "steer")
LEAST_CORRELATION, SURE_CORRELATION = 0.6, 0.9
LEAST_AGAINST = -0.3
"""A correlation above tells no sign, as in `quality`: of noise alone half are below zero."""
_GOES_WITH, _GOES_NOT = 0.8, 0.5
"""Correlations of an acceleration with the turns, across the car and along it."""
_FACTORS = {57.3: "degrees and radians", 9.81: "g and m/s^2", 3.6: "km/h and m/s"}


@dataclass(frozen=True)
class Suspicion:
    """What looks wrong.

    Attributes:
        kind: as `quality` calls it (stuck, magnitude, reversed, swapped, scaled, repeated, no slip,
            noisy), or late, absent, values, time, cars, or scale, which does no harm.
        signals: those concerned.
        figure: what shows it.
        remedy: what to try in the mapping.
        value: how late, in seconds.
    """

    kind: str
    signals: tuple[str, ...]
    figure: str
    remedy: str
    value: float | None = None

    def __str__(self) -> str:
        """Return it as one line."""
        return f"{self.kind} {', '.join(self.signals)}? {self.figure}. {self.remedy}"


def find_suspicions(signals: Signals) -> list[Suspicion]:
    """Return what looks wrong in the signals of one drive; little data raises few suspicions."""
    still = list(_still(signals))
    usual = {name: v for name, v in signals.items() if name not in {s.signals[0] for s in still}}
    speed = speed_mps(usual)
    remedy = 'Where another column has its sign: sign = { column = "..." }.'
    magnitudes = {
        name: Suspicion("magnitude", (name,), figure, remedy)
        for name, figure in find_one_sided(usual, None if speed is None else moving(speed))
    }
    sideslip = magnitudes.pop(catalogue().label, None)
    usual = {name: values for name, values in usual.items() if name not in magnitudes}
    found = [*still, *magnitudes.values(), *_turning(usual, speed)]
    for check in (_axes_swapped, _wheels_differ, _rates_differ, _accelerates, _axles_swapped):
        found += check(usual, speed)
    label: list[Suspicion] = []
    if not any({"ay", "yaw_rate"} & set(one.signals) for one in found):
        label = list(_label(usual, speed))  # which is judged by them
    if sideslip and all(one.kind != "biased" for one in label):  # else it is off to one side
        label = [sideslip]
    found += label
    if fault := course_fault(usual, speed):
        found.append(Suspicion(**vars(fault)))
    return found


def speed_mps(signals: Signals) -> FloatArray | None:
    """Return a rough speed: that of the wheels, else `vx` or the car's own; None without any."""
    wheels = [signals[name] for name in WHEELS if name in signals]
    if wheels:
        return np.asarray(np.median(wheels, axis=0) * RADIUS_M, dtype=np.float64)
    return signals.get("vx", signals.get("vehicle_speed"))


def _still(signals: Signals) -> Iterator[Suspicion]:
    for name, values in signals.items():
        present = values[np.isfinite(values)]
        if not present.size:
            yield Suspicion("absent", (name,), "it has no value at all", "Map another column.")
        elif present.size >= FEWEST_TICKS and present.min() == present.max():
            figure = f"it is {present[0]:g} {catalogue()[name].unit} all the time"
            yield Suspicion("stuck", (name,), figure, "Map another column.")


def _turning(signals: Signals, speed: FloatArray | None) -> Iterator[Suspicion]:
    """Compare the signs of all that tells left from right.

    The fewest faults that explain all count, as in `quality`: where up to two others are against
    both axles, the axes are not ISO 8855; where more are, left and right wheels are swapped.
    """
    known = {
        name: np.asarray(sum(k * signals[s] for s, k in parts.items()))
        for name, parts in {**WITNESSES, "steer": {"steer": 1}}.items()
        if set(parts) <= set(signals)
    }
    known = {name: values for name, values in known.items() if np.nanstd(values) > 0}
    if len(known) < 2:
        return
    names, values = list(known), np.array(list(known.values()))
    rows = moving(speed) & np.isfinite(values).all(axis=0)
    if rows.sum() < FEWEST_TICKS:
        return
    correlations = np.nan_to_num(np.corrcoef(values[:, rows]))
    loadings = np.linalg.eigh(correlations)[1][:, -1]
    axles = [loadings[names.index(n)] for n in ("front wheels", "rear wheels") if n in names]
    agree = len(axles) == 2 and min(map(abs, axles)) > 0.2 and axles[0] * axles[1] > 0
    few = len(names) - len(axles) <= len(axles)
    loadings *= np.sign(axles[0] if agree and few else loadings.sum()) or 1
    for name, loading in zip(names, loadings, strict=True):
        if loading > -0.2:
            continue
        concerned = tuple(WITNESSES.get(name, (name,)))
        others = np.where(loadings > 0, correlations[names.index(name)], 0.0)
        against = int(np.argmin(others))
        if others[against] > LEAST_AGAINST:
            continue
        figure = f"its correlation with {names[against]} is {others[against]:+.2f}"
        if len(concerned) == 2:
            remedy = "Swap their columns."
            if agree:
                remedy += " If all others are positive to the right (SAE J670), negate these."
            yield Suspicion("swapped", concerned, figure, remedy)
        else:
            yield Suspicion("reversed", concerned, figure, "Write negate = true.")


def _axes_swapped(signals: Signals, speed: FloatArray | None) -> Iterator[Suspicion]:
    """Compare both accelerations with the turns."""
    if speed is None or not {"ax", "ay", "yaw_rate"} <= set(signals):
        return
    expected, rows = signals["yaw_rate"] * speed, moving(speed)
    ax, ay = (abs(slope_of(signals[name], expected, rows)[1]) for name in ("ax", "ay"))
    if ax > _GOES_WITH and ay < _GOES_NOT:
        figure = f"yaw rate times speed goes with ax by {ax:.2f}, with ay by {ay:.2f}"
        yield Suspicion("swapped", ("ax", "ay"), figure, "Swap their columns.")


def _wheels_differ(signals: Signals, speed: FloatArray | None) -> Iterator[Suspicion]:
    if speed is None:
        return
    for name in (*WHEELS, "vx", "vehicle_speed"):
        if name in signals:
            own = signals[name] * (RADIUS_M if name in WHEELS else 1.0)
            yield from _of_scale(own, speed, (name,), "the speed of the wheels", (0.7, 1.4), speed)


def _rates_differ(signals: Signals, speed: FloatArray | None) -> Iterator[Suspicion]:
    if speed is None or "yaw_rate" not in signals:
        return
    yaw_rate, wide = signals["yaw_rate"], (0.4, 2.5)
    if {"wheel_rl", "wheel_rr"} <= set(signals):
        turn = (signals["wheel_rr"] - signals["wheel_rl"]) * RADIUS_M / TRACK_M
        of = "what the rear wheels tell"
        yield from _of_scale(yaw_rate, turn, ("yaw_rate",), of, wide, speed)
    if "ay" in signals:
        both, of = ("ay", "yaw_rate"), "yaw rate times speed"
        yield from _of_scale(signals["ay"], yaw_rate * speed, both, of, wide, speed)
    angle = next((name for name in ROAD_WHEELS if name in signals), None)
    if angle is not None and "steering_wheel" in signals:
        both, of = ("steering_wheel", angle), "15 times the other"
        wheel, road = signals["steering_wheel"], 15 * signals[angle]
        yield from _of_scale(wheel, road, both, of, wide, speed)


def _accelerates(signals: Signals, speed: FloatArray | None) -> Iterator[Suspicion]:
    """Compare `ax` with the change of speed over a second."""
    if speed is None or "ax" not in signals or speed.size < 4 * FEWEST_TICKS:
        return
    second = round(1 / float(SAMPLE_TIME_S))
    change = np.full(speed.size, np.nan)
    change[second // 2 : -second // 2] = speed[second:] - speed[:-second]
    smooth = np.convolve(np.nan_to_num(signals["ax"]), np.ones(second) / second, "same")
    slope, correlation = slope_of(smooth, change, moving(speed))
    if correlation < -LEAST_CORRELATION:
        figure = f"its correlation with the change of speed is {correlation:+.2f}"
        yield Suspicion("reversed", ("ax",), figure, "Write negate = true.")
    elif correlation > LEAST_CORRELATION:
        yield from _wrong_scale(slope, ("ax",), "the change of speed", (0.4, 2.5))


def _axles_swapped(signals: Signals, speed: FloatArray | None) -> Iterator[Suspicion]:
    """Compare axles in tight bends: the front one drives the longer way."""
    if speed is None or not {"yaw_rate", *WHEELS} <= set(signals):
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
        yield Suspicion("swapped", WHEELS, figure, "Swap the front columns with the rear ones.")


def _label(signals: Signals, speed: FloatArray | None) -> Iterator[Suspicion]:
    """Look for the label's delay behind its inputs, its sign, and its unit."""
    label = catalogue().label
    if label not in signals or speed is None or not {"yaw_rate", "ay"} <= set(signals):
        return
    rows = moving(speed)
    angle = signals[label]
    large = np.abs(angle[rows & (speed > 8) & np.isfinite(angle)])
    if large.size >= FEWEST_TICKS and np.median(large) > 0.5:
        figure = f"half of the time it is above {np.degrees(np.median(large)):.0f} deg"
        yield Suspicion("scaled", (label,), figure, "Check its unit: degrees or radians?")
        return
    with np.errstate(divide="ignore", invalid="ignore"):
        inputs = [signals["ay"], signals["yaw_rate"] / speed, signals["yaw_rate"] * speed]
    steering = [signals[n] for n in ("steering_wheel", *ROAD_WHEELS) if n in signals]
    delay = find_delay(angle, signals["ay"], signals["yaw_rate"], speed, [*inputs, *steering])
    told = "course" in signals and is_in_time(angle, signals["course"], signals["yaw_rate"])
    if delay is not None and not told:
        seconds, gain = delay
        figure = f"its inputs explain it best {abs(seconds):.2f} s " + (
            "earlier" if seconds > 0 else "later"
        )
        figure += f", with {gain:.0%} less of its variance left"
        yield Suspicion("late", (label,), figure, f"Try delay_s = {seconds:.2f}.", seconds)
    many = large.size >= FEWEST_TICKS and np.quantile(large, 0.9) > LARGE_RAD
    yield from _lever(signals, np.array(inputs[:2]), rows & (speed < SLOW_MPS), many=bool(many))


def _lever(
    signals: Signals, inputs: FloatArray, slow: BoolArray, *, many: bool
) -> Iterator[Suspicion]:
    """Compare the label with what any car does: it needs no peers, where all are wrong alike.

    Turning slowly it is the distance to the rear axle times the yaw rate over the speed, less what
    the rear tyres slip, and 0 on a straight (Milliken and Milliken, Race Car Vehicle Dynamics,
    chapter 5). The same fit of the road wheels tells the wheelbase, which is longer.
    """
    label = catalogue().label
    (_, lever), zero, explained = fit(signals[label], inputs, slow)
    figure = f"turning slowly it goes with the yaw rate by {lever:+.2f} m, should be +1 to +2"
    if explained <= LEAST_CORRELATION:
        return
    if lever < -LEAST_LEVER_M / 2:
        yield Suspicion("reversed", (label,), figure, "Write negate = true.")
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
        yield Suspicion("scaled", (label,), figure, unit)
    elif explained <= SURE_EXPLAINED:
        return
    elif not LEAST_LEVER_M < lever < longest:
        yield Suspicion("scaled", (label,), figure, unit)
    elif abs(zero) > LARGEST_ZERO_RAD:
        figure = f"on a straight it is {np.degrees(zero):+.2f} deg, should be 0"
        yield Suspicion("biased", (label,), figure, f"Write offset = {-zero:.4f} (rad).")


def _of_scale(
    values: FloatArray,
    expected: FloatArray,
    concerned: tuple[str, ...],
    of: str,
    sound: tuple[float, float],
    speed: FloatArray,
) -> Iterator[Suspicion]:
    slope, correlation = slope_of(values, expected, moving(speed))
    if abs(correlation) > LEAST_CORRELATION:
        yield from _wrong_scale(abs(slope), concerned, of, sound)


def _wrong_scale(
    slope: float, concerned: tuple[str, ...], of: str, sound: tuple[float, float]
) -> Iterator[Suspicion]:
    if sound[0] <= slope <= sound[1] or slope <= 0:
        return
    large = max(slope, 1 / slope)
    factor = min(_FACTORS, key=lambda f: abs(np.log(f / large)))
    near = f" ({factor:g} is between {_FACTORS[factor]})" if 0.6 < factor / large < 1.7 else ""
    yield Suspicion("scaled", concerned, f"it is {slope:.3g} times {of}{near}", "Check the units.")
