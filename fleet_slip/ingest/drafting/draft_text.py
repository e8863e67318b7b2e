"""Writes a draft of a mapping as TOML, each guess with its reasons as a comment."""

import json
from typing import Any

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.ingest.drafting.draft import Draft, signal_keys
from fleet_slip.ingest.mapping.signal_column import COURSE, SPEED
from fleet_slip.words import shown

_HEAD = """\
# A draft for {file}. Every line is a guess: check it, with
# fleet-slip ingest {file} --mapping THIS_FILE --dry-run
# docs/mapping.md explains the keys, docs/conventions.md the axes and signs.
"""


def write_draft(draft: Draft, name: str) -> str:
    """Return a mapping in TOML. It lacks what the file does not tell: the day, the car."""
    parts = [_HEAD.format(file=shown(draft.file.name)), f"name = {_value(name)}\n"]
    formats = draft.profile.formats
    if formats.csv.separator != ",":
        keys = {"separator": formats.csv.separator, "decimal_comma": formats.csv.decimal_comma}
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
    return "\n".join(parts)


def _drive(draft: Draft) -> str:
    lines = ["[drive]"]
    if draft.time.day is not None:
        lines.append(f"day = {draft.time.day.isoformat()}  # as the first time tells, in UTC")
    elif not draft.profile.has_clock:
        lines.append("# day = 2024-05-31  # to be filled in")
    lines.append('# vehicle_id = ""     # to be filled in')
    lines.append('# vehicle_model = ""  # to be filled in')
    return "\n".join(lines) + "\n"


def _signals(draft: Draft) -> str:
    lines = ["[signals]"]
    for name, guess in draft.guesses.items():
        keys = signal_keys(guess)
        lines.append(f"# {name}: {'; '.join(guess.reasons)}")
        if guess.component == "east":  # stands beside north
            continue
        if guess.component:
            east = draft.guesses[SPEED].profile.channel.name
            keys = {"north": keys["column"], "east": east, "unit": keys["unit"]}
        told = ", ".join(f"{key} = {_value(value)}" for key, value in keys.items())
        end = "  # antenna_x_m and antenna_y_m: to be filled in" if name == COURSE else ""
        lines.append(f"{name} = {{ {told} }}{end}")
    absent = [name for name in catalogue().signals if name not in draft.guesses]
    if absent:
        lines.append(f"# No channel looks like {', '.join(absent)}.")
    return "\n".join(lines) + "\n"


def _table(name: str, keys: dict[str, Any]) -> str:
    return f"[{name}]\n" + "".join(f"{key} = {_value(value)}\n" for key, value in keys.items())


def _value(value: object) -> str:
    """Return a TOML value; its strings are those of JSON."""
    return json.dumps(value, ensure_ascii=False)
