"""Brings the label from its sensor to the centre of gravity, on the ticks of a drive.

With the yaw rate r, a sensor x before and y to the left of the centre of gravity has the velocities
(vx - r y, vy + r x). Of an angle alone the speed is needed beside it.
"""

from collections.abc import Mapping as Named

import numpy as np
import polars as pl
import pyarrow as pa

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.counts import round_chunks
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.ingest.mapping.label_sensor import SPEEDS, LabelSensor
from fleet_slip.ingest.mapping.mapping import Mapping

RADIUS_M = 0.31
"""Of a wheel whose mapping names none; a tenth more moves the correction by a tenth."""
LEAST_SPEED_MPS = 2.0
"""Below it two velocities tell no angle, and an angle is not moved."""


def physical(counts: Named[str, pa.Array], name: str) -> FloatArray:
    """Return a signal in SI units, NaN where there is none."""
    told = pl.Series(counts[name]).cast(pl.Float64).fill_null(float("nan")).to_numpy()
    return np.asarray(told * float(catalogue()[name].scale))


def place_label(mapping: Mapping, counts: Named[str, pa.Array]) -> dict[str, pa.Array]:
    """Return the counts of the label at the centre of gravity, and of velocities it is made of."""
    sensor = mapping.label
    if sensor is None:
        return {}
    found = _velocities(sensor, counts) if sensor.from_velocities else _angle(mapping, counts)
    return {name: round_chunks([values], catalogue()[name]) for name, values in found.items()}


def _velocities(sensor: LabelSensor, counts: Named[str, pa.Array]) -> dict[str, FloatArray]:
    vx, vy = physical(counts, "vx"), physical(counts, "vy")
    if sensor.is_elsewhere:
        yaw_rate = physical(counts, "yaw_rate")
        vx, vy = vx + yaw_rate * sensor.sensor_y_m, vy - yaw_rate * sensor.sensor_x_m
    fast = np.hypot(vx, vy) >= LEAST_SPEED_MPS
    return {"vx": vx, "vy": vy, catalogue().label: np.where(fast, np.arctan2(vy, vx), np.nan)}


def _angle(mapping: Mapping, counts: Named[str, pa.Array]) -> dict[str, FloatArray]:
    sensor, label = mapping.label, catalogue().label
    if sensor is None or not sensor.is_elsewhere:
        return {}
    angle, yaw_rate = physical(counts, label), physical(counts, "yaw_rate")
    speed = _speed(mapping, counts)
    vx = speed * np.cos(angle) + yaw_rate * sensor.sensor_y_m
    vy = speed * np.sin(angle) - yaw_rate * sensor.sensor_x_m
    return {label: np.where(speed >= LEAST_SPEED_MPS, np.arctan2(vy, vx), np.nan)}


def _speed(mapping: Mapping, counts: Named[str, pa.Array]) -> FloatArray:
    """Return the car's speed: as it is logged, or that of its wheels."""
    for name in SPEEDS:
        if name in counts:
            return np.abs(physical(counts, name))
    wheels = [name for name in counts if name.startswith("wheel_")]
    speeds = [physical(counts, n) * (mapping.signals[n].radius_m or RADIUS_M) for n in wheels]
    return np.asarray(np.median(speeds, axis=0), dtype=np.float64)
