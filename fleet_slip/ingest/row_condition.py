"""Which rows of a file count: conditions on its columns. Those of other rows are only counted."""

from collections.abc import Sequence
from typing import Annotated, Any

import polars as pl
from pydantic import Field, model_validator

from fleet_slip.config import Config
from fleet_slip.ingest.names import Name

Bound = Annotated[float, Field(allow_inf_nan=False)]


class RowCondition(Config):
    """A condition on one column, in the column's own unit; a missing value does not meet it."""

    column: Name
    at_least: Bound | None = None
    at_most: Bound | None = None
    one_of: tuple[Name, ...] = ()
    """Texts, such as the states of a fix; of a column of numbers, numbers as text."""

    @model_validator(mode="after")
    def _says_something(self) -> "RowCondition":
        bounds = (self.at_least, self.at_most)
        if self.one_of and bounds != (None, None):
            raise ValueError("give 'one_of', or 'at_least' and 'at_most', and not both")
        if not self.one_of and bounds == (None, None):
            raise ValueError("needs 'at_least', 'at_most' or 'one_of'")
        return self

    def is_met(self, number: pl.Expr, text: pl.Expr) -> pl.Expr:
        """Return whether a row meets it, given the column as a number and as a text."""
        if self.one_of:
            return text.is_in(self.one_of).fill_null(value=False)
        met = number.is_finite()
        if self.at_least is not None:
            met &= number >= self.at_least
        if self.at_most is not None:
            met &= number <= self.at_most
        return met.fill_null(value=False)


def describe(conditions: Sequence[RowCondition]) -> str:
    """Return conditions as a message shows them."""
    return " and ".join(map(_text, conditions))


def _text(condition: RowCondition) -> str:
    said: dict[str, Any] = condition.model_dump(exclude_defaults=True, exclude={"column"})
    parts = [f"{key.replace('_', ' ')} {value}" for key, value in said.items()]
    return f"{condition.column!r} is {' and '.join(parts)}"
