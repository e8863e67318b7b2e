"""Drafts a mapping for a file: guesses by name, unit and values, corrected by how the car moves.

The draft is read as any mapping is, and what looks wrong in the drives that come out is put right
where there is one way to do so: a sign, or left for right. The rest is left to a person.
"""

import json
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import FleetSlipError, InputError
from fleet_slip.ingest.drafting.guessing import (
    OTHER_UNITS,
    Guess,
    guess_signals,
    guess_unnamed_wheels,
    headings,
    parts_of,
)
from fleet_slip.ingest.drafting.preview import preview_log
from fleet_slip.ingest.drafting.profile import FileProfile, Profile, sample_rate_hz
from fleet_slip.ingest.drives.suspicion import (
    RADIUS_M,
    WHEELS,
    Suspicion,
    find_suspicions,
    speed_ratio,
)
from fleet_slip.ingest.mapping.mapping import Mapping
from fleet_slip.ingest.mapping.signal_column import COURSE, SPEED
from fleet_slip.words import shown

_TIME_NAMES = ("time", "timestamp", "zeit", "t", "sec", "seconds")
_TIME_UNITS = {"s": "s", "sec": "s", "ms": "ms", "us": "us", "µs": "us", "ns": "ns"}
_STEPS = ((0.5, "s"), (500.0, "ms"), (500_000.0, "us"), (np.inf, "ns"))
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_EPOCH_S = (6e8, 4e9)
"""Times between 1989 and 2096 are counted from 1970."""
_STAND_IN: dict[str, Any] = {"vehicle_id": "car", "vehicle_model": "car", "day": date(2000, 1, 1)}


@dataclass(frozen=True)
class TimeGuess:
    """Where time is from."""

    keys: dict[str, Any]
    reason: str
    rate_hz: float | None
    day: date | None = None
    """What times tell of it; None if they tell nothing."""


@dataclass(frozen=True)
class Draft:
    """A draft of a mapping."""

    file: Path
    profile: FileProfile
    time: TimeGuess
    guesses: dict[str, Guess]
    open_questions: tuple[str, ...]
    """What looks wrong in what it makes of the file, or why it makes nothing."""


def draft_mapping(file: Path, profile: FileProfile) -> Draft:
    """Guess a mapping. Raises `InputError` if nothing in the file looks like a signal."""
    guesses = guess_signals(profile.profiles)
    taken = {guess.profile.channel.name for guess in guesses.values()}
    unnamed = not set(WHEELS) & set(guesses)
    if unnamed:
        wheels = guess_unnamed_wheels(profile.profiles, taken)
        guesses |= {guess.signal: guess for guess in wheels}
    if not guesses:
        names = ", ".join(repr(p.channel.name) for p in profile.profiles[:30])
        raise InputError(
            f"{shown(file)}: none of its channels looks like a signal: {names}. Write the mapping "
            "by hand: docs/mapping.md."
        )
    time = _guess_time(profile, guesses)
    try:
        if unnamed and set(WHEELS) <= set(guesses):
            guesses |= _place_wheels(guesses, _drive(file, profile, time, guesses))
        guesses |= _other_wheels(guesses, _drive(file, profile, time, guesses))
        suspicions = find_suspicions(_drive(file, profile, time, guesses))
        for name in _doubtful_units(guesses, suspicions):
            other = _with_other_unit(guesses, name, suspicions)
            found = find_suspicions(_drive(file, profile, time, other))
            if len(found) < len(suspicions):
                guesses, suspicions = other, found
        corrected = _correct(guesses, suspicions)
        if corrected != guesses:
            guesses = corrected
            suspicions = find_suspicions(_drive(file, profile, time, guesses))
    except FleetSlipError as error:
        return Draft(file, profile, time, guesses, (str(error),))
    asked = () if COURSE in guesses else _ask_of_headings(profile, guesses)
    return Draft(file, profile, time, guesses, (*map(str, suspicions), *asked))


def _ask_of_headings(profile: FileProfile, guesses: dict[str, Guess]) -> tuple[str, ...]:
    """Return what only a person knows: whether a direction is the car's, or that of its way."""
    taken = {guess.profile.channel.name for guess in guesses.values()}
    return tuple(
        f"{shown(name)}: is it where the car points, or where it goes? If a satellite receiver "
        f"tells it from motion: course = {{ column = {json.dumps(name, ensure_ascii=False)}, "
        'unit = "deg", clockwise_from_north = true, antenna_x_m = ..., antenna_y_m = ... }, with '
        "satellite_speed beside it. A heading says nothing of side-slip."
        for name in headings(profile.profiles, taken)
    )


