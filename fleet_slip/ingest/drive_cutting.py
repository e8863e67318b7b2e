"""Checks the order of time and cuts rows, block by block, into drives: uninterrupted stretches."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import UTC, date, datetime, timedelta
from functools import cached_property, partial
from typing import Any

import numpy as np
import polars as pl
import pyarrow as pa
from numpy.typing import NDArray

from fleet_slip.arrays import BoolArray, FloatArray, IntArray
from fleet_slip.catalog.counts import digest_counts, round_chunks
from fleet_slip.catalog.course import COURSE, SATELLITE_SPEED
from fleet_slip.catalog.drive_sources import MEASURED
from fleet_slip.errors import InputError
from fleet_slip.ingest.columns import TimeBase
from fleet_slip.ingest.formats.source import EARLIEST_S
from fleet_slip.ingest.log_rows import describe_refused, no_rows
from fleet_slip.ingest.mapping import DriveMetadata, FromColumn, Mapping
from fleet_slip.ingest.open_drives import DriveRows
from fleet_slip.ingest.resampling import (
    SNAP_TOLERANCE_S,
    STEP_S,
    TIME_EPSILON_S,
    Method,
    Resampler,
    build_resampler,
    choose_method,
    fixes_on_ticks,
    physical,
    place_label,
)

MAX_DRIVE_S = 2**19 * STEP_S
"""A longer stretch is cut after this time, some 87 minutes, so that a drive fits into memory."""


_GROUP = np.dtype(
    [
        ("last", "f8"),  # time of the last row
        ("kept", "f8"),  # of the last one that is not isolated
        ("latest", "f8"),  # the latest time of the stretch
        ("start", "f8"),  # its first time
        ("segment", "i8"),  # number of the open segment
        ("piece", "i8"),  # index of the segment in its stretch
    ]
)
_UNSEEN = np.array((np.nan, np.nan, np.nan, np.nan, -1, -1), dtype=_GROUP)


class DriveCutter:
    """Assigns every row to a segment, which becomes a drive, and rejects rows out of order.

    A group, such as a car, has stretches, and these have segments. A step in time larger than
    `split_gap_s`, forward or back, begins a stretch, and `longest_s` ends a segment. A row that far
    from both neighbours is `isolated`, so that one wrong time stamp does not cut a drive.
    `time_duplicate` and `time_backwards` are rows not later than all earlier rows of their stretch.
    The result does not depend on the blocks: a row that needs the next one waits for it.
    """

    def __init__(self, base: TimeBase, longest_s: float = MAX_DRIVE_S) -> None:
        """Set the gap that ends a drive, and the maximum duration of a segment."""
        self._gap_s = base.split_gap_s + TIME_EPSILON_S
        self._longest_s = longest_s
        self._waiting: pl.DataFrame | None = None
        self._segments = 0
        self._state = np.empty(0, dtype=_GROUP)
        """The state of each group."""
        self.ended: list[int] = []
        """Segments that the last block ended, in an order that does not depend on blocks."""

    def cut(self, rows: pl.DataFrame, *, last: bool) -> tuple[pl.DataFrame, pl.DataFrame]:
        """Return the rows of a block with their `segment`, together; and the misplaced ones."""
        self.ended = []
        several = "base" in rows.columns
        if self._waiting is not None:
            rows = pl.concat([self._waiting, rows])
        if rows.is_empty():
            return rows.with_columns(pl.lit(0, pl.Int64).alias("segment")), no_rows()
        if several:
            rows = rows.sort("group", "time", maintain_order=True)
        elif not rows["group"].is_sorted():
            rows = rows.sort("group", maintain_order=True)
        more = int(rows["group"][-1]) + 1 - self._state.size
        if more > 0:
            self._state = np.concatenate([self._state, np.full(more, _UNSEEN, dtype=_GROUP)])
        alone, waiting, known_at = self._isolated(rows, last=last)
        self._waiting = rows.filter(pl.Series(waiting)) if waiting.any() else None
        refused = [describe_refused(rows, alone, "isolated")]
        unsettled = alone | waiting
        if unsettled.any():
            rows, known_at = rows.filter(pl.Series(~unsettled)), known_at[~unsettled]
        rows, before = self._number_segments(rows, known_at)
        if not several:
            time = rows["time"].to_numpy()
            twice, backwards = time == before, time < before
            refused += [
                describe_refused(rows, twice, "time_duplicate"),
                describe_refused(rows, backwards, "time_backwards"),
            ]
            if (disordered := twice | backwards).any():
                rows = rows.filter(pl.Series(~disordered))
        return rows, pl.concat(refused)

    def _isolated(
        self, rows: pl.DataFrame, *, last: bool
    ) -> tuple[BoolArray, BoolArray, FloatArray]:
        """Return which rows are isolated, which wait for the next, and which row shows that."""
        group, time = rows["group"].to_numpy(), rows["time"].to_numpy()
        first, end = _ends(group)
        before = np.concatenate([[np.nan], time[:-1]])
        before[first] = self._state["last"][group[first]]
        is_far = ~(np.abs(time - before) <= self._gap_s)
        far_next = np.concatenate([is_far[1:], [True]])
        far_next[end] = True
        alone = is_far & far_next
        waiting = np.zeros(alone.size, dtype=np.bool_)
        if not last:
            waiting[end] = alone[end]
            alone[end] = False
        self._state["last"][group[end]] = np.where(waiting[end], before[end], time[end])
        # Rows of several time bases can be ordered by their times only.
        number = time if "base" in rows.columns else rows["row"].to_numpy().astype(np.float64)
        known_at = np.concatenate([number[1:], [np.inf]])
        known_at[end] = np.inf
        return alone, waiting, np.where(is_far, known_at, number)

    def _number_segments(
        self, rows: pl.DataFrame, known_at: FloatArray
    ) -> tuple[pl.DataFrame, FloatArray]:
        """Return the rows with their segments, and the latest earlier time of their stretch.

        Lists ended segments in the order in which their end is detected. Example for one group,
        with `split_gap_s` = 1 and `longest_s` = 2: times 0, 1, 2, 3, 9 are in the segments
        0, 0, 1, 1, 2, since the first one ends after 2 s, and 9 follows a gap.
        """
        group, time, seen = rows["group"].to_numpy(), rows["time"].to_numpy(), self._state
        first, end = _ends(group)
        is_first = np.zeros(time.size, dtype=np.bool_)
        is_first[first] = True
        before = np.concatenate([[np.nan], time[:-1]])
        before[first] = seen["kept"][group[first]]
        begins = ~(np.abs(time - before) <= self._gap_s)
        before[first] = seen["latest"][group[first]]
        before[begins] = np.nan
        latest = time
        if not (begins | (time > before)).all():
            latest, before = _latest(time, before, begins | is_first)
        heads = np.flatnonzero(begins | is_first)
        start_of = np.where(begins[heads], time[heads], seen["start"][group[heads]])
        start = np.repeat(start_of, np.diff(np.append(heads, time.size)))
        piece = ((latest - start) // self._longest_s).astype(np.int64)
        piece_before = np.concatenate([[-1], piece[:-1]])
        piece_before[first] = seen["piece"][group[first]]
        begins |= piece != piece_before
        heads = np.flatnonzero(begins | is_first)
        fresh, open_segment = begins[heads], seen["segment"][group[heads]]
        segment_of = np.where(fresh, self._segments + np.cumsum(fresh) - 1, open_segment)
        self._segments += int(fresh.sum())
        before_head = np.where(
            is_first[heads], open_segment, np.concatenate([[-1], segment_of[:-1]])
        )
        over = fresh & (before_head >= 0)
        order = np.lexsort((group[heads[over]], known_at[heads[over]]))
        self.ended += before_head[over][order].tolist()
        segments = np.repeat(segment_of, np.diff(np.append(heads, time.size)))
        now = {"kept": time, "latest": latest, "start": start, "segment": segments, "piece": piece}
        for name, values in now.items():
            seen[name][group[end]] = values[end]
        return rows.with_columns(pl.Series("segment", segments)), before

    def open_segments(self) -> list[int]:
        """Return the segments that no block has ended, by group."""
        return [int(segment) for segment in self._state["segment"] if segment >= 0]


def sample_intervals_s(rows: pl.DataFrame) -> dict[int, float]:
    """Return the median time between two rows of each time base; the only one is number 0."""
    several = "base" in rows.columns
    bases = rows.partition_by("base", as_dict=True) if several else {(0,): rows}
    intervals_s = {}
    for (number,), base in bases.items():
        step_s, segment = np.diff(base["time"].to_numpy()), base["segment"].to_numpy()
        median = pl.Series(step_s[segment[1:] == segment[:-1]]).median()
        intervals_s[number] = median if isinstance(median, float) and median else STEP_S
    return intervals_s


def _ends(group: IntArray) -> tuple[IntArray, IntArray]:
    """Return where each group's rows begin, and the last of them."""
    if not group.size:
        nothing = np.empty(0, dtype=np.int64)
        return nothing, nothing
    changes = np.flatnonzero(np.diff(group)) + 1
    return np.concatenate([[0], changes]), np.concatenate([changes - 1, [group.size - 1]])


