"""Guesses the signal of each channel by its name, unit and values.

Every guess has reasons as texts, for a person to check. A guess with doubts becomes a question.
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime
from typing import Any, TypeAlias

import numpy as np
import polars as pl
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray
from fleet_slip.catalog.course import COURSE, SATELLITE_SPEED
from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.ingest.columns import (
    CHOOSE,
    VELOCITY,
    conversion_factor,
    measures,
    reads_clock,
)
from fleet_slip.ingest.profile import FileProfile, Profile, sample_rate_hz
from fleet_slip.ingest.vocabulary import (
    best_words,
    fits_any,
    is_called,
    parts_of,
    split_unit,
    unit_behind,
    unit_called,
    vocabulary,
)
from fleet_slip.quality.drive_signals import RADIUS_M, SIGNED, WHEELS

_WEAK = 0.5
"""Weight of an ambiguous word; that of an unambiguous one is 1."""
_UNIT_FITS = 4.0
_SIGN_WORDS = {"vz", "vorzeichen", "sign", "signum", "sgn"}

Keys: TypeAlias = Mapping[str, Any]
"""Keys of a signal in a mapping."""


@dataclass(frozen=True)
class Guess:
    """A channel that may be a signal.

    Attributes
    ----------
    keys
        Keys of the signal in a mapping, without the column: unit, negate, sign …
    reasons
        Reasons for the guess, as texts.
    doubts
        Reasons against the guess.
    rivals
        Guesses of other channels that fit the signal equally well.
    readings
        The possible units, if the file has none.
    """

    signal: str
    profile: Profile
    keys: Mapping[str, Any]
    reasons: tuple[str, ...]
    doubts: tuple[str, ...] = ()
    rivals: tuple["Guess", ...] = ()
    readings: tuple[Keys, ...] = ()

    @property
    def column(self) -> str:
        """Name of the channel."""
        return self.profile.channel.name

    @property
    def entry(self) -> dict[str, Any]:
        """The entry of the signal in a mapping, without keys at their default."""
        column = {} if "north" in self.keys else {"column": self.column}
        rate_hz, entry = self.profile.rate_hz, {**column, **self.keys}
        if rate_hz and rate_hz < 20 and self.signal not in {COURSE, SATELLITE_SPEED}:
            entry["longest_gap_s"] = round(2 / rate_hz, 2)
        return entry

    @property
    def is_doubtful(self) -> bool:
        """True if the guess has doubts or rivals."""
        return bool(self.doubts or self.rivals)

    @property
    def explanation(self) -> str:
        """The reasons or doubts."""
        if self.is_doubtful:
            doubts = "; ".join(self.doubts) or "its name and unit fit several columns"
            return f"Doubtful: {self.signal}: {doubts}"
        return f"{self.signal}: {'; '.join(self.reasons)}"

    @property
    def choices(self) -> str:
        """The units that are possible, as a person writes them."""
        units = [f'"{keys["unit"]}"' for keys in self.readings]
        if "radius_m" in self.readings[0]:  # a wheel speed in km/h or m/s
            units[0] += f" with radius_m = {RADIUS_M}"
        return " or ".join(units)

    def answered(self, unit: str | None) -> "Guess":
        """Return the guess with a unit that a person chose."""
        if not unit:
            return self
        keys = next((keys for keys in self.readings if keys["unit"] == unit), {"unit": unit})
        return replace(self, keys={**self.keys, **keys}, readings=())

    def because(self, reason: str, **keys: Any) -> "Guess":
        """Return the guess with more keys, and one more reason."""
        return replace(self, keys={**self.keys, **keys}, reasons=(*self.reasons, reason))

    def doubted(self, doubt: str) -> "Guess":
        """Return the guess with one more doubt."""
        return replace(self, doubts=(*self.doubts, doubt))


def guess_signals(catalog: SignalCatalog, profiles: tuple[Profile, ...]) -> dict[str, Guess]:
    """Return the best guess for each signal. A channel is assigned to one signal at most."""
    scored = [pair for p in profiles if p.is_number for pair in _scored(catalog, p)]
    scored.sort(key=lambda pair: -pair[0])
    guesses: dict[str, Guess] = {}
    best: dict[str, float] = {}
    taken: set[str] = set()
    for score, guess in scored:
        signal, name = guess.signal, guess.column
        if name in taken:
            continue
        if signal not in guesses:
            guesses[signal], best[signal] = guess, score
            taken.add(name)
        elif score == best[signal]:
            first = guesses[signal]
            guesses[signal] = replace(first, rivals=(*first.rivals, guess))
    guesses = _satellites(guesses)
    signed = {name: _with_sign(guess, profiles) for name, guess in guesses.items()}
    return {name: signed[name] for name in catalog.signals if name in signed}


def _scored(catalog: SignalCatalog, profile: Profile) -> Iterator[tuple[float, Guess]]:
    """Yield the possible signals of a channel with their scores."""
    if not profile.channel.name.isprintable():
        return
    name = profile.channel.title or profile.channel.name
    for signal in vocabulary()["signals"]:
        score, words = best_words(signal, name)
        weak = not score
        if weak:
            score, words = best_words(signal, name, "weak")
            score *= _WEAK
        if not score or (guess := _guess(catalog, signal, profile, words)) is None:
            continue
        if weak and guess.readings:
            guess = guess.doubted("name and unit are ambiguous")
        yield score + (0.0 if guess.readings else _UNIT_FITS), guess


def _satellites(guesses: dict[str, Guess]) -> dict[str, Guess]:
    """Return the guesses with the course in the form of mappings; without one if incomplete."""
    result = dict(guesses)
    north, east = result.pop("north", None), result.pop("east", None)
    course, speed = result.get(COURSE), result.get(SATELLITE_SPEED)
    if north and east and north.keys == east.keys:
        keys = {"north": north.column, "east": east.column, **north.keys}
        result[COURSE] = replace(north, signal=COURSE, keys=keys)
        result[SATELLITE_SPEED] = replace(east, signal=SATELLITE_SPEED, keys=keys)
    elif course and speed:
        reason = "clockwise from north, as receivers give it"
        result[COURSE] = course.because(reason, clockwise_from_north=True)
    if "yaw_rate" not in result or not {COURSE, SATELLITE_SPEED} <= set(result):
        result.pop(COURSE, None)
        alone = result.pop(SATELLITE_SPEED, None)
        if alone and "north" not in alone.keys:
            result.setdefault("vehicle_speed", replace(alone, signal="vehicle_speed"))
    return result


def _with_sign(guess: Guess, profiles: tuple[Profile, ...]) -> Guess:
    """Return the guess of a magnitude with the column of its sign, if a channel is named so."""
    if guess.signal not in (*SIGNED, "sideslip") or guess.profile.range[0] < 0:
        return guess
    words_of_name = sorted(parts_of(split_unit(guess.column)[0]))
    for other in profiles:
        parts = parts_of(split_unit(other.channel.name)[0])
        if sorted(p for p in parts if p not in _SIGN_WORDS) != words_of_name or len(parts) == len(
            words_of_name
        ):
            continue
        values = sorted({float(v) for v in np.unique(other.values[np.isfinite(other.values)])[:3]})
        if len(values) == 2 and all(value.is_integer() for value in values):
            negative = int(values[0] if values[0] < 0 else values[1])
            reason = f"{other.channel.name!r} is called its sign, and it is never negative"
            return guess.because(reason, sign={"column": other.channel.name, "negative": negative})
    return guess


def headings(profiles: tuple[Profile, ...], taken: set[str]) -> list[tuple[str, str]]:
    """Return the channels that may be a heading or a course, and their units."""
    never = set(vocabulary()["never"]["course"])
    return [
        (p.channel.name, _unit_of(p) or CHOOSE)
        for p in profiles
        if p.is_number
        and p.channel.name not in taken
        and fits_any(vocabulary()["headings"]["words"], p.channel.name)
        and not never & set(parts_of(p.channel.name))
    ]


_VSS = re.compile(r"([^./]+/)?Vehicle(\.[A-Z]\w*)+$|([^./]+/)?Vehicle(_[A-Z][A-Za-z0-9]*){2,}$")
"""A path of COVESA's Vehicle Signal Specification, which defines units."""


