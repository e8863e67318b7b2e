"""Drafts a mapping for a file: guesses by name, unit and values, corrected by how the car moves.

The draft is read as any mapping is, and what looks wrong in the drives that come out is put right
where there is one way to do so: a sign, or left for right. The rest is left to a person.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import FleetSlipError, InputError
from fleet_slip.ingest.drafting.guessing import (
    Guess,
    guess_signals,
    guess_unnamed_wheels,
    headings,
)
from fleet_slip.ingest.drafting.preview import preview_log
from fleet_slip.ingest.drafting.profile import FileProfile
from fleet_slip.ingest.drafting.times_and_cars import TimeGuess, guess_cars, guess_time
from fleet_slip.ingest.drafting.unit_choice import choose_units, steering_ratio
from fleet_slip.ingest.drives.suspicion import WHEELS, Suspicion, find_suspicions
from fleet_slip.ingest.mapping.mapping import Mapping
from fleet_slip.ingest.mapping.signal_column import COURSE, SPEED
from fleet_slip.ingest.mapping.vocabulary import parts_of
from fleet_slip.words import shown

_STAND_IN: dict[str, Any] = {"vehicle_id": "car", "vehicle_model": "car", "day": date(2000, 1, 1)}


@dataclass(frozen=True)
class Draft:
    """A draft of a mapping."""

    file: Path
    profile: FileProfile
    time: TimeGuess
    guesses: dict[str, Guess]
    """Those that nothing speaks against."""
    questions: dict[str, Guess]
    """Those with doubts, or with rivals."""
    drive: dict[str, dict[str, str]]
    """The columns that tell cars and trips apart, by key of `[drive]`."""
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
    drive_keys, group = guess_cars(profile.profiles)
    bases = [guess.profile.channel.base for guess in guesses.values()]
    taken = {guess.profile.channel.name for guess in guesses.values()}
    time = guess_time(profile, taken, bases, group)
    tried = _Tried(file, profile, time, drive_keys)
    failures: tuple[str, ...] = ()
    suspicions: list[Suspicion] = []
    try:
        if unnamed and set(WHEELS) <= set(guesses):
            guesses |= _place_wheels(guesses, tried.drive(guesses))
        guesses = choose_units(guesses, tried.drive(guesses))
        drive = tried.drive(guesses)
        guesses = _road_wheels(guesses, drive)
        corrected = _correct(guesses, find_suspicions(drive))
        guesses = corrected
        suspicions = find_suspicions(tried.drive(guesses))
    except FleetSlipError as error:
        failures = (str(error),)
    guesses = _doubted(guesses, suspicions)
    asked_for = {name for name, guess in guesses.items() if guess.doubts or guess.rivals}
    if COURSE in guesses and asked_for & {COURSE, SPEED, "yaw_rate"}:
        asked_for |= {COURSE, SPEED}  # which stand together
    sure = {name: guess for name, guess in guesses.items() if name not in asked_for}
    left = {name: guess for name, guess in guesses.items() if name in asked_for}
    asked = () if COURSE in guesses else _ask_of_headings(profile, guesses)
    notes = (*failures, *map(str, suspicions), *asked, *_notes(profile, guesses))
    return Draft(file, profile, time, sure, left, drive_keys, notes)


@dataclass(frozen=True)
class _Tried:
    """What a draft makes of its file."""

    file: Path
    profile: FileProfile
    time: TimeGuess
    drive_keys: dict[str, dict[str, str]]

    def drive(self, guesses: dict[str, Guess]) -> dict[str, FloatArray]:
        """Return the signals of the longest drive, of all guesses that the catalogue can hold."""
        usable = {name: guess for name, guess in guesses.items() if not guess.doubts}
        if COURSE in usable and not {SPEED, "yaw_rate"} <= set(usable):
            usable.pop(COURSE)
        if not usable:
            return {}
        mapping = as_mapping(self.profile, self.time, usable, self.drive_keys)
        return preview_log(self.file, mapping).longest


def _road_wheels(guesses: dict[str, Guess], drive: dict[str, FloatArray]) -> dict[str, Guess]:
    """Return an angle called that of steering as the road wheels', where the car turns so."""
    guess = guesses.get("steering_wheel")
    ratio = steering_ratio(drive, "steering_wheel")
    if guess is None or ratio is None or not 0.3 < ratio < 4:
        return guesses
    figure = f"it is {ratio:.1f} times the angle of the road wheels in bends, not 12 to 20 times"
    named = {"wheel", "whl", "rad", "lenkrad"} & set(parts_of(guess.profile.channel.name))
    if "steer" in guesses or named:
        return {**guesses, "steering_wheel": guess.doubted(figure)}
    others = {name: one for name, one in guesses.items() if name != "steering_wheel"}
    return {**others, "steer": replace(guess.because(figure), signal="steer")}


