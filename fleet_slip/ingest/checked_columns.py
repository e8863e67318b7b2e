"""Checks each row by itself: values in SI units of good ones, the reason why bad ones are refused.

A batch's columns carry the prefix `RAW`, so that no name in a file can meet one of ours, be taken
for a pattern, or be anything but a name.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import date, datetime
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import polars as pl

from fleet_slip.arrays import BoolArray
from fleet_slip.base import find_name_fault, normalize_name, quote_name
from fleet_slip.errors import InputError
from fleet_slip.ingest.batches import DISORDER, HELD, ROW, read_batches
from fleet_slip.ingest.columns import (
    NO_NUMBER,
    DateColumn,
    SignalColumn,
    as_moments,
    conversion_factor,
    count_range,
    describe,
    parse_numbers,
)
from fleet_slip.ingest.formats.csv import CUT, EXTRA_FIELDS, FEWER
from fleet_slip.ingest.formats.source import BASE
from fleet_slip.ingest.mapping import FromColumn, Mapping, is_number

RAW = "raw "
REASONS = (
    "missing",
    "not_a_number",
    "not_a_time",
    "not_finite",
    "out_of_range",
    "extra_fields",
    "cut_line",
    "fewer_fields",
    "no_value",
    "time_backwards",
    "time_duplicate",
    "isolated",
)
"""Reasons to reject a row by itself; a problem is an index into this.

The last three apply to logs with several time bases; else `DriveCutter` detects them.
"""


@dataclass(frozen=True)
class RowField:
    """A value to take from a row, or a condition on it.

    `value` is made of raw columns; `problem`, null where all is well, may also use the value under
    the field's name, so that a text is parsed once.
    """

    name: str
    kind: Literal["key", "time", "signal", "condition"]
    raw: pl.Expr
    value: pl.Expr
    problem: pl.Expr


def find_held(column: str, schema: pl.Schema) -> str:
    """Return the column with another column's last value, for rows of several time bases."""
    return HELD + column if RAW + HELD + column in schema else column


def find_problems(*cases: tuple[pl.Expr, str]) -> pl.Expr:
    """Return the index of the first reason whose condition holds, else null."""
    return pl.coalesce(
        [
            pl.when(condition).then(pl.lit(REASONS.index(reason), pl.Int16))
            for condition, reason in cases
        ]
    )


def _number_problems(name: str, present: pl.Expr, more: tuple[pl.Expr, str]) -> pl.Expr:
    """Return the problems of a field's number; `present` is true where there is a text."""
    value = pl.col(name)
    unread, infinite = value.is_null() & present, ~value.is_finite()
    return find_problems((unread, "not_a_number"), (infinite, "not_finite"), more)


def _time_problems(name: str, text: pl.Expr, *more: tuple[pl.Expr, str]) -> pl.Expr:
    """Return the problems of a field's day or time."""
    unread = pl.col(name).is_null()
    return find_problems((text.is_null(), "missing"), (unread, "not_a_time"), *more)


MAX_WHOLE = 2.0**53
"""From here on neighbouring whole numbers are the same float."""


def as_text(column: str, schema: pl.Schema, mapping: Mapping) -> pl.Expr:
    """Return a column as text, whole numbers without a point, null for missing."""
    raw = pl.col(RAW + column)
    text = raw.cast(pl.String)
    if schema[RAW + column] == pl.Float64:
        integer = raw.cast(pl.Int64, strict=False)
        text = pl.when(integer == raw).then(integer.cast(pl.String)).otherwise(text)
    return without_missing(text, mapping)


