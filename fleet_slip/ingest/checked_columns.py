"""Checks each row by itself: values in SI units of good ones, the reason why bad ones are refused.

A batch's columns carry the prefix `RAW`, so that no name in a file can meet one of ours, be taken
for a pattern, or be anything but a name.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import date
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import polars as pl

from fleet_slip.base import find_name_fault, normalize_name, quote_name
from fleet_slip.catalog.signals import Signal
from fleet_slip.errors import InputError
from fleet_slip.ingest.batches import DISORDER, HELD, LATER, ROW, read_batches, read_columns
from fleet_slip.ingest.columns import (
    DateColumn,
    SignalColumn,
    as_number,
    count_range,
    describe,
    unfit_column,
    without_missing,
)
from fleet_slip.ingest.formats.csv import CUT, EXTRA_FIELDS, FEWER
from fleet_slip.ingest.formats.source import BASE, OWN_TIME
from fleet_slip.ingest.log_files import size_of
from fleet_slip.ingest.mapping import FromColumn, Mapping

RAW = "raw "
Faults: TypeAlias = dict[str, pl.Expr]
"""Boolean expressions, true for rows with a fault, by reason. The first fault is reported."""


@dataclass(frozen=True)
class RowField:
    """A value to take from a row, or a condition on it.

    `value` is made of raw columns; `faults` may also use the value under the field's name, so that
    a text is parsed once.
    """

    name: str
    kind: Literal["key", "time", "signal", "condition"]
    raw: pl.Expr
    value: pl.Expr
    faults: Faults


def find_held(column: str, schema: pl.Schema) -> str:
    """Return the column with another column's last value, for rows of several time bases."""
    return HELD + column if RAW + HELD + column in schema else column


def _number_faults(name: str, reason: str, is_faulty: pl.Expr) -> Faults:
    """Return the faults of a field's number."""
    value = pl.col(name)
    return {"not_a_number": value.is_nan(), "not_finite": value.is_infinite(), reason: is_faulty}


MAX_WHOLE = 2.0**53
"""From this number on, neighbouring whole numbers are the same float."""


def as_text(column: str, schema: pl.Schema, mapping: Mapping) -> pl.Expr:
    """Return a column as text, whole numbers without a point, null for missing."""
    raw = pl.col(RAW + column)
    text = raw.cast(pl.String)
    if schema[RAW + column] == pl.Float64:
        integer = raw.cast(pl.Int64, strict=False)
        text = pl.when(integer == raw).then(integer.cast(pl.String)).otherwise(text)
    return without_missing(text, mapping.missing)


def _number(column: str, schema: pl.Schema, mapping: Mapping) -> pl.Expr:
    """Return a column as float64, null for missing, NaN for other texts."""
    kind, comma = schema[RAW + column], mapping.csv.decimal_comma
    return as_number(column, pl.col(RAW + column), kind, mapping.missing, decimal_comma=comma)


_FIRST_DAY, _END_DAY = date(1970, 1, 1), date(2200, 1, 1)


def day_field(name: str, column: str, schema: pl.Schema, mapping: Mapping) -> RowField:
    """Return the field of a day. Raises `ValueError` for a column that is none."""
    raw, value = pl.col(RAW + column), pl.col(name)
    text = raw
    match schema[RAW + column]:
        case pl.String:
            text = without_missing(raw, mapping.missing)
            days = [text.str.to_date(f, strict=False) for f in ("%Y-%m-%d", "%d.%m.%Y")]
            day = pl.coalesce(days)
        case pl.Date | pl.Datetime:
            day = raw.cast(pl.Date)
        case other:
            raise unfit_column(column, other, "a date such as 2024-05-31")
    outside = (value < pl.lit(_FIRST_DAY)) | (value >= pl.lit(_END_DAY))
    faults = {"missing": text.is_null(), "not_a_time": value.is_null(), "out_of_range": outside}
    return RowField(name, "key", raw, day, faults)


def time_field(column: str, schema: pl.Schema, mapping: Mapping) -> RowField:
    """Return the field of the time in s, since 1970 for timestamps. Raises `ValueError`."""
    raw, value, time = pl.col(RAW + column), pl.col("time"), mapping.time
    faults = {"missing": value.is_null()}
    if column == OWN_TIME or time.unit is not None:
        faults |= {"not_a_number": value.is_nan(), "not_finite": value.is_infinite()}
    else:
        faults["not_a_time"] = value.is_nan()
        if time.is_dated:
            days = (_END_DAY - _FIRST_DAY).days
            faults["out_of_range"] = (value < 0) | (value >= days * 86_400)
    if column == OWN_TIME:
        return RowField("time", "time", raw, raw, faults)
    time_s = time.in_s(
        raw,
        schema[RAW + column],
        missing=mapping.missing,
        decimal_comma=mapping.csv.decimal_comma,
        dates=_dates(time.date, schema, mapping) if time.date else None,
        later=pl.col(RAW + LATER) if RAW + LATER in schema else None,
    )
    return RowField("time", "time", raw, time_s, faults)


