"""Guesses which channel is which signal, by its name, its unit and its values.

Every guess has its reasons as texts, for a person to correct; what speaks against it are doubts,
and with a doubt it is a question.
"""

import itertools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.signals import SAMPLE_TIME_S, catalogue
from fleet_slip.ingest.columns import COURSE, SPEED, Component, conversion_factor, reads_clock
from fleet_slip.ingest.profile import FileProfile, Profile, sample_rate_hz
from fleet_slip.ingest.suspicion import RADIUS_M, TURNING, WHEELS, moving, slope_of, speed_mps
from fleet_slip.ingest.vocabulary import (
    CORNERS,
    best_words,
    fits_any,
    is_called,
    parts_of,
    split_unit,
    unit_behind,
    unit_called,
    vocabulary,
)

NO_UNIT = "the file has no unit"
_WEAK = 0.5
"""What a word that may mean something else counts against one that does not."""
_UNIT_FITS = 4.0
_SIGN_WORDS = {"vz", "vorzeichen", "sign", "signum", "sgn"}
_ALIKE = 0.02


@dataclass(frozen=True)
class Guess:
    """A channel as a signal."""

    signal: str
    profile: Profile
    unit: str
    reasons: tuple[str, ...]
    """Why, for people."""
    radius_m: float | None = None
    negate: bool = False
    component: Component | None = None
    clockwise_from_north: bool | None = None
    sign: tuple[str, int] | None = None
    """The column with its sign, and what stands there where it is negative."""
    is_weak: bool = False
    """Whether its name may as well mean something else."""
    doubts: tuple[str, ...] = ()
    """What speaks against it."""
    rivals: tuple["Guess", ...] = ()
    """Others that its name and unit fit as well."""

    @property
    def is_without_unit(self) -> bool:
        """Whether nothing but the values tell the unit."""
        return any(reason.startswith(NO_UNIT) for reason in self.reasons)

    def because(self, reason: str, **changes: object) -> "Guess":
        """Return the guess changed, with one more reason."""
        changed: Guess = replace(self, reasons=(*self.reasons, reason), **changes)  # type: ignore[arg-type]
        return changed

    def doubted(self, doubt: str) -> "Guess":
        """Return the guess as one that has something against it."""
        return replace(self, doubts=(*self.doubts, doubt))


def guess_signals(profiles: tuple[Profile, ...]) -> dict[str, Guess]:
    """Return the best guess for each signal that has one; a channel is one signal at most."""
    scored = [one for p in profiles if p.is_number for one in _scored(p)]
    scored.sort(key=lambda one: -one[0])
    guesses: dict[str, Guess] = {}
    best: dict[str, float] = {}
    taken: set[str] = set()
    for score, guess in scored:
        signal, name = guess.signal, guess.profile.channel.name
        if name in taken:
            continue
        if signal not in guesses:
            guesses[signal], best[signal] = guess, score
            taken.add(name)
        elif score == best[signal] and not _same_values(guess, guesses[signal]):
            first = guesses[signal]
            guesses[signal] = replace(first, rivals=(*first.rivals, guess))
    guesses = _satellites(guesses)
    signed = {name: _with_sign(guess, profiles) for name, guess in guesses.items()}
    return {name: signed[name] for name in catalogue().signals if name in signed}


def _scored(profile: Profile) -> Iterator[tuple[float, Guess]]:
    """Yield what a channel may be, with how well it fits."""
    name = profile.channel.name
    if not name.isprintable():
        return
    for signal in vocabulary()["signals"]:
        score, words = best_words(signal, name)
        weak = not score
        if weak:
            score, words = best_words(signal, name, "weak")
            score *= _WEAK
        if not score or (guess := _guess(signal, profile, words)) is None:
            continue
        fits = 0.0 if guess.is_without_unit else _UNIT_FITS
        yield score + fits, replace(guess, is_weak=weak)


def _same_values(one: Guess, other: Guess) -> bool:
    a, b = one.profile.values, other.profile.values
    if a.size != b.size:
        return False
    both = np.isfinite(a) & np.isfinite(b)
    spread = float(np.std(b[both])) if both.any() else 0.0
    return bool(both.any() and np.std(a[both] - b[both]) <= _ALIKE * max(spread, 1e-9))


