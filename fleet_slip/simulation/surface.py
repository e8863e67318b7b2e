"""The surface of a drive's road: slopes of the track, adhesion and wind of the drive.

Drawn at knots and linear in between, periodic on a closed track.
"""

import math

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.compiling import kernel
from fleet_slip.simulation.imperfections import RoadImperfections
from fleet_slip.simulation.track import Track
from fleet_slip.vehicle.lanes.road import Surface
from fleet_slip.vehicle.parameters import GRAVITY_MPS2

KNOTS_M = 60.0
"""Distance of the knots: the length of a bend, a patch or a gust."""

SHARP_1PM = 0.01
"""Curvature from which on a bend has all of its superelevation."""

LEAST_GRIP = 0.1


def surface(
    road: RoadImperfections,
    track: Track,
    station_m: FloatArray,
    of_track: np.random.Generator,
    of_drive: np.random.Generator,
) -> Surface | None:
    """Return the surface at the stations of a track's grid; None for a perfect road."""
    if road == RoadImperfections():
        return None
    curvature = track.curvature(station_m)
    bank = _along(track, station_m, of_track)
    grade = _along(track, station_m, of_track)
    change, split, gust = (_along(track, station_m, of_drive) for _ in range(3))
    wind_x, wind_y = of_drive.standard_normal(2).tolist()
    share = road.wind_mps / math.sqrt(wind_x * wind_x + wind_y * wind_y)
    fall = (
        road.cross_slope_percent
        - road.superelevation_percent * np.clip(curvature / SHARP_1PM, -1.0, 1.0)
        + road.bank_std_percent * bank
    ) / 100
    climb = road.grade_std_percent * grade / 100
    grip = 1 + road.adhesion_std * change
    half = road.adhesion_split_std * split / 2
    spacing_m = station_m[1] - station_m[0]
    return Surface(
        gravity_x_mps2=-GRAVITY_MPS2 * climb / np.sqrt(1 + climb * climb),
        gravity_y_mps2=-GRAVITY_MPS2 * fall / np.sqrt(1 + fall * fall),
        grip_left=np.maximum(grip + half, LEAST_GRIP),
        grip_right=np.maximum(grip - half, LEAST_GRIP),
        cross_wind_mps=_across(curvature, spacing_m, share * wind_x, share * wind_y)
        + road.gust_std_mps * gust,
    )


def _along(track: Track, station_m: FloatArray, generator: np.random.Generator) -> FloatArray:
    """Return standard normal numbers at knots, of mean zero over the track, between them linear."""
    knots = max(2, round(track.length_m / KNOTS_M))
    values = generator.standard_normal(knots)
    values = values - np.sum(values) / knots
    at_m = np.arange(knots) * (track.length_m / knots)
    if track.closed:
        at_m, values = np.append(at_m, track.length_m), np.append(values, values[0])
    return np.interp(station_m, at_m, values)


@kernel
def _across(curvature: FloatArray, spacing_m: float, wind_x: float, wind_y: float) -> FloatArray:
    """Return a wind's part across the track; its heading is a unit vector turned by points."""
    across = np.empty(len(curvature))
    cosine, sine = 1.0, 0.0
    for i in range(len(curvature)):
        across[i] = wind_y * cosine - wind_x * sine
        half = 0.5 * curvature[i] * spacing_m
        scale = 1.0 / (1.0 + half * half)
        along, side = (1.0 - half * half) * scale, 2.0 * half * scale
        cosine, sine = cosine * along - sine * side, sine * along + cosine * side
    return across
