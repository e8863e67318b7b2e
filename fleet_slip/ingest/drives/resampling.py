"""Puts the samples of one drive onto ticks of 100 Hz: snap, interpolate or average.

All functions are pure; `time_s` is strictly increasing, seconds since any origin; a missing value
is NaN, and each signal is resampled from its own samples, so that a slow sensor in a fast file is
as well off as one with a file of its own. Nothing is extrapolated. A satellite receiver's fixes
become the velocity of the centre of gravity.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from fleet_slip.arrays import BoolArray, FloatArray, IntArray
from fleet_slip.catalogue.signals import SAMPLE_TIME_S
from fleet_slip.ingest.drives.sound_fixes import find_ticks, is_backwards, is_held, on_grid
from fleet_slip.ingest.mapping.signal_column import SignalColumn

Method = Literal["snap", "interpolate", "average"]

STEP_S = float(SAMPLE_TIME_S)
SNAP_TOLERANCE_S = 0.1 * STEP_S
"""A sample this close to its tick is taken as measured there."""
TIME_EPSILON_S = 1e-6
"""Times that differ by less are equal: a float64 of seconds since 1970 resolves 0.24 µs."""

LEAST_SPEED_MPS = 2.0
"""Below, receivers freeze the course or tell noise."""


def choose_method(time_s: FloatArray, interval_s: float) -> Method:
    """Snap samples of 100 Hz that are near ticks, average a faster log, interpolate others."""
    if interval_s < STEP_S - SNAP_TOLERANCE_S:
        return "average"
    if interval_s <= STEP_S + SNAP_TOLERANCE_S:
        since = time_s - time_s[0]
        ticks = np.rint(since / STEP_S)
        offset = np.abs(since - ticks * STEP_S).max()
        distinct = bool(np.all(ticks[1:] > ticks[:-1]))
        if distinct and offset <= SNAP_TOLERANCE_S + TIME_EPSILON_S:
            return "snap"
    return "interpolate"


@dataclass(frozen=True)
class Resampler:
    """Brings the signals of one drive onto its ticks.

    Attributes:
        ticks: the drive's ticks, shape (n_ticks,).
        start_s: time of tick 0.
    """

    time_s: FloatArray
    method: Method
    ticks: IntArray
    start_s: float

    @cached_property
    def at_s(self) -> FloatArray:
        """Times of the ticks."""
        return np.asarray(self.start_s + self.ticks * STEP_S, dtype=np.float64)

    def resample(
        self, values: FloatArray, delay_s: float = 0.0, longest_gap_s: float = 0.1
    ) -> FloatArray:
        """Return a signal on the ticks; what was measured at t stands in the file at t + delay."""
        if self.method == "snap" and not delay_s:
            return values
        resample = average if self.method == "average" else interpolate
        return resample(self.time_s - delay_s, values, self.at_s, longest_gap_s)

    def hold(
        self, values: FloatArray, delay_s: float = 0.0, longest_gap_s: float = 0.1
    ) -> FloatArray:
        """Return a signal that changes in steps: at each tick the last sample, unless too old."""
        if self.method == "snap" and not delay_s:
            return values
        time_s, values = _present(self.time_s - delay_s, values)
        last = np.searchsorted(time_s, self.at_s + TIME_EPSILON_S, side="right") - 1
        held = np.full(self.at_s.size, np.nan)
        known = last >= 0
        known[known] = (self.at_s[known] - time_s[last[known]]) <= longest_gap_s + TIME_EPSILON_S
        held[known] = values[last[known]]
        return held

    def place(self, values: FloatArray, delay_s: float = 0.0) -> FloatArray:
        """Return a signal with each sample at its nearest tick, the last of several, else NaN."""
        present = np.flatnonzero(~np.isnan(values))
        nearest = np.rint((self.time_s[present] - delay_s - self.at_s[0]) / STEP_S)
        place, found = find_ticks(self.ticks, nearest)
        placed = np.full(self.ticks.size, np.nan)
        placed[place[found]] = values[present[found]]
        return placed


def build_resampler(time_s: FloatArray, method: Method) -> Resampler:
    """Return what brings signals at these times onto the ticks of their drive."""
    if method == "snap":
        return Resampler(time_s, method, snap(time_s), time_s[0])
    start_s, number = tick_range(time_s, method)
    return Resampler(time_s, method, np.arange(number), start_s)


def snap(time_s: FloatArray) -> IntArray:
    """Return the tick nearest to each sample, the first sample being tick 0."""
    ticks: IntArray = np.rint((time_s - time_s[0]) / STEP_S).astype(np.int64)
    return ticks


def tick_range(time_s: FloatArray, method: Method) -> tuple[float, int]:
    """Return the time of tick 0, half a tick late for averages, and the number of ticks."""
    margin = STEP_S / 2 if method == "average" else 0.0
    span = time_s[-1] - time_s[0] - 2 * margin
    return float(time_s[0] + margin), int(np.floor((span + TIME_EPSILON_S) / STEP_S)) + 1


def interpolate(
    time_s: FloatArray, values: FloatArray, at_s: FloatArray, longest_gap_s: float
) -> FloatArray:
    """Interpolate at `at_s`; NaN outside, and in gaps that are too wide unless at a sample."""
    time_s, values = _present(time_s, values)
    if not time_s.size:
        return np.full(at_s.shape, np.nan)
    right = np.clip(np.searchsorted(time_s, at_s), 0, time_s.size - 1)
    left = np.maximum(right - 1, 0)
    to_left, to_right = np.abs(at_s - time_s[left]), np.abs(at_s - time_s[right])
    measured = np.minimum(to_left, to_right) <= TIME_EPSILON_S
    inside = (at_s >= time_s[0]) & (at_s <= time_s[-1])
    bridged = time_s[right] - time_s[left] <= longest_gap_s + TIME_EPSILON_S
    return np.where(measured | (inside & bridged), np.interp(at_s, time_s, values), np.nan)


def average(
    time_s: FloatArray, values: FloatArray, at_s: FloatArray, longest_gap_s: float
) -> FloatArray:
    """Average the piecewise linear signal over the sample time around each of `at_s`.

    The integral of the trapezoids is exact, so a linear signal comes out exact. As a filter it is
    a moving average of 10 ms: gain sinc(f / 100 Hz), -3.9 dB at 50 Hz, zero at 100 Hz and its
    multiples, no phase shift. NaN where the window leaves the samples or meets a gap.
    """
    time_s, values = _present(time_s, values)
    if time_s.size < 2:
        return np.full(at_s.shape, np.nan)
    step = np.diff(time_s)
    slope = np.diff(values) / step
    area = np.concatenate([[0.0], np.cumsum(step * (values[1:] + values[:-1]) / 2)])
    gaps = np.concatenate([[0], np.cumsum(step > longest_gap_s + TIME_EPSILON_S)])
    start = np.clip(at_s - STEP_S / 2, time_s[0], time_s[-1])
    end = np.clip(at_s + STEP_S / 2, time_s[0], time_s[-1])
    first = np.clip(np.searchsorted(time_s, start, side="right") - 1, 0, step.size - 1)
    last = np.clip(np.searchsorted(time_s, end) - 1, 0, step.size - 1)

    def integral(i: IntArray, t: FloatArray) -> FloatArray:
        into = t - time_s[i]
        return np.asarray(area[i] + into * (values[i] + slope[i] * into / 2), dtype=np.float64)

    width = end - start
    whole = (width >= STEP_S - 2 * TIME_EPSILON_S) & (gaps[last + 1] == gaps[first])
    mean = (integral(last, end) - integral(first, start)) / np.where(whole, width, 1.0)
    return np.where(whole, mean, np.nan)


def _present(time_s: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    present = ~np.isnan(values)
    return time_s[present], values[present]


@dataclass(frozen=True)
class Antenna:
    """Where the antenna is: before the centre of gravity, and to the left of it, in m."""

    x_m: float
    y_m: float


def course_and_speed(
    column: SignalColumn, first: FloatArray, second: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return course from east and speed of two columns: north and east, or course and speed."""
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
    ay: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return course in rad and speed in m/s at the ticks nearest to the fixes, NaN elsewhere.

    `course` and `speed` are the antenna's, of the resampler's samples; `yaw_rate` in rad/s and
    `ay` in m/s² are of the ticks. A sample that repeats the one before is no fix: the file holds
    values in between. One of a course that `is_held`, or of a car that `is_backwards`, has none.
    Fixes at irregular times are brought `on_grid`.

    In the car's axes the antenna moves by (-r y, r x) against the centre of gravity, with the yaw
    rate r. Where the car does not slip, that tells how the axes lie to the antenna's course; what
    slip β there is makes an error of r y β over speed. A fix that is measured a part of a tick
    before its tick turns by r times that part. Without a yaw rate there is no course; nor is there
    one below `LEAST_SPEED_MPS`.
    """
    present = np.flatnonzero(_is_new(course, speed))
    nearest, late_s = _nearest(resampler, present, delay_s)
    place, found = find_ticks(resampler.ticks, nearest)
    place, late_s, fixes = place[found], late_s[found], present[found]
    r = yaw_rate[place]
    across = r * antenna.x_m
    along = np.sqrt(np.maximum(speed[fixes] ** 2 - across**2, 0.0))
    turned = course[fixes] - np.arctan2(across, along) + r * late_s
    courses, speeds = (np.full(resampler.ticks.size, np.nan) for _ in range(2))
    speeds[place] = along + r * antenna.y_m
    sound = (speed[fixes] >= LEAST_SPEED_MPS) & ~is_held(course[fixes], yaw_rate, place)
    if ay is not None:
        sound &= ~is_backwards(yaw_rate, ay, speed[fixes], place)
    courses[place] = np.where(sound, turned, np.nan)
    courses, speeds = on_grid(resampler.ticks, courses, speeds, yaw_rate)
    return _in_one_turn(courses), speeds


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