def _satellites(guesses: dict[str, Guess]) -> dict[str, Guess]:
    """Return the guesses with the course as a mapping has it, or without it."""
    found = dict(guesses)
    north, east = found.pop("north", None), found.pop("east", None)
    course, speed = found.get(COURSE), found.get(SPEED)
    if north and east and north.unit == east.unit:
        found[COURSE] = replace(north, signal=COURSE, component="north")
        found[SPEED] = replace(east, signal=SPEED, component="east")
    elif course and speed:
        told = "clockwise from north, as receivers tell it"
        found[COURSE] = course.because(told, clockwise_from_north=True)
    if "yaw_rate" not in found or not {COURSE, SPEED} <= set(found):
        found.pop(COURSE, None)
        alone = found.pop(SPEED, None)
        if alone and not alone.component:
            found.setdefault("vehicle_speed", replace(alone, signal="vehicle_speed"))
    return found


def _with_sign(guess: Guess, profiles: tuple[Profile, ...]) -> Guess:
    """Return a magnitude with the column of its sign, where another is called so."""
    if guess.signal not in TURNING or guess.profile.range[0] < 0:
        return guess
    own = sorted(parts_of(split_unit(guess.profile.channel.name)[0]))
    for other in profiles:
        parts = parts_of(split_unit(other.channel.name)[0])
        if sorted(p for p in parts if p not in _SIGN_WORDS) != own or len(parts) == len(own):
            continue
        values = sorted({float(v) for v in np.unique(other.values[np.isfinite(other.values)])[:3]})
        if len(values) == 2 and all(value.is_integer() for value in values):
            negative = int(values[0] if values[0] < 0 else values[1])
            told = f"{other.channel.name!r} is called its sign, and it is never negative"
            return guess.because(told, sign=(other.channel.name, negative))
    return guess


def headings(profiles: tuple[Profile, ...], taken: set[str]) -> list[str]:
    """Return the channels that are a heading or a course, whichever."""
    never = set(vocabulary()["never"]["course"])
    return [
        p.channel.name
        for p in profiles
        if p.is_number
        and p.channel.name not in taken
        and fits_any(vocabulary()["headings"]["words"], p.channel.name)
        and not never & set(parts_of(p.channel.name))
    ]


def guess_unnamed_wheels(profiles: tuple[Profile, ...], taken: set[str]) -> list[Guess]:
    """Return four channels that are called wheels without a place, in the file's order, or none."""
    found = [
        p
        for p in profiles
        if p.is_number
        and p.channel.name not in taken
        and {"wheel", "whl"} & {part[:5] for part in parts_of(p.channel.name)}
    ]
    guesses = [_guess(f"wheel_{c}", p, "wheel") for c, p in zip(CORNERS, found, strict=False)]
    return [g for g in guesses if g] if len(found) == 4 and all(guesses) else []


def told_unit(profile: Profile) -> tuple[str, str | None]:
    """Return the unit that a channel has, as the file says it, and as a mapping writes it."""
    name, in_brackets = split_unit(profile.channel.name)
    text = profile.channel.unit.strip() or in_brackets
    return text, unit_called(text) or unit_behind(name)


def _guess(signal: str, profile: Profile, words: str) -> Guess | None:
    """Return a guess with a unit that the signal can have, or None."""
    si_unit = "m/s" if signal in {"north", "east"} else catalogue()[signal].unit
    named = f"its name has {words!r}"
    text, told = told_unit(profile)
    largest = float(np.nanquantile(np.abs(profile.values), 0.999))
    for unit, radius_m in ((told, None), (told, RADIUS_M)):
        measures = si_unit if radius_m is None else "m/s"
        if unit is None or (radius_m is not None and not signal.startswith("wheel_")):
            continue
        try:
            factor = conversion_factor(unit, measures) / (radius_m or 1.0)
        except ValueError:
            continue
        guess = Guess(signal, profile, unit, (named, f"its unit is {unit}"), radius_m)
        return _within_range(guess, largest * factor)
    if told is not None:
        return None
    unit, radius_m = _unit_of_values(si_unit, signal, largest)
    unknown = f" that is known: {text!r}" if text else ""
    reason = f"{NO_UNIT}{unknown}; values up to {largest:.3g} look like {unit}"
    guess = Guess(signal, profile, unit, (named, reason), radius_m)
    factor = conversion_factor(unit, si_unit if radius_m is None else "m/s") / (radius_m or 1.0)
    return _within_range(guess, largest * factor)


def _within_range(guess: Guess, largest: float) -> Guess:
    """Return a guess, with a doubt if its values are beyond what the catalogue can hold."""
    if guess.signal not in catalogue().signals:
        return guess
    signal = catalogue()[guess.signal]
    most = float(max(-signal.min, signal.max))
    if largest <= most or signal.cyclic:
        return guess
    return guess.doubted(
        f"in {guess.unit} it would be up to {largest:.3g} {signal.unit}, and the catalogue has "
        f"{most:g}"
    )


