"""Manoeuvres: what a driver does besides following the track, as changes of the road before him.

Steps and slaloms are added curvature, braking a dip of the speed: no law or kernel knows them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.vehicle.lanes.road import Road

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
        curvature[inside] += _bend(one, passed[inside]) / planned**2
        if one.kind == "braking":
            dip = min(DEEPEST_DIP, abs(one.strength_mps2) * one.duration_s / 2 / planned)
            speed[inside] *= 1.0 - dip * (1.0 - np.abs(2 * passed[inside] - 1))
    return road._replace(curvature_1pm=curvature, speed_mps=np.maximum(speed, SLOWEST_MPS))


def _bend(one: Manoeuvre, passed: FloatArray) -> FloatArray:
    """Return the further lateral acceleration at the shares of the manoeuvre that have passed."""
    if one.kind == "step":
        return one.strength_mps2 * np.where(passed < 0.5, 1.0, -1.0)
    if one.kind == "slalom":
        swings = max(1, round(one.duration_s / one.period_s))
        return one.strength_mps2 * np.sin(2 * math.pi * swings * passed)
    return np.zeros(len(passed))