def _unit_of(profile: Profile) -> str | None:
    """Return the unit from the file or the name of a column; None without a known unit."""
    name, in_brackets = split_unit(profile.channel.name)
    return unit_called(profile.channel.unit.strip() or in_brackets) or unit_behind(name)


def _guess(catalog: SignalCatalog, signal: str, profile: Profile, words: str) -> Guess | None:
    """Return a guess with a unit that the signal can have, or None."""
    largest = float(np.nanquantile(np.abs(profile.values), 0.999))  # but for outliers
    text = profile.channel.unit.strip() or split_unit(profile.channel.name)[1]
    unit = _unit_of(profile) or ("1" if signal == "gear" else None)
    if unit is None and _VSS.match(profile.channel.name):
        unit = vocabulary()["vss"].get("wheels" if signal in WHEELS else signal)
    how = "the format calls it" if profile.channel.title else "its name contains"
    named = f"{how} {words!r}"
    if unit is None:
        units = vocabulary()["choices"][_si_unit(catalog, signal)]
        several: tuple[Keys, ...] = tuple({"unit": unit} for unit in units)
        unknown = f" that is known: {text!r}" if text else ""
        reason = f"the file has no unit{unknown}; values up to {largest:.3g}"
        readings = _OF_WHEELS if signal in WHEELS else several
        return Guess(signal, profile, {"unit": CHOOSE}, (named, reason), readings=readings)
    radii = (None, RADIUS_M) if signal in WHEELS else (None,)
    fitting = [radius for radius in radii if measures(unit, _si_unit(catalog, signal, radius))]
    if not fitting:
        return None
    keys: Keys = {"unit": unit} | ({"radius_m": fitting[0]} if fitting[0] else {})
    guess = Guess(signal, profile, keys, (named, f"its unit is {unit}"))
    if signal not in catalog.signals or catalog[signal].cyclic:
        return guess
    factor = conversion_factor(unit, _si_unit(catalog, signal, fitting[0])) / (fitting[0] or 1.0)
    entry, in_si = catalog[signal], largest * factor
    limit = float(max(-entry.min, entry.max))
    if in_si <= limit:
        return guess
    return guess.doubted(
        f"in {unit} it would reach {in_si:.3g} {entry.unit}; the limit of the catalog is {limit:g}"
    )