def as_number(column: str, schema: pl.Schema, mapping: Mapping) -> tuple[pl.Expr, pl.Expr]:
    """Return a column as float64 with null for missing, and whether there is a text."""
    raw = pl.col(RAW + column)
    absent = [float(text) for text in mapping.missing if is_number(text)]
    match schema[RAW + column]:
        case pl.String:
            text = without_missing(raw, mapping)
            number = parse_numbers(text, decimal_comma=mapping.csv.decimal_comma)
            is_absent = number.is_nan() | text.str.contains(NO_NUMBER)
            if absent:
                is_absent |= number.is_in(absent)
            is_present = text.is_not_null() & ~is_absent.fill_null(value=False)
            return pl.when(is_present).then(number), is_present
        case pl.Float64 | pl.Int64 | pl.UInt64:
            number = raw.cast(pl.Float64).fill_nan(None)
            number = pl.when(~number.is_in(absent)).then(number) if absent else number
            return number, pl.lit(value=False)
        case other:
            raise unfit_column(column, other, "numbers")


def without_missing(text: pl.Expr, mapping: Mapping) -> pl.Expr:
    """Return a text without spaces around it, null where it means that there is no value."""
    text = text.str.strip_chars()
    return pl.when(~text.is_in(["", *mapping.missing])).then(text)


def unfit_column(column: str, kind: pl.DataType, needed: str) -> InputError:
    """Return the error of a column whose type does not fit the mapping."""
    return InputError(f"column {column!r} has the type {kind}; the mapping needs {needed}.")


_FIRST_DAY, _END_DAY = date(1970, 1, 1), date(2200, 1, 1)


def day_field(name: str, column: str, schema: pl.Schema, mapping: Mapping) -> RowField:
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
    problem = _time_problems(name, text, (outside, "out_of_range"))
    return RowField(name, "key", raw, day, problem)


def time_field(column: str, schema: pl.Schema, mapping: Mapping) -> RowField:
    """Return the field of the time in s, since 1970 for timestamps. Raises `InputError`."""
    unit = "s" if mapping.time.own_clock else mapping.time.unit
    if unit is None:
        return _timestamp(column, schema, mapping)
    number, present = as_number(column, schema, mapping)
    problem = _number_problems("time", present, (pl.col("time").is_null(), "missing"))
    time_s = number * conversion_factor(unit, "s")
    return RowField("time", "time", pl.col(RAW + column), time_s, problem)


def _timestamp(column: str, schema: pl.Schema, mapping: Mapping) -> RowField:
    raw, value = pl.col(RAW + column), pl.col("time")
    kind = schema[RAW + column]
    if kind == pl.String and mapping.time.format is not None:
        text = without_missing(raw, mapping)
        if mapping.time.date is not None:
            text = _dates(mapping.time.date, schema, mapping) + " " + text
        if not mapping.time.is_dated:  # the time of day
            clock_s = text.str.to_time(mapping.time.format, strict=False).cast(pl.Int64) / 1e9
            return RowField("time", "time", raw, clock_s, _time_problems("time", text))
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
    problem = _time_problems("time", text, (outside, "out_of_range"))
    return RowField("time", "time", raw, moment.dt.epoch("us") / 1e6, problem)


def _dates(date: DateColumn, schema: pl.Schema, mapping: Mapping) -> pl.Expr:
    """Return dates as text; of digits alone with the noughts that a number lacks."""
    text = as_text(find_held(date.column, schema), schema, mapping)
    digits = _FIRST_DAY.strftime(date.format)
    return text.str.zfill(len(digits)) if digits.isdigit() else text


# The fields of a mapping: values in SI units and their problems.

MAX_VALUE_CHARACTERS = 200
"""Characters of offending values that are kept."""


