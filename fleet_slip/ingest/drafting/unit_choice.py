"""Chooses the units that a file does not say, those of all signals together, by how a car moves.

The relations are products: the lateral acceleration is yaw rate times speed, so a wrong unit shows
as a factor of 3.6, 9.8 or 57, and which signals share it tells whose it is.
"""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.signals import SAMPLE_TIME_S, catalogue
from fleet_slip.ingest.drafting.guessing import Guess
from fleet_slip.ingest.drives.relations import moving, slope_of
from fleet_slip.ingest.drives.suspicion import RADIUS_M, WHEELS, speed_mps
from fleet_slip.ingest.mapping.signal_column import COURSE, SPEED
from fleet_slip.ingest.mapping.units import conversion_factor

WHEELBASE_M, STEERING_RATIO = 2.7, 15.0
_LEAST_CORRELATION = 0.6
_UNLIKELY = 0.7
"""What it costs not to take the unit that the largest value suggests."""
_WITH_UNITS = {
    "m/s^2": ("m/s^2", "g"),
    "rad/s": ("deg/s", "rad/s"),
    "rad": ("deg", "rad"),
    "m/s": ("m/s", "km/h", "mph"),
}
_OF_WHEELS = (("rad/s", None), ("km/h", RADIUS_M), ("m/s", RADIUS_M), ("rpm", None))
_GROUPS = (("ax", "ay"), ("vx", "vy"), WHEELS, ("steer_fl", "steer_fr"))
"""Signals of one sensor, which have one unit."""


@dataclass(frozen=True)
class _Relation:
    """A product of signals that should be 1, to these powers, and how exactly."""

    powers: Mapping[str, int]
    ratio: float
    tolerance: float


def choose_units(guesses: dict[str, Guess], drive: Mapping[str, FloatArray]) -> dict[str, Guess]:
    """Return the guesses without a unit with that in which the car moves as cars do."""
    relations = list(_relations(drive))
    groups = _groups(guesses)
    guesses = _doubt_speeds(guesses, groups, relations)
    if not relations or not groups:
        return guesses
    choices = [list(unit_choices(guesses[group[0]])) for group in groups]
    best = min(
        itertools.product(*choices), key=lambda some: _cost(some, groups, guesses, relations)
    )
    changed = dict(guesses)
    for group, (unit, radius_m) in zip(groups, best, strict=True):
        for name in group:
            guess = guesses[name]
            if (guess.unit, guess.radius_m) != (unit, radius_m):
                reason = f"with {unit} it fits the other signals"
                changed[name] = guess.because(reason, unit=unit, radius_m=radius_m, doubts=())
    return changed


def steering_ratio(drive: Mapping[str, FloatArray], name: str) -> float | None:
    """Return an angle over that of the road wheels in a bend: 1, or a steering wheel's 15."""
    speed = speed_mps(drive)
    if speed is None or not {name, "yaw_rate"} <= set(drive):
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        bend = WHEELBASE_M * drive["yaw_rate"] / speed
    slope, correlation = slope_of(drive[name], bend, moving(speed))
    return abs(slope) if abs(correlation) > _LEAST_CORRELATION else None


def _doubt_speeds(
    guesses: dict[str, Guess], groups: list[list[str]], relations: list[_Relation]
) -> dict[str, Guess]:
    """Return the guesses with a doubt for speeds of which nothing tells the unit.

    The speed of a car in km/h is that of a faster one in m/s, and angles per second of its wheels
    are near to both; of all else the largest value tells the unit.
    """
    found = dict(guesses)
    related = {name for relation in relations for name in relation.powers}
    for group in groups:
        is_speed = catalogue()[group[0]].unit == "m/s" or group[0] in WHEELS
        if is_speed and group != [SPEED] and not related & set(group):
            units = " or ".join(unit for unit, _ in unit_choices(guesses[group[0]]))
            for name in group:
                found[name] = found[name].doubted(f"nothing tells whether it is in {units}")
    return found


def _groups(guesses: dict[str, Guess]) -> list[list[str]]:
    """Return the signals without a unit, those of one sensor together."""
    told = {n for n, guess in guesses.items() if not guess.is_without_unit or guess.component}
    open_ones = [name for name in guesses if name not in {*told, COURSE}]
    together = [[name for name in group if name in open_ones] for group in _GROUPS]
    alone = [[n] for n in open_ones if not any(n in group for group in together)]
    known = {*_WITH_UNITS}
    return [g for g in (*together, *alone) if g and catalogue()[g[0]].unit in known]