def _latest(
    time: FloatArray, before: FloatArray, heads: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return the latest time up to each row of its stretch, and before it (NaN for the first)."""
    seeded = np.where(heads & ~np.isnan(before), np.maximum(time, before), time)
    frame = pl.DataFrame({"time": seeded, "stretch": np.cumsum(heads)})
    latest = frame.select(pl.col("time").cum_max().over("stretch"))["time"].to_numpy()
    shifted = np.concatenate([[np.nan], latest[:-1]])
    return latest, np.where(heads, before, shifted)


_SECONDS_PER_DAY = 86_400
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_FROM_MAPPING = tuple(name for name in DriveMetadata.model_fields if name != "column")


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
    grid_values: dict[str, int] = field(default_factory=dict)
    """Values of each signal on the ticks, before labels at low speed were dropped."""

    @cached_property
    def counts_digest(self) -> str:
        """The digest of its counts."""
        car, day = str(self.metadata["vehicle_id"]), str(self.metadata["day"])
        return digest_counts(car, day, self.ticks, self.counts)


def drive_id(prefix: str, group: int, segment: int = 1) -> str:
    """Return the name of the n-th segment (from 1) of the drive with this number (from 0)."""
    return f"{prefix}-{group + 1}" + (f"-{segment}" if segment > 1 else "")


def to_ticks(
    rows: DriveRows,
    mapping: Mapping,
    intervals_s: dict[int, float],
    name: str,
    metadata_of_drive: dict[str, Any],
) -> MeasuredDrive:
    """Convert a drive's signals, SI units at times in s, to counts at 100 Hz.

    Ticks at which no signal has a value are left out. `intervals_s` are the usual times between
    the samples of each time base; `metadata_of_drive` has values by column of `logs`. Raises
    `InputError` for missing metadata.
    """
    start_s = rows.start_s
    resampler = _resampler_of(rows, intervals_s, fill_gaps=COURSE in mapping.signals)
    method, ticks = resampler.method, resampler.ticks.astype(np.int32)
    counts, somewhere = {}, np.zeros(ticks.size, dtype=np.bool_)
    for signal, source in mapping.signals.items():
        if signal in {COURSE, SATELLITE_SPEED} and COURSE in mapping.signals:
            continue
        if method == "snap" and source.interpolate and not source.delay_s:
            values = [chunk.to_numpy() for chunk in rows.column(signal).get_chunks()]
        else:
            samples = rows.samples(signal)
            on_own_times = _on_own_times(rows, signal, samples, resampler, intervals_s)
            values = [_resample(samples[signal].to_numpy(), on_own_times, signal, mapping)]
        # Rounding clips a resampled value's last bit, no more: the rest is in quarantine.
        counts[signal] = round_chunks(values, mapping.signal_catalog[signal])
    if COURSE in mapping.signals:
        counts |= _fixes(rows, resampler, intervals_s, mapping, counts)
    grid_values = {signal: len(array) - array.null_count for signal, array in counts.items()}
    counts |= place_label(mapping, counts)
    counts |= {
        wheel: round_chunks(
            [physical(mapping.signal_catalog, counts, "steer")], mapping.signal_catalog[wheel]
        )
        for wheel in mapping.front_wheels
    }
    for signal in counts:
        if not counts[signal].null_count:
            somewhere[:] = True
        elif not somewhere.all():
            somewhere |= pl.Series(counts[signal]).is_not_null().to_numpy()
    if not somewhere.all():
        is_present = pl.Series(somewhere).to_arrow()
        counts = {key: array.filter(is_present) for key, array in counts.items()}
        ticks = ticks[somewhere]
    metadata = _metadata(name, metadata_of_drive, start_s, mapping)
    if len(ticks):
        metadata |= {"rows": len(ticks), "duration_s": (int(ticks[-1]) - int(ticks[0])) * STEP_S}
    return MeasuredDrive(name, metadata, method, ticks, counts, grid_values)


def _fixes(
    rows: DriveRows,
    resampler: Resampler,
    intervals_s: dict[int, float],
    mapping: Mapping,
    counts: dict[str, pa.Array],
) -> dict[str, pa.Array]:
    """Return the counts of course and speed over ground, null between fixes."""
    both = rows.samples(COURSE), rows.samples(SATELLITE_SPEED)
    samples = both[0].join(both[1], on="time", how="inner", maintain_order="left")
    fixes = fixes_on_ticks(
        mapping.signals[COURSE],
        (samples[COURSE].to_numpy(), samples[SATELLITE_SPEED].to_numpy()),
        _on_own_times(rows, COURSE, samples, resampler, intervals_s),
        physical(mapping.signal_catalog, counts, "yaw_rate"),
        physical(mapping.signal_catalog, counts, "ay") if "ay" in counts else None,
    )
    columns = zip((COURSE, SATELLITE_SPEED), fixes, strict=True)
    return {name: round_chunks([values], mapping.signal_catalog[name]) for name, values in columns}


def _resample(
    values: FloatArray, resampler: Resampler, signal: str, mapping: Mapping
) -> FloatArray:
    """Return a signal on the ticks of its drive."""
    source = mapping.signals[signal]
    if not source.interpolate:
        return resampler.place(values, source.delay_s)
    longest_gap_s = source.longest_gap_s or mapping.time.longest_gap_s
    between = resampler.hold if mapping.signal_catalog[signal].stepwise else resampler.resample
    resample = partial(between, delay_s=source.delay_s, longest_gap_s=longest_gap_s)
    is_label = signal == mapping.signal_catalog.label
    return _on_the_circle(resample, values) if is_label else resample(values)


def _resampler_of(rows: DriveRows, intervals_s: dict[int, float], *, fill_gaps: bool) -> Resampler:
    """Return the resampler that has the ticks of a drive; it resamples signals of one time base.

    With `fill_gaps` ticks in short gaps are interpolated: some loggers lose one sample in a
    hundred, which would leave no whole second over which to integrate the yaw rate.
    """
    if len(intervals_s) == 1:
        (interval_s,) = intervals_s.values()
        time_s = rows.column("time").to_numpy() - rows.start_s
        resampler = build_resampler(time_s, choose_method(time_s, interval_s))
        if fill_gaps and resampler.method == "snap" and (np.diff(resampler.ticks) > 1).any():
            return build_resampler(time_s, "interpolate")
        return resampler
    return build_resampler(np.array([0.0, rows.end_s - rows.start_s]), "interpolate")


def _on_own_times(
    rows: DriveRows,
    signal: str,
    samples: pl.DataFrame,
    ticks: Resampler,
    intervals_s: dict[int, float],
) -> Resampler:
    """Return the resampler from a signal's own times to the ticks of its drive."""
    of_base = (
        intervals_s[base]
        for base, rows_of_base in rows.bases.items()
        if signal in rows_of_base.columns
    )
    fast = next(of_base, STEP_S) < STEP_S - SNAP_TOLERANCE_S
    time_s = samples["time"].to_numpy() - rows.start_s
    return replace(ticks, time_s=time_s, method="average" if fast else "interpolate")


def _on_the_circle(resample: Callable[[FloatArray], FloatArray], angle: FloatArray) -> FloatArray:
    """Resample an angle without passing through 0 where it wraps from π to -π: the car spins."""
    present = ~np.isnan(angle)
    unwrapped = angle.copy()
    unwrapped[present] = np.unwrap(angle[present])
    resampled = resample(unwrapped)
    return np.asarray(resampled - 2 * np.pi * np.rint(resampled / (2 * np.pi)), dtype=np.float64)


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
