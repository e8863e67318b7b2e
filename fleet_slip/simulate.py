"""From drives to the rows of a log: plan the speed, drive the car, measure, tabulate counts."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from fleet_slip.campaign import Batch, DriveSpec
from fleet_slip.sensors import GPS_SIGNALS, SAMPLE_RATE_HZ, Measurement, measure
from fleet_slip.signals import catalogue
from fleet_slip.vehicle.lanes import LaneDrive, Road, Truth, simulate_drives

DRIVES_AT_ONCE = 32
"""Drives of a batch that are simulated together, which bounds the memory for their true signals."""


@dataclass(frozen=True)
class DriveLog:
    """One drive as its car logged it."""

    spec: DriveSpec
    measurement: Measurement
    lost_control_s: float | None

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
            "adhesion": spec.adhesion,
            "speed_factor": spec.speed_factor,
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
    )
    return LaneDrive(vehicle=spec.vehicle, road=road, adhesion=spec.adhesion, laps=spec.laps)


def simulate_batch(batch: Batch) -> pa.Table:
    """Simulate and measure the drives of a batch.

    Returns a table in the order of `SignalCatalogue.log_schema`, with strings as dictionaries,
    sorted by drive, then tick. It depends on the batch alone: any number of threads may simulate
    any batches in any order.
    """
    logs: list[DriveLog] = []
    for first in range(0, len(batch.drives), DRIVES_AT_ONCE):
        logs += simulate_logs(batch.drives[first : first + DRIVES_AT_ONCE])
    return tabulate(batch, logs)


def simulate_logs(specs: Sequence[DriveSpec]) -> list[DriveLog]:
    """Simulate and measure drives together."""
    truths = simulate_drives([lane_drive(spec) for spec in specs])
    return [log_drive(spec, truth) for spec, truth in zip(specs, truths, strict=True)]


def log_drive(spec: DriveSpec, truth: Truth) -> DriveLog:
    """Measure one drive with its own sensors and random generator."""
    columns = {
        signal.column: getattr(truth, signal.column)
        for name, signal in catalogue().signals.items()
        if name not in GPS_SIGNALS and hasattr(truth, signal.column)
    }
    lost = truth.lost_control_tick
    return DriveLog(
        spec,
        measure(columns, spec.sensors, spec.generator()),
        None if lost is None else lost / SAMPLE_RATE_HZ,
    )


def tabulate(batch: Batch, logs: Sequence[DriveLog]) -> pa.Table:
    """Return the rows of the logs as one table."""
    rows = [log.rows for log in logs]
    drive_of_row = pa.array(np.repeat(np.arange(len(logs), dtype=np.int32), rows))
    columns = {"day": pa.repeat(pa.scalar(batch.day), sum(rows))}
    for field in catalogue().drive_schema:
        values = pa.array([log.metadata[field.name] for log in logs], type=field.type)
        if pa.types.is_string(field.type):
            values = values.dictionary_encode()
        columns[field.name] = values.take(drive_of_row)
    columns["tick"] = pa.array(np.concatenate([np.arange(n, dtype=np.int32) for n in rows]))
    no_fix = ~np.concatenate([log.measurement.gps_fix for log in logs])
    for name in catalogue().signals:
        if name not in logs[0].measurement.counts:
            columns[name] = pa.nulls(len(drive_of_row), pa.int16())
            continue
        counts = np.concatenate([log.measurement.counts[name] for log in logs])
        columns[name] = pa.array(counts, mask=no_fix if name in GPS_SIGNALS else None)
    return pa.table({name: columns[name] for name in catalogue().log_schema.names})
