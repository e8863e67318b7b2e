"""Tracks from files, roads drawn by class, speed profiles, surfaces, manoeuvres, driven lines.

Drawn roads consist of straights and bends, which are arcs between clothoids with parameters from a
third of the radius to the radius, as in German guidelines (RAL 2012, RAA 2008, RASt 06). Only sums
and products are used, for the same bits on every machine.
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

CLOSURE_TOLERANCE_M = 0.05
"""Largest gap between the ends of a closed track, in m."""

CLOSURE_TOLERANCE_RAD = 1e-3
"""Largest difference of heading between the ends of a closed track, in rad."""

CONTINUITY_TOLERANCE_1PM = 1e-6
"""Largest jump of curvature between two segments, in 1/m: a car cannot follow a jump."""

MAX_LENGTH_M = 1e6
"""Maximum length of a track, in m: its tables take memory in proportion."""

MAX_CURVATURE_1PM = 1.0
"""Maximum curvature of a track, in 1/m. No car turns so sharply."""

INTEGRATION_STEP_M = 5.0
QUADRATURE_POINTS = 6


Curvature = Annotated[FiniteFloat, Field(ge=-MAX_CURVATURE_1PM, le=MAX_CURVATURE_1PM)]


class Segment(Config):
    """A straight, an arc or a clothoid: curvature is linear in the arc length."""

    length_m: FiniteFloat = Field(gt=0, le=MAX_LENGTH_M)
    curvature_1pm: tuple[Curvature, Curvature]


@dataclass(frozen=True)
class CentreLine:
    """Points of a centre line that starts at the origin along x; `heading_rad` is not wrapped."""

    station_m: FloatArray
    x_m: FloatArray
    y_m: FloatArray
    heading_rad: FloatArray

    def at(self, station_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return x and y in m, and the heading in rad, at stations in m."""
        along = (self.x_m, self.y_m, self.heading_rad)
        x, y, heading = (np.interp(station_m, self.station_m, values) for values in along)
        return x, y, heading


class Track(Config):
    """A circuit or an open road, given by the curvature of its line, positive to the left."""

    name: Identifier
    description: str = Field(min_length=1)
    closed: bool
    segments: tuple[Segment, ...] = Field(min_length=1, max_length=10_000)

    @model_validator(mode="after")
    def _can_be_driven(self) -> Self:
        if self.length_m > MAX_LENGTH_M:
            raise ValueError(f"is {self.length_m:g} m long: give at most {MAX_LENGTH_M:g} m")
        following = [*self.segments[1:], *(self.segments[:1] if self.closed else ())]
        for index, (segment, successor) in enumerate(zip(self.segments, following, strict=False)):
            end, start = segment.curvature_1pm[1], successor.curvature_1pm[0]
            if abs(end - start) > CONTINUITY_TOLERANCE_1PM:
                raise ValueError(
                    f"curvature jumps from {end} to {start} 1/m after segment {index}"
                    f" (counted from 0)"
                )
        gap_m, gap_rad = self.closure() if self.closed else (0.0, 0.0)
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
        """Return the curvature in 1/m at stations in m; the stations of a closed track wrap."""
        station = np.asarray(station_m, dtype=np.float64)
        if self.closed:
            station = np.mod(station, self.length_m)
        return np.interp(station, self._knots_m, self._curvature_at_knots_1pm)

    def grid(self, spacing_m: float) -> tuple[FloatArray, float]:
        """Return even stations in m from 0, and their spacing, the nearest to `spacing_m`.

        The stations of an open track include its end, those of a closed track do not.
        """
        intervals = max(1, round(self.length_m / spacing_m))
        stations = np.linspace(0.0, self.length_m, intervals + 1)
        return (stations[:-1] if self.closed else stations), self.length_m / intervals

    def centre_line(self, spacing_m: float) -> CentreLine:
        """Integrate the curvature to points about `spacing_m` apart, including both ends."""
        intervals = max(1, round(self.length_m / spacing_m))
        station = np.linspace(0.0, self.length_m, intervals + 1)
        steps = np.arange(0.0, self.length_m, INTEGRATION_STEP_M)
        nodes = np.union1d(station, np.concatenate([self._knots_m, steps]))
        x, y, heading = self._integrate(nodes)
        i = np.searchsorted(nodes, station)
        return CentreLine(station, x[i], y[i], heading[i])

    def through(self, curvature_1pm: FloatArray, step_m: float) -> Self:
        """Return a track of this name with other curvatures, `step_m` apart."""
        pairs = zip(curvature_1pm[:-1].tolist(), curvature_1pm[1:].tolist(), strict=True)
        segments = tuple(Segment(length_m=step_m, curvature_1pm=pair) for pair in pairs)
        return type(self)(
            name=self.name, description=self.description, closed=self.closed, segments=segments
        )

    def closure(self) -> tuple[float, float]:
        """Return the gap between both ends in m, and the difference of their headings in rad."""
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
    """Limits of a speed profile: the half axes of the friction ellipse, and a top speed."""

    lateral_mps2: FiniteFloat = Field(gt=0)
    acceleration_mps2: FiniteFloat = Field(gt=0)
    braking_mps2: FiniteFloat = Field(gt=0)
    top_speed_mps: FiniteFloat = Field(gt=0)


