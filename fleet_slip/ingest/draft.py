"""Drafts a mapping for a file: guesses by name and unit, each with its reasons.

Doubtful guesses become questions, as comments. A person chooses units that the file does not
contain: until then the draft does not load. A dry run of the ingest checks signs and wheels.
"""

import json
import re
import shlex
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment

from fleet_slip.base import quote_name
from fleet_slip.catalog.course import COURSE, SATELLITE_SPEED
from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.errors import InputError
from fleet_slip.ingest.columns import TimeBase
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
    drive: dict[str, dict[str, str]]
    """The columns that identify cars and trips, by key of `[drive]`."""
    absent: tuple[str, ...]
    """The signals without a channel."""
    notes: tuple[str, ...]
    """Questions that only a person can answer, and parts of the file that were not read."""

    @property
    def is_dated(self) -> bool:
        """True if the file contains the day."""
        return self.profile.has_clock or TimeBase.model_validate(self.time.keys).is_dated

    def open_keys(self) -> dict[str, list[str]]:
        """Return the keys that only a person can fill in, with the usual values of units."""
        keys = {"day": self.is_dated, "vehicle_id": self.drive.get("vehicle_id")}
        units = {n: [r["unit"] for r in g.readings] for n, g in self.guesses.items() if g.readings}
        return {**{key: [] for key in (*keys, "vehicle_model") if not keys.get(key)}, **units}


def draft_mapping(signals: SignalCatalog, file: Path, profile: FileProfile) -> Draft:
    """Guess a mapping. Raises `InputError` if nothing in the file looks like a signal."""
    guesses = guess_signals(signals, profile.profiles)
    if not guesses:
        names = ", ".join(repr(p.channel.name) for p in profile.profiles[:30])
        raise InputError(
            f"{quote_name(file)}: none of its channels looks like a signal: {names}. Write the "
            f"mapping by hand: docs/mapping.md. {' '.join(_refused(profile))}".rstrip()
        )
    drive_keys, group = guess_cars(profile.profiles)
    if isinstance(file, FileGroup):  # the files of a lake are in a folder for each car
        drive_keys["vehicle_id"] = {"path": "{}/*"}
    bases = [guess.profile.channel.base for guess in guesses.values()]
    time = guess_time(profile, {guess.column for guess in guesses.values()}, bases, group)
    rasters = guess_rasters(profile, time, guesses, group)
    for name, guess in guesses.items():
        if raster := rasters.get(guess.column):
            guesses[name] = guess.because(f"its times are in {raster}", time=raster)
    doubtful = {name for name, guess in guesses.items() if guess.is_doubtful}
    if COURSE in guesses and doubtful & {COURSE, SATELLITE_SPEED, "yaw_rate"}:
        for name in (COURSE, SATELLITE_SPEED):
            guesses[name] = guesses[name].doubted("course, speed and yaw rate go together")
    notes = (*_notes(profile, guesses), *_refused(profile))
    absent = tuple(name for name in signals.signals if name not in guesses)
    return Draft(file, profile, time, guesses, drive_keys, absent, notes)


def _notes(profile: FileProfile, guesses: dict[str, Guess]) -> Iterator[str]:
    """Yield the questions on headings, missing values, and the label's sensor."""
    taken = {guess.column for guess in guesses.values()}
    for name, unit in headings(profile.profiles, taken) if COURSE not in guesses else ():
        yield (
            f"{quote_name(name)}: is it where the car points, or where it goes? If a satellite "
            f"receiver derives it from motion: course = {{ column = {_value(name)}, unit = "
            f"{_value(unit)}, clockwise_from_north = true, antenna_x_m = ..., antenna_y_m = ... "
            "}, with satellite_speed beside it. A heading contains no side-slip."
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


# Writes a draft of a mapping as TOML, each guess with its reasons as a comment.

_COLUMNS = 80
"""Width of a terminal: it breaks longer lines, and a copy would not be valid TOML."""


def name_of(stem: str) -> str:
    """Return a valid name of a mapping for a file, also for names such as 2024-05-30."""
    plain = re.sub("[^a-z0-9]", "_", stem.lower())
    return (plain if plain[:1].isalpha() else f"log_{plain}")[:41]


def write_draft(draft: Draft, name: str, answers: Mapping[str, str] | None = None) -> str:
    """Return a mapping in TOML, with answers for its open keys; an empty one leaves a key open."""
    answers = answers or {}
    csv = draft.profile.formats.csv
    keys = csv.model_dump(exclude_defaults=True)
    if "separator" in keys:
        keys["decimal_comma"] = csv.decimal_comma
    environment = Environment(  # noqa: S701 - no HTML; what goes into TOML is quoted
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    environment.filters |= {
        "comment": _comment, "lines": _lines, "signal": _signal_lines, "toml": _value,
    }  # fmt: skip
    template = (files(__package__) / "draft.toml.j2").read_text(encoding="utf-8")
    is_lake = isinstance(draft.file, FileGroup)
    return environment.from_string(template).render(
        file=shlex.quote(quote_name(draft.file.parents[1] if is_lake else draft.file)),
        name=name,
        csv=keys,
        answers=answers,
        car=answers.get("vehicle_id") or draft.drive.get("vehicle_id"),
        is_dated=draft.is_dated,
        profile=draft.profile,
        time=draft.time,
        guesses={n: guess.answered(answers.get(n)) for n, guess in draft.guesses.items()},
        drive=draft.drive,
        absent=draft.absent,
        notes=draft.notes,
    )


def _comment(text: str) -> str:
    """Return a text as lines of a comment."""
    return textwrap.fill(
        text, _COLUMNS - 1, initial_indent="# ", subsequent_indent="#   ", break_on_hyphens=False
    )


def _signal_lines(guess: Guess, is_doubtful: bool) -> str:
    """Return the keys of a signal on one line, or on a line each if one is too long."""
    line = f"{guess.signal} = {_value(guess.entry)}"
    if len(line) >= _COLUMNS:
        line = _lines({f"{guess.signal}.{key}": value for key, value in guess.entry.items()})
    return re.sub("(?m)^", "# ", line) if is_doubtful else line


def _lines(keys: Mapping[str, Any]) -> str:
    return "\n".join(f"{key} = {_value(value)}" for key, value in keys.items())


def _value(value: object) -> str:
    """Return a TOML value; its strings are those of JSON."""
    if isinstance(value, Mapping):
        text = ", ".join(f"{key} = {_value(item)}" for key, item in value.items())
        return f"{{ {text} }}"
    return json.dumps(value, ensure_ascii=False)