def as_mapping(profile: FileProfile, time: TimeGuess, guesses: dict[str, Guess]) -> Mapping:
    """Return a mapping of the guesses, with stand-ins for what nobody said of the drive."""
    signals = {name: signal_keys(guess) for name, guess in guesses.items()}
    if COURSE in signals:
        signals[COURSE] |= {"antenna_x_m": 0.0, "antenna_y_m": 0.0}
    formats = profile.formats
    given: dict[str, Any] = {"csv": formats.csv, "can": formats.can, "duckdb": formats.duckdb}
    return Mapping.model_validate(
        {"name": "draft", "time": time.keys, "drive": _STAND_IN, "signals": signals, **given}
    )


def signal_keys(guess: Guess) -> dict[str, Any]:
    """Return the keys of a signal in a mapping, those that are not usual."""
    keys: dict[str, Any] = {"column": guess.profile.channel.name, "unit": guess.unit}
    if guess.radius_m is not None:
        keys["radius_m"] = guess.radius_m
    if guess.negate:
        keys["negate"] = True
    if guess.component is not None:
        keys["component"] = guess.component
    if guess.clockwise_from_north is not None:
        keys["clockwise_from_north"] = guess.clockwise_from_north
    rate_hz = guess.profile.rate_hz
    if rate_hz is not None and rate_hz < 20 and guess.signal not in {COURSE, SPEED}:
        keys["longest_gap_s"] = round(2 / rate_hz, 2)
    return keys


def _drive(
    file: Path, profile: FileProfile, time: TimeGuess, guesses: dict[str, Guess]
) -> dict[str, FloatArray]:
    mapping = as_mapping(profile, time, guesses)
    return preview_log(file, mapping).longest


def _guess_time(profile: FileProfile, guesses: dict[str, Guess]) -> TimeGuess:
    if profile.has_clock:
        return TimeGuess({"own_clock": True}, "the file says when each sample was taken", None)
    taken = {guess.profile.channel.name for guess in guesses.values()}
    bases = [guess.profile.channel.base for guess in guesses.values()]
    for one in profile.profiles:
        channel = one.channel
        goes_on = one.values.size > 1 and bool((np.diff(one.values) >= 0).all())
        named = any(part in _TIME_NAMES for part in parts_of(channel.name))
        if goes_on and named and channel.name not in taken and channel.base in bases:
            return _time_of(one)
    keys = {"rate_hz": 100}
    return TimeGuess(keys, "no channel looks like a time: 100 Hz is a mere assumption", 100.0)


def _time_of(one: Profile) -> TimeGuess:
    step = float(np.median(np.diff(one.values)))
    ends = parts_of(one.channel.name)[-1]
    told = _TIME_UNITS.get(one.channel.unit.lower()) or _TIME_UNITS.get(ends)
    unit = told or next(name for limit, name in _STEPS if step < limit)
    reason = f"its name, it goes on in steps of {step:g}" + (
        f", its unit is {told}" if told else ""
    )
    start_s = float(one.values[0]) * _SECONDS[unit]
    rate_hz = sample_rate_hz(one.values * _SECONDS[unit])
    keys: dict[str, Any] = {"column": one.channel.name, "unit": unit}
    if rate_hz is not None and rate_hz < 20:
        keys |= {
            "longest_gap_s": round(2 / rate_hz, 2),
            "split_gap_s": max(1.0, round(4 / rate_hz)),
        }
    day = None
    if _EPOCH_S[0] < start_s < _EPOCH_S[1]:
        day = datetime.fromtimestamp(start_s, UTC).date()
    return TimeGuess(keys, reason, rate_hz, day)


def _doubtful_units(guesses: dict[str, Guess], suspicions: list[Suspicion]) -> list[str]:
    """Return the signals with a suspicious unit that the file does not tell."""
    doubtful = [name for one in suspicions if one.kind == "unit" for name in one.signals]
    able = (n for n in dict.fromkeys(doubtful) if n in guesses and guesses[n].is_without_unit)
    return [name for name in able if guesses[name].unit in OTHER_UNITS]


