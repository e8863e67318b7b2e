"""Puts a satellite receiver's fixes onto ticks, as the velocity of the centre of gravity."""

from dataclasses import dataclass

import numpy as np

from fleet_slip.arrays import BoolArray, FloatArray, IntArray
from fleet_slip.ingest.drives.resampling import STEP_S, Resampler
from fleet_slip.ingest.mapping.signal_column import SignalColumn

LEAST_SPEED_MPS = 2.0
"""Below, receivers freeze the course or tell noise."""


@dataclass(frozen=True)
class Antenna:
    """Where the antenna is: before the centre of gravity, and to the left of it, in m."""

    x_m: float
    y_m: float


def course_and_speed(
    column: SignalColumn, first: FloatArray, second: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return counterclockwise course from east and speed of what a mapping's two columns tell.

    They are north and east velocity, or course and speed. NaN where one is missing.
    """
    if column.component:
        return np.arctan2(first, second), np.hypot(first, second)
    course = np.pi / 2 - first if column.clockwise_from_north else first
    return course, second


def fixes_on_ticks(
    course: FloatArray,
    speed: FloatArray,
    resampler: Resampler,
    delay_s: float,
    antenna: Antenna,
    yaw_rate: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return course in rad and speed in m/s at the ticks nearest to the fixes, NaN elsewhere.

    `course` and `speed` are the antenna's, of the resampler's samples; `yaw_rate` is of the ticks,
    in rad/s. A sample that repeats the one before is no fix: the file holds values in between.

    In the car's axes the antenna moves by (-r y, r x) against the centre of gravity, with the yaw
    rate r. Where the car does not slip, that tells how the axes lie to the antenna's course; what
    slip β there is makes an error of r y β over speed. A fix that is measured a part of a tick
    before its tick turns by r times that part. Without a yaw rate there is no course; nor is there
    one below `LEAST_SPEED_MPS`.
    """
    present = np.flatnonzero(_is_new(course, speed))
    nearest, late_s = _nearest(resampler, present, delay_s)
    place = np.searchsorted(resampler.ticks, nearest)
    found = np.isin(nearest, resampler.ticks)
    place, late_s, fixes = place[found], late_s[found], present[found]
    r = yaw_rate[place]
    across = r * antenna.x_m
    along = np.sqrt(np.maximum(speed[fixes] ** 2 - across**2, 0.0))
    turned = course[fixes] - np.arctan2(across, along) + r * late_s
    courses, speeds = (np.full(resampler.ticks.size, np.nan) for _ in range(2))
    speeds[place] = along + r * antenna.y_m
    courses[place] = np.where(speed[fixes] >= LEAST_SPEED_MPS, _in_one_turn(turned), np.nan)
    return courses, speeds


def _is_new(course: FloatArray, speed: FloatArray) -> BoolArray:
    """Return where a sample is there and is not the one before again."""
    there = np.flatnonzero(~np.isnan(course) & ~np.isnan(speed))
    same = np.zeros(there.size, dtype=np.bool_)
    same[1:] = (np.diff(course[there]) == 0) & (np.diff(speed[there]) == 0)
    new = np.zeros(course.size, dtype=np.bool_)
    new[there[~same]] = True
    return new


def _nearest(
    resampler: Resampler, samples: IntArray, delay_s: float
) -> tuple[FloatArray, FloatArray]:
    """Return the tick nearest to each sample, and how much later it is, in s."""
    since = resampler.time_s[samples] - delay_s - resampler.start_s
    nearest = np.rint(since / STEP_S)
    return nearest, nearest * STEP_S - since


def _in_one_turn(angle: FloatArray) -> FloatArray:
    """Return the angle from -pi on, below pi."""
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi, dtype=np.float64)
