"""Which fixes of a satellite receiver tell where the car goes, and where they stand.

Not all that have a course do, and changes over some seconds are of fixes that are exactly so far
apart.
"""

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import BoolArray, FloatArray, IntArray
from fleet_slip.catalogue.signals import SAMPLE_TIME_S

STEP_S = float(SAMPLE_TIME_S)
SAME_RAD = 1e-6
"""A course is finer; of two velocities one that stands still differs by rounding."""
HELD_RAD = 0.005
"""What a car may turn while its course stays the same: half a degree is a coarse receiver's."""
BACKWARDS_MPS = 8.0
"""Nobody drives backwards faster."""
LEAST_TURNING_RAD_S = 0.1
"""An accelerometer that is off by 0.15 m/s² seems to drive backwards at 1.5 m/s then, no faster."""

SECOND = round(1 / STEP_S)
GRIDS = tuple(ticks for ticks in range(1, SECOND + 1) if SECOND % ticks == 0)
"""Spacings of fixes, in ticks, of which a whole number is a second."""
REGULAR = 0.8
LONGEST_BETWEEN = 25
"""Ticks between two fixes, in which the side-slip angle is nearly a straight line."""
LONGEST_BESIDE = 5
"""Ticks from the only fix near: it changes by some tenths of a degree at most."""


def is_held(course: FloatArray, yaw_rate: FloatArray, place: IntArray) -> BoolArray:
    """Return which fixes repeat a course from before the car turned on.

    Receivers hold the course when they are slow, or tell it less often than the speed. `place` says
    at which tick each fix is; `course` is of the fixes, and `yaw_rate` of the ticks.
    """
    if not course.size:
        return np.zeros(0, dtype=np.bool_)
    heading = np.cumsum(np.nan_to_num(yaw_rate))[place] * STEP_S
    new = np.append(True, np.abs(np.diff(course)) > SAME_RAD)
    first = np.maximum.accumulate(np.where(new, np.arange(course.size), 0))
    held: BoolArray = ~new & (np.abs(heading - heading[first]) > HELD_RAD)
    return held


def is_backwards(
    yaw_rate: FloatArray, ay: FloatArray, speed: FloatArray, place: IntArray
) -> BoolArray:
    """Return at which fixes the car drives backwards: it is pushed to the outside of its bend.

    The lateral acceleration is the yaw rate times the forward speed, here by least squares over the
    second around a fix. Straight on it does not tell, and the course is right all the same.
    """
    second = np.ones(2 * round(0.5 / STEP_S) + 1)
    if not place.size:
        return np.zeros(0, dtype=np.bool_)
    squares, products = (
        np.convolve(np.nan_to_num(one), second)[second.size // 2 :][place]
        for one in (yaw_rate**2, yaw_rate * ay)
    )
    turning = squares > second.size * LEAST_TURNING_RAD_S**2
    backwards: BoolArray = turning & (speed < BACKWARDS_MPS) & (products < -0.5 * speed * squares)
    return backwards


def on_grid(
    ticks: IntArray, course: FloatArray, speed: FloatArray, yaw_rate: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return course and speed at regular ticks, if the fixes are at irregular ones.

    They are regular if most that have a fix about a second later have one exactly then. What is
    interpolated is the course less the yaw rate's integral, that is the slip, between two fixes
    that are near, or taken from one that is nearer. All arrays are of the ticks.
    """
    fixes = np.flatnonzero(~np.isnan(course))
    if fixes.size < 2 or _is_regular(ticks[fixes]):
        return course, speed
    heading = np.cumsum(np.nan_to_num(yaw_rate)) * STEP_S
    heading[np.isnan(yaw_rate)] = np.nan
    slip = np.full(course.size, np.nan)
    slip[fixes] = np.unwrap(course[fixes] - heading[fixes])
    usual = float(np.median(np.diff(ticks[fixes])))
    spacing = min(GRIDS, key=lambda grid: abs(np.log(grid / usual)))
    chosen = ticks % spacing == 0
    found = []
    for values in (slip, speed):
        placed = np.full(values.size, np.nan)
        placed[chosen] = _between(ticks, values, ticks[chosen])
        found.append(placed)
    return found[0] + heading, found[1]


def find_ticks(
    ticks: IntArray, wanted: IntArray | FloatArray
) -> tuple[NDArray[np.intp], BoolArray]:
    """Return where ticks are among others, which are in order, and whether they are at all."""
    place = np.searchsorted(ticks, wanted)
    found: BoolArray = place < ticks.size
    found[found] = ticks[place[found]] == wanted[found]
    return place, found


def _is_regular(fixes: IntArray) -> bool:
    """Return whether most fixes that have one about a second later have one exactly then."""
    later = find_ticks(fixes, fixes + SECOND)[1]
    next_one = np.searchsorted(fixes, fixes + SECOND - SECOND // 10)
    there = next_one < fixes.size
    there[there] = fixes[next_one[there]] <= fixes[there] + SECOND + SECOND // 10
    return not there.any() or bool(later[there].mean() >= REGULAR)


def _between(ticks: IntArray, values: FloatArray, at: IntArray) -> FloatArray:
    """Return values at ticks, by straight lines between near samples, else beside a nearer one."""
    known = np.flatnonzero(~np.isnan(values))
    times, told = ticks[known], values[known]
    right = np.clip(np.searchsorted(times, at), 0, times.size - 1)
    left = np.maximum(right - 1, 0)
    bridged = (times[right] >= at) & (times[right] - times[left] <= LONGEST_BETWEEN)
    bridged &= times[left] <= at
    nearer = np.where(at - times[left] < times[right] - at, left, right)
    beside = np.abs(times[nearer] - at) <= LONGEST_BESIDE
    line = np.where(bridged, np.interp(at, times, told), np.nan)
    return np.where(bridged | ~beside, line, told[nearer])
