"""Converts a drive to ticks and counts: its signals are resampled to 100 Hz and rounded.

Each signal is resampled from its own samples, with strictly increasing times, so that a slow sensor
in a fast file gives the same values as in a separate file. Nothing is extrapolated. The fixes of a
satellite receiver become the velocity of the centre of gravity.
"""

from collections.abc import Mapping as Named
from dataclasses import dataclass, field
from datetime import UTC, date, datetime, timedelta
from functools import cached_property
from typing import Any, Literal

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from fleet_slip.arrays import BoolArray, FloatArray, IntArray
from fleet_slip.catalog.counts import as_floats, digest_counts, round_chunks
from fleet_slip.catalog.course import COURSE, SATELLITE_SPEED
from fleet_slip.catalog.signals import MEASURED, SignalCatalog
from fleet_slip.errors import InputError
from fleet_slip.ingest.columns import STEP_S, TIME_EPSILON_S, WHEEL_PREFIX, SignalColumn
from fleet_slip.ingest.drives import DriveSamples
from fleet_slip.ingest.formats.source import EARLIEST_S
from fleet_slip.ingest.mapping import DriveMetadata, FromColumn, LabelSensor, Mapping
from fleet_slip.quality.drive_signals import (
    MOVING_MPS,
    OWN_SPEEDS,
    RADIUS_M,
    TICKS_PER_S,
    wrap_angle,
)

_SECONDS_PER_DAY = 86_400
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_FROM_MAPPING = tuple(name for name in DriveMetadata.model_fields if name != "column")

FINGERPRINT_PREFIX = "same/"
"""Prefix of the name of a fingerprint's transaction; see `recordings`."""

Method = Literal["snap", "interpolate", "average"]


@dataclass(frozen=True)
class MeasuredDrive:
    """An uninterrupted segment of a file on ticks.

    Attributes
    ----------
    metadata
        Values by column of `logs`.
    counts
        An int16 array for each signal.
    """

    drive_id: str
    metadata: dict[str, Any]
    method: Method
    ticks: NDArray[np.int32]
    counts: dict[str, pa.Array]
    values_on_ticks: dict[str, int] = field(default_factory=dict)
    """Number of values of each mapped signal, before labels at low speed were dropped."""
    interval_s: float = STEP_S
    """Sample time of the fastest time base, in s."""

    @cached_property
    def counts_digest(self) -> str:
        """The digest of its counts."""
        car, day = str(self.metadata["vehicle_id"]), str(self.metadata["day"])
        return digest_counts(car, day, self.ticks, self.counts)


def drive_id(prefix: str, group: int, segment: int = 1) -> str:
    """Return the name of the n-th segment (from 1) of the drive with this number (from 0)."""
    return f"{prefix}-{group + 1}" + (f"-{segment}" if segment > 1 else "")


def to_ticks(
    rows: DriveSamples, mapping: Mapping, name: str, metadata_of_drive: dict[str, Any]
) -> MeasuredDrive:
    """Convert a drive's signals, SI units at times in s, to counts at 100 Hz.

    Ticks at which no signal has a value are left out. `metadata_of_drive` has values by column of
    `logs`. Raises `InputError` for missing metadata.
    """
    signals, has_course = mapping.signal_catalog, COURSE in mapping.signals
    if len(rows.bases) > 1:  # ticks of several time bases are interpolated
        grid = choose_grid(np.array([0.0, rows.end_s - rows.start_s]), np.inf)
    else:
        time_s = rows.column("time").to_numpy() - rows.start_s
        grid = choose_grid(time_s, rows.interval_of("time"), fill_gaps=has_course)
    counts = {}
    for signal, source in mapping.signals.items():
        if has_course and signal in {COURSE, SATELLITE_SPEED}:
            continue
        if grid.method == "snap" and source.interpolate and not source.delay_s:
            values = [chunk.to_numpy() for chunk in rows.column(signal).get_chunks()]
        else:
            values = [_resample(rows, signal, grid, mapping)]
        # Rounding can clip only the last bit of resampling: other values are in quarantine.
        counts[signal] = round_chunks(values, signals[signal])
    if has_course:
        counts |= _fixes(rows, grid, mapping, counts)
    values_on_ticks = {name: len(column) - column.null_count for name, column in counts.items()}
    counts |= place_label(mapping, counts)
    if mapping.front_wheels:
        steer = [physical(signals, counts, "steer")]
        counts |= {wheel: round_chunks(steer, signals[wheel]) for wheel in mapping.front_wheels}
    ticks = grid.ticks
    if all(column.null_count for column in counts.values()):
        columns = pl.DataFrame({signal: pl.Series(column) for signal, column in counts.items()})
        has_value = columns.select(pl.any_horizontal(pl.all().is_not_null())).to_series()
        counts = {key: array.filter(has_value.to_arrow()) for key, array in counts.items()}
        ticks = ticks[has_value.to_numpy()]
    metadata = _metadata(name, metadata_of_drive, rows.start_s, mapping)
    if len(ticks):
        metadata |= {"rows": len(ticks), "duration_s": (int(ticks[-1]) - int(ticks[0])) * STEP_S}
    interval_s = min(rows.intervals_s.values())
    return MeasuredDrive(name, metadata, grid.method, ticks, counts, values_on_ticks, interval_s)


