"""Drafts a mapping for a file: guesses by name and unit, each with its reasons.

Doubtful guesses become questions, as comments. A person chooses units that the file does not
contain: until then the draft does not load. A dry run of the ingest checks signs and wheels.
"""

import json
import re
import shlex
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fleet_slip.base import quote_name
from fleet_slip.catalog.course import COURSE, SATELLITE_SPEED
from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.errors import InputError
from fleet_slip.ingest.columns import CHOOSE, WHEEL_PREFIX, TimeBase
from fleet_slip.ingest.guess import (
    Guess,
    TimeGuess,
    guess_cars,
    guess_rasters,
    guess_signals,
    guess_time,
    headings,
)
from fleet_slip.ingest.log_files import FileGroup
from fleet_slip.ingest.profile import FileProfile
from fleet_slip.quality.drive_signals import RADIUS_M

_MAX_REFUSED = 20


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
    """The columns that identify cars and trips, by key of `[drive]`."""
    absent: tuple[str, ...]
    """The signals that no channel looks like."""
    open_questions: tuple[str, ...]
    """Questions that only a person can answer, and parts of the file that were not read."""


def draft_mapping(signals: SignalCatalog, file: Path, profile: FileProfile) -> Draft:
    """Guess a mapping. Raises `InputError` if nothing in the file looks like a signal."""
    guesses = guess_signals(signals, profile.profiles)
    if not guesses:
        names = ", ".join(repr(p.channel.name) for p in profile.profiles[:30])
        raise InputError(
            f"{quote_name(file)}: none of its channels looks like a signal: {names}. Write the "
            "mapping "
            f"by hand: docs/mapping.md. {' '.join(_refused(profile))}".rstrip()
        )
    drive_keys, group = guess_cars(profile.profiles)
    bases = [guess.profile.channel.base for guess in guesses.values()]
    time = guess_time(profile, {guess.column for guess in guesses.values()}, bases, group)

    rasters = guess_rasters(profile, time, guesses, group)
    for name, guess in guesses.items():
        if raster := rasters.get(guess.column):
            guesses[name] = guess.because(f"its times are in {raster}", time=raster)
    asked_for = {name for name, guess in guesses.items() if guess.doubts or guess.rivals}
    if COURSE in guesses and asked_for & {COURSE, SATELLITE_SPEED, "yaw_rate"}:
        asked_for |= {COURSE, SATELLITE_SPEED}  # which stand together
    sure = {name: guess for name, guess in guesses.items() if name not in asked_for}
    doubtful = {name: guess for name, guess in guesses.items() if name in asked_for}
    notes = (*_notes(profile, guesses), *_refused(profile))
    absent = tuple(name for name in signals.signals if name not in guesses)
    return Draft(file, profile, time, sure, doubtful, drive_keys, absent, notes)


def _notes(profile: FileProfile, guesses: dict[str, Guess]) -> Iterator[str]:
    """Yield the questions on headings, missing values, and the label's sensor."""
    taken = {guess.column for guess in guesses.values()}
    for name, unit in headings(profile.profiles, taken) if COURSE not in guesses else ():
        yield (
            f"{quote_name(name)}: is it where the car points, or where it goes? If a satellite "
            "receiver "
            f"derives it from motion: course = {{ column = {_value(name)}, "
            f"unit = {_value(unit)}, clockwise_from_north = true, antenna_x_m = ..., "
            "antenna_y_m = ... }, "
            "with satellite_speed beside it. A heading contains no side-slip."
        )
    speeds = [guesses[name] for name in ("vehicle_speed", "vx") if name in guesses]
    if speeds and not any(name.startswith("wheel_") for name in guesses):
        keys = {"column": speeds[0].column, **speeds[0].keys, "radius_m": RADIUS_M}
        yield (
            "no wheel speeds: a speed of the car may replace all four, from which curvature "
            f"and yaw rate times speed follow: wheel_fl = {_value(keys)}, and wheel_fr, wheel_rl, "
            "wheel_rr alike. On a simulator it halved the error."
        )
    if {"vx", "vy"} <= set(guesses) and "sideslip" not in guesses:
        yield (
            "there is no side-slip angle. If vx and vy are a sensor's, they give it: [label] "
            "from_velocities = true, sensor_x_m = ... before the centre of gravity."
        )
    elif "sideslip" in guesses:
        yield (
            "sideslip: where is its sensor? If not at the centre of gravity: [label] sensor_x_m = "
            "... before it, sensor_y_m = ... to its left."
        )