def unit_choices(guess: Guess) -> list[tuple[str, float | None]]:
    """Return what units values without one may have: first the likely one."""
    if guess.signal.startswith("wheel_"):
        found = list(_OF_WHEELS)
    else:
        found = [(unit, None) for unit in _WITH_UNITS.get(catalogue()[guess.signal].unit, ())]
    first = (guess.unit, guess.radius_m)
    return [first, *(one for one in found if one != first)]


def _cost(
    some: tuple[tuple[str, float | None], ...],
    groups: list[list[str]],
    guesses: dict[str, Guess],
    relations: list[_Relation],
) -> float:
    cost, factors = 0.0, dict[str, float]()
    for group, (unit, radius_m) in zip(groups, some, strict=True):
        for name in group:
            guess = guesses[name]
            factors[name] = _si(name, unit, radius_m) / _si(name, guess.unit, guess.radius_m)
            largest = float(np.nanquantile(np.abs(guess.profile.values), 0.999))
            most = float(catalogue()[name].max)
            cost += 100.0 * (largest * _si(name, unit, radius_m) > most)
        likely = guesses[group[0]]
        cost += _UNLIKELY * ((unit, radius_m) != (likely.unit, likely.radius_m))
    for relation in relations:
        off = np.log(relation.ratio)
        off += sum(p * np.log(factors.get(n, 1.0)) for n, p in relation.powers.items())
        cost += (off / relation.tolerance) ** 2
    return cost


def _si(name: str, unit: str, radius_m: float | None) -> float:
    measures = catalogue()[name].unit if radius_m is None else "m/s"
    return conversion_factor(unit, measures) / (radius_m or 1.0)


def _relations(drive: Mapping[str, FloatArray]) -> list[_Relation]:
    """Return what a car's signals have to do with one another, where they do."""
    speed = speed_mps(drive)
    if speed is None:
        return []
    by = next((n for n in (*WHEELS, "vx", "vehicle_speed") if n in drive), "vehicle_speed")
    found, rows = [], moving(speed)

    def relate(
        powers: dict[str, int], values: FloatArray, expected: FloatArray, tolerance: float
    ) -> None:
        slope, correlation = slope_of(values, expected, rows)
        if abs(correlation) > _LEAST_CORRELATION and slope:
            found.append(_Relation(powers, abs(slope), tolerance))

    for name in ("vx", "vehicle_speed", SPEED):
        if name in drive and name != by:
            with np.errstate(divide="ignore", invalid="ignore"):
                ratios = (drive[name] / speed)[rows & np.isfinite(drive[name])]
            if ratios.size and np.median(ratios) > 0:
                found.append(_Relation({name: 1, by: -1}, float(np.median(ratios)), 0.15))
    if {"ay", "yaw_rate"} <= set(drive):
        powers = {"ay": 1, "yaw_rate": -1, by: -1}
        relate(powers, drive["ay"], drive["yaw_rate"] * speed, 0.15)
    if "yaw_rate" in drive and {"wheel_rl", "wheel_rr"} <= set(drive):
        turn = (drive["wheel_rr"] - drive["wheel_rl"]) * RADIUS_M / 1.55
        relate({"yaw_rate": 1, by: -1}, drive["yaw_rate"], turn, 0.3)
    if "ax" in drive:
        second = round(1 / float(SAMPLE_TIME_S))
        change = np.full(speed.size, np.nan)
        if speed.size > 2 * second:
            change[second // 2 : -second // 2] = speed[second:] - speed[:-second]
            smooth = np.convolve(np.nan_to_num(drive["ax"]), np.ones(second) / second, "same")
            relate({"ax": 1, by: -1}, smooth, change, 0.3)
    for name, ratio in (("steering_wheel", STEERING_RATIO), ("steer", 1.0), ("steer_fl", 1.0)):
        if name in drive and "yaw_rate" in drive:
            with np.errstate(divide="ignore", invalid="ignore"):
                bend = ratio * WHEELBASE_M * drive["yaw_rate"] / speed
            relate({name: 1, "yaw_rate": -1, by: 1}, drive[name], bend, 1.0)
        elif name in drive and "ay" in drive:
            with np.errstate(divide="ignore", invalid="ignore"):
                bend = ratio * WHEELBASE_M * drive["ay"] / speed**2
            relate({name: 1, "ay": -1, by: 2}, drive[name], bend, 1.0)
    return found
