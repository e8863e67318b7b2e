"""The columns of a batch as Polars expressions: texts, numbers, and what is made of them.

A batch's columns carry the prefix `RAW`, so that no name in a file can meet one of ours, be taken
for a pattern, or be anything but a name.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import polars as pl

from fleet_slip.errors import InputError
from fleet_slip.ingest.drives.time_bases import HELD
from fleet_slip.ingest.mapping.mapping import Mapping, is_number

RAW = "raw "
REASONS = (
    "missing",
    "not_a_number",
    "not_a_time",
    "not_finite",
    "out_of_range",
    "extra_fields",
    "no_value",
    "time_backwards",
    "time_duplicate",
    "isolated",
)
"""What can be wrong with a row by itself; a problem is an index into this."""


@dataclass(frozen=True)
class Field:
    """One thing to take from a row, or a condition on it.

    `value` is made of raw columns; `problem`, null where all is well, may also use the value under
    the field's name, so that a text is parsed once. `is_sound` looks at a whole batch that has the
    values: where it holds no row has the problem, and looking at each is saved.
    """

    name: str
    kind: Literal["key", "time", "signal", "condition"]
    raw: pl.Expr
    value: pl.Expr
    problem: pl.Expr
    is_sound: Callable[[pl.DataFrame], bool] = lambda _: False


def find_held(column: str, schema: pl.Schema) -> str:
    """Return where a column's last value stands, in rows of several time bases."""
    return HELD + column if RAW + HELD + column in schema else column


def find_problems(*cases: tuple[pl.Expr, str]) -> pl.Expr:
    """Return the index of the first reason whose condition holds, else null."""
    return pl.coalesce(
        [
            pl.when(condition).then(pl.lit(REASONS.index(reason), pl.Int16))
            for condition, reason in cases
        ]
    )


def as_text(column: str, schema: pl.Schema, mapping: Mapping) -> pl.Expr:
    """Return a column as text, whole numbers without a point, null for missing."""
    raw = pl.col(RAW + column)
    text = raw.cast(pl.String)
    if schema[RAW + column] == pl.Float64:
        whole = raw.cast(pl.Int64, strict=False)
        text = pl.when(whole == raw).then(whole.cast(pl.String)).otherwise(text)
    return without_missing(text, mapping)


def as_number(column: str, schema: pl.Schema, mapping: Mapping) -> tuple[pl.Expr, pl.Expr, pl.Expr]:
    """Return a column as it is, as float64 with null for missing, and whether there is a text."""
    raw = pl.col(RAW + column)
    absent = [float(text) for text in mapping.missing if is_number(text)]
    match schema[RAW + column]:
        case pl.String:
            text = without_missing(raw, mapping)
            if mapping.csv.decimal_comma:
                text = text.str.replace(",", ".", literal=True)
            number = text.cast(pl.Float64, strict=False)
            if not absent:
                return raw, number, text.is_not_null()
            is_told = text.is_not_null() & ~number.is_in(absent).fill_null(value=False)
            return raw, pl.when(is_told).then(number), is_told
        case pl.Float64:
            number = pl.when(~raw.is_in(absent)).then(raw) if absent else raw
            return raw, number, pl.lit(value=False)
        case other:
            raise unfit_column(column, other, "numbers")


def without_missing(text: pl.Expr, mapping: Mapping) -> pl.Expr:
    """Return a text without spaces around it, null where it means that there is no value."""
    text = text.str.strip_chars()
    return pl.when(~text.is_in(["", *mapping.missing])).then(text)


def unfit_column(column: str, kind: pl.DataType, needed: str) -> InputError:
    """Return the error of a column whose type cannot be what the mapping says it is."""
    return InputError(f"column {column!r} has the type {kind}; the mapping needs {needed}.")