@dataclass(frozen=True)
class SpeedProfile:
    """Speed at the stations of `Track.grid`, periodic on a closed track."""

    track: Track
    spacing_m: float
    station_m: FloatArray
    speed_mps: FloatArray

    def time_s(self, laps: float) -> float:
        """Return the time of a number of laps in s, at constant acceleration between stations."""
        station, speed = self.station_m, self.speed_mps
        if self.track.closed:
            station, speed = np.append(station, self.track.length_m), np.append(speed, speed[0])
        steps = 2 * np.diff(station) / (speed[:-1] + speed[1:])
        passed = np.append(0.0, np.cumsum(steps))
        full_laps, fraction = divmod(laps, 1)
        last_lap_s = np.interp(fraction * self.track.length_m, station, passed)
        return float(full_laps * passed[-1] + last_lap_s)


def speed_profile(track: Track, limits: SpeedLimits, spacing_m: float) -> SpeedProfile:
    """Compute the fastest speed profile within the limits, by a forward and a backward pass.

    With speed v, longitudinal acceleration a and curvature κ, v <= top speed and
    (κ v² / lateral)² + (a / a_max)² <= 1, with a_max for acceleration or braking. Implicit steps
    hold the limits exactly, and a higher limit never lowers a speed. Open ends have no limit.

    References
    ----------
    N. R. Kapania, J. Subosits, J. C. Gerdes, "A sequential two-step algorithm for fast generation
    of vehicle racing trajectories" (2016).
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
    """Limit the increase of the squared speed w from point to point.

    The next w is the larger root of ((w - w_previous) / gain)² + (load w)² = 1, at most its cap,
    with gain = 2 Δs a_max. A closed track starts at its slowest point.
    """
    count = len(cap)
    squared = cap.copy()
    i = np.argmin(cap) if periodic else 0
    for _ in range(1, count):
        previous = squared[i]
        i = i + 1 if i + 1 < count else 0
        if previous < cap[i]:
            k2 = load[i] ** 2
            root = gain * np.sqrt(1 + k2 * (gain**2 - previous**2))
            squared[i] = min(cap[i], (previous + root) / (1 + k2 * gain**2))
    return squared


# The surface of a road: slopes belong to the track, adhesion and wind to the drive. They are drawn
# at knots, linear in between, and periodic on a closed track.

KNOTS_M = 60.0
"""Distance of the knots in m: the length of a bend, a patch or a gust."""

FULL_SUPERELEVATION_1PM = 0.01
"""Curvature in 1/m above which a bend has its full superelevation."""

MIN_GRIP = 0.1


def surface(
    road: RoadImperfections,
    track: Track,
    station_m: FloatArray,
    track_rng: np.random.Generator,
    drive_rng: np.random.Generator,
) -> Surface | None:
    """Draw the surface at the stations of a track's grid; None for an ideal road."""
    if road == RoadImperfections():
        return None
    curvature = track.curvature(station_m)
    bank = _along(track, station_m, track_rng)
    grade = _along(track, station_m, track_rng)
    change, split, gust = (_along(track, station_m, drive_rng) for _ in range(3))
    wind_x, wind_y = drive_rng.standard_normal(2).tolist()
    share = road.wind_mps / math.sqrt(wind_x * wind_x + wind_y * wind_y)
    fall = (
        road.cross_slope_percent
        - road.superelevation_percent * np.clip(curvature / FULL_SUPERELEVATION_1PM, -1.0, 1.0)
        + road.bank_std_percent * bank
    ) / 100
    climb = road.grade_std_percent * grade / 100
    grip = 1 + road.adhesion_std * change
    half = road.adhesion_split_std * split / 2
    spacing_m = station_m[1] - station_m[0]
    return Surface(
        gravity_x_mps2=-GRAVITY_MPS2 * climb / np.sqrt(1 + climb * climb),
        gravity_y_mps2=-GRAVITY_MPS2 * fall / np.sqrt(1 + fall * fall),
        grip_left=np.maximum(grip + half, MIN_GRIP),
        grip_right=np.maximum(grip - half, MIN_GRIP),
        cross_wind_mps=_across(curvature, spacing_m, share * wind_x, share * wind_y)
        + road.gust_std_mps * gust,
    )


