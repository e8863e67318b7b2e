"""Roads drawn by class, and the lines that drivers take along them.

Straights and bends, arcs between clothoids, as laid out in Germany (RAL 2012, RAA 2008, RASt 06:
parameters from a third of the radius to it); from sums and products, for the same bits.
"""

import hashlib
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Literal, NamedTuple, Self, get_args

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, FiniteFloat, model_validator

from fleet_slip.arrays import FloatArray
from fleet_slip.catalog.signals import Identifier
from fleet_slip.compiling import kernel
from fleet_slip.config import Config, load_config
from fleet_slip.resources import Configs
from fleet_slip.simulation.imperfections import RoadImperfections
from fleet_slip.vehicle.batch import Road, Surface
from fleet_slip.vehicle.parameters import GRAVITY_MPS2

# Tracks as sequences of curvature segments (`configs/tracks/*.toml`), and how fast a car follows.
#
# Speeds come of a forward-backward pass (Kapania, Subosits and Gerdes, 2016) within the friction
# circle; implicit steps hold the limits exactly, and a higher limit slows no point.

CLOSURE_TOLERANCE_M = 0.05
"""Largest gap between the ends of a closed track, in m."""

CLOSURE_TOLERANCE_RAD = 1e-3
"""Largest difference of heading between the ends of a closed track, in rad."""

CONTINUITY_TOLERANCE_1PM = 1e-6
"""Largest jump of curvature between two segments, in 1/m: a car cannot follow a jump."""

LONGEST_M = 1e6
"""Longest track, in m. Its points are tabulated, which takes memory."""

SHARPEST_1PM = 1.0
"""Largest curvature of a track, in 1/m. No car turns so sharply; sums of much more overflow."""

INTEGRATION_STEP_M = 5.0
QUADRATURE_POINTS = 6


Curvature = Annotated[FiniteFloat, Field(ge=-SHARPEST_1PM, le=SHARPEST_1PM)]


class Segment(Config):
    """A straight, an arc or a clothoid: curvature is linear in arc length between two values."""

    length_m: FiniteFloat = Field(gt=0, le=LONGEST_M)
    curvature_1pm: tuple[Curvature, Curvature]


