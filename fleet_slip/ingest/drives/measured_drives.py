"""Makes drives of checked rows: their names and trips, their ticks and counts; and counts them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime, timedelta
from functools import cached_property, partial
from typing import Any

import numpy as np
import polars as pl
import pyarrow as pa
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.counts import digest_drive, round_chunks
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.catalogue.sources import LONGEST_PAUSE_S
from fleet_slip.errors import InputError
from fleet_slip.ingest.drives.label_place import physical, place_label
from fleet_slip.ingest.drives.open_drives import DriveRows
from fleet_slip.ingest.drives.resampling import (
    SNAP_TOLERANCE_S,
    STEP_S,
    Antenna,
    Method,
    Resampler,
    build_resampler,
    choose_method,
    course_and_speed,
    fixes_on_ticks,
)
from fleet_slip.ingest.mapping.mapping import FromColumn, Mapping
from fleet_slip.ingest.mapping.signal_column import COURSE, SPEED

SOURCE = "measured"
_SECONDS_PER_DAY = 86_400
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_EARLIEST_S = 10**8
"""Times before 1973 are counted from the start of a recording, not from 1970."""
_FROM_FILE = ("drive_name", "source_file", "trip_id")
_FROM_MAPPING = (
    *("vehicle_id", "vehicle_model", "track", "mass_kg"),
    *("tyres", "receiver", "adhesion", "day"),
)


@dataclass(frozen=True)
class MeasuredDrive:
    """One uninterrupted stretch of a file on ticks.

    Attributes:
        metadata: what is known of it, by column of `logs`.
        counts: an int16 array for each signal.
    """

    drive_id: str
    metadata: dict[str, Any]
    method: Method
    ticks: NDArray[np.int32]
    counts: dict[str, pa.Array]

    @property
    def num_rows(self) -> int:
        """Number of its rows, as a table has it."""
        return self.ticks.size

    @cached_property
    def counts_digest(self) -> str:
        """What tells it by its counts."""
        car, day = str(self.metadata["vehicle_id"]), str(self.metadata["day"])
        return digest_drive(car, day, self.ticks, self.counts)


def drive_id(prefix: str, group: int, stretch: int = 1) -> str:
    """Return the name of the n-th stretch (from 1) of the drive with this number (from 0)."""
    return f"{prefix}-{group + 1}" + (f"-{stretch}" if stretch > 1 else "")


def to_ticks(
    rows: DriveRows,
    mapping: Mapping,
    intervals_s: dict[int, float],
    name: str,
    known: dict[str, Any],
) -> MeasuredDrive:
    """Bring one drive's signals, SI units at times in s, to counts at 100 Hz.

    Ticks at which no signal has a value are left out. `intervals_s` are the usual times between
    the samples of each time base; `known` is what is known of the drive, by column of `logs`.
    Raises `InputError` for what nobody says.
    """
    start_s = rows.start_s
    resampler = _build_resampler(rows, intervals_s, whole=COURSE in mapping.signals)
    method, ticks = resampler.method, resampler.ticks.astype(np.int32)
    counts, somewhere = {}, np.zeros(ticks.size, dtype=np.bool_)
    for signal, source in mapping.signals.items():
        if signal in {COURSE, SPEED} and COURSE in mapping.signals:
            continue
        if method == "snap" and source.interpolate and not source.delay_s:
            values = rows.chunks(signal)
        elif len(intervals_s) == 1:
            values = [_resample(rows.column(signal), resampler, signal, mapping)]
        else:
            samples = rows.samples(signal)
            own = _on_own_times(samples, start_s, resampler, intervals_s)
            values = [_resample(samples[signal].to_numpy(), own, signal, mapping)]
        # Rounding clips a resampled value's last bit, no more: the rest is in quarantine.
        counts[signal] = round_chunks(values, catalogue()[signal])
    if COURSE in mapping.signals:
        counts |= _fixes(rows, resampler, intervals_s, mapping, counts)
    counts |= place_label(mapping, counts)
    for signal in counts:
        if not counts[signal].null_count:
            somewhere[:] = True
        elif not somewhere.all():
            somewhere |= pl.Series(counts[signal]).is_not_null().to_numpy()
    if not somewhere.all():
        kept = pl.Series(somewhere).to_arrow()
        counts = {key: array.filter(kept) for key, array in counts.items()}
        ticks = ticks[somewhere]
    metadata = _metadata(name, known, start_s, mapping)
    if len(ticks):
        metadata |= {"rows": len(ticks), "duration_s": (int(ticks[-1]) - int(ticks[0])) * STEP_S}
    return MeasuredDrive(name, metadata, method, ticks, counts)


def _fixes(
    rows: DriveRows,
    resampler: Resampler,
    intervals_s: dict[int, float],
    mapping: Mapping,
    counts: dict[str, pa.Array],
) -> dict[str, pa.Array]:
    """Return the counts of course and speed over ground, null between fixes."""
    source = mapping.signals[COURSE]
    if len(intervals_s) == 1:
        first, second = rows.column(COURSE), rows.column(SPEED)
    else:
        samples = rows.samples(COURSE).join(rows.samples(SPEED), on="time", how="inner")
        resampler = _on_own_times(samples, rows.start_s, resampler, intervals_s)
        first, second = samples[COURSE].to_numpy(), samples[SPEED].to_numpy()
    fixes = fixes_on_ticks(
        *course_and_speed(source, first, second),
        resampler,
        source.delay_s,
        Antenna(source.antenna_x_m or 0.0, source.antenna_y_m or 0.0),
        physical(counts, "yaw_rate"),
        physical(counts, "ay") if "ay" in counts else None,
    )
    both = zip((COURSE, SPEED), fixes, strict=True)
    return {name: round_chunks([values], catalogue()[name]) for name, values in both}


def _resample(
    values: FloatArray, resampler: Resampler, signal: str, mapping: Mapping
) -> FloatArray:
    """Return a signal on the ticks of its drive."""
    source = mapping.signals[signal]
    if not source.interpolate:
        return resampler.place(values, source.delay_s)
    longest_gap_s = source.longest_gap_s or mapping.time.longest_gap_s
    between = resampler.hold if catalogue()[signal].stepwise else resampler.resample
    resample = partial(between, delay_s=source.delay_s, longest_gap_s=longest_gap_s)
    return _on_the_circle(resample, values) if signal == catalogue().label else resample(values)


def _build_resampler(rows: DriveRows, intervals_s: dict[int, float], *, whole: bool) -> Resampler:
    """Return what says the ticks of a drive, and brings its signals there if they share times.

    A `whole` drive is one without missing ticks where gaps are short: a lost sample, of which some
    loggers have one in a hundred, would leave no seconds in which the yaw rate adds up.
    """
    if len(intervals_s) == 1:
        (interval_s,) = intervals_s.values()
        time_s = rows.time_s - rows.start_s
        resampler = build_resampler(time_s, choose_method(time_s, interval_s))
        if whole and resampler.method == "snap" and (np.diff(resampler.ticks) > 1).any():
            return build_resampler(time_s, "interpolate")
        return resampler
    return build_resampler(np.array([0.0, rows.end_s - rows.start_s]), "interpolate")


def _on_own_times(
    samples: pl.DataFrame, start_s: float, ticks: Resampler, intervals_s: dict[int, float]
) -> Resampler:
    """Return what brings the samples of one time base of several onto a drive's ticks."""
    interval_s = intervals_s[samples["base"][0]] if len(samples) else STEP_S
    fast = interval_s < STEP_S - SNAP_TOLERANCE_S
    time_s = samples["time"].to_numpy() - start_s
    return replace(ticks, time_s=time_s, method="average" if fast else "interpolate")