def _unit_of_values(si_unit: str, signal: str, largest: float) -> tuple[str, float | None]:
    """Return the unit that values of a car on a road are likely to have."""
    if signal.startswith("wheel_"):
        if largest > 300:
            return "rpm", None
        return ("rad/s", None) if largest > 110 else ("km/h", RADIUS_M)
    if signal == "gear":
        return "1", None
    likely = {
        "m/s^2": (1.3, "g", "m/s^2"),
        "rad/s": (2.5, "rad/s", "deg/s"),
        "rad": ({"steering_wheel": 14.0, COURSE: 6.3}.get(signal, 0.9), "rad", "deg"),
        "m/s": (70.0, "m/s", "km/h"),
        "Pa": (400.0, "bar", "kPa"),
        "1": (1.2, "1", "%"),
    }
    limit, small, large = likely[si_unit]
    return (small if largest < limit else large), None


# Guesses where the times of a log are, and which columns tell its cars and trips apart.

_UNITS = {"s": "s", "sec": "s", "ms": "ms", "us": "us", "µs": "us", "ns": "ns"}
_STEPS = ((0.5, "s"), (500.0, "ms"), (500_000.0, "us"), (np.inf, "ns"))
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_EPOCH_S = (6e8, 4e9)
"""Times between 1989 and 2096 are counted from 1970."""
_MOST_CARS = 1000
_LEAST_RISING = 0.95


@dataclass(frozen=True)
class TimeGuess:
    """Where time is from."""

    keys: dict[str, Any]
    reason: str
    rate_hz: float | None
    day: date | None = None
    """What times tell of it; None if they tell nothing, or each drive's own."""


