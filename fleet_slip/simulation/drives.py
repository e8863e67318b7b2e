"""From drives to the rows of a log: choose the speed, drive the car, measure, tabulate counts."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.simulation.campaign import Batch, DriveSpec
from fleet_slip.simulation.manoeuvres import road_with
from fleet_slip.simulation.sensing.receivers import ReceiverFixes, ReceiverLog
from fleet_slip.simulation.sensing.sensors import GPS_SIGNALS, SAMPLE_RATE_HZ, Measurement, Recorder
from fleet_slip.vehicle.lanes.lane_drives import LaneDrive, simulate_blocks
from fleet_slip.vehicle.lanes.road import Road

DRIVES_AT_ONCE = 128
"""Drives of a batch that are simulated together, which bounds the memory for their roads."""

CHUNK_ROWS = 2**16
"""Rows of a chunk of a column that is the same in all rows of a drive."""


@dataclass(frozen=True)
class DriveLog:
    """One drive as its car logged it."""

    spec: DriveSpec
    measurement: Measurement
    lost_control_s: float | None
    fixes: ReceiverFixes | None = None
    """What its satellite receiver logged, if the campaign has receivers."""

    @property
    def signals(self) -> set[str]:
        """Names of the signals that it has."""
        return {*self.measurement.counts, *(self.fixes.counts if self.fixes else ())}

    @property
    def rows(self) -> int:
        """Number of ticks."""
        return len(self.measurement.gps_fix)

    @property
    def metadata(self) -> dict[str, object]:
        """The columns of `SignalCatalogue.drive_schema`."""
        spec = self.spec
        return {
            "drive_id": spec.drive_id,
            "vehicle_id": spec.vehicle_id,
            "vehicle_model": spec.vehicle.name,
            "source": spec.source,
            "campaign": spec.campaign,
            "track": spec.track.name,
            "mass_kg": spec.vehicle.body.sprung_mass_kg,
            "receiver": spec.receiver.name if spec.receiver else None,
            "adhesion": spec.adhesion,
            "speed_factor": spec.speed_factor,
            "duration_s": (self.rows - 1) / SAMPLE_RATE_HZ,
            "rows": self.rows,
            "lost_control_s": self.lost_control_s,
            "saturated": self.measurement.saturated,
        }


def lane_drive(spec: DriveSpec) -> LaneDrive:
    """Return the drive as the simulator takes it."""
    profile = spec.profile
    road = Road(
        spacing_m=profile.spacing_m,
        curvature_1pm=spec.track.curvature(profile.station_m),
        speed_mps=spec.speed_factor * profile.speed_mps,
        length_m=spec.track.length_m,
        closed=spec.track.closed,
        surface=spec.surface(profile.station_m),
    )
    felt = spec.distortion() is not None
    road = road_with(road, spec.script)
    return LaneDrive(spec.vehicle, road, spec.adhesion, spec.laps, spec.flaws.car, felt)


def simulate_batch(batch: Batch) -> pa.Table:
    """Simulate and measure the drives of a batch, a function of the batch alone.

    Columns are in the order of `SignalCatalogue.log_schema`, without unlogged extras, strings as
    dictionaries; rows by drive, then tick.
    """
    logs: list[DriveLog] = []
    for first in range(0, len(batch.drives), DRIVES_AT_ONCE):
        logs += simulate_logs(batch.drives[first : first + DRIVES_AT_ONCE])
    return tabulate(batch, logs)


def simulate_logs(specs: Sequence[DriveSpec]) -> list[DriveLog]:
    """Simulate drives together, each measured block by block by its own sensors and generator."""
    recorders = [Recorder(s.sensors, s.generator(), s.distortion()) for s in specs]
    receivers = [
        ReceiverLog(s.receiver, s.satellite_generator()) if s.receiver else None for s in specs
    ]
    logs: dict[int, DriveLog] = {}
    for block in simulate_blocks([lane_drive(spec) for spec in specs]):
        recorder, receiver = recorders[block.drive], receivers[block.drive]
        recorder.record(block.channels)
        if receiver:
            receiver.record(block.channels)
        if block.last:
            lost = block.lost_control_tick
            logs[block.drive] = DriveLog(
                specs[block.drive],
                recorder.measurement(),
                None if lost is None else lost / SAMPLE_RATE_HZ,
                receiver.fixes() if receiver else None,
            )
    return [logs[drive] for drive in range(len(specs))]


MOTION = ("vx_mps", "vy_mps", "station_m", "lateral_offset_m")
"""What of the truth an evaluation needs, as no sensor measures it."""


def exact_motion(specs: Sequence[DriveSpec]) -> list[dict[str, FloatArray]]:
    """Return the channels of `MOTION` of each drive at 100 Hz, not rounded to counts."""
    blocks: list[list[dict[str, FloatArray]]] = [[] for _ in specs]
    for block in simulate_blocks([lane_drive(spec) for spec in specs]):
        blocks[block.drive].append({name: block.channels[name].copy() for name in MOTION})
    return [
        {name: np.concatenate([part[name] for part in parts]) for name in MOTION}
        for parts in blocks
    ]


def tabulate(batch: Batch, logs: Sequence[DriveLog]) -> pa.Table:
    """Return the rows of the logs as one table."""
    rows = [log.rows for log in logs]
    columns = {"day": pa.repeat(pa.scalar(batch.day), sum(rows))}
    for field in catalogue().drive_schema:
        values = pa.array([log.metadata.get(field.name) for log in logs], type=field.type)
        if field.name not in catalogue().optional or values.null_count < len(values):
            columns[field.name] = _repeated(values, rows)
    ticks = pa.array(np.arange(max(rows), dtype=np.int32))
    columns["tick"] = pa.chunked_array([ticks[:n] for n in rows])
    for name in catalogue().signals:
        if name not in catalogue().extras or any(name in log.signals for log in logs):
            columns[name] = pa.chunked_array([_counts(log, name) for log in logs])
    names = [name for name in catalogue().log_schema.names if name in columns]
    return pa.table({name: columns[name] for name in names})


def _counts(log: DriveLog, name: str) -> pa.Array:
    if log.fixes and name in log.fixes.counts:
        return pa.array(log.fixes.counts[name], mask=~log.fixes.fix)
    if name not in log.measurement.counts:
        return pa.nulls(log.rows, pa.int16())
    no_fix = ~log.measurement.gps_fix if name in GPS_SIGNALS else None
    return pa.array(log.measurement.counts[name], mask=no_fix)


def _repeated(values: pa.Array, times: Sequence[int]) -> pa.ChunkedArray:
    """Return each value so many times, strings as a dictionary; chunks of a drive share memory."""
    encoded = values.dictionary_encode() if pa.types.is_string(values.type) else values
    chunks = []
    for drive, count in enumerate(times):
        same = encoded.take(pa.array(np.full(min(count, CHUNK_ROWS), drive)))
        chunks += [same[: count - first] for first in range(0, count, CHUNK_ROWS)]
    return pa.chunked_array(chunks, type=encoded.type)