def _refused(profile: FileProfile) -> Iterator[str]:
    """Yield the channels that could not be read, with reasons."""
    yield from (f"not read: {reason}" for reason in profile.refused[:_MAX_REFUSED])
    if len(profile.refused) > _MAX_REFUSED:
        yield f"not read: {len(profile.refused) - _MAX_REFUSED:,} channels more."


def signal_keys(guess: Guess) -> dict[str, Any]:
    """Return the keys of a signal in a mapping, those that are not usual."""
    keys = {"column": guess.column, **guess.keys}
    rate_hz = guess.profile.rate_hz
    if rate_hz is not None and rate_hz < 20 and guess.signal not in {COURSE, SATELLITE_SPEED}:
        keys["longest_gap_s"] = round(2 / rate_hz, 2)
    return keys


# Writes a draft of a mapping as TOML, each guess with its reasons as a comment.

_HEAD = """\
# A draft for {file}. Every line is a guess: check it, with
# fleet-slip ingest {file} --mapping THIS_FILE --dry-run
# docs/mapping.md explains the keys, docs/conventions.md the axes and signs.
"""


_COLUMNS = 80
"""Width of a terminal, which breaks longer lines, so that a copy is not valid TOML."""


def comment(text: str) -> list[str]:
    """Return a text as lines of a comment."""
    return textwrap.wrap(
        text, _COLUMNS - 1, initial_indent="# ", subsequent_indent="#   ", break_on_hyphens=False
    )


def name_of(stem: str) -> str:
    """Return the name of a mapping for a file, whatever that is called, such as 2024-05-30."""
    plain = re.sub("[^a-z0-9]", "_", stem.lower())
    return (plain if plain[:1].isalpha() else f"log_{plain}")[:41]


def write_draft(draft: Draft, name: str) -> str:
    """Return a mapping in TOML, without the day and the car, which the file does not contain."""
    is_lake = isinstance(draft.file, FileGroup)
    called = shlex.quote(quote_name(draft.file.parents[1] if is_lake else draft.file))
    parts = [_HEAD.format(file=called), f"name = {_value(name)}\n"]
    formats = draft.profile.formats
    if draft.profile.missing:
        parts.append(f"missing = {_value(draft.profile.missing)}\n")
    if keys := formats.csv.model_dump(exclude_defaults=True):
        decimal_comma = {"decimal_comma": formats.csv.decimal_comma} if "separator" in keys else {}
        parts.append(_table("csv", keys | decimal_comma))
    if formats.can is not None:
        parts.append(_table("can", {"database": formats.can.database}))
    reason = "\n".join(comment(draft.time.reason))
    parts.append(f"{reason}\n" + _table("time", draft.time.keys))
    parts.append(_drive(draft))
    parts.append(_signals(draft))
    if draft.open_questions:
        notes = (line for text in draft.open_questions for line in comment(f"To check: {text}"))
        parts.append("".join(f"{line}\n" for line in notes))
    return "\n".join(parts)


def _drive(draft: Draft) -> str:
    lines = ["[drive]"]
    if not draft.profile.has_clock and not TimeBase.model_validate(draft.time.keys).is_dated:
        lines.append("# day = 2024-05-31  # to be filled in")
    trip = draft.drive.get("column", {}).get("drive")
    if trip is not None:
        lines.append(f"column = {_value(trip)}  # each value is a drive of its own")
    car = draft.drive.get("vehicle_id")
    if isinstance(draft.file, FileGroup):  # of a lake
        car = {"path": "{}/*"}
    if car is not None:
        lines.append(f"vehicle_id = {_value(car)}")
    else:
        lines.append('# vehicle_id = ""     # to be filled in')
    lines.append('# vehicle_model = ""  # to be filled in')
    return "\n".join(lines) + "\n"