def _doubted(guesses: dict[str, Guess], suspicions: list[Suspicion]) -> dict[str, Guess]:
    """Return the guesses with what the car's motion has against them.

    Of several signals that contradict one another, those are doubted of which the file does not
    say the unit, if there are some. A weak name without a unit needs something that agrees.
    """
    found = dict(guesses)
    for one in suspicions:
        if one.kind in {"late", "absent"}:
            continue
        concerned = [name for name in one.signals if name in found]
        if one.kind == "stuck":  # a gear, a pedal and a brake may well be
            concerned = [n for n in concerned if catalogue()[n].unit not in {"1", "Pa"}]
        weak = [n for n in concerned if found[n].is_without_unit or found[n].is_weak]
        for name in weak or concerned:
            found[name] = found[name].doubted(one.figure)
    agreeing = {"yaw_rate", "ay", "steering_wheel"} & set(guesses)
    for name, guess in guesses.items():
        if guess.is_weak and guess.is_without_unit and len(agreeing - {name}) < 1:
            found[name] = found[name].doubted("its name may mean something else, and so its unit")
    return found


def _notes(profile: FileProfile, guesses: dict[str, Guess]) -> Iterator[str]:
    """Yield what a person is to know of values that mean none, and of a label that is not there."""
    for name, number in profile.absent.doubtful:
        yield (
            f"{shown(name)}: {number:g} looks like no value, but is one in another column: leave "
            f"such rows out with where = '\"{name}\" != {number:g}'."
        )
    if {"vx", "vy"} <= set(guesses) and "sideslip" not in guesses:
        yield (
            "there is no side-slip angle, and vx and vy tell it if they are a sensor's: [label] "
            "from_velocities = true, sensor_x_m = ... before the centre of gravity."
        )
    elif "sideslip" in guesses:
        yield (
            "sideslip: where is its sensor? If not at the centre of gravity: [label] sensor_x_m = "
            "... before it, sensor_y_m = ... to its left."
        )


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


def as_mapping(
    profile: FileProfile,
    time: TimeGuess,
    guesses: dict[str, Guess],
    drive_keys: dict[str, dict[str, str]],
) -> Mapping:
    """Return a mapping of the guesses, with stand-ins for what nobody said of the drive."""
    signals = {name: signal_keys(guess) for name, guess in guesses.items()}
    if COURSE in signals:
        signals[COURSE] |= {"antenna_x_m": 0.0, "antenna_y_m": 0.0}
    formats = profile.formats
    given: dict[str, Any] = {"csv": formats.csv, "can": formats.can, "duckdb": formats.duckdb}
    drive = {**_STAND_IN, **{key: told.get("drive", told) for key, told in drive_keys.items()}}
    given |= {"missing": profile.absent.texts, "drive": drive}
    return Mapping.model_validate({"name": "draft", "time": time.keys, "signals": signals, **given})


def signal_keys(guess: Guess) -> dict[str, Any]:
    """Return the keys of a signal in a mapping, those that are not usual."""
    keys: dict[str, Any] = {"column": guess.profile.channel.name, "unit": guess.unit}
    if guess.radius_m is not None:
        keys["radius_m"] = guess.radius_m
    if guess.negate:
        keys["negate"] = True
    if guess.sign is not None:
        column, negative = guess.sign
        keys["sign"] = {"column": column, "negative": negative}
    if guess.component is not None:
        keys["component"] = guess.component
    if guess.clockwise_from_north is not None:
        keys["clockwise_from_north"] = guess.clockwise_from_north
    rate_hz = guess.profile.rate_hz
    if rate_hz is not None and rate_hz < 20 and guess.signal not in {COURSE, SPEED}:
        keys["longest_gap_s"] = round(2 / rate_hz, 2)
    return keys


def _correct(guesses: dict[str, Guess], suspicions: list[Suspicion]) -> dict[str, Guess]:
    """Return the guesses with signs turned and pairs swapped, each with its figure."""
    corrected = dict(guesses)
    for one in suspicions:
        if one.kind == "reversed":
            (name,) = one.signals
            if name not in corrected:
                continue
            if name == COURSE:
                corrected |= _turned_round(corrected, one.figure)
                continue
            turned = not corrected[name].negate
            corrected[name] = corrected[name].because(one.figure, negate=turned)
        elif one.kind == "swapped" and len(one.signals) == 2 and {*one.signals} <= {*corrected}:
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