def _dates(date: DateColumn, schema: pl.Schema, mapping: Mapping) -> pl.Expr:
    """Return dates as text; dates of digits alone get the leading zeros that a number lacks."""
    text = as_text(find_held(date.column, schema), schema, mapping)
    digits = _FIRST_DAY.strftime(date.format)
    return text.str.zfill(len(digits)) if digits.isdigit() else text


# The fields of a mapping: values in SI units and their problems.

MAX_VALUE_CHARACTERS = 200
"""Characters of offending values that are kept."""


def fields_of(mapping: Mapping, schema: pl.Schema) -> list[RowField]:
    """Return the fields of a batch with this schema: drive metadata, time, signals, conditions.

    Raises `ValueError` if a column's type does not fit the mapping.
    """
    fields = [
        _METADATA[name](name, find_held(column, schema), schema, mapping)
        for name, column in _key_columns(mapping).items()
    ]
    time = OWN_TIME if RAW + OWN_TIME in schema else mapping.time.key
    if time is not None:
        fields.append(time_field(time, schema, mapping))
        if RAW + DISORDER in schema:
            # The faults of times within their base, found by `merge_bases`.
            reasons = ("time_backwards", "time_duplicate", "isolated")
            faults = {reason: pl.col(RAW + DISORDER) == reason for reason in reasons}
            fields.append(_condition(faults, raw=pl.col(RAW + time), name="time"))
    names = [name for name in mapping.signal_catalog.signals if name in mapping.signals]
    signals = [_signal(name, schema, mapping) for name in names]
    nothing = pl.all_horizontal([pl.col(name).is_null() for name in names])
    fields += [*signals, _condition({"no_value": nothing}, raw=pl.lit(None, pl.String))]
    if RAW + EXTRA_FIELDS in schema:
        extra = pl.col(RAW + EXTRA_FIELDS)
        short = {"cut_line": extra == CUT, "fewer_fields": extra == FEWER}
        faults = short | {"extra_fields": extra.is_not_null()}
        fields.append(_condition(faults, raw=extra))
    return fields


def _key_columns(mapping: Mapping) -> dict[str, str]:
    """Return the columns with metadata of drives, by the names of their fields."""
    sources = {name: getattr(mapping.drive, name) for name in _METADATA if name != "drive"}
    columns = {n: source.column for n, source in sources.items() if isinstance(source, FromColumn)}
    return columns if mapping.drive.column is None else {"drive": mapping.drive.column, **columns}


def meets_conditions(mapping: Mapping, schema: pl.Schema) -> pl.Expr:
    """Return whether a row meets all of the mapping's conditions. Raises `ValueError`."""
    predicates = []
    for condition in mapping.where:
        column = find_held(condition.column, schema)
        read = as_text if condition.one_of else _number
        predicates.append(condition.is_met(read(column, schema, mapping)))
    return pl.all_horizontal(predicates)


def _condition(faults: Faults, raw: pl.Expr, name: str = "") -> RowField:
    return RowField(name, "condition", raw, raw, faults)


def _signal(name: str, schema: pl.Schema, mapping: Mapping) -> RowField:
    """Return a signal in SI units; its range is checked on the count that it becomes."""
    source = mapping.signals[name]
    raw = pl.col(RAW + source.column)
    number = _signed(source, source.column, schema, mapping)
    least, largest = _value_range(*count_range(mapping.signal_catalog, name, source))
    faults = _number_faults(name, "out_of_range", ~pl.col(name).is_between(least, largest))
    return RowField(name, "signal", raw, _si_value(mapping, name, source, number), faults)


def _value_range(signal: Signal, low: int, high: int) -> tuple[float, float]:
    """Return the least and the largest value in SI units whose count rounds into a range."""
    scale, margin = float(signal.scale), 4 * np.spacing(max(abs(low), abs(high)) + 0.5)
    least, largest = (low - 0.5 - margin) * scale, (high + 0.5 + margin) * scale
    while least / scale <= low - 0.5:
        least = np.nextafter(least, np.inf)
    while largest / scale >= high + 0.5:
        largest = np.nextafter(largest, -np.inf)
    return float(least), float(largest)


def _signed(source: SignalColumn, column: str, schema: pl.Schema, mapping: Mapping) -> pl.Expr:
    """Return a column as a number, with the sign of another column."""
    number = _number(column, schema, mapping)
    if source.sign is None:
        return number
    sign = as_text(find_held(source.sign.column, schema), schema, mapping)
    is_negative = sign == str(source.sign.negative)
    return pl.when(is_negative).then(-number).when(sign.is_not_null()).then(number)