def _along(track: Track, station_m: FloatArray, generator: np.random.Generator) -> FloatArray:
    """Draw standard normal numbers at knots, with mean zero over the track, linear in between."""
    knots = max(2, round(track.length_m / KNOTS_M))
    values = generator.standard_normal(knots)
    values = values - np.sum(values) / knots
    knots_m = np.arange(knots) * (track.length_m / knots)
    if track.closed:
        knots_m, values = np.append(knots_m, track.length_m), np.append(values, values[0])
    return np.interp(station_m, knots_m, values)


@kernel
def _across(curvature: FloatArray, spacing_m: float, wind_x: float, wind_y: float) -> FloatArray:
    """Return the component of a wind across the track, whose heading is a rotated unit vector."""
    across = np.empty(len(curvature))
    cosine, sine = 1.0, 0.0
    for i in range(len(curvature)):
        across[i] = wind_y * cosine - wind_x * sine
        half = 0.5 * curvature[i] * spacing_m
        scale = 1.0 / (1.0 + half * half)
        along, side = (1.0 - half * half) * scale, 2.0 * half * scale
        cosine, sine = cosine * along - sine * side, sine * along + cosine * side
    return across


# Manoeuvres are changes of the road that the driver follows: steps and slaloms add curvature,
# braking reduces the target speed. Driver and kernel need no code for them.

Kind = Literal["step", "slalom", "braking"]
KINDS: tuple[Kind, ...] = get_args(Kind)

SLOWEST_MPS = 4.0
"""Lower bound of the speed in manoeuvres, in m/s."""

MAX_DIP = 0.45
"""Largest relative reduction of the speed by braking."""


@dataclass(frozen=True)
class Manoeuvre:
    """A manoeuvre on each lap."""

    kind: Kind
    """A step to one side and back, a slalom in sines, or braking and accelerating again."""
    station_m: float
    """Start of the manoeuvre."""
    duration_s: float
    """Duration at the planned speed."""
    strength_mps2: float
    """Planned lateral acceleration, first to the left, or deceleration."""
    period_s: float
    """Period of a slalom."""


def road_with(road: Road, script: Sequence[Manoeuvre]) -> Road:
    """Return a road with manoeuvres, applied in order; without any, the same road."""
    if not script:
        return road
    curvature, speed = road.curvature_1pm.copy(), road.speed_mps.copy()
    station: FloatArray = np.arange(len(speed), dtype=np.float64) * road.spacing_m
    for manoeuvre in script:
        planned = max(float(np.interp(manoeuvre.station_m, station, speed)), SLOWEST_MPS)
        ahead: FloatArray = station - manoeuvre.station_m
        if road.closed:
            ahead %= road.length_m
        progress: FloatArray = ahead / (manoeuvre.duration_s * planned)
        inside = (progress >= 0) & (progress < 1)
        curvature[inside] += _lateral_mps2(manoeuvre, progress[inside]) / planned**2
        if manoeuvre.kind == "braking":
            dip = abs(manoeuvre.strength_mps2) * manoeuvre.duration_s / 2 / planned
            speed[inside] *= 1.0 - min(MAX_DIP, dip) * (1.0 - np.abs(2 * progress[inside] - 1))
    return road._replace(curvature_1pm=curvature, speed_mps=np.maximum(speed, SLOWEST_MPS))


