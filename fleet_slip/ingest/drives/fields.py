"""What a mapping takes from each row, as Polars expressions: values in SI units and their faults.

A batch's columns carry the prefix `RAW`, so that no name in a file can meet one of ours, be taken
for a pattern, or be anything but a name.
"""

from collections.abc import Callable
from dataclasses import replace
from decimal import Decimal

import polars as pl

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.ingest.drives.raw_columns import (
    RAW,
    Field,
    as_number,
    as_text,
    find_held,
    find_problems,
)
from fleet_slip.ingest.drives.time_bases import DISORDER
from fleet_slip.ingest.drives.time_fields import day_field, time_field
from fleet_slip.ingest.formats.csv_batches import EXTRA_FIELDS
from fleet_slip.ingest.mapping.mapping import FromColumn, Mapping
from fleet_slip.ingest.mapping.signal_column import SignalColumn, count_range

LONGEST_TEXT = 200
"""Characters of metadata that are accepted, and of offending values that are kept."""


def fields_of(mapping: Mapping, schema: pl.Schema) -> list[Field]:
    """Return the fields of a batch with this schema: drive metadata, time, signals, conditions.

    Raises `InputError` if a column's type cannot be what the mapping says it is.
    """
    fields: list[Field] = []
    if mapping.drive.column is not None:
        fields.append(_text("drive", find_held(mapping.drive.column, schema), schema, mapping))
    for name, make in _METADATA.items():
        source = getattr(mapping.drive, name)
        if isinstance(source, FromColumn):
            fields.append(make(name, find_held(source.column, schema), schema, mapping))
    if mapping.time.key is not None:
        fields.append(time_field(mapping.time.key, schema, mapping))
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
        name = find_held(str(source.column if source else condition.column), schema)
        column = pl.col(RAW + name)
        if of is not None and source is not None:
            number = _signed(source, name, schema, mapping)[1]
            met &= condition.is_met(_si_value(of, source, number), column)
        elif condition.one_of:
            met &= condition.is_met(column, as_text(name, schema, mapping))
        else:
            met &= condition.is_met(as_number(name, schema, mapping)[1], column)
    return met


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
    """Return a column as `as_number` does, with the sign that stands in another one."""
    raw, number, present = as_number(column, schema, mapping)
    if source.sign is None:
        return raw, number, present
    told = as_text(find_held(source.sign.column, schema), schema, mapping)
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
    raw, number, present = as_number(column, schema, mapping)
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
    return Field(name, "key", pl.col(RAW + column), as_text(column, schema, mapping), problem)


_METADATA: dict[str, Callable[[str, str, pl.Schema, Mapping], Field]] = {
    "vehicle_id": _text,
    "vehicle_model": _text,
    "track": _text,
    "mass_kg": _positive,
    "tyres": _text,
    "receiver": _text,
    "adhesion": _positive,
    "day": day_field,
}