def fields_of(mapping: Mapping, schema: pl.Schema) -> list[RowField]:
    """Return the fields of a batch with this schema: drive metadata, time, signals, conditions.

    Raises `InputError` if a column's type does not fit the mapping.
    """
    fields: list[RowField] = []
    if mapping.drive.column is not None:
        fields.append(_text("drive", find_held(mapping.drive.column, schema), schema, mapping))
    for name, make in _METADATA.items():
        source = getattr(mapping.drive, name)
        if isinstance(source, FromColumn):
            fields.append(make(name, find_held(source.column, schema), schema, mapping))
    if mapping.time.key is not None:
        fields.append(time_field(mapping.time.key, schema, mapping))
        if RAW + DISORDER in schema:
            # The faults of times within their base, found by `merge_bases`.
            reasons = ("time_backwards", "time_duplicate", "isolated")
            cases = ((pl.col(RAW + DISORDER) == reason, reason) for reason in reasons)
            fields.append(_condition(*cases, raw=pl.col(RAW + mapping.time.key), name="time"))
    names = [name for name in mapping.signal_catalog.signals if name in mapping.signals]
    signals = [_signal(name, schema, mapping) for name in names]
    nothing = pl.all_horizontal([pl.col(name).is_null() for name in names])
    fields += [*signals, _condition((nothing, "no_value"), raw=pl.lit(None, pl.String))]
    if RAW + EXTRA_FIELDS in schema:
        extra = pl.col(RAW + EXTRA_FIELDS)
        short = ((extra == CUT, "cut_line"), (extra == FEWER, "fewer_fields"))
        fields.append(_condition(*short, (extra.is_not_null(), "extra_fields"), raw=extra))
    return fields


def meets_conditions(mapping: Mapping, schema: pl.Schema) -> pl.Expr:
    """Return whether a row meets all of the mapping's conditions. Raises `InputError`."""
    predicates = []
    for condition in mapping.where:
        signal = condition.signal
        name = find_held(
            str(condition.column if signal is None else mapping.signals[signal].column), schema
        )
        if signal is not None:
            source = mapping.signals[signal]
            value = _si_value(mapping, signal, source, _signed(source, name, schema, mapping)[0])
        elif condition.one_of:
            value = as_text(name, schema, mapping)
        else:
            value = as_number(name, schema, mapping)[0]
        predicates.append(condition.is_met(value))
    return pl.all_horizontal(predicates)


def _condition(*cases: tuple[pl.Expr, str], raw: pl.Expr, name: str = "") -> RowField:
    return RowField(name, "condition", raw, raw, find_problems(*cases))


def _signal(name: str, schema: pl.Schema, mapping: Mapping) -> RowField:
    """Return a signal in SI units; its range is checked on the count that it becomes."""
    source = mapping.signals[name]
    raw = pl.col(RAW + source.column)
    number, present = _signed(source, source.column, schema, mapping)
    (signal, low, high), value = count_range(mapping.signal_catalog, name, source), pl.col(name)
    count = value / float(signal.scale)
    outside = (count <= low - 0.5) | (count >= high + 0.5)
    problem = _number_problems(name, present, (outside, "out_of_range"))
    return RowField(name, "signal", raw, _si_value(mapping, name, source, number), problem)


def _signed(
    source: SignalColumn, column: str, schema: pl.Schema, mapping: Mapping
) -> tuple[pl.Expr, pl.Expr]:
    """Return a column as `as_number` does, with the sign of another column."""
    number, present = as_number(column, schema, mapping)
    if source.sign is None:
        return number, present
    sign = as_text(find_held(source.sign.column, schema), schema, mapping)
    negative = sign == str(source.sign.negative)
    signed = pl.when(negative).then(-number).when(sign.is_not_null()).then(number)
    return signed, present & sign.is_not_null()


def _si_value(mapping: Mapping, name: str, source: SignalColumn, number: pl.Expr) -> pl.Expr:
    gain, bias = source.linear(mapping.signal_catalog[name].unit)
    # Otherwise it would change nothing but the sign of zero.
    return number if (gain, bias) == (1.0, 0.0) else number * gain + bias


def _positive(name: str, column: str, schema: pl.Schema, mapping: Mapping) -> RowField:
    number, present = as_number(column, schema, mapping)
    problem = _number_problems(name, present, (pl.col(name) <= 0, "out_of_range"))
    return RowField(name, "key", pl.col(RAW + column), number, problem)


def _text(name: str, column: str, schema: pl.Schema, mapping: Mapping) -> RowField:
    text = as_text(column, schema, mapping)
    value = text.map_batches(partial(_map_texts, normalize_name, pl.String), pl.String)
    faulty = pl.col(name).map_batches(partial(_map_texts, _is_faulty, pl.Boolean), pl.Boolean)
    if schema[RAW + column] == pl.Float64:  # which has lost digits of longer numbers
        faulty |= pl.col(RAW + column).abs() >= MAX_WHOLE
    problem = find_problems((pl.col(name).is_null(), "missing"), (faulty, "out_of_range"))
    return RowField(name, "key", pl.col(RAW + column), value, problem)


