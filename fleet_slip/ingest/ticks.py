"""Converts a drive to ticks and counts: its signals are resampled to 100 Hz and rounded."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import UTC, date, datetime, timedelta
from functools import cached_property, partial
from typing import Any

import numpy as np
import polars as pl
import pyarrow as pa
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray
from fleet_slip.catalog.counts import digest_counts, round_chunks
from fleet_slip.catalog.course import COURSE, SATELLITE_SPEED
from fleet_slip.catalog.signals import MEASURED
from fleet_slip.errors import InputError
from fleet_slip.ingest.drives import DriveRows
from fleet_slip.ingest.formats.source import EARLIEST_S
from fleet_slip.ingest.mapping import DriveMetadata, FromColumn, Mapping
from fleet_slip.ingest.resampling import (
    SNAP_TOLERANCE_S,
    STEP_S,
    Method,
    Resampler,
    build_resampler,
    choose_method,
    fixes_on_ticks,
    physical,
    place_label,
)

_SECONDS_PER_DAY = 86_400
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_FROM_MAPPING = tuple(name for name in DriveMetadata.model_fields if name != "column")


PREFIX = "same/"
"""Prefix of the name of a fingerprint's transaction; see `recordings`."""


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
    values: dict[str, int] = field(default_factory=dict)
    """Values of each mapped signal on the ticks, before labels at low speed were dropped."""
    interval_s: float = STEP_S
    """Least of the usual times between the samples of a time base."""

    @cached_property
    def counts_digest(self) -> str:
        """The digest of its counts."""
        car, day = str(self.metadata["vehicle_id"]), str(self.metadata["day"])
        return digest_counts(car, day, self.ticks, self.counts)


def drive_id(prefix: str, group: int, segment: int = 1) -> str:
    """Return the name of the n-th segment (from 1) of the drive with this number (from 0)."""
    return f"{prefix}-{group + 1}" + (f"-{segment}" if segment > 1 else "")


def to_ticks(
    rows: DriveRows, mapping: Mapping, name: str, metadata_of_drive: dict[str, Any]
) -> MeasuredDrive:
    """Convert a drive's signals, SI units at times in s, to counts at 100 Hz.

    Ticks at which no signal has a value are left out. `metadata_of_drive` has values by column of
    `logs`. Raises `InputError` for missing metadata.
    """
    start_s = rows.start_s
    resampler = _resampler_of(rows, fill_gaps=COURSE in mapping.signals)
    method, ticks = resampler.method, resampler.ticks.astype(np.int32)
    counts, somewhere = {}, np.zeros(ticks.size, dtype=np.bool_)
    for signal, source in mapping.signals.items():
        if signal in {COURSE, SATELLITE_SPEED} and COURSE in mapping.signals:
            continue
        if method == "snap" and source.interpolate and not source.delay_s:
            values = [chunk.to_numpy() for chunk in rows.column(signal).get_chunks()]
        else:
            samples = rows.samples(signal)
            on_own_times = _on_own_times(rows, signal, samples, resampler)
            values = [_resample(samples[signal].to_numpy(), on_own_times, signal, mapping)]
        # Rounding clips a resampled value's last bit, no more: the rest is in quarantine.
        counts[signal] = round_chunks(values, mapping.signal_catalog[signal])
    if COURSE in mapping.signals:
        counts |= _fixes(rows, resampler, mapping, counts)
    values_on_ticks = {signal: len(a) - a.null_count for signal, a in counts.items()}
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
    interval_s = min(rows.intervals_s.values())
    return MeasuredDrive(name, metadata, method, ticks, counts, values_on_ticks, interval_s)


def _fixes(
    rows: DriveRows,
    resampler: Resampler,
    mapping: Mapping,
    counts: dict[str, pa.Array],
) -> dict[str, pa.Array]:
    """Return the counts of course and speed over ground, null between fixes."""
    both = rows.samples(COURSE), rows.samples(SATELLITE_SPEED)
    samples = both[0].join(both[1], on="time", how="inner", maintain_order="left")
    fixes = fixes_on_ticks(
        mapping.signals[COURSE],
        (samples[COURSE].to_numpy(), samples[SATELLITE_SPEED].to_numpy()),
        _on_own_times(rows, COURSE, samples, resampler),
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


def _resampler_of(rows: DriveRows, *, fill_gaps: bool) -> Resampler:
    """Return the resampler that has the ticks of a drive; it resamples signals of one time base.

    With `fill_gaps` ticks in short gaps are interpolated: some loggers lose one sample in a
    hundred, which would leave no whole second over which to integrate the yaw rate.
    """
    if len(rows.bases) == 1:
        (interval_s,) = rows.intervals_s.values()
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
) -> Resampler:
    """Return the resampler from a signal's own times to the ticks of its drive."""
    of_base = (
        rows.intervals_s[base]
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
