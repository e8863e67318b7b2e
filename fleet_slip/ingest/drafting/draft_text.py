"""Writes a draft of a mapping as TOML, each guess with its reasons as a comment."""

import json
import re
import shlex
import textwrap
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.ingest.drafting.draft import Draft, signal_keys
from fleet_slip.ingest.drafting.guessing import Guess
from fleet_slip.ingest.drafting.unit_choice import unit_choices
from fleet_slip.ingest.formats.csv_text import CsvFormat
from fleet_slip.ingest.mapping.signal_column import COURSE, SPEED
from fleet_slip.ingest.mapping.time_base import TimeBase
from fleet_slip.words import shown

WIDTH = 100
"""Of a comment."""
_COPIED = re.compile(r"# ([a-z_0-9]+ = |fleet-slip )")
_HEAD = """\
# A draft for {file}. Every line is a guess: check it, with
# fleet-slip ingest {file} --mapping THIS_FILE --dry-run
# docs/mapping.md explains the keys, docs/conventions.md the axes and signs.
"""


def name_of(stem: str) -> str:
    """Return the name of a mapping for a file, whatever that is called, such as 2024-05-30."""
    plain = re.sub("[^a-z0-9]", "_", stem.lower())
    return (plain if plain[:1].isalpha() else f"log_{plain}")[:41]


def write_draft(draft: Draft, name: str, place: Path | str | None = None) -> str:
    """Return a mapping in TOML. It lacks what the file does not tell: the day, the car.

    `place` is what a person calls the file, if that is not where it was read.
    """
    called = shlex.quote(shown(str(place or draft.file)))
    parts = [_HEAD.format(file=called), f"name = {_value(name)}\n"]
    formats = draft.profile.formats
    if draft.profile.absent.texts:
        parts.append(f"missing = {_value(draft.profile.absent.texts)}\n")
    if keys := _csv_keys(formats.csv):
        parts.append(_table("csv", keys))
    if formats.can is not None:
        parts.append(_table("can", {"database": formats.can.database}))
    if formats.duckdb is not None:
        parts.append(_table("duckdb", formats.duckdb.model_dump(exclude_none=True)))
    parts.append(f"# {draft.time.reason}\n" + _table("time", draft.time.keys))
    parts.append(_drive(draft))
    parts.append(_signals(draft))
    if draft.open_questions:
        parts.append("".join(f"# Look at this: {text}\n" for text in draft.open_questions))
    return "\n".join(_wrapped(line) for line in "\n".join(parts).split("\n"))


def _wrapped(line: str) -> str:
    """Return a line; a long comment as several lines, unless it has a key or a command."""
    if len(line) <= WIDTH or not line.startswith("# ") or _COPIED.match(line):
        return line
    return textwrap.fill(
        line, WIDTH, subsequent_indent="#   ", break_long_words=False, break_on_hyphens=False
    )


def _csv_keys(csv: CsvFormat) -> dict[str, Any]:
    """Return what is not usual of a text file."""
    keys = csv.model_dump(exclude_defaults=True)
    return keys | ({"decimal_comma": csv.decimal_comma} if "separator" in keys else {})


def _drive(draft: Draft) -> str:
    lines = ["[drive]"]
    if not draft.profile.has_clock and not _is_dated(draft):
        lines.append("# day = 2024-05-31  # to be filled in")
    trip = draft.drive.get("column", {}).get("drive")
    if trip is not None:
        lines.append(f"column = {_value(trip)}  # each value is a drive of its own")
    car = draft.drive.get("vehicle_id")
    if car is not None:
        lines.append(f"vehicle_id = {_value(car)}")
    else:
        lines.append('# vehicle_id = ""     # to be filled in')
    lines.append('# vehicle_model = ""  # to be filled in')
    return "\n".join(lines) + "\n"


def _is_dated(draft: Draft) -> bool:
    return TimeBase.model_validate(draft.time.keys).is_dated


def _signals(draft: Draft) -> str:
    lines = ["[signals]"]
    for name, guess in draft.guesses.items():
        lines.append(f"# {name}: {'; '.join(guess.reasons)}")
        if guess.component != "east":  # stands beside north
            end = "  # antenna_x_m and antenna_y_m: to be filled in" if name == COURSE else ""
            lines.append(_line(name, guess, draft.guesses) + end)
    for name, guess in draft.questions.items():
        doubts = "; ".join(guess.doubts) or "its name and unit fit several columns"
        lines.append(f"# Which one, if any? {name}: {doubts}")
        if guess.component != "east":
            alternatives = (guess, *guess.rivals, *_in_other_units(guess))
            lines += ["# " + _line(name, one, draft.questions) for one in alternatives]
    known = {*draft.guesses, *draft.questions}
    absent = [name for name in catalogue().signals if name not in known]
    if absent:
        lines.append(f"# No channel looks like {', '.join(absent)}.")
    return "\n".join(lines) + "\n"


def _line(name: str, guess: Guess, guesses: dict[str, Guess]) -> str:
    keys = signal_keys(guess)
    if guess.component:
        east = guesses[SPEED].profile.channel.name
        keys = {"north": keys["column"], "east": east, "unit": keys["unit"]}
    told = ", ".join(f"{key} = {_value(value)}" for key, value in keys.items())
    return f"{name} = {{ {told} }}"


def _in_other_units(guess: Guess) -> Iterator[Guess]:
    """Yield a guess in the other units that its values may be in."""
    if guess.is_without_unit and not guess.rivals:
        for unit, radius_m in unit_choices(guess):
            if unit != guess.unit:
                yield replace(guess, unit=unit, radius_m=radius_m)


def _table(name: str, keys: dict[str, Any]) -> str:
    return f"[{name}]\n" + "".join(f"{key} = {_value(value)}\n" for key, value in keys.items())


def _value(value: object) -> str:
    """Return a TOML value; its strings are those of JSON."""
    if isinstance(value, dict):
        told = ", ".join(f"{key} = {_value(one)}" for key, one in value.items())
        return f"{{ {told} }}"
    return json.dumps(value, ensure_ascii=False)
