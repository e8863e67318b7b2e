"""Speed over station, as fast as the friction circle lets a car follow a track.

The usual forward-backward pass of lap-time simulation (Kapania, Subosits and Gerdes, 2016, "A
sequential two-step algorithm for fast generation of vehicle racing trajectories"). Each step is
taken implicitly, so that the limits hold exactly at every point of the grid and a higher limit
never makes any point slower.
"""

from dataclasses import dataclass

import numpy as np
from pydantic import Field, FiniteFloat

from fleet_slip.arrays import FloatArray
from fleet_slip.compiling import kernel
from fleet_slip.config import Config
from fleet_slip.simulation.track import Track


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
        """Return the time from the start over so many laps, or over a part of one, in s.

        Between the stations the acceleration is constant.
        """
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

    With v the speed, a the acceleration along the track and κ the curvature, everywhere

        v <= top speed   and   (κ v² / lateral)² + (a / a_max)² <= 1,

    where a_max is the limit of acceleration or of braking, after the sign of a. The ends of an
    open track are entered and left at any speed.
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

    The next w is the larger root of ((w - w_before) / gain)² + (load w)² = 1, at most its cap,
    where gain = 2 Δs a_max. On a closed track the pass begins at the slowest point, which no
    other limits.
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