def _is_faulty(name: str) -> bool:
    return find_name_fault(name) is not None


def _map_texts(
    function: Callable[[str], object], kind: pl.datatypes.DataTypeClass, texts: pl.Series
) -> pl.Series:
    """Apply a function to texts, once for each different one."""
    different = texts.drop_nulls().unique()
    values = pl.Series([function(text) for text in different], dtype=kind)
    return texts.replace_strict(different, values, default=None, return_dtype=kind)


_METADATA: dict[str, Callable[[str, str, pl.Schema, Mapping], RowField]] = {
    "vehicle_id": _text,
    "vehicle_model": _text,
    "track": _text,
    "mass_kg": _positive,
    "tyres": _text,
    "receiver": _text,
    "adhesion": _positive,
    "day": day_field,
}


# Each row is checked by itself: values in SI units of good ones, the reason of bad ones.

MAX_KEYS = 100_000
"""Combinations of drive metadata in one file, of whatever rows."""
_PROBLEM = "problem"


class CheckedBlock(NamedTuple):
    """Some rows of a file: the good ones, the bad ones, and how many were read until its end."""

    rows: pl.DataFrame
    refused: pl.DataFrame
    read: int


class RowChecker:
    """Checks the rows of a file and counts them.

    Attributes
    ----------
    rows
        Read so far.
    left_out
        Of these, those that do not meet the mapping's conditions.
    keys
        The metadata of each number in the column `group`.
    """

    def __init__(self, file: Path, mapping: Mapping) -> None:
        """Take a file that is not open yet."""
        self._file, self._mapping = file, mapping
        self.rows = self.left_out = 0
        self.keys = DriveKeys()

    def blocks(self) -> Iterator[CheckedBlock]:
        """Yield the rows of each batch. Raises `InputError`."""
        for batch in read_batches(self._file, self._mapping):
            yield self._check(batch)
        if not self.rows:
            raise InputError(f"{quote_name(self._file)}: a header without rows. Export it again.")
        if self.left_out == self.rows:
            raise InputError(
                f"{quote_name(self._file)}: none of {self.rows:,} rows meets the condition of "
                "mapping "
                f"{self._mapping.name!r}: {describe(self._mapping.where)}."
            )

    def _check(self, batch: pl.DataFrame) -> CheckedBlock:
        raw = batch.select(pl.all().name.prefix(RAW))
        try:
            fields, meeting = _understand(self._mapping, tuple(raw.schema.items()))
        except InputError as error:
            raise InputError(f"{quote_name(self._file)}: {error}") from None
        if RAW + ROW in raw.columns:
            raw = raw.rename({RAW + ROW: "row"})
        else:
            row = pl.int_range(self.rows + 1, self.rows + batch.height + 1, dtype=pl.Int64)
            raw = raw.with_columns(row.alias("row"))
        if meeting is not None:
            raw = raw.filter(meeting)
        raw = raw.rename({RAW + BASE: "base"}, strict=False)
        self.rows += batch.height
        self.left_out += batch.height - raw.height
        valued = raw.with_columns(f.value.alias(f.name) for f in fields if f.kind != "condition")
        rows, refused = _split(self.keys.number(valued, fields), fields)
        if len(self.keys.metadata) > MAX_KEYS:
            raise InputError(
                f"{quote_name(self._file)}: more than {MAX_KEYS:,} combinations of drive metadata. "
                f"Check the columns under [drive] in the mapping {self._mapping.name!r}."
            )
        if self._mapping.time.rate_hz is not None:
            rows = rows.with_columns((pl.col("row") / self._mapping.time.rate_hz).alias("time"))
        return CheckedBlock(rows, refused, self.rows)


