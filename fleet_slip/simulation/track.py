"""Tracks as sequences of curvature segments (`configs/tracks/*.toml`), and how fast a car follows.

Speeds come of a forward-backward pass (Kapania, Subosits and Gerdes, 2016) within the friction
circle; implicit steps hold the limits exactly, and a higher limit slows no point.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, FiniteFloat, model_validator

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.signals import Identifier
from fleet_slip.compiling import kernel
from fleet_slip.config import Config

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
