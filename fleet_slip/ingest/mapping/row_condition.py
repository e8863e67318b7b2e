"""Which rows of a file count: conditions on its columns. Those of other rows are only counted."""

import operator
from collections.abc import Callable, Sequence
from functools import reduce
from typing import Annotated, Any

import polars as pl
from pydantic import Field, model_validator

from fleet_slip.catalogue.signals import Identifier
from fleet_slip.config import Config, Name

Bound = Annotated[float, Field(allow_inf_nan=False)]
_BOUNDS: dict[str, Callable[[pl.Expr, float], Any]] = {
    "at_least": operator.ge,
    "at_most": operator.le,
    "above": operator.gt,
    "below": operator.lt,
    "other_than": operator.ne,
}


def _is_none(value: object) -> bool:
    return value is None


class RowCondition(Config):
    """A condition on one column, in the column's own unit; a missing value does not meet it.

    Or on a signal that the mapping makes of a column, in the catalogue's unit. `text_conditions`
    reads what people write: `speed > 5 m/s`.
    """

    column: Name | None = None
    signal: Identifier | None = Field(default=None, exclude_if=_is_none)
    at_least: Bound | None = None
    at_most: Bound | None = None
    above: Bound | None = Field(default=None, exclude_if=_is_none)
    below: Bound | None = Field(default=None, exclude_if=_is_none)
    other_than: Bound | None = Field(default=None, exclude_if=_is_none)
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
