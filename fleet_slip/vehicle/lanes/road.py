"""The road that a lane's driver follows, as the kernel looks it up."""

import math
from typing import NamedTuple

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import ConfigError
from fleet_slip.vehicle.lanes.lane_kernel import LOST_SPEED_MPS

FARTHEST_VIEW_M = 20.0
"""How far beyond a lap's end a driver may look."""


class Surface(NamedTuple):
    """What is not flat, even and calm about a road, at its entries: arrays of shape (m,)."""

    gravity_x_mps2: FloatArray
    """Weight per mass along the road; negative uphill."""
    gravity_y_mps2: FloatArray
    """Weight per mass across the road, positive where it pulls to the left."""
    grip_left: FloatArray
    """Adhesion under the left wheels over that of the drive."""
    grip_right: FloatArray
    cross_wind_mps: FloatArray
    """Speed of the air across the road, positive to the left."""


class Road(NamedTuple):
    """The line to follow and the speed to hold, at equal steps of the station from 0.

    A closed road is a whole number of spacings long, and the entry after the last is the first.
    """

    spacing_m: float
    curvature_1pm: FloatArray
    """Curvature of the line, (m,), positive to the left."""
    speed_mps: FloatArray
    """Target speed, (m,), already times the speed factor."""
    length_m: float
    closed: bool
    surface: Surface | None = None
    """None: flat, even and calm."""


def planned_time_s(road: Road, distance_m: float) -> float:
    """Return the time to drive a distance at the road's target speed."""
    speed = np.append(road.speed_mps, road.speed_mps[0]) if road.closed else road.speed_mps
    lap_s = float(np.sum(2 * road.spacing_m / (speed[:-1] + speed[1:])))
    return lap_s * distance_m / road.length_m


def target_acceleration(road: Road) -> FloatArray:
    """Return d(v²/2)/ds of the target speed at the entries, m/s², by central differences."""
    energy = road.speed_mps**2 / 2
    if road.closed:
        return (np.roll(energy, -1) - np.roll(energy, 1)) / (2 * road.spacing_m)
    return np.gradient(energy, road.spacing_m)


def road_table(road: Road) -> FloatArray:
    """Return what the kernel looks up of a road: curvature, target speed and acceleration."""
    return _continued(road, road.curvature_1pm, road.speed_mps, target_acceleration(road))


def surface_table(road: Road) -> FloatArray:
    """Return what the kernel looks up of a road's surface."""
    zero, one = np.zeros(len(road.curvature_1pm)), np.ones(len(road.curvature_1pm))
    flat_even_and_calm = Surface(zero, zero, one, one, zero)
    return _continued(road, *(road.surface or flat_even_and_calm))


def _continued(road: Road, *columns_of_road: FloatArray) -> FloatArray:
    """Return a road's table; that of a closed one goes on by what a driver sees ahead."""
    columns = np.stack(columns_of_road, axis=1)
    further = math.ceil(FARTHEST_VIEW_M / road.spacing_m) + 1 if road.closed else 0
    return np.take(columns, range(len(columns) + further), axis=0, mode="wrap")


def require_usable(road: Road) -> None:
    """Raise `ConfigError` if a road's tables are not usable."""
    entries = len(road.curvature_1pm)
    if len(road.speed_mps) != entries or entries < 2:
        raise ConfigError(
            f"a road needs two or more entries of curvature and as many of speed, not {entries}"
            f" and {len(road.speed_mps)}."
        )
    intervals = entries if road.closed else entries - 1
    if abs(intervals * road.spacing_m - road.length_m) > 1e-6 * road.length_m:
        raise ConfigError(
            f"a road of {intervals} intervals of {road.spacing_m} m is not {road.length_m} m long."
        )
    if not (np.isfinite(road.curvature_1pm).all() and (road.speed_mps > LOST_SPEED_MPS).all()):
        raise ConfigError(
            f"a road needs finite curvature and target speeds above {LOST_SPEED_MPS} m/s."
        )
    if road.surface and any(len(c) != entries or not np.isfinite(c).all() for c in road.surface):
        raise ConfigError(f"a surface needs {entries} finite entries, as many as its road.")