def _lateral_mps2(manoeuvre: Manoeuvre, progress: FloatArray) -> FloatArray:
    """Return the additional lateral acceleration, given the progress from 0 to 1."""
    if manoeuvre.kind == "step":
        return manoeuvre.strength_mps2 * np.where(progress < 0.5, 1.0, -1.0)
    if manoeuvre.kind == "slalom":
        swings = max(1, round(manoeuvre.duration_s / manoeuvre.period_s))
        return manoeuvre.strength_mps2 * np.sin(2 * math.pi * swings * progress)
    return np.zeros(len(progress))


def random_generator(seed: int, *purpose: str) -> np.random.Generator:
    """Return a generator that depends on the seed and its purpose only."""
    digest = hashlib.sha256("\n".join(purpose).encode()).digest()
    words = np.frombuffer(digest, dtype="<u4").tolist()
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, *words])))


LINE_STEP_M = 2.0
"""Distance of the points of a driver's line, in m."""

WANDER_S = 2.0
"""Time between two offsets of a wandering driver at top speed, in s."""


class RoadClass(NamedTuple):
    """Dimensions of the roads of a class. Most bends are near the smaller radius."""

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
"""Dimensions from RAL 2012, RAA 2008 and RASt 06. No guideline has hill roads and switchbacks."""

_NAME = re.compile(rf"({'|'.join(CLASSES)})_(\d{{1,9}})")


def load_track(name_or_path: str, configs: Configs) -> Track:
    """Read a track by name or path, or draw a road such as `country_17` (class, seed)."""
    drawn = _NAME.fullmatch(name_or_path)
    if drawn:
        return draw_road(drawn[1], int(drawn[2]))
    return load_config(configs.find("tracks", name_or_path), Track)


def road_class(track: Track) -> str | None:
    """Return the class of a drawn road, None for a track from a file."""
    drawn = _NAME.fullmatch(track.name)
    return drawn[1] if drawn else None


def draw_road(kind: str, seed: int) -> Track:
    """Draw an open road of a class of `CLASSES`, with straight ends."""
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
    min_m, max_m = road.radius_m
    radius_m = min_m + (max_m - min_m) * generator.random() ** 2
    turn_rad = generator.uniform(*road.turn_deg) * (math.pi / 180)
    spiral_rad = min(generator.uniform(1 / 3, 1.0) ** 2, turn_rad)  # angle of each clothoid
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
    wander_spacing_m: float,
    generator: np.random.Generator,
) -> Track:
    """Draw the line of a driver along a road.

    The driver cuts bends: the line's curvature is the mean of the road's from `cut_m` behind to
    `cut_m` ahead. The driver wanders: a cubic spline through random offsets is added, with the
    standard deviation `wander_m` and the distance `wander_spacing_m`.
    """
    points = max(2, round(road.length_m / LINE_STEP_M)) + 1
    station_m = np.linspace(0.0, road.length_m, points)
    curvature = _mean_curvature(road, station_m, cut_m)
    knots = max(4, round(road.length_m / wander_spacing_m))
    offsets_m = wander_m * generator.standard_normal(knots)
    bends = np.zeros(knots)
    bends[1:-1] = (offsets_m[:-2] - 2 * offsets_m[1:-1] + offsets_m[2:]) / wander_spacing_m**2
    curvature = curvature + np.interp(station_m, np.linspace(0.0, road.length_m, knots), bends)
    return road.through(curvature, road.length_m / (points - 1))


def _mean_curvature(road: Track, station_m: FloatArray, reach_m: float) -> FloatArray:
    """Return the mean curvature of a road within `reach_m` of stations."""
    if reach_m <= 0:
        return road.curvature(station_m)
    shares = np.linspace(-1.0, 1.0, 21)
    curvatures = [road.curvature(station_m + share * reach_m) for share in shares]
    mean: FloatArray = np.sum(curvatures, axis=0) / len(curvatures)
    return mean