def _other_wheels(guesses: dict[str, Guess], drive: dict[str, FloatArray]) -> dict[str, Guess]:
    """Return wheel speeds without a unit as rad/s instead of km/h, or the other way round.

    They differ by an eighth, as tyres do: what is nearer to the lateral acceleration is taken.
    """
    wheels = [name for name in WHEELS if name in guesses and guesses[name].is_without_unit]
    ratio = speed_ratio(drive)
    if not wheels or ratio is None:
        return {}
    in_kmh = guesses[wheels[0]].radius_m is not None
    kmh_in_rad_s = 1 / (3.6 * RADIUS_M)
    if_other = ratio * (kmh_in_rad_s if in_kmh else 1 / kmh_in_rad_s)
    if abs(np.log(if_other)) >= abs(np.log(ratio)):
        return {}
    unit, radius_m = ("rad/s", None) if in_kmh else ("km/h", RADIUS_M)
    reason = f"ay is {ratio:.2f} times yaw rate times speed, with {unit} {if_other:.2f} times"
    return {n: guesses[n].because(reason, unit=unit, radius_m=radius_m) for n in wheels}


def _with_other_unit(
    guesses: dict[str, Guess], name: str, suspicions: list[Suspicion]
) -> dict[str, Guess]:
    guess = guesses[name]
    unit = OTHER_UNITS[guess.unit]
    figure = next(s.figure for s in suspicions if s.kind == "unit" and name in s.signals)
    changed = guess.because(f"as {guess.unit} {figure}, so it is {unit}", unit=unit)
    return {**guesses, name: changed}


def _correct(guesses: dict[str, Guess], suspicions: list[Suspicion]) -> dict[str, Guess]:
    """Return the guesses with signs turned and pairs swapped, each with its figure."""
    corrected = dict(guesses)
    for one in suspicions:
        if one.kind == "sign":
            (name,) = one.signals
            if name == COURSE:
                corrected |= _turned_round(corrected, one.figure)
                continue
            turned = not corrected[name].negate
            corrected[name] = corrected[name].because(one.figure, negate=turned)
        elif one.kind == "swapped" and len(one.signals) == 2:
            left, right = one.signals
            corrected[left], corrected[right] = (
                replace(corrected[right].because(one.figure), signal=left),
                replace(corrected[left].because(one.figure), signal=right),
            )
    return corrected


def _turned_round(guesses: dict[str, Guess], figure: str) -> dict[str, Guess]:
    """Return the course counterclockwise, or with north and east swapped."""
    course, speed = guesses[COURSE], guesses[SPEED]
    if not course.component:
        return {COURSE: course.because(figure, clockwise_from_north=False)}
    return {
        COURSE: replace(speed.because(figure), signal=COURSE, component="north"),
        SPEED: replace(course.because(figure), signal=SPEED, component="east"),
    }


def _place_wheels(guesses: dict[str, Guess], drive: dict[str, FloatArray]) -> dict[str, Guess]:
    """Return where four wheels are: in bends the outer and the front ones are faster."""
    if "yaw_rate" not in drive:
        return {}
    speeds = np.array([drive[name] for name in WHEELS])
    rows = np.isfinite(speeds).all(axis=0) & np.isfinite(drive["yaw_rate"]) & (speeds[0] > 5)
    if rows.sum() < 200:
        return {}
    relative = speeds[:, rows] / speeds[:, rows].mean(axis=0) - 1
    yaw_rate = drive["yaw_rate"][rows]
    outer = relative @ (yaw_rate - yaw_rate.mean())
    left, right = np.argsort(outer)[:2], np.argsort(outer)[2:]
    squared = yaw_rate**2 - np.mean(yaw_rate**2)
    placed = {}
    for side, pair in (("l", left), ("r", right)):
        rear, front = sorted(pair, key=lambda wheel: float(relative[wheel] @ squared))
        for axle, wheel in (("f", front), ("r", rear)):
            name = f"wheel_{axle}{side}"
            reason = "in bends it is the " + ("faster" if axle == "f" else "slower")
            reason += f" of the two on the {'left' if side == 'l' else 'right'}, as yaw rate tells"
            placed[name] = replace(guesses[WHEELS[wheel]].because(reason), signal=name)
    return placed