def _signals(draft: Draft) -> str:
    lines = ["[signals]"]
    guesses = {**draft.guesses, **draft.questions}
    for name, guess in guesses.items():
        prefix, reasons = "", f"{name}: {'; '.join(guess.reasons)}"
        if name in draft.questions:
            doubts = "; ".join(guess.doubts) or "its name and unit fit several columns"
            prefix, reasons = "# ", f"Doubtful: {name}: {doubts}"
        lines += comment(reasons)
        if guess.component == "east":  # stands beside north
            continue
        if guess.readings:
            lines += comment(f"Choose the unit: {_choices(guess)}.")
        for candidate in (guess, *guess.rivals):
            lines += [f"{prefix}{line}" for line in _lines(name, candidate, guesses)]
        if name == COURSE:
            lines += comment("antenna_x_m and antenna_y_m: to be filled in")
    if draft.absent:
        lines += comment(f"No channel looks like {', '.join(draft.absent)}.")
    return "\n".join(lines) + "\n"


def _choices(guess: Guess) -> str:
    """Return the units that are possible, as a person writes them."""
    units = [f'"{keys["unit"]}"' for keys in guess.readings]
    if "radius_m" in guess.readings[0]:  # as every velocity of a wheel
        units[0] += f" with radius_m = {guess.readings[0]['radius_m']}"
    return " or ".join(units)


def _lines(name: str, guess: Guess, guesses: dict[str, Guess]) -> list[str]:
    """Return the keys of a signal on one line, or on a line each if one is too long."""
    keys = signal_keys(guess)
    if guess.component:
        east = guesses[SATELLITE_SPEED].column
        keys = {"north": keys["column"], "east": east, "unit": keys["unit"]}
    text = ", ".join(f"{key} = {_value(value)}" for key, value in keys.items())
    line = f"{name} = {{ {text} }}"
    if len(line) < _COLUMNS:
        return [line]
    return [f"{name}.{key} = {_value(value)}" for key, value in keys.items()]


def _table(name: str, keys: dict[str, Any]) -> str:
    return f"[{name}]\n" + "".join(f"{key} = {_value(value)}\n" for key, value in keys.items())


def _value(value: object) -> str:
    """Return a TOML value; its strings are those of JSON."""
    if isinstance(value, dict):
        text = ", ".join(f"{key} = {_value(item)}" for key, item in value.items())
        return f"{{ {text} }}"
    return json.dumps(value, ensure_ascii=False)


# Questions for the open keys of a draft.


def open_keys(draft: Draft, text: str) -> dict[str, list[str]]:
    """Return the keys that a draft leaves open, with the usual values of units."""
    keys = [key for key in ("day", "vehicle_id", "vehicle_model") if f"\n# {key} = " in text]
    units = {
        name: [str(reading["unit"]) for reading in guess.readings]
        for name, guess in draft.guesses.items()
        if guess.readings
    }
    return {**{key: [] for key in keys}, **units}


def answer_key(text: str, key: str, answer: str) -> str:
    """Return a draft with the value of an open key, unchanged for an empty answer."""
    if not answer:
        return text
    if key in {"day", "vehicle_id", "vehicle_model"}:
        value = answer if key == "day" else _value(answer)
        return re.sub(rf"(?m)^# {key} = .*$", lambda _: f"{key} = {value}", text, count=1)
    is_velocity = key.startswith(WHEEL_PREFIX) and answer in {"km/h", "m/s"}
    more = f", radius_m = {RADIUS_M}" if is_velocity else ""
    line = re.compile(rf'(?m)^({key} = .*unit = )"{CHOOSE}"')
    if line.search(text):
        return line.sub(lambda match: f"{match[1]}{_value(answer)}{more}", text, count=1)
    more = more.replace(", radius_m", f"\n{key}.radius_m")
    return text.replace(f'{key}.unit = "{CHOOSE}"', f"{key}.unit = {_value(answer)}{more}")