def guess_cars(profiles: Iterable[Profile]) -> tuple[dict[str, dict[str, str]], NDArray[np.int64]]:
    """Return the columns of cars and trips by key of `[drive]`, and a number for each row's."""
    found: dict[str, dict[str, str]] = {}
    group = np.zeros(0, dtype=np.int64)
    for key, words in vocabulary()["cars"].items():
        for one in profiles:
            if not one.keys.size or not is_called(words, one.channel.name):
                continue
            if np.unique(one.keys).size > min(_MOST_CARS, max(one.keys.size // 20, 1)):
                continue
            found[key] = {"drive" if key == "column" else "column": one.channel.name}
            if not group.size or group.size == one.keys.size:
                group = one.keys + (one.keys.max() + 1) * (group if group.size else 0)
            break
    return found, group


def guess_time(
    profile: FileProfile, taken: set[str], bases: list[str], group: NDArray[np.int64]
) -> TimeGuess:
    """Return where time is from; of several cars in turns, that of the first is looked at."""
    if profile.has_clock:
        return TimeGuess({"own_clock": True}, "the file says when each sample was taken", None)
    found = []
    for one in profile.profiles:
        values = one.values[group == group[0]] if group.size == one.values.size > 0 else one.values
        named = _is_named(one) or one.time_format is not None
        if not named or one.channel.name in taken or one.channel.base not in bases:
            continue
        rising, distinct = _rising(values)
        if rising >= _LEAST_RISING:
            found.append((distinct, one, values))
    if found:
        _, one, values = max(found, key=lambda some: round(some[0], 2))
        is_text = one.time_format is not None
        guess = _timestamps(one, values) if is_text else _numbers(one, values)
        written = guess.keys.get("format")
        if written and reads_clock(written):
            beside = (other for other in profile.profiles if other.channel.name not in taken)
            return _with_date(guess, beside)
        return guess
    keys = {"rate_hz": 100, "assumed": True}
    reason = "no channel looks like a time: 100 Hz is a mere assumption. Find out, correct it"
    return TimeGuess(keys, f"{reason}, and remove assumed", 100.0)


def _with_date(guess: TimeGuess, profiles: Iterable[Profile]) -> TimeGuess:
    """Return a time of the day with the column of dates beside it, if there is one."""
    words = set(vocabulary()["time"]["date_words"])
    for one in profiles:
        if words.isdisjoint(parts_of(one.channel.name)) or one.channel.name == guess.keys["column"]:
            continue
        numbers = one.values[np.isfinite(one.values)]
        texts = one.texts or tuple(f"{number:06.0f}" for number in np.unique(numbers)[:3])
        fits = [written for written in vocabulary()["time"]["dates"] if _are_dates(texts, written)]
        if not fits or (one.time_format and "%d" in one.time_format):
            continue
        dates = {"column": one.channel.name, "format": fits[0]}
        reason = f"{guess.reason}, and {one.channel.name} the date"
        if len(fits) > 1:
            reason += f"; if the month comes first, write {fits[1]}"
        return replace(guess, keys={**guess.keys, "date": dates}, reason=reason)
    return guess


def _are_dates(texts: tuple[str, ...], written: str) -> bool:
    """Whether texts are dates of this century, or of the end of the last."""
    days = pl.Series(texts, dtype=pl.String).str.to_date(written, strict=False)
    return bool(texts) and all(day and date(1990, 1, 1) <= day < date(2100, 1, 1) for day in days)


def _is_named(one: Profile) -> bool:
    name, _ = split_unit(one.channel.name)
    return one.is_number and bool(set(vocabulary()["time"]["words"]) & set(parts_of(name)))


def _rising(values: FloatArray) -> tuple[float, float]:
    """Return which part of the steps does not go back, and which part goes on."""
    steps = np.diff(values[np.isfinite(values)])
    if not steps.size:
        return 0.0, 0.0
    return float((steps >= 0).mean()), float((steps > 0).mean())


def _timestamps(one: Profile, values: FloatArray) -> TimeGuess:
    rate_hz = sample_rate_hz(values[np.isfinite(values)])
    keys: dict[str, Any] = {"column": one.channel.name}
    if one.time_format:
        keys["format"] = one.time_format
    keys |= _gaps(rate_hz)
    reason = "it has timestamps"
    if not one.time_format or "%z" not in one.time_format:
        reason += '; without a zone they are UTC, else write zone = "Europe/Berlin"'
    return TimeGuess(keys, reason, rate_hz)


def _numbers(one: Profile, values: FloatArray) -> TimeGuess:
    name, in_brackets = split_unit(one.channel.name)
    present = values[np.isfinite(values)]
    if _is_clock(present):
        seconds = present // 10000 * 3600 + present // 100 % 100 * 60 + present % 100
        rate_hz = sample_rate_hz(seconds)
        clock = {"column": one.channel.name, "format": "%H%M%S%.f", **_gaps(rate_hz)}
        return TimeGuess(clock, "it counts hours, minutes and seconds of the day", rate_hz)
    step = float(np.median(np.diff(present)))
    ends = parts_of(name)[-1]
    told = _UNITS.get((one.channel.unit or in_brackets).lower()) or _UNITS.get(ends)
    since_1970 = [u for u, s in _SECONDS.items() if _EPOCH_S[0] < present[0] * s < _EPOCH_S[1]]
    unit = told or (since_1970[0] if since_1970 else _unit_of_step(step))
    reason = f"its name, it goes on in steps of {step:g}" + (
        f", its unit is {told}" if told else ""
    )
    rate_hz = sample_rate_hz(present * _SECONDS[unit])
    keys: dict[str, Any] = {"column": one.channel.name, "unit": unit}
    if unit in since_1970:
        keys["epoch"] = True
        day = datetime.fromtimestamp(float(present[0]) * _SECONDS[unit], UTC).date()
        reason += f", counted from 1970: it begins on {day.isoformat()}"
    return TimeGuess(keys | _gaps(rate_hz), reason, rate_hz)


def _is_clock(values: FloatArray) -> bool:
    """Whether numbers are a time of the day without colons: after 59.99 comes 100, not 60."""
    inside = (values >= 0) & (values < 240_000) & (values % 100 < 60) & (values // 100 % 100 < 60)
    steps = np.diff(values)
    rolls = ((steps > 40) & (steps <= 41)) | (steps < -235_900)  # a minute, midnight
    return bool(inside.all() and rolls.any() and np.median(steps) < 1)


def _unit_of_step(step: float) -> str:
    return next(name for limit, name in _STEPS if step < limit)


def _gaps(rate_hz: float | None) -> dict[str, float]:
    """Return the gaps that a slow log needs."""
    if rate_hz is None or rate_hz >= 20:
        return {}
    return {"longest_gap_s": round(2 / rate_hz, 2), "split_gap_s": max(1.0, round(4 / rate_hz))}


# Chooses the units that a file does not say, those of all signals together, by how a car moves.
#
# The relations are products: the lateral acceleration is yaw rate times speed, so a wrong unit
# shows as a factor of 3.6, 9.8 or 57, and which signals share it tells whose it is.

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
