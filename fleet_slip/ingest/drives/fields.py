"""What a mapping takes from each row, as Polars expressions: values in SI units and their faults.

A batch's columns carry the prefix `RAW`, so that no name in a file can meet one of ours, be taken
for a pattern, or be anything but a name.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import date, datetime
from decimal import Decimal
from typing import Literal

import polars as pl

from fleet_slip.arrays import is_finite
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import InputError
from fleet_slip.ingest.drives.time_bases import DISORDER, HELD
from fleet_slip.ingest.formats.csv_batches import EXTRA_FIELDS
from fleet_slip.ingest.mapping.mapping import FromColumn, Mapping, is_number
from fleet_slip.ingest.mapping.signal_column import SignalColumn, count_range
from fleet_slip.ingest.mapping.time_base import DateColumn, as_moments
from fleet_slip.ingest.mapping.units import conversion_factor

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
LONGEST_TEXT = 200
"""Characters of metadata that are accepted, and of offending values that are kept."""
_FIRST_DAY, _END_DAY = date(1970, 1, 1), date(2200, 1, 1)


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


def fields_of(mapping: Mapping, schema: pl.Schema) -> list[Field]:
    """Return the fields of a batch with this schema: drive metadata, time, signals, conditions.

    Raises `InputError` if a column's type cannot be what the mapping says it is.
    """
    fields: list[Field] = []
    if mapping.drive.column is not None:
        fields.append(_text("drive", held(mapping.drive.column, schema), schema, mapping))
    for name, make in _METADATA.items():
        source = getattr(mapping.drive, name)
        if isinstance(source, FromColumn):
            fields.append(make(name, held(source.column, schema), schema, mapping))
    if mapping.time.key is not None:
        fields.append(_time(mapping.time.key, schema, mapping))
        if RAW + DISORDER in schema:
            fields.append(_disorder(pl.col(RAW + mapping.time.key)))
    names = [name for name in catalogue().signals if name in mapping.signals]
    signals = [_signal(name, schema, mapping) for name in names]
    nothing = pl.all_horizontal([pl.col(name).is_null() for name in names])
    no_value = _condition(nothing, "no_value", pl.lit(None, pl.String))
    somewhere = replace(
        no_value, is_sound=lambda rows: any(not rows[name].null_count() for name in names)
    )
    fields += [*signals, somewhere]
    if RAW + EXTRA_FIELDS in schema:
        name = RAW + EXTRA_FIELDS
        extra = _condition(pl.col(name).is_not_null(), "extra_fields", pl.col(name))
        fields.append(replace(extra, is_sound=lambda rows: rows[name].null_count() == rows.height))
    return fields


def meets_conditions(mapping: Mapping, schema: pl.Schema) -> pl.Expr:
    """Return whether a row meets all of the mapping's conditions. Raises `InputError`."""
    met = pl.lit(value=True)
    for condition in mapping.where:
        of = condition.signal
        source = None if of is None else mapping.signals[of]
        name = held(str(source.column if source else condition.column), schema)
        column = pl.col(RAW + name)
        if of is not None and source is not None:
            number = _signed(source, name, schema, mapping)[1]
            met &= condition.is_met(_si_value(of, source, number), column)
        elif condition.one_of:
            met &= condition.is_met(column, _as_text(name, schema, mapping))
        else:
            met &= condition.is_met(_number(name, schema, mapping)[1], column)
    return met


def held(column: str, schema: pl.Schema) -> str:
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


def _condition(condition: pl.Expr, reason: str, raw: pl.Expr) -> Field:
    return Field("", "condition", raw, raw, find_problems((condition, reason)))


def _disorder(time: pl.Expr) -> Field:
    """What a file of several time bases says of each row's time among those of its base."""
    reasons = ("time_backwards", "time_duplicate", "isolated")
    problem = find_problems(*((pl.col(RAW + DISORDER) == reason, reason) for reason in reasons))
    return Field("time", "condition", time, time, problem)


def _signal(name: str, schema: pl.Schema, mapping: Mapping) -> Field:
    """A signal in SI units. Its range is checked on the count that it will become."""
    source = mapping.signals[name]
    raw, number, present = _signed(source, source.column, schema, mapping)
    (signal, least, most), value = count_range(name, source), pl.col(name)
    count = value / float(signal.scale)
    outside = (count <= least - 0.5) | (count >= most + 0.5)
    problem = find_problems(
        (value.is_null() & present, "not_a_number"),
        (source.is_outside_table(number), "out_of_range"),
        (~value.is_finite(), "not_finite"),
        (outside, "out_of_range"),
    )

    def is_sound(rows: pl.DataFrame) -> bool:
        found = rows[name]
        if source.table or (found.null_count() and schema[RAW + source.column] == pl.String):
            return False
        return _lies_within(found, least - 0.5, most + 0.5, signal.scale)

    return Field(name, "signal", raw, _si_value(name, source, number), problem, is_sound)


