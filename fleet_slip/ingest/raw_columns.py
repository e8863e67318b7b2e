"""The columns of a batch as Polars expressions: texts, numbers, and what is made of them.

A batch's columns carry the prefix `RAW`, so that no name in a file can meet one of ours, be taken
for a pattern, or be anything but a name.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import date, datetime
from decimal import Decimal
from itertools import chain
from typing import Literal

import numpy as np
import polars as pl

from fleet_slip.arrays import is_finite
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import InputError
from fleet_slip.ingest.columns import (
    DateColumn,
    SignalColumn,
    as_moments,
    conversion_factor,
    count_range,
)
from fleet_slip.ingest.formats.csv import CUT, EXTRA_FIELDS
from fleet_slip.ingest.formats.source import BASE, Base
from fleet_slip.ingest.mapping import FromColumn, Mapping, is_number

# Time bases become one table: a row is a sample of one of them, and null in the columns of others.
# It comes in windows of time, so that only some rows of each base are in memory.

DISORDER = "\0disorder"
"""Column that says what is wrong with a row's time among those of its base, null if nothing."""
HELD = "\0held "
"""Before the name of a column: its last value at the time, whatever base the row is of."""
ROW = "\0row"
"""Column with the row's number, from 1: those of the first base come first, then the next."""
_RIGHT = "\0right"
"""Column with the last right time of the base up to each row: where the row stands among others."""
WINDOW_ROWS = 2**16
"""A window has about this many rows of all bases together."""