def _on_the_circle(resample: Callable[[FloatArray], FloatArray], angle: FloatArray) -> FloatArray:
    """Resample an angle without passing through 0 where it wraps from π to -π: the car spins."""
    present = ~np.isnan(angle)
    unwrapped = angle.copy()
    unwrapped[present] = np.unwrap(angle[present])
    resampled = resample(unwrapped)
    return np.asarray(resampled - 2 * np.pi * np.rint(resampled / (2 * np.pi)), dtype=np.float64)


def _metadata(name: str, told: dict[str, Any], start_s: float, mapping: Mapping) -> dict[str, Any]:
    """Return what is known of a drive, by column of `logs`. Raises `InputError`."""
    given = {key: getattr(mapping.drive, key) for key in _FROM_MAPPING}
    known = {key: value for key, value in given.items() if not isinstance(value, FromColumn)}
    if given["day"] is None:  # then time is in timestamps, or those of the file's own clock
        if mapping.time.own_clock and start_s < _EARLIEST_S:
            raise InputError("its clock does not tell the date. Give it in the mapping: drive.day.")
        known["day"] = date.fromordinal(_EPOCH.toordinal() + int(start_s // _SECONDS_PER_DAY))
    known |= {key: value for key, value in told.items() if key in given or key in _FROM_FILE}
    dated = mapping.time.is_dated and start_s >= _EARLIEST_S
    return {
        **known,
        "started_at": _EPOCH + timedelta(seconds=start_s) if dated else None,  # to the microsecond
        **_facts_of(mapping, known),
        "drive_id": name,
        "source": SOURCE,
        "campaign": mapping.name,
        "saturated": 0,  # what is outside its range is quarantined, not clipped
    }


def _facts_of(mapping: Mapping, known: dict[str, Any]) -> dict[str, Any]:
    """Return what the mapping's table adds to what is known of a car. Raises `InputError`."""
    vehicles = mapping.vehicle_facts()
    if not vehicles:
        return {}
    vehicle = known["vehicle_id"]
    facts = next((facts for facts in vehicles if facts.vehicle_id == vehicle), None)
    if facts is None:
        raise InputError(
            f"the car {vehicle!r} is not in the table of vehicles of the mapping "
            f"{mapping.name!r}. Add a row for it."
        )
    told = {name: fact for name, fact in facts.model_dump().items() if known.get(name) is None}
    if told.get("vehicle_model", "") is None:
        raise InputError(f"nobody says the vehicle_model of the car {vehicle!r}. Add it.")
    return told


class Trips:
    """Names each drive's trip: the first of the drives of one file that follow each other."""

    def __init__(self) -> None:
        """Begin without drives."""
        self._last: dict[int, tuple[str, float]] = {}

    def name(self, drive_id: str, group: int, start_s: float, end_s: float) -> str:
        """Return the trip of a group's next drive; a clock that goes back begins another."""
        trip_id, ended_s = self._last.get(group, (drive_id, start_s))
        if not 0 <= start_s - ended_s <= LONGEST_PAUSE_S:
            trip_id = drive_id
        self._last[group] = trip_id, end_s
        return trip_id
