"""Roads drawn by class, and the lines that drivers take along them.

Straights and bends, arcs between clothoids, as laid out in Germany (RAL 2012, RAA 2008, RASt 06:
parameters from a third of the radius to it); from sums and products, for the same bits.
"""

import math
import re
from typing import NamedTuple

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.config import load_config
from fleet_slip.resources import find_config
from fleet_slip.simulation.random_numbers import random_generator
from fleet_slip.simulation.track import Segment, Track

LINE_STEP_M = 2.0
"""Distance of the points of a driver's line."""

WANDER_S = 2.0
"""A driver wanders about his line, with a new offset every so many seconds at top speed."""


class RoadClass(NamedTuple):
    """What roads of a class are like. Bends are mostly near the smaller radius."""

    radius_m: tuple[float, float]
    turn_deg: tuple[float, float]
    straight_m: tuple[float, float]
    length_m: float
    top_speed_mps: float


CLASSES = {
    "city": RoadClass((9.0, 60.0), (40.0, 100.0), (30.0, 200.0), 1500.0, 14.0),
    "country": RoadClass((90.0, 600.0), (15.0, 80.0), (40.0, 300.0), 3500.0, 30.0),
    "hill": RoadClass((30.0, 200.0), (20.0, 120.0), (10.0, 120.0), 2500.0, 25.0),
    "motorway": RoadClass((400.0, 3000.0), (5.0, 40.0), (200.0, 900.0), 6000.0, 45.0),
    "switchback": RoadClass((8.0, 25.0), (100.0, 190.0), (40.0, 200.0), 1500.0, 18.0),
}
"""From RAL 2012, RAA 2008 and RASt 06; hill roads and switchbacks are older than any rule."""

_NAME = re.compile(rf"({'|'.join(CLASSES)})_(\d{{1,9}})")


def load_track(name_or_path: str) -> Track:
    """Read a track by name or path, or draw `country_17`: class, seed. Raises `ConfigError`."""
    drawn = _NAME.fullmatch(name_or_path)
    if drawn:
        return draw_road(drawn[1], int(drawn[2]))
    return load_config(find_config("tracks", name_or_path), Track)


def road_class(track: Track) -> str | None:
    """Return the class of a road that was drawn; None for any other track."""
    drawn = _NAME.fullmatch(track.name)
    return drawn[1] if drawn else None


def draw_road(kind: str, seed: int) -> Track:
    """Draw a road of a class of `CLASSES`. It is open, and its ends are straight."""
    road, generator = CLASSES[kind], random_generator(seed, "road", kind)
    segments = [_straight(road, generator)]
    while sum(segment.length_m for segment in segments) < road.length_m:
        segments += [*_bend(road, generator), _straight(road, generator)]
    return Track(
        name=f"{kind}_{seed}",
        description=f"A road of the class {kind}, drawn with the seed {seed}",
        closed=False,
        segments=tuple(segments),
    )


def _straight(road: RoadClass, generator: np.random.Generator) -> Segment:
    return Segment(length_m=generator.uniform(*road.straight_m), curvature_1pm=(0.0, 0.0))


def _bend(road: RoadClass, generator: np.random.Generator) -> list[Segment]:
    least, most = road.radius_m
    radius_m = least + (most - least) * generator.random() ** 2
    turn_rad = generator.uniform(*road.turn_deg) * (math.pi / 180)
    spiral_rad = min(generator.uniform(1 / 3, 1.0) ** 2, turn_rad)  # what both clothoids turn
    side = 1.0 if generator.random() < 0.5 else -1.0
    bend = side / radius_m
    shapes = [
        (spiral_rad, (0.0, bend)),
        (turn_rad - spiral_rad, (bend, bend)),
        (spiral_rad, (bend, 0.0)),
    ]
    return [
        Segment(length_m=radius_m * turn, curvature_1pm=curvature)
        for turn, curvature in shapes
        if turn > 0
    ]


def driven_line(
    road: Track,
    cut_m: float,
    wander_m: float,
    wander_every_m: float,
    of_driver: np.random.Generator,
) -> Track:
    """Return the line that a driver takes along a road.

    He cuts bends: curvature is the road's mean from `cut_m` behind to `cut_m` ahead. He wanders:
    cubic splines through offsets of deviation `wander_m`, `wander_every_m` apart.
    """
    points = max(2, round(road.length_m / LINE_STEP_M)) + 1
    station_m = np.linspace(0.0, road.length_m, points)
    curvature = _mean_around(road, station_m, cut_m)
    knots = max(4, round(road.length_m / wander_every_m))
    offsets_m = wander_m * of_driver.standard_normal(knots)
    bends = np.zeros(knots)
    bends[1:-1] = (offsets_m[:-2] - 2 * offsets_m[1:-1] + offsets_m[2:]) / wander_every_m**2
    curvature = curvature + np.interp(station_m, np.linspace(0.0, road.length_m, knots), bends)
    ends = zip(curvature[:-1].tolist(), curvature[1:].tolist(), strict=True)
    step_m = road.length_m / (points - 1)
    return Track(
        name=road.name,
        description=road.description,
        closed=road.closed,
        segments=tuple(Segment(length_m=step_m, curvature_1pm=pair) for pair in ends),
    )


def _mean_around(road: Track, station_m: FloatArray, reach_m: float) -> FloatArray:
    """Return the mean of a road's curvature from so far behind to so far ahead."""
    if reach_m <= 0:
        return road.curvature(station_m)
    shares = np.linspace(-1.0, 1.0, 21)
    near = [road.curvature(station_m + share * reach_m) for share in shares]
    mean: FloatArray = np.sum(near, axis=0) / len(near)
    return mean