def _si_unit(catalog: SignalCatalog, signal: str, radius_m: float | None = None) -> str:
    return VELOCITY if signal in {"north", "east"} or radius_m else catalog[signal].unit


# Units that the file does not contain: a person chooses among those of other files.

_OF_WHEELS: tuple[Keys, ...] = (
    {"unit": "km/h", "radius_m": RADIUS_M},
    {"unit": "m/s", "radius_m": RADIUS_M},
    {"unit": "rad/s"},
    {"unit": "rpm"},
)


# Guesses where the times of a log are, and which columns identify its cars and trips.

_STEPS = ((0.5, "s"), (500.0, "ms"), (500_000.0, "us"), (np.inf, "ns"))
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_EPOCH_S = (6e8, 4e9)
"""Times between 1989 and 2096 are counted from 1970."""
_MAX_CARS = 1000
_MIN_RISING_SHARE = 0.95


@dataclass(frozen=True)
class TimeGuess:
    """Source of the time."""

    keys: dict[str, Any]
    reason: str
    rate_hz: float | None


def guess_cars(profiles: Iterable[Profile]) -> tuple[dict[str, dict[str, str]], NDArray[np.int64]]:
    """Return the columns of cars and trips by key of `[drive]`, and a group number for each row."""
    keys: dict[str, dict[str, str]] = {}
    group = np.zeros(0, dtype=np.int64)
    for key, words in vocabulary()["cars"].items():
        for profile in profiles:
            if not profile.keys.size or not is_called(words, profile.channel.name):
                continue
            if np.unique(profile.keys).size > min(_MAX_CARS, max(profile.keys.size // 20, 1)):
                continue
            keys[key] = {"drive" if key == "column" else "column": profile.channel.name}
            if not group.size or group.size == profile.keys.size:
                group = profile.keys + (profile.keys.max() + 1) * (group if group.size else 0)
            break
    return keys, group


def guess_time(
    profile: FileProfile, taken: set[str], bases: list[str], group: NDArray[np.int64]
) -> TimeGuess:
    """Return the source of time; if rows of cars alternate, only the first car is examined."""
    if profile.has_clock:
        return TimeGuess({"own_clock": True}, "the file says when each sample was taken", None)
    candidates = [
        (float((np.diff(values) > 0).mean()), candidate, values)
        for candidate, values in _time_candidates(profile, taken, group)
        if candidate.channel.base in bases
    ]
    if candidates:
        _, candidate, values = max(candidates, key=lambda item: round(item[0], 2))  # the first best
        is_text = candidate.time_format is not None
        guess = _timestamps(candidate, values) if is_text else _numbers(candidate, values)
        written = guess.keys.get("format")
        if written and reads_clock(written):
            beside = (other for other in profile.profiles if other.channel.name not in taken)
            return _with_date(guess, beside)
        return guess
    keys = {"rate_hz": 100, "assumed": True}
    reason = "no channel looks like a time: 100 Hz is assumed. Correct it, and remove assumed"
    return TimeGuess(keys, reason, 100.0)


def _time_candidates(
    profile: FileProfile, taken: set[str], group: NDArray[np.int64]
) -> Iterator[tuple[Profile, FloatArray]]:
    """Yield the columns that are called times and increase, with their values."""
    time_words = set(vocabulary()["time"]["words"])
    for candidate in profile.profiles:
        values = candidate.values
        if group.size == values.size > 0:
            values = values[group == group[0]]
        name = candidate.channel.title or candidate.channel.name
        words = parts_of(split_unit(name)[0]) if candidate.is_number else ()
        named = candidate.time_format is not None or not time_words.isdisjoint(words)
        if not named or candidate.channel.name in taken:
            continue
        values = values[np.isfinite(values)]
        steps = np.diff(values)
        if steps.size and (steps >= 0).mean() >= _MIN_RISING_SHARE:
            yield candidate, values


def guess_rasters(
    profile: FileProfile, time: TimeGuess, guesses: Mapping[str, Guess], group: NDArray[np.int64]
) -> dict[str, str]:
    """Return the column of times of each column whose times are not the file's.

    In a text file it is the last column of times before the column, in other formats one with as
    many rows. A second clock of the same rows does not count.
    """
    if profile.has_clock or "column" not in time.keys:
        return {}
    taken = {guess.column for guess in guesses.values()}
    candidates = {
        candidate.channel.name: (candidate, values)
        for candidate, values in _time_candidates(profile, taken, group)
    }
    main, main_values = candidates.get(time.keys["column"], (None, np.zeros(0)))
    if main is None:
        return {}
    clocks = {
        name: candidate
        for name, (candidate, values) in candidates.items()
        if name == main.channel.name
        or candidate.channel.base != main.channel.base
        or _is_raster(values, main_values)
    }
    rasters, current = dict[str, str](), main.channel.name
    for column in profile.profiles:
        if column.channel.name in clocks:
            current = column.channel.name
        same_base = [n for n, c in clocks.items() if c.channel.base == column.channel.base]
        raster = current if current in same_base else next(iter(same_base), main.channel.name)
        if column.channel.name in taken and raster != main.channel.name:
            rasters[column.channel.name] = raster
    return rasters


def _is_raster(values: FloatArray, main: FloatArray) -> bool:
    """Return True if times belong to other samples: their number differs, or they are shifted."""
    step, main_step = np.median(np.diff(values)), np.median(np.diff(main))
    if values.size != main.size:
        return bool(step <= 1e4 * main_step)
    shift = np.abs(values - main)
    return bool(abs(step / main_step - 1) < 0.01 and 0 < shift.max() < 2 * main_step)


def _with_date(guess: TimeGuess, profiles: Iterable[Profile]) -> TimeGuess:
    """Return a time of the day with its column of dates, if there is one."""
    words = set(vocabulary()["time"]["date_words"])
    for profile in profiles:
        if (
            words.isdisjoint(parts_of(profile.channel.name))
            or profile.channel.name == guess.keys["column"]
        ):
            continue
        numbers = profile.values[np.isfinite(profile.values)]
        texts = profile.texts or tuple(f"{number:06.0f}" for number in np.unique(numbers)[:3])
        fits = [written for written in vocabulary()["time"]["dates"] if _are_dates(texts, written)]
        if not fits or (profile.time_format and "%d" in profile.time_format):
            continue
        dates = {"column": profile.channel.name, "format": fits[0]}
        reason = f"{guess.reason}, and {profile.channel.name} the date"
        if len(fits) > 1:
            reason += f"; if the month comes first, write {fits[1]}"
        return replace(guess, keys={**guess.keys, "date": dates}, reason=reason)
    return guess


def _are_dates(texts: tuple[str, ...], written: str) -> bool:
    """Return True if texts are dates of this century, or of the end of the last."""
    days = pl.Series(texts, dtype=pl.String).str.to_date(written, strict=False)
    return bool(texts) and all(day and date(1990, 1, 1) <= day < date(2100, 1, 1) for day in days)


def _timestamps(profile: Profile, values: FloatArray) -> TimeGuess:
    rate_hz = sample_rate_hz(values)
    keys: dict[str, Any] = {"column": profile.channel.name}
    if profile.time_format:
        keys["format"] = profile.time_format
    keys |= _gaps(rate_hz)
    reason = "it has timestamps"
    if not profile.time_format or "%z" not in profile.time_format:
        reason += '; without a zone they are UTC, else write zone = "Europe/Berlin"'
    return TimeGuess(keys, reason, rate_hz)


def _numbers(profile: Profile, present: FloatArray) -> TimeGuess:
    name, in_brackets = split_unit(profile.channel.name)
    if _is_clock(present):
        seconds = present // 10000 * 3600 + present // 100 % 100 * 60 + present % 100
        rate_hz = sample_rate_hz(seconds)
        clock = {"column": profile.channel.name, "format": "%H%M%S%.f", **_gaps(rate_hz)}
        return TimeGuess(clock, "its digits are hours, minutes and seconds of the day", rate_hz)
    step = float(np.median(np.diff(present)))
    ends = parts_of(name)[-1]
    units = vocabulary()["time"]["units"]
    named = units.get((profile.channel.unit or in_brackets).lower()) or units.get(ends)
    since_1970 = [u for u, s in _SECONDS.items() if _EPOCH_S[0] < present[0] * s < _EPOCH_S[1]]
    likely = [*since_1970, *(name for limit, name in _STEPS if step < limit)]
    unit = named or likely[0]
    reason = f"its name; it increases in steps of {step:g}"
    reason += f"; its unit is {named}" if named else ""
    rate_hz = sample_rate_hz(present * _SECONDS[unit])
    keys: dict[str, Any] = {"column": profile.channel.name, "unit": unit}
    if unit in since_1970:
        keys["epoch"] = True
        day = datetime.fromtimestamp(float(present[0]) * _SECONDS[unit], UTC).date()
        reason += f"; counted from 1970, it begins on {day.isoformat()}"
    return TimeGuess(keys | _gaps(rate_hz), reason, rate_hz)


def _is_clock(values: FloatArray) -> bool:
    """Return True if numbers are a time of day without colons: 100, not 60, follows 59.99."""
    inside = (values >= 0) & (values < 240_000) & (values % 100 < 60) & (values // 100 % 100 < 60)
    steps = np.diff(values)
    rolls = ((steps > 40) & (steps <= 41)) | (steps < -235_900)  # a minute, midnight
    return bool(inside.all() and rolls.any() and np.median(steps) < 1)


def _gaps(rate_hz: float | None) -> dict[str, float]:
    """Return the gaps that a slow log needs."""
    if rate_hz is None or rate_hz >= 20:
        return {}
    return {"longest_gap_s": round(2 / rate_hz, 2), "split_gap_s": max(1.0, round(4 / rate_hz))}