@lru_cache(maxsize=64)
def _understand(
    mapping: Mapping, columns: tuple[tuple[str, pl.DataType], ...]
) -> tuple[list[RowField], pl.Expr | None]:
    """Return the fields of batches with these columns: the same for all files of a folder."""
    schema = pl.Schema(columns)
    fields = fields_of(mapping, schema)
    return fields, meets_conditions(mapping, schema) if mapping.where else None


class DriveKeys:
    """Numbers the combinations of drive metadata in a file, from 0, in order of appearance."""

    def __init__(self) -> None:
        """Begin without any."""
        self._numbers: dict[tuple[Any, ...], int] = {}
        self.metadata: list[dict[str, Any]] = []
        """The metadata of each number."""

    def number(self, batch: pl.DataFrame, fields: list[RowField]) -> pl.DataFrame:
        """Add `group` to a batch with values: the row's number, null where its key is faulty.

        A key are the fields of the kind `key`; without any, the whole file is number 0.
        """
        of_key = [field for field in fields if field.kind == "key"]
        if not of_key:
            self.metadata = self.metadata or [{}]
            return batch.with_columns(pl.lit(0, pl.Int32).alias("group"))
        names = [field.name for field in of_key]
        sound = pl.all_horizontal([field.problem.is_null() for field in of_key])
        keys = batch.filter(sound).select(names).unique(maintain_order=True)
        fresh = [key for key in keys.rows() if key not in self._numbers]
        self._numbers |= {key: number for number, key in enumerate(fresh, len(self._numbers))}
        self.metadata += [dict(zip(names, key, strict=True)) for key in fresh]
        numbers = [self._numbers[key] for key in keys.rows()]
        keys = keys.with_columns(pl.Series("group", numbers, pl.Int32))
        joined = batch.join(keys, on=names, how="left", nulls_equal=True, maintain_order="left")
        return joined.with_columns(pl.when(sound).then("group").alias("group"))


def _split(batch: pl.DataFrame, fields: list[RowField]) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Split a batch into good rows, in SI units, and bad ones, by the first problem of each."""
    values = [field.name for field in fields if field.kind in {"time", "signal"}]
    columns = ["row", "group", *({"base"} & set(batch.columns)), *values]
    codes = pl.coalesce(field.problem + len(REASONS) * i for i, field in enumerate(fields))
    checked = batch.with_columns(codes.alias(_PROBLEM))
    if checked[_PROBLEM].null_count() == checked.height:
        return batch.select(columns), no_rows()
    good = checked.filter(pl.col(_PROBLEM).is_null()).select(columns)
    bad = checked.filter(pl.col(_PROBLEM).is_not_null())
    explained = [_explain(rows, fields) for rows in bad.partition_by(_PROBLEM)]
    return good, pl.concat([no_rows(), *explained])


def describe_refused(rows: pl.DataFrame, mask: BoolArray | None, reason: str) -> pl.DataFrame:
    """Return rows as bad ones, because of their time: those of a mask, or all."""
    if mask is not None and not mask.any():
        return no_rows()
    bad = rows if mask is None else rows.filter(pl.Series(mask))
    return bad.select(
        pl.col("row"),
        pl.col("group"),
        pl.lit(reason).alias("reason"),
        pl.lit("time").alias("signal"),
        pl.col("time").cast(pl.String).alias("value"),
    )


@cache
def no_rows() -> pl.DataFrame:
    """Return an empty frame of bad rows."""
    names = {"row": pl.Int64, "group": pl.Int32, "reason": pl.String}
    return pl.DataFrame(schema={**names, "signal": pl.String, "value": pl.String})


def _explain(bad: pl.DataFrame, fields: list[RowField]) -> pl.DataFrame:
    """Describe rows that all have the same problem."""
    index, reason = divmod(bad[_PROBLEM][0], len(REASONS))
    field = fields[index]
    return bad.select(
        "row",
        "group",
        pl.lit(REASONS[reason]).alias("reason"),
        pl.lit(field.name or None, pl.String).alias("signal"),
        field.raw.cast(pl.String).str.slice(0, MAX_VALUE_CHARACTERS).alias("value"),
    )
