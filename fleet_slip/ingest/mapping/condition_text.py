"""Reads conditions as people write them: `vehicle_speed > 5 m/s and fix in (4, 5)`."""

import re
from collections.abc import Collection
from typing import Any

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.ingest.mapping.units import conversion_factor

_KEYS = {">=": "at_least", "<=": "at_most", ">": "above", "<": "below", "!=": "other_than"}
_NAME = r'"(?P<quoted>[^"]{1,200})"|(?P<name>[^\W\d][\w.:@/\[\]-]*(?:\(:,\d+\))?)'
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_UNIT = r"(?!and\b)[^\W\d]\S*|°\S*|%"
_ITEM = rf"'[^']*'|{_NUMBER}"
_COMPARISON = re.compile(
    rf"\s*(?:{_NAME})\s*(?:"
    rf"(?P<sign>>=|<=|!=|==|=|>|<)\s*(?:(?P<number>{_NUMBER})(?:\s*(?P<unit>{_UNIT}))?"
    rf"|'(?P<text>[^']*)')"
    rf"|in\s*\((?P<items>\s*(?:{_ITEM})(?:\s*,\s*(?:{_ITEM}))*\s*)\))\s*(?P<end>and\b|$)"
)
_LONGEST = 2000


def text_conditions(text: str, signals: Collection[str]) -> list[dict[str, Any]]:
    """Return the keys of a `RowCondition` for each comparison of a text, joined by `and`.

    A name is that of one of the mapping's signals, and the number has a unit; else, or in double
    quotes, it is a column of the file, whose own unit the number is in. Raises `ValueError`.
    """
    if len(text) > _LONGEST:
        raise ValueError(f"is longer than {_LONGEST:,} characters")
    conditions, at, more = [], 0, True
    while more:
        found = _COMPARISON.match(text, at)
        if found is None:
            raise ValueError(
                f"{text[at:].strip()[:60]!r} is no condition. Write NAME > NUMBER UNIT, "
                "NAME = 'text' or NAME in (4, 5); several are joined by: and"
            )
        conditions.append(_condition(found, signals))
        at, more = found.end(), found["end"] == "and"
    return conditions


def _condition(found: re.Match[str], signals: Collection[str]) -> dict[str, Any]:
    name = found["quoted"] or found["name"]
    if found["quoted"] is None and name in signals:
        return {"signal": name, **_of_signal(name, found)}
    if found["items"] is not None:
        texts = re.findall(_ITEM, found["items"])
        return {"column": name, "one_of": [text.strip("'") for text in texts]}
    if found["unit"] is not None:
        raise ValueError(
            f"{name!r} is no signal of this mapping but a column: its unit is not known. Give the "
            f"number in the column's own unit, without {found['unit']!r}"
        )
    if found["text"] is not None:
        if found["sign"] not in {"=", "=="}:
            raise ValueError(f"{name} {found['sign']} '{found['text']}': a text can only be =")
        return {"column": name, "one_of": [found["text"]]}
    return {"column": name, **_bounds(found["sign"], float(found["number"]))}


def _of_signal(name: str, found: re.Match[str]) -> dict[str, Any]:
    if found["number"] is None:
        raise ValueError(f"{name} is a signal, which is compared with a number")
    unit = catalogue()[name].unit
    if found["unit"] is None and unit != "1":
        raise ValueError(f"{name} {found['sign']} {found['number']}: of which unit? Say it: {unit}")
    try:
        factor = conversion_factor(found["unit"] or "1", unit, name)
    except ValueError as error:
        raise ValueError(f"{name} {found['sign']} {found['number']} {error}") from None
    return _bounds(found["sign"], float(found["number"]) * factor)


def _bounds(sign: str, value: float) -> dict[str, float]:
    if sign in {"=", "=="}:
        return {"at_least": value, "at_most": value}
    return {_KEYS[sign]: value}
