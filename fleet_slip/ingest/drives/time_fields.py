"""Days and times of rows, as Polars expressions: numbers, timestamps, and dates beside times."""

from datetime import date, datetime

import polars as pl

from fleet_slip.arrays import is_finite
from fleet_slip.ingest.drives.raw_columns import (
    RAW,
    Field,
    as_number,
    as_text,
    find_held,
    find_problems,
    unfit_column,
    without_missing,
)
from fleet_slip.ingest.mapping.mapping import Mapping
from fleet_slip.ingest.mapping.time_base import DateColumn, as_moments
from fleet_slip.ingest.mapping.units import conversion_factor

_FIRST_DAY, _END_DAY = date(1970, 1, 1), date(2200, 1, 1)


def day_field(name: str, column: str, schema: pl.Schema, mapping: Mapping) -> Field:
    """Return the field of a day. Raises `InputError` for a column that is none."""
    raw, value = pl.col(RAW + column), pl.col(name)
    text = raw
    match schema[RAW + column]:
        case pl.String:
            text = without_missing(raw, mapping)
            days = [text.str.to_date(f, strict=False) for f in ("%Y-%m-%d", "%d.%m.%Y")]
            day = pl.coalesce(days)
        case pl.Date | pl.Datetime:
            day = raw.cast(pl.Date)
        case other:
            raise unfit_column(column, other, "a date such as 2024-05-31")
    outside = (value < pl.lit(_FIRST_DAY)) | (value >= pl.lit(_END_DAY))
    problem = find_problems(
        (text.is_null(), "missing"), (value.is_null(), "not_a_time"), (outside, "out_of_range")
    )
    return Field(name, "key", raw, day, problem)


def time_field(column: str, schema: pl.Schema, mapping: Mapping) -> Field:
    """Return the field of the time in s, since 1970 for timestamps. Raises `InputError`."""
    unit = "s" if mapping.time.own_clock else mapping.time.unit
    if unit is None:
        return _timestamp(column, schema, mapping)
    raw, number, present = as_number(column, schema, mapping)
    value = pl.col("time")
    problem = find_problems(
        (value.is_null() & present, "not_a_number"),
        (value.is_null(), "missing"),
        (~value.is_finite(), "not_finite"),
    )
    time_s = number * conversion_factor(unit, "s")

    def is_sound(rows: pl.DataFrame) -> bool:
        found = rows["time"]
        return not found.null_count() and is_finite(found.to_numpy())

    return Field("time", "time", raw, time_s, problem, is_sound)


def _timestamp(column: str, schema: pl.Schema, mapping: Mapping) -> Field:
    raw, value = pl.col(RAW + column), pl.col("time")
    kind = schema[RAW + column]
    if kind == pl.String and mapping.time.format is not None:
        text = without_missing(raw, mapping)
        if mapping.time.date is not None:
            text = _dates(mapping.time.date, schema, mapping) + " " + text
        if not mapping.time.is_dated:  # the time of day
            clock_s = text.str.to_time(mapping.time.format, strict=False).cast(pl.Int64) / 1e9
            cases = ((text.is_null(), "missing"), (value.is_null(), "not_a_time"))
            return Field("time", "time", raw, clock_s, find_problems(*cases))
        moment = as_moments(text, str(mapping.time.moment_format))
    elif isinstance(kind, pl.Datetime):
        text = moment = raw
    else:
        needed = "a time: add 'unit' for numbers, 'format' for timestamps as text"
        raise unfit_column(column, kind, needed)
    if mapping.time.zone is not None and getattr(kind, "time_zone", None) is None:
        moment = moment.dt.replace_time_zone(
            mapping.time.zone, ambiguous="earliest", non_existent="null"
        )
    first, end = (datetime.combine(day, datetime.min.time()) for day in (_FIRST_DAY, _END_DAY))
    outside = (value < 0) | (value >= (end - first).total_seconds())
    problem = find_problems(
        (text.is_null(), "missing"), (value.is_null(), "not_a_time"), (outside, "out_of_range")
    )
    return Field("time", "time", raw, moment.dt.epoch("us") / 1e6, problem)


def _dates(date: DateColumn, schema: pl.Schema, mapping: Mapping) -> pl.Expr:
    """Return dates as text; of digits alone with the noughts that a number lacks."""
    text = as_text(find_held(date.column, schema), schema, mapping)
    digits = _FIRST_DAY.strftime(date.format)
    return text.str.zfill(len(digits)) if digits.isdigit() else text
