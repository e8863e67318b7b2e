"""Which rows of a file count: conditions on its columns. Those of other rows are only counted.

People write them as `vehicle_speed > 5 m/s and fix in (4, 5)`.
"""

import operator
import re
from collections.abc import Callable, Collection, Sequence
from functools import reduce
from typing import Annotated, Any

import polars as pl
from pydantic import Field, model_validator

from fleet_slip.catalogue.signals import Identifier, catalogue
from fleet_slip.config import Config, Name, added
from fleet_slip.ingest.mapping.units import conversion_factor

Bound = Annotated[float, Field(allow_inf_nan=False)]
_BOUNDS: dict[str, Callable[[pl.Expr, float], Any]] = {
    "at_least": operator.ge,
    "at_most": operator.le,
    "above": operator.gt,
    "below": operator.lt,
    "other_than": operator.ne,
}

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


class RowCondition(Config):
    """A condition on one column, in the column's own unit; a missing value does not meet it.

    Or on a signal that the mapping makes of a column, in the catalogue's unit. `text_conditions`
    reads what people write: `speed > 5 m/s`.
    """

    column: Name | None = None
    signal: Identifier | None = added(None)
    at_least: Bound | None = None
    at_most: Bound | None = None
    above: Bound | None = added(None)
    below: Bound | None = added(None)
    other_than: Bound | None = added(None)
    one_of: tuple[Name, ...] = ()
    """Texts, such as the states of a fix; of a column of numbers, numbers as text."""

    @model_validator(mode="after")
    def _says_something(self) -> "RowCondition":
        if (self.column is None) == (self.signal is None):
            raise ValueError("needs either 'column' or 'signal'")
        if self.one_of and self.bounds:
            raise ValueError("give 'one_of', or 'at_least' and 'at_most', and not both")
        if not self.one_of and not self.bounds:
            raise ValueError("needs 'at_least', 'at_most' or 'one_of'")
        if self.one_of and self.signal is not None:
            raise ValueError("'one_of' is for a column: a signal is a number")
        return self

    @property
    def bounds(self) -> dict[str, float]:
        """The limits that are given, by their key."""
        given = {key: getattr(self, key) for key in _BOUNDS}
        return {key: bound for key, bound in given.items() if bound is not None}

    def is_met(self, number: pl.Expr, text: pl.Expr) -> pl.Expr:
        """Return whether a row meets it, given the column as a number and as a text."""
        if self.one_of:
            return text.is_in(self.one_of).fill_null(value=False)
        met = (_BOUNDS[key](number, bound) for key, bound in self.bounds.items())
        return reduce(operator.and_, met, number.is_finite()).fill_null(value=False)


def describe(conditions: Sequence[RowCondition]) -> str:
    """Return conditions as a message shows them."""
    return " and ".join(map(_text, conditions))


def _text(condition: RowCondition) -> str:
    said: dict[str, Any] = condition.model_dump(exclude_defaults=True, exclude={"column", "signal"})
    parts = [f"{key.replace('_', ' ')} {value}" for key, value in said.items()]
    return f"{condition.column or condition.signal!r} is {' and '.join(parts)}"


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