def _metadata(
    name: str, of_drive: dict[str, Any], start_s: float, mapping: Mapping
) -> dict[str, Any]:
    """Return the metadata of a drive, by column of `logs`. Raises `InputError`."""
    stated = {key: getattr(mapping.drive, key) for key in _FROM_MAPPING}
    metadata = {key: value for key, value in stated.items() if not isinstance(value, FromColumn)}
    if stated["day"] is None:  # then time is in timestamps, or those of the file's own clock
        if mapping.time.own_clock and start_s < EARLIEST_S:
            raise InputError("its clock has no date. Give it in the mapping: drive.day.")
        metadata["day"] = date.fromordinal(_EPOCH.toordinal() + int(start_s // _SECONDS_PER_DAY))
    metadata |= of_drive
    dated = mapping.time.is_dated and start_s >= EARLIEST_S
    return {
        **metadata,
        "started_at": _EPOCH + timedelta(seconds=start_s) if dated else None,  # to the microsecond
        "drive_id": name,
        "source": MEASURED,
        "campaign": mapping.name,
        "saturated": 0,  # values outside their range are quarantined, not clipped
    }


# Resampling: samples of 100 Hz near their ticks are snapped, faster ones averaged, others
# interpolated.

SNAP_TOLERANCE_S = 0.1 * STEP_S
"""A sample this close to its tick is taken as measured there."""


@dataclass(frozen=True)
class TickGrid:
    """The ticks of a drive.

    Attributes
    ----------
    start_s
        Time of tick 0: the first sample, for averages half a tick later.
    """

    method: Method
    ticks: NDArray[np.int32]
    start_s: float = 0.0

    @cached_property
    def at_s(self) -> FloatArray:
        """Times of the ticks."""
        return np.asarray(self.start_s + self.ticks * STEP_S, dtype=np.float64)


def choose_grid(time_s: FloatArray, interval_s: float, *, fill_gaps: bool = False) -> TickGrid:
    """Return the ticks of samples with this usual time between them.

    With `fill_gaps` ticks in short gaps are interpolated: some loggers lose one sample in a
    hundred, which would leave no whole second over which to integrate the yaw rate.
    """
    if abs(interval_s - STEP_S) <= SNAP_TOLERANCE_S:
        since_s = time_s - time_s[0]
        ticks = np.rint(since_s / STEP_S)
        offset_s = np.abs(since_s - ticks * STEP_S).max()
        steps = np.diff(ticks)
        is_distinct = steps.min(initial=1) >= 1
        has_gaps = fill_gaps and steps.max(initial=1) > 1
        if is_distinct and not has_gaps and offset_s <= SNAP_TOLERANCE_S + TIME_EPSILON_S:
            return TickGrid("snap", ticks.astype(np.int32), float(time_s[0]))
    is_fast = interval_s < STEP_S - SNAP_TOLERANCE_S
    margin_s = STEP_S / 2 if is_fast else 0.0
    span_s = time_s[-1] - time_s[0] - 2 * margin_s
    number = int(np.floor((span_s + TIME_EPSILON_S) / STEP_S)) + 1
    method: Method = "average" if is_fast else "interpolate"
    return TickGrid(method, np.arange(number, dtype=np.int32), float(time_s[0] + margin_s))


def _resample(rows: DriveSamples, signal: str, grid: TickGrid, mapping: Mapping) -> FloatArray:
    """Return a signal on the ticks of its drive. The file has the value of time t at t + delay."""
    source, samples = mapping.signals[signal], rows.samples(signal)
    time_s = samples["time"].to_numpy() - rows.start_s - source.delay_s
    values = samples[signal].to_numpy()
    if not source.interpolate:
        return place_samples(time_s, values, grid)
    longest_gap_s = source.longest_gap_s or mapping.time.longest_gap_s
    if mapping.signal_catalog[signal].stepwise:
        return hold(time_s, values, grid.at_s, longest_gap_s)
    interval_s = rows.interval_of(signal)
    resample = average if interval_s < STEP_S - SNAP_TOLERANCE_S else interpolate
    if signal != mapping.signal_catalog.label:
        return resample(time_s, values, grid.at_s, longest_gap_s)
    # An angle must not pass through 0 where it wraps from π to -π: the car spins.
    angle = resample(time_s, np.unwrap(values), grid.at_s, longest_gap_s)
    return np.asarray(angle - 2 * np.pi * np.rint(angle / (2 * np.pi)), dtype=np.float64)


def hold(
    time_s: FloatArray, values: FloatArray, at_s: FloatArray, longest_gap_s: float
) -> FloatArray:
    """Return a signal that changes in steps: at each tick the last sample, unless too old."""
    last = np.searchsorted(time_s, at_s + TIME_EPSILON_S, side="right") - 1
    age_s = at_s - np.append(time_s, np.inf)[last]
    is_known = (last >= 0) & (age_s <= longest_gap_s + TIME_EPSILON_S)
    return np.where(is_known, np.append(values, np.nan)[last], np.nan)


def place_samples(time_s: FloatArray, values: FloatArray, grid: TickGrid) -> FloatArray:
    """Return each sample at its nearest tick, the last of several, and NaN at other ticks."""
    place, exists = find_ticks(grid.ticks, np.rint((time_s - grid.at_s[0]) / STEP_S))
    placed = np.full(grid.ticks.size, np.nan)
    placed[place[exists]] = values[exists]
    return placed


def find_ticks(
    ticks: IntArray | NDArray[np.int32], values: IntArray | FloatArray
) -> tuple[NDArray[np.intp], BoolArray]:
    """Return the positions of `values` in the sorted `ticks`, and the mask of present values."""
    place = np.searchsorted(ticks, values)
    exists: BoolArray = place < ticks.size
    exists[exists] = ticks[place[exists]] == values[exists]
    return place, exists


def interpolate(
    time_s: FloatArray, values: FloatArray, at_s: FloatArray, longest_gap_s: float
) -> FloatArray:
    """Interpolate at `at_s`; NaN outside, and in gaps that are too wide unless at a sample."""
    if not time_s.size:
        return np.full(at_s.shape, np.nan)
    right = np.clip(np.searchsorted(time_s, at_s), 0, time_s.size - 1)
    before = np.maximum(right - 1, 0)
    to_left, to_right = np.abs(at_s - time_s[before]), np.abs(at_s - time_s[right])
    measured = np.minimum(to_left, to_right) <= TIME_EPSILON_S
    inside = (at_s >= time_s[0]) & (at_s <= time_s[-1])
    bridged = time_s[right] - time_s[before] <= longest_gap_s + TIME_EPSILON_S
    return np.where(measured | (inside & bridged), np.interp(at_s, time_s, values), np.nan)


def average(
    time_s: FloatArray, values: FloatArray, at_s: FloatArray, longest_gap_s: float
) -> FloatArray:
    """Average the piecewise linear signal over the sample time around each of `at_s`.

    The integral of the trapezoids is exact, so a linear signal comes out exact. As a filter it is
    a moving average of 10 ms: gain sinc(f / 100 Hz), -3.9 dB at 50 Hz, zero at 100 Hz and its
    multiples, no phase shift. NaN where the window leaves the samples or meets a gap.
    """
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
    is_complete = (width >= STEP_S - 2 * TIME_EPSILON_S) & (gaps[last + 1] == gaps[first])
    mean = (integral(last, end) - integral(first, start)) / np.where(is_complete, width, 1.0)
    return np.where(is_complete, mean, np.nan)


# Valid fixes of a satellite receiver, and their ticks.

SAME_RAD = 1e-6
"""Tolerance for equal courses, above the rounding of a course from two velocities."""
HELD_RAD = 0.005
"""Maximum turn with an unchanged course: coarse receivers have steps of half a degree."""
BACKWARDS_MPS = 8.0
"""Maximum speed backwards."""
MIN_YAW_RATE_BACKWARDS_RAD_S = 0.1
"""Minimum RMS of the yaw rate: an offset of 0.15 m/s² then looks like at most 1.5 m/s backwards."""

GRIDS = np.array([ticks for ticks in range(1, TICKS_PER_S + 1) if TICKS_PER_S % ticks == 0])
"""Spacings of fixes, in ticks, that divide a second."""
REGULAR = 0.8
"""Minimum share of fixes with another one exactly a second later, if the fixes are regular."""
MAX_TICKS_BETWEEN = 25
"""Ticks between two fixes, for which the side-slip angle is nearly linear in time."""


def is_held(course: FloatArray, yaw_rate: FloatArray, place: IntArray) -> BoolArray:
    """Return a mask of fixes that repeat an outdated course.

    Receivers hold the course when they are slow, or report it less often than the speed. `course`
    has the shape (fixes,), `yaw_rate` (ticks,), and `place` is the tick of each fix.
    """
    heading = np.cumsum(np.nan_to_num(yaw_rate))[place] * STEP_S
    new = np.append(True, np.abs(np.diff(course)) > SAME_RAD)
    first = np.maximum.accumulate(np.where(new, np.arange(course.size), 0))
    held: BoolArray = ~new & (np.abs(heading - heading[first]) > HELD_RAD)
    return held


def is_backwards(
    yaw_rate: FloatArray, ay: FloatArray, speed: FloatArray, place: IntArray
) -> BoolArray:
    """Return a mask of fixes at which the car drives backwards.

    The lateral acceleration is the yaw rate times the forward speed. The sign of this speed follows
    by least squares over the second around a fix. Straight driving does not show it.
    """
    second = np.ones(2 * round(0.5 / STEP_S) + 1)
    squares, products = (
        np.convolve(np.nan_to_num(signal), second)[second.size // 2 :][place]
        for signal in (yaw_rate**2, yaw_rate * ay)
    )
    turning = squares > second.size * MIN_YAW_RATE_BACKWARDS_RAD_S**2
    backwards: BoolArray = turning & (speed < BACKWARDS_MPS) & (products < -0.5 * speed * squares)
    return backwards


def on_grid(
    ticks: NDArray[np.int32], course: FloatArray, speed: FloatArray, yaw_rate: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return course and speed at regular ticks; regular fixes stay unchanged.

    Interpolates the course minus the integral of the yaw rate, which is the side-slip angle,
    between near fixes. All arrays have the shape (ticks,).
    """
    is_fix = ~np.isnan(course)
    fixes = ticks[is_fix]
    if fixes.size < 2:
        return course, speed
    later, tolerance = fixes + TICKS_PER_S, TICKS_PER_S // 10
    following = np.searchsorted(fixes, later - tolerance)
    has_later = following < np.searchsorted(fixes, later + tolerance, side="right")
    # Regular fixes: most with another about a second later have one exactly then.
    if not has_later.any() or np.isin(later, fixes)[has_later].mean() >= REGULAR:
        return course, speed
    heading = np.cumsum(np.nan_to_num(yaw_rate)) * STEP_S
    heading[np.isnan(yaw_rate)] = np.nan
    usual = float(np.median(np.diff(fixes)))
    spacing = GRIDS[np.argmin(np.abs(np.log(GRIDS / usual)))]
    chosen = ticks % spacing == 0
    gridded = []
    for values in (np.unwrap((course - heading)[is_fix]), speed[is_fix]):
        placed = np.full(ticks.size, np.nan)
        placed[chosen] = interpolate(
            fixes.astype(np.float64), values, ticks[chosen], MAX_TICKS_BETWEEN
        )
        gridded.append(placed)
    return gridded[0] + heading, gridded[1]


def _new_fixes(
    rows: DriveSamples, source: SignalColumn
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return time in s since the drive began, course in rad and speed in m/s of each new fix.

    The course is counter-clockwise from the east. A sample equal to the previous one is no new fix.
    """
    both = rows.samples(COURSE), rows.samples(SATELLITE_SPEED)
    samples = both[0].join(both[1], on="time", how="inner", maintain_order="left")
    course, speed = samples[COURSE].to_numpy(), samples[SATELLITE_SPEED].to_numpy()
    if source.component:  # the velocities to the north and to the east
        course, speed = np.arctan2(course, speed), np.hypot(course, speed)
    elif source.clockwise_from_north:
        course = np.pi / 2 - course
    is_new = (np.diff(course, prepend=np.nan) != 0) | (np.diff(speed, prepend=np.nan) != 0)
    time_s = samples["time"].to_numpy() - rows.start_s
    return time_s[is_new], course[is_new], speed[is_new]


def _fixes(
    rows: DriveSamples, grid: TickGrid, mapping: Mapping, counts: dict[str, pa.Array]
) -> dict[str, pa.Array]:
    """Return the counts of course and speed at the ticks nearest to the fixes, null elsewhere.

    The course is null without a yaw rate, below `MOVING_MPS`, and where it `is_held` or
    `is_backwards`.

    In the car's axes the antenna moves by (-r y, r x) relative to the centre of gravity, with the
    yaw rate r; a slip β causes an error of r y β / speed. A fix that is measured a fraction of a
    tick before its tick is rotated by r times that time.
    """
    signals, source = mapping.signal_catalog, mapping.signals[COURSE]
    time_s, course, speed = _new_fixes(rows, source)
    since = time_s - source.delay_s - grid.start_s
    nearest = np.rint(since / STEP_S)
    place, exists = find_ticks(grid.ticks, nearest)
    place, late_s = place[exists], (nearest * STEP_S - since)[exists]
    courses, speeds = (np.full(grid.ticks.size, np.nan) for _ in range(2))
    if place.size:
        yaw_rate = physical(signals, counts, "yaw_rate")
        course, speed, r = course[exists], speed[exists], yaw_rate[place]
        across = r * (source.antenna_x_m or 0.0)
        along = np.sqrt(np.maximum(speed**2 - across**2, 0.0))
        turned = course - np.arctan2(across, along) + r * late_s
        speeds[place] = along + r * (source.antenna_y_m or 0.0)
        sound = (speed >= MOVING_MPS) & ~is_held(course, yaw_rate, place)
        if "ay" in counts:
            sound &= ~is_backwards(yaw_rate, physical(signals, counts, "ay"), speed, place)
        courses[place] = np.where(sound, turned, np.nan)
        courses, speeds = on_grid(grid.ticks, courses, speeds, yaw_rate)
    columns = {COURSE: wrap_angle(courses), SATELLITE_SPEED: speeds}
    return {name: round_chunks([values], signals[name]) for name, values in columns.items()}


# The label is moved to the centre of gravity. With the yaw rate r, a sensor x before it and y to
# its left has the velocities (vx - r y, vy + r x). A measured angle needs a speed for this.


def physical(signals: SignalCatalog, counts: Named[str, pa.Array], name: str) -> FloatArray:
    """Return a signal in SI units, NaN where there is none."""
    return as_floats(counts[name]) * float(signals[name].scale)


def place_label(mapping: Mapping, counts: Named[str, pa.Array]) -> dict[str, pa.Array]:
    """Return the counts of the label at the centre of gravity, and of velocities that it is from.

    There is no label below `MOVING_MPS`, where sensors of angles report noise.
    """
    sensor, signals = mapping.label or LabelSensor(), mapping.signal_catalog
    label, speed = signals.label, _speed(mapping, counts)
    if sensor.from_velocities:
        vx, vy = physical(signals, counts, "vx"), physical(signals, counts, "vy")
    elif label not in counts or speed is None:
        return {}
    elif sensor.is_elsewhere:
        angle = physical(signals, counts, label)
        vx, vy = speed * np.cos(angle), speed * np.sin(angle)
    else:
        is_fast = pl.Series(~(speed < MOVING_MPS)).to_arrow()
        return {label: pc.if_else(is_fast, counts[label], pa.scalar(None, pa.int16()))}
    if sensor.is_elsewhere:
        yaw_rate = physical(signals, counts, "yaw_rate")
        vx, vy = vx + yaw_rate * sensor.sensor_y_m, vy - yaw_rate * sensor.sensor_x_m
    if speed is None or sensor.from_velocities:
        speed = np.hypot(vx, vy)
    columns = {label: np.where(speed >= MOVING_MPS, np.arctan2(vy, vx), np.nan)}
    columns |= {"vx": vx, "vy": vy} if sensor.from_velocities else {}
    return {name: round_chunks([values], signals[name]) for name, values in columns.items()}


def _speed(mapping: Mapping, counts: Named[str, pa.Array]) -> FloatArray | None:
    """Return the speed in m/s: the logged one, else the median of the wheels; None without both."""
    signals = mapping.signal_catalog
    for name in OWN_SPEEDS:
        if name in counts:
            return np.abs(physical(signals, counts, name))
    wheels = [name for name in counts if name.startswith(WHEEL_PREFIX)]
    factors = [
        float(signals[name].scale) * (mapping.signals[name].radius_m or RADIUS_M) for name in wheels
    ]
    if not wheels:
        return None
    if len(set(factors)) > 1 or len(wheels) != 4:
        pairs = zip(wheels, factors, strict=True)
        speeds = [as_floats(counts[name]) * factor for name, factor in pairs]
        return np.asarray(np.median(speeds, axis=0), dtype=np.float64)
    # The median of four counts by comparing pairs takes a tenth of the time of numpy's.
    a, b, c, d = (pl.Series(counts[name]).to_numpy() for name in wheels)
    lower = np.maximum(np.minimum(a, b), np.minimum(c, d))
    upper = np.minimum(np.maximum(a, b), np.maximum(c, d))
    return np.asarray(np.add(lower, upper, dtype=np.float64) * (factors[0] / 2))
