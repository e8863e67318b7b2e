"""Guesses where the times of a log are, and which columns tell its cars and trips apart."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray
from fleet_slip.ingest.drafting.profile import FileProfile, Profile, sample_rate_hz
from fleet_slip.ingest.mapping.time_base import reads_clock
from fleet_slip.ingest.mapping.vocabulary import is_called, parts_of, split_unit, vocabulary

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