def _signed(
    source: SignalColumn, column: str, schema: pl.Schema, mapping: Mapping
) -> tuple[pl.Expr, pl.Expr, pl.Expr]:
    """Return a column as `_number` does, with the sign that stands in another one."""
    raw, number, present = _number(column, schema, mapping)
    if source.sign is None:
        return raw, number, present
    told = _as_text(held(source.sign.column, schema), schema, mapping)
    negative = told == str(source.sign.negative)
    signed = pl.when(negative).then(-number).when(told.is_not_null()).then(number)
    return raw, signed, present & told.is_not_null()


def _si_value(name: str, source: SignalColumn, number: pl.Expr) -> pl.Expr:
    gain, bias = source.linear(catalogue()[name].unit)
    value = source.looked_up(number)
    # Otherwise it would change nothing but the sign of zero.
    return value if (gain, bias) == (1.0, 0.0) else value * gain + bias


def _lies_within(values: pl.Series, low: float, high: float, scale: Decimal) -> bool:
    """Whether all values are finite, and their counts between two limits, which are outside."""
    present = (values.drop_nulls() if values.null_count() else values).to_numpy()
    if not present.size:
        return True
    # Dividing keeps the order of what it rounds; a NaN is the least and the most, and in no range.
    least, most = float(present.min()) / float(scale), float(present.max()) / float(scale)
    return low < least and most < high


def _positive(name: str, column: str, schema: pl.Schema, mapping: Mapping) -> Field:
    raw, number, present = _number(column, schema, mapping)
    value = pl.col(name)
    problem = find_problems(
        (value.is_null() & present, "not_a_number"),
        (~value.is_finite(), "not_finite"),
        (value <= 0, "out_of_range"),
    )
    return Field(name, "key", raw, number, problem)


def _text(name: str, column: str, schema: pl.Schema, mapping: Mapping) -> Field:
    too_long = pl.col(name).str.len_chars() > LONGEST_TEXT
    problem = find_problems((pl.col(name).is_null(), "missing"), (too_long, "out_of_range"))
    return Field(name, "key", pl.col(RAW + column), _as_text(column, schema, mapping), problem)


def _as_text(column: str, schema: pl.Schema, mapping: Mapping) -> pl.Expr:
    """Return a column as text, whole numbers without a point, null for missing."""
    raw = pl.col(RAW + column)
    text = raw.cast(pl.String)
    if schema[RAW + column] == pl.Float64:
        whole = raw.cast(pl.Int64, strict=False)
        text = pl.when(whole == raw).then(whole.cast(pl.String)).otherwise(text)
    return _without_missing(text, mapping)


def _day(name: str, column: str, schema: pl.Schema, mapping: Mapping) -> Field:
    raw, value = pl.col(RAW + column), pl.col(name)
    text = raw
    match schema[RAW + column]:
        case pl.String:
            text = _without_missing(raw, mapping)
            days = [text.str.to_date(f, strict=False) for f in ("%Y-%m-%d", "%d.%m.%Y")]
            day = pl.coalesce(days)
        case pl.Date | pl.Datetime:
            day = raw.cast(pl.Date)
        case other:
            raise _unfit(column, other, "a date such as 2024-05-31")
    outside = (value < pl.lit(_FIRST_DAY)) | (value >= pl.lit(_END_DAY))
    problem = find_problems(
        (text.is_null(), "missing"), (value.is_null(), "not_a_time"), (outside, "out_of_range")
    )
    return Field(name, "key", raw, day, problem)


def _time(column: str, schema: pl.Schema, mapping: Mapping) -> Field:
    """Time in s, since 1970 for timestamps."""
    unit = "s" if mapping.time.own_clock else mapping.time.unit
    if unit is None:
        return _timestamp(column, schema, mapping)
    raw, number, present = _number(column, schema, mapping)
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
        text = _without_missing(raw, mapping)
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
        raise _unfit(column, kind, needed)
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
    text = _as_text(held(date.column, schema), schema, mapping)
    digits = _FIRST_DAY.strftime(date.format)
    return text.str.zfill(len(digits)) if digits.isdigit() else text


def _number(column: str, schema: pl.Schema, mapping: Mapping) -> tuple[pl.Expr, pl.Expr, pl.Expr]:
    """Return a column as it is, as float64 with null for missing, and whether there is a text."""
    raw = pl.col(RAW + column)
    absent = [float(text) for text in mapping.missing if is_number(text)]
    match schema[RAW + column]:
        case pl.String:
            text = _without_missing(raw, mapping)
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
            raise _unfit(column, other, "numbers")


def _without_missing(text: pl.Expr, mapping: Mapping) -> pl.Expr:
    text = text.str.strip_chars()
    return pl.when(~text.is_in(["", *mapping.missing])).then(text)


def _unfit(column: str, kind: pl.DataType, needed: str) -> InputError:
    return InputError(f"column {column!r} has the type {kind}; the mapping needs {needed}.")


_METADATA: dict[str, Callable[[str, str, pl.Schema, Mapping], Field]] = {
    "vehicle_id": _text,
    "vehicle_model": _text,
    "track": _text,
    "mass_kg": _positive,
    "tyres": _text,
    "receiver": _text,
    "adhesion": _positive,
    "day": _day,
}