def _si_value(mapping: Mapping, name: str, source: SignalColumn, number: pl.Expr) -> pl.Expr:
    gain, bias = source.linear(mapping.signal_catalog[name].unit)
    # Otherwise it would change nothing but the sign of zero.
    return number if (gain, bias) == (1.0, 0.0) else number * gain + bias


def _positive(name: str, column: str, schema: pl.Schema, mapping: Mapping) -> RowField:
    number = _number(column, schema, mapping)
    faults = _number_faults(name, "out_of_range", pl.col(name) <= 0)
    return RowField(name, "key", pl.col(RAW + column), number, faults)


def _text(name: str, column: str, schema: pl.Schema, mapping: Mapping) -> RowField:
    text = as_text(column, schema, mapping)
    value = text.map_batches(partial(_map_texts, normalize_name, pl.String), pl.String)
    faulty = pl.col(name).map_batches(partial(_map_texts, _is_faulty, pl.Boolean), pl.Boolean)
    if schema[RAW + column] == pl.Float64:  # which has lost digits of longer numbers
        faulty |= pl.col(RAW + column).abs() >= MAX_WHOLE
    faults = {"missing": pl.col(name).is_null(), "out_of_range": faulty}
    return RowField(name, "key", pl.col(RAW + column), value, faults)


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
    "drive": _text,
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


CheckedRows: TypeAlias = tuple[pl.DataFrame, pl.DataFrame]
"""The good rows of a batch, and the refused ones."""


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

    def blocks(self) -> Iterator[CheckedRows]:
        """Yield the rows of each batch. Raises `InputError`."""
        for batch in read_batches(self._file, self._mapping):
            yield self._check(batch)
        if not self.rows:
            raise InputError(f"{quote_name(self._file)}: a header without rows. Export it again.")
        if self.left_out == self.rows:
            raise InputError(
                f"{quote_name(self._file)}: none of {self.rows:,} rows meets the condition of "
                f"mapping {self._mapping.name!r}: {describe(self._mapping.where)}."
            )

    def _check(self, batch: pl.DataFrame) -> CheckedRows:
        raw = _without_nan(batch.rename({name: RAW + name for name in batch.columns}))
        try:
            fields, meeting = _understand(self._mapping, tuple(raw.schema.items()))
        except ValueError as error:
            raise InputError(f"{quote_name(self._file)}: {error}") from None
        if RAW + ROW in raw.columns:
            raw = raw.rename({RAW + ROW: "row", RAW + BASE: "base"})
        else:
            row = pl.int_range(self.rows + 1, self.rows + batch.height + 1, dtype=pl.Int64)
            raw = raw.with_columns(row.alias("row"))
        if meeting is not None:
            raw = raw.filter(meeting)
        self.rows += batch.height
        self.left_out += batch.height - raw.height
        rows, refused = _split(raw, self.keys.number(raw, fields), fields)
        if len(self.keys.metadata) > MAX_KEYS:
            raise InputError(
                f"{quote_name(self._file)}: more than {MAX_KEYS:,} combinations of drive metadata. "
                f"Check the columns under [drive] in the mapping {self._mapping.name!r}."
            )
        if self._mapping.time.rate_hz is not None:
            rows = rows.with_columns((pl.col("row") / self._mapping.time.rate_hz).alias("time"))
        return rows, refused


def _without_nan(batch: pl.DataFrame) -> pl.DataFrame:
    """Return a batch with null in place of NaN."""
    names = [name for name, kind in batch.schema.items() if kind == pl.Float64]
    if not names:
        return batch
    has_nan = batch.select(pl.col(names).is_nan().any()).row(0)
    return batch.with_columns(
        pl.col(name).fill_nan(None) for name, nan in zip(names, has_nan, strict=True) if nan
    )


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

    def number(self, batch: pl.DataFrame, fields: list[RowField]) -> pl.Expr | pl.Series:
        """Return `group` for raw columns: the row's number, null where its key is faulty.

        A key are the fields of the kind `key`; without any, the whole file is number 0. A run of
        rows with the same raw values is looked at once.
        """
        keys = [field for field in fields if field.kind == "key"]
        if not keys:
            self.metadata = self.metadata or [{}]
            return pl.lit(0, pl.Int32).alias("group")
        sources = {name for field in keys for name in field.value.meta.root_names()}
        changes = [pl.col(name).ne_missing(pl.col(name).shift()) for name in sources]
        is_head = pl.any_horizontal(*changes, pl.int_range(pl.len()) == 0)
        run = batch.select(is_head.alias("head"))["head"]
        heads = batch.select(sources).filter(run).with_columns(_values(keys))
        numbers = self._number_keys(heads, keys)
        return numbers.gather(run.cum_sum() - 1)

    def _number_keys(self, rows: pl.DataFrame, keys: list[RowField]) -> pl.Series:
        """Return the number of each row's key, null where it is faulty."""
        names = [field.name for field in keys]
        faulty = pl.any_horizontal(fault for field in keys for fault in field.faults.values())
        sound = rows.with_columns(faulty.fill_null(value=False).alias("\0faulty"))
        combinations = sound.filter(~pl.col("\0faulty")).select(names).unique(maintain_order=True)
        fresh = [key for key in combinations.rows() if key not in self._numbers]
        self._numbers |= {key: number for number, key in enumerate(fresh, len(self._numbers))}
        self.metadata += [dict(zip(names, key, strict=True)) for key in fresh]
        numbers = [self._numbers[key] for key in combinations.rows()]
        numbered = combinations.with_columns(pl.Series("group", numbers, pl.Int32))
        joined = sound.join(numbered, on=names, how="left", nulls_equal=True, maintain_order="left")
        return joined.select(pl.when(~pl.col("\0faulty")).then("group"))["group"]