def merge_bases(
    bases: Sequence[Base], time: str, held: Sequence[str], split_gap_s: float
) -> Iterator[pl.DataFrame]:
    """Yield the rows of all bases, window by window in the order of time, with `BASE` as a number.

    Times are in s. A row whose time does not increase within its base has the reason in
    `DISORDER`, and stands where the base's last right time was. The `held` columns, conditions and
    names of drives, say of every row what was last known there, for `split_gap_s` at most. Where
    only one base has rows, they come as they are.
    """
    opened = [_Coming(base, time, split_gap_s) for base in bases]
    columns = {name: kind for one in opened for name, kind in one.columns.items()}
    some = [one for one in opened if one.has_rows]
    if len(some) == 1:
        yield from (_completed(batch, columns) for batch in some[0].batches)
        return
    coming, offset = some, 0
    for number, one in enumerate(some):
        one.begin(number, offset, max(WINDOW_ROWS // len(some), 1))
        if number + 1 < len(some):
            offset += one.base.count_rows()
    columns |= {BASE: pl.Int32(), DISORDER: pl.String(), ROW: pl.Int64(), _RIGHT: pl.Float64()}
    of = {name: number for number, one in reversed([*enumerate(some)]) for name in one.columns}
    lasting = [_Lasting(name, of.get(name, -1), time, split_gap_s) for name in held]
    while coming := [one for one in coming if one.fill()]:
        until = min(one.reached for one in coming)
        rows = pl.concat([_completed(one.take(until), columns) for one in coming])
        rows = rows.sort(_RIGHT, maintain_order=True)
        yield rows.with_columns(one.hold(rows) for one in lasting).drop(_RIGHT)


def _completed(rows: pl.DataFrame, columns: dict[str, pl.DataType]) -> pl.DataFrame:
    """Return rows with all columns, null where they have none."""
    absent = [pl.lit(None, kind).alias(name) for name, kind in columns.items() if name not in rows]
    return rows.with_columns(absent).select(*columns)


class _Coming:
    """The rows of a base that are in no window yet; of the first ones its columns are known."""

    def __init__(self, base: Base, time: str, split_gap_s: float) -> None:
        self.base, self._time, self._gap_s = base, time, split_gap_s
        batches = base.read()
        first = next(batches)
        while not first.height and (following := next(batches, None)) is not None:
            first = following
        self.columns, self.has_rows = dict(first.schema), first.height > 0
        self.batches = chain([first], batches)
        self._before_s, self._right_s = np.nan, -np.inf
        self._rows = pl.DataFrame()

    def begin(self, number: int, offset: int, most: int) -> None:
        """Take the base's number, that of its first row, and how many rows to read at once."""
        self._number, self._offset = pl.lit(number, pl.Int32).alias(BASE), offset
        self._slices = _resized(self._judged(), most)

    def _judged(self) -> Iterator[pl.DataFrame]:
        """Yield the rows with `DISORDER`, `ROW` and `_RIGHT`; the last one waits for the next."""
        waiting: pl.DataFrame | None = None
        for batch in self.batches:
            rows = batch if waiting is None else pl.concat([waiting, batch])
            if rows.height > 1:
                yield self._judge(rows.head(rows.height - 1), rows[self._time][-1])
            waiting = rows.tail(1)
        if waiting is not None and waiting.height:
            yield self._judge(waiting, None)

    def _judge(self, rows: pl.DataFrame, after_s: float | None) -> pl.DataFrame:
        """Judge rows before a time. One far ahead is `isolated`, or all after it would be late."""
        time_s = rows[self._time].to_numpy()
        before_s = np.concatenate([[self._before_s], time_s[:-1]])
        next_s = np.append(time_s[1:], np.nan if after_s is None else after_s)
        with np.errstate(invalid="ignore"):
            ahead = (time_s - before_s > self._gap_s) & (next_s < time_s)
        usable = np.where(ahead | ~np.isfinite(time_s), -np.inf, time_s)
        right_s = np.maximum.accumulate(np.concatenate([[self._right_s], usable]))
        late, twice = time_s < right_s[:-1], time_s == right_s[:-1]
        reasons: pl.Series | pl.Expr = pl.lit(None, pl.String)
        if (late | twice | ahead).any():
            names = np.select(
                [ahead, late, twice], ["isolated", "time_backwards", "time_duplicate"], ""
            )
            reasons = pl.Series(names.tolist()).replace("", None)
        self._before_s, self._right_s = time_s[-1], right_s[-1]
        self._offset += rows.height
        first = self._offset - rows.height + 1
        return rows.with_columns(
            reasons.alias(DISORDER),
            pl.int_range(first, self._offset + 1, dtype=pl.Int64).alias(ROW),
            pl.Series(_RIGHT, right_s[1:]),
        )

    def fill(self) -> bool:
        """Read on if no rows wait; return whether some do now."""
        if not self._rows.height:
            self._rows = next(self._slices, self._rows)
        return self._rows.height > 0

    @property
    def reached(self) -> float:
        """Place of the last row."""
        return float(self._rows[_RIGHT][-1])

    def take(self, until: float) -> pl.DataFrame:
        """Return what waits up to a time."""
        number = int(self._rows[_RIGHT].search_sorted(until, side="right"))
        taken, self._rows = self._rows.head(number), self._rows.slice(number)
        return taken.with_columns(self._number)


def _resized(batches: Iterator[pl.DataFrame], most: int) -> Iterator[pl.DataFrame]:
    """Yield the rows of batches with `most` at once: of large ones less, of small ones together."""
    small: list[pl.DataFrame] = []
    for batch in batches:
        small.append(batch)
        if sum(one.height for one in small) >= most:
            yield from pl.concat(small).iter_slices(most)
            small = []
    if small:
        yield from pl.concat(small).iter_slices(most)


class _Lasting:
    """A column of one base that says something of the rows of all."""

    def __init__(self, name: str, base: int, time: str, longest_s: float) -> None:
        self._name, self._longest_s = name, longest_s
        self._says = (
            pl.col(name).is_not_null()
            & (pl.col(BASE) == base)
            & pl.col(DISORDER).is_null()
            & pl.col(time).is_finite()
        )
        self._last: list[pl.DataFrame] = []

    def hold(self, rows: pl.DataFrame) -> pl.Series:
        """Return the last value at the place of each row of a window, null if it is too old."""
        said = rows.filter(self._says).select(_RIGHT, pl.col(self._name).alias(HELD + self._name))
        known = pl.concat([*self._last, said]).set_sorted(_RIGHT)
        self._last = [known.tail(1)]
        held = rows.select(_RIGHT).join_asof(known, on=_RIGHT, tolerance=self._longest_s)
        return held[HELD + self._name]


RAW = "raw "
REASONS = (
    "missing",
    "not_a_number",
    "not_a_time",
    "not_finite",
    "out_of_range",
    "extra_fields",
    "cut_line",
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
            is_present = text.is_not_null() & ~number.is_in(absent).fill_null(value=False)
            return raw, pl.when(is_present).then(number), is_present
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


# What a mapping takes from each row: values in SI units and their faults.

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
        extra = pl.col(name)
        problem = find_problems((extra == CUT, "cut_line"), (extra.is_not_null(), "extra_fields"))
        field = Field("", "condition", extra, extra, problem)
        fields.append(replace(field, is_sound=lambda rows: rows[name].null_count() == rows.height))
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
    sign = as_text(find_held(source.sign.column, schema), schema, mapping)
    negative = sign == str(source.sign.negative)
    signed = pl.when(negative).then(-number).when(sign.is_not_null()).then(number)
    return raw, signed, present & sign.is_not_null()


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