@dataclass(frozen=True)
class CentreLine:
    """Points from a start at the origin along x; `heading_rad` is continuous, not wrapped."""

    station_m: FloatArray
    x_m: FloatArray
    y_m: FloatArray
    heading_rad: FloatArray

    def at(self, station_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return x and y in m and the heading in rad at stations in m."""
        along = (self.x_m, self.y_m, self.heading_rad)
        x, y, heading = (np.interp(station_m, self.station_m, values) for values in along)
        return x, y, heading


class Track(Config):
    """A centre line given by its curvature, positive when bending left."""

    name: Identifier
    description: str = Field(min_length=1)
    closed: bool
    segments: tuple[Segment, ...] = Field(min_length=1, max_length=10_000)

    @model_validator(mode="after")
    def _is_not_too_long(self) -> Self:
        if self.length_m > LONGEST_M:
            raise ValueError(f"is {self.length_m:g} m long, at most {LONGEST_M:g} m are possible")
        return self

    @model_validator(mode="after")
    def _curvature_is_continuous(self) -> Self:
        following = [*self.segments[1:], *(self.segments[:1] if self.closed else ())]
        for index, (segment, successor) in enumerate(zip(self.segments, following, strict=False)):
            end, start = segment.curvature_1pm[1], successor.curvature_1pm[0]
            if abs(end - start) > CONTINUITY_TOLERANCE_1PM:
                raise ValueError(
                    f"curvature jumps from {end} to {start} 1/m after segment {index}"
                    f" (counted from 0)"
                )
        return self

    @model_validator(mode="after")
    def _closed_track_closes(self) -> Self:
        if not self.closed:
            return self
        gap_m, gap_rad = self.closure()
        if gap_m > CLOSURE_TOLERANCE_M or gap_rad > CLOSURE_TOLERANCE_RAD:
            raise ValueError(
                f"the lap does not close: its ends are {gap_m:.3f} m and {gap_rad:.5f} rad apart"
            )
        return self

    @cached_property
    def _knots_m(self) -> FloatArray:
        return np.concatenate([[0.0], np.cumsum([s.length_m for s in self.segments])])

    @cached_property
    def _curvature_at_knots_1pm(self) -> FloatArray:
        first = [segment.curvature_1pm[0] for segment in self.segments]
        return np.array([*first, self.segments[-1].curvature_1pm[1]])

    @property
    def length_m(self) -> float:
        """Length of the centre line, in m."""
        return float(self._knots_m[-1])

    def curvature(self, station_m: ArrayLike) -> FloatArray:
        """Return the curvature in 1/m at stations in m; a closed track wraps, an open one ends."""
        station = np.asarray(station_m, dtype=np.float64)
        if self.closed:
            station = np.mod(station, self.length_m)
        return np.interp(station, self._knots_m, self._curvature_at_knots_1pm)

    def grid(self, spacing_m: float) -> tuple[FloatArray, float]:
        """Return even stations in m from 0 and their spacing, as near `spacing_m` as fits.

        On an open track they reach its end; on a closed one the next would be the start.
        """
        intervals = max(1, round(self.length_m / spacing_m))
        stations = np.linspace(0.0, self.length_m, intervals + 1)
        return (stations[:-1] if self.closed else stations), self.length_m / intervals

    def centre_line(self, spacing_m: float) -> CentreLine:
        """Integrate the curvature to points about `spacing_m` apart, ends included, to rounding."""
        intervals = max(1, round(self.length_m / spacing_m))
        station = np.linspace(0.0, self.length_m, intervals + 1)
        steps = np.arange(0.0, self.length_m, INTEGRATION_STEP_M)
        nodes = np.union1d(station, np.concatenate([self._knots_m, steps]))
        x, y, heading = self._integrate(nodes)
        at = np.searchsorted(nodes, station)
        return CentreLine(station, x[at], y[at], heading[at])

    def through(self, curvature_1pm: FloatArray, step_m: float) -> Self:
        """Return a track in the place of this one, through curvatures so far apart."""
        pairs = zip(curvature_1pm[:-1].tolist(), curvature_1pm[1:].tolist(), strict=True)
        segments = tuple(Segment(length_m=step_m, curvature_1pm=pair) for pair in pairs)
        return type(self)(
            name=self.name, description=self.description, closed=self.closed, segments=segments
        )

    def closure(self) -> tuple[float, float]:
        """Return how far apart the ends are: in m, and in rad beside whole turns."""
        line = self.centre_line(self.length_m)
        turns = line.heading_rad[-1] / (2 * np.pi)
        gap_rad = 2 * np.pi * abs(turns - round(turns))
        return float(np.hypot(line.x_m[-1], line.y_m[-1])), float(gap_rad)

    def _integrate(self, nodes: FloatArray) -> tuple[FloatArray, ...]:
        step = np.diff(nodes)
        curvature = self.curvature(nodes)
        if self.closed:
            curvature[-1] = self.segments[-1].curvature_1pm[1]
        change = np.diff(curvature)
        heading = _cumulative(step * (curvature[:-1] + change / 2))
        points, weights = np.polynomial.legendre.leggauss(QUADRATURE_POINTS)
        u = (points[:, None] + 1) / 2
        inside = heading[:-1] + step * u * (curvature[:-1] + change * u / 2)
        x = _cumulative(step * (weights / 2 @ np.cos(inside)))
        y = _cumulative(step * (weights / 2 @ np.sin(inside)))
        return x, y, heading


def _cumulative(increments: FloatArray) -> FloatArray:
    return np.concatenate([[0.0], np.cumsum(increments)])


class SpeedLimits(Config):
    """What the profile allows itself: the half axes of the friction ellipse, and a top speed."""

    lateral_mps2: FiniteFloat = Field(gt=0)
    acceleration_mps2: FiniteFloat = Field(gt=0)
    braking_mps2: FiniteFloat = Field(gt=0)
    top_speed_mps: FiniteFloat = Field(gt=0)


@dataclass(frozen=True)
class SpeedProfile:
    """Speed at the stations of `Track.grid`; periodic on a closed track."""

    track: Track
    spacing_m: float
    station_m: FloatArray
    speed_mps: FloatArray

    def time_s(self, laps: float) -> float:
        """Return the time from the start over laps or parts, by constant accelerations."""
        station, speed = self.station_m, self.speed_mps
        if self.track.closed:
            station, speed = np.append(station, self.track.length_m), np.append(speed, speed[0])
        steps = 2 * np.diff(station) / (speed[:-1] + speed[1:])
        passed = np.append(0.0, np.cumsum(steps))
        whole, part = divmod(laps, 1)
        rest = np.interp(part * self.track.length_m, station, passed)
        return float(whole * passed[-1] + rest)


def speed_profile(track: Track, limits: SpeedLimits, spacing_m: float) -> SpeedProfile:
    """Return the fastest speed over station within the limits.

    With v the speed, a the acceleration along the track and κ the curvature, v <= top speed and (κ
    v² / lateral)² + (a / a_max)² <= 1, a_max by the sign of a. Open ends take any speed.
    """
    station_m, step_m = track.grid(spacing_m)
    load = np.abs(track.curvature(station_m)) / limits.lateral_mps2
    cap = np.full(len(load), limits.top_speed_mps**2)
    np.divide(1.0, load, out=cap, where=load * cap > 1)
    squared = _pass(cap, load, 2 * step_m * limits.acceleration_mps2, track.closed)
    squared = _pass(squared[::-1], load[::-1], 2 * step_m * limits.braking_mps2, track.closed)
    return SpeedProfile(track, step_m, station_m, np.sqrt(squared[::-1]))


@kernel
def _pass(cap: FloatArray, load: FloatArray, gain: float, periodic: bool) -> FloatArray:
    """Limit how fast the squared speed w rises from point to point.

    The next w is the larger root of ((w - w_before) / gain)² + (load w)² = 1, gain = 2 Δs a_max, at
    most its cap. A closed track begins at its slowest point.
    """
    count = len(cap)
    first = np.argmin(cap) if periodic else 0
    squared = cap.copy()
    at = first
    for _ in range(1, count):
        before = squared[at]
        at = at + 1 if at + 1 < count else 0
        if before < cap[at]:
            k2 = load[at] ** 2
            root = gain * np.sqrt(1 + k2 * (gain**2 - before**2))
            squared[at] = min(cap[at], (before + root) / (1 + k2 * gain**2))
    return squared


# The surface of a drive's road: slopes of the track, adhesion and wind of the drive.
#
# Drawn at knots and linear in between, periodic on a closed track.

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


# Manoeuvres: what a driver does besides following the track, as changes of the road before him.
#
# Steps and slaloms are added curvature, braking a dip of the speed: no law or kernel knows them.

Kind = Literal["step", "slalom", "braking"]
KINDS: tuple[Kind, ...] = get_args(Kind)

SLOWEST_MPS = 4.0
"""A car does not brake below this speed, nor is a manoeuvre planned for less."""

DEEPEST_DIP = 0.45
"""Largest part of the speed that braking takes."""


@dataclass(frozen=True)
class Manoeuvre:
    """One manoeuvre on each lap.

    Attributes:
        kind: a step to one side and back, a slalom in sines, or braking and speeding up again.
        station_m: where it begins.
        duration_s: how long it takes at the planned speed.
        strength_mps2: planned lateral acceleration, first to the left, or deceleration.
        period_s: of a slalom, how long one swing to each side takes together.
    """

    kind: Kind
    station_m: float
    duration_s: float
    strength_mps2: float
    period_s: float


def road_with(road: Road, script: Sequence[Manoeuvre]) -> Road:
    """Return a road with manoeuvres, one after the other; without any it is the same road."""
    if not script:
        return road
    curvature, speed = road.curvature_1pm.copy(), road.speed_mps.copy()
    station: FloatArray = np.arange(len(speed), dtype=np.float64) * road.spacing_m
    for one in script:
        planned = max(float(np.interp(one.station_m, station, speed)), SLOWEST_MPS)
        ahead: FloatArray = station - one.station_m
        if road.closed:
            ahead %= road.length_m
        passed: FloatArray = ahead / (one.duration_s * planned)
        inside = (passed >= 0) & (passed < 1)
        curvature[inside] += _bend_of(one, passed[inside]) / planned**2
        if one.kind == "braking":
            dip = min(DEEPEST_DIP, abs(one.strength_mps2) * one.duration_s / 2 / planned)
            speed[inside] *= 1.0 - dip * (1.0 - np.abs(2 * passed[inside] - 1))
    return road._replace(curvature_1pm=curvature, speed_mps=np.maximum(speed, SLOWEST_MPS))


def _bend_of(one: Manoeuvre, passed: FloatArray) -> FloatArray:
    """Return the further lateral acceleration at the shares of the manoeuvre that have passed."""
    if one.kind == "step":
        return one.strength_mps2 * np.where(passed < 0.5, 1.0, -1.0)
    if one.kind == "slalom":
        swings = max(1, round(one.duration_s / one.period_s))
        return one.strength_mps2 * np.sin(2 * math.pi * swings * passed)
    return np.zeros(len(passed))


# Random numbers that depend on what they are for, and on nothing else.


def random_generator(seed: int, *identity: str) -> np.random.Generator:
    """Return a generator that depends on the seed and on what it is for, and on nothing else."""
    digest = hashlib.sha256("\n".join(identity).encode()).digest()
    words = np.frombuffer(digest, dtype="<u4").tolist()
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, *words])))


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


def load_track(name_or_path: str, configs: Configs) -> Track:
    """Read a track by name or path, or draw `country_17`: class, seed. Raises `ConfigError`."""
    drawn = _NAME.fullmatch(name_or_path)
    if drawn:
        return draw_road(drawn[1], int(drawn[2]))
    return load_config(configs.find("tracks", name_or_path), Track)


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
    return road.through(curvature, road.length_m / (points - 1))


def _mean_around(road: Track, station_m: FloatArray, reach_m: float) -> FloatArray:
    """Return the mean of a road's curvature from so far behind to so far ahead."""
    if reach_m <= 0:
        return road.curvature(station_m)
    shares = np.linspace(-1.0, 1.0, 21)
    near = [road.curvature(station_m + share * reach_m) for share in shares]
    mean: FloatArray = np.sum(near, axis=0) / len(near)
    return mean