LARGE_FILE_BYTES = 2**22
"""Size of a file from which `is_grouped` reads it: the rows of a smaller one fit into memory."""


def is_grouped(file: Path, mapping: Mapping) -> bool:
    """Return True if the rows of each drive are together. Reads these columns only.

    False for small files, several time bases, and a file whose faults `RowChecker` reports.
    """
    columns = _key_columns(mapping)
    if not columns:
        return True
    several_bases = mapping.time.own_clock or len(mapping.time_bases()) > 1
    if several_bases or size_of(file) < LARGE_FILE_BYTES:
        return False
    keys, latest = DriveKeys(), -1
    with suppress(InputError, ValueError):
        for batch in read_columns(file, mapping, [*dict.fromkeys(columns.values())]):
            raw = batch.rename({name: RAW + name for name in batch.columns})
            fields = [
                _METADATA[name](name, column, raw.schema, mapping)
                for name, column in columns.items()
            ]
            groups = raw.select(keys.number(raw, fields))["group"].drop_nulls()
            if not groups.is_sorted() or (len(groups) and groups[0] < latest):
                return False
            latest = groups[-1] if len(groups) else latest
            if len(keys.metadata) > MAX_KEYS:
                return False
        return True
    return False


def _values(fields: Iterable[RowField]) -> list[pl.Expr]:
    return [field.value.alias(field.name) for field in fields]


def _split(
    raw: pl.DataFrame, group: pl.Expr | pl.Series, fields: list[RowField]
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Split a batch into good rows, in SI units, and bad ones with the first fault of each.

    Most batches are good: then each fault is only looked for. A signal that is no finite number is
    out of its range, too.
    """
    measured = [field for field in fields if field.kind in {"time", "signal"}]
    columns = ["row", "group", *({"base"} & set(raw.columns)), *(f.name for f in measured)]
    valued = raw.with_columns(group, *_values(measured))
    faults = [(field, *fault) for field in fields for fault in field.faults.items()]
    possible = [
        fault
        for field, reason, fault in faults
        if field.kind != "key" and (field.kind != "signal" or reason == "out_of_range")
    ]
    seen = valued.select(
        fault.any().alias(str(i)) for i, fault in enumerate([pl.col("group").is_null(), *possible])
    )
    if not any(seen.row(0)):
        return valued.select(columns), no_rows()
    valued = valued.with_columns(_values(field for field in fields if field.kind == "key"))
    masks = valued.select(
        fault.fill_null(value=False).alias(str(i)) for i, (_, _, fault) in enumerate(faults)
    )
    is_refused, pieces = pl.repeat(value=False, n=valued.height, eager=True), [no_rows()]
    for (field, reason, _), mask in zip(faults, masks, strict=True):
        if mask.any():
            bad = valued.filter(mask & ~is_refused)
            pieces.append(_refused(bad, reason, field.name or None, field.raw))
            is_refused |= mask
    return valued.filter(~is_refused).select(columns), pl.concat(pieces)


def describe_refused(rows: pl.DataFrame, reason: str) -> pl.DataFrame:
    """Return rows as bad ones, because of their time."""
    return _refused(rows, reason, "time", pl.col("time"))


def _refused(rows: pl.DataFrame, reason: str, signal: str | None, value: pl.Expr) -> pl.DataFrame:
    return rows.select(
        "row",
        "group",
        pl.lit(reason).alias("reason"),
        pl.lit(signal, pl.String).alias("signal"),
        value.cast(pl.String).str.slice(0, MAX_VALUE_CHARACTERS).alias("value"),
    )


@cache
def no_rows() -> pl.DataFrame:
    """Return an empty frame of bad rows."""
    names = {"row": pl.Int64, "group": pl.Int32, "reason": pl.String}
    return pl.DataFrame(schema={**names, "signal": pl.String, "value": pl.String})
