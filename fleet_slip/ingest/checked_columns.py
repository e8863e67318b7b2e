"""Checks each row by itself: converts good rows to SI units, rejects bad rows with a reason.

The columns of a batch have the prefix `RAW`, so that no name in a file equals one of ours or is a
pattern of Polars.
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import date
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any, Literal, TypeAlias

import polars as pl

from fleet_slip.base import find_name_fault, normalize_name, quote_name
from fleet_slip.errors import InputError
from fleet_slip.ingest.batches import DISORDER, HELD, LATER, ROW, read_batches, read_columns
from fleet_slip.ingest.columns import (
    as_number,
    count_range,
    unfit_column,
    without_missing,
)
from fleet_slip.ingest.formats.csv import CUT, EXTRA_FIELDS, FEWER
from fleet_slip.ingest.formats.source import BASE, OWN_TIME
from fleet_slip.ingest.log_files import size_of
from fleet_slip.ingest.mapping import FromColumn, Mapping

RAW = "raw "
Faults: TypeAlias = dict[str, pl.Expr]
"""Boolean expressions by reason, true for rows with this fault. The first fault is reported."""


@dataclass(frozen=True)
class RowField:
    """A value to read from a row, or a condition on the row.

    `value` is computed from raw columns. `faults` may also use the value under the field's name, so
    that a text is parsed once.
    """

    name: str
    kind: Literal["key", "time", "signal", "condition"]
    raw: pl.Expr
    value: pl.Expr
    faults: Faults


@dataclass(frozen=True)
class RawColumns:
    """The raw columns of batches with one schema, and the mapping that defines their use."""

    schema: pl.Schema
    mapping: Mapping

    def held(self, column: str) -> str:
        """Return the name of a column; with several time bases, that of its last value."""
        return HELD + column if RAW + HELD + column in self.schema else column

    def kind(self, column: str) -> pl.DataType:
        """Return the type of a column."""
        return self.schema[RAW + column]

    def text(self, column: str) -> pl.Expr:
        """Return a column as text, whole numbers without a point, null for missing."""
        raw = pl.col(RAW + column)
        text = raw.cast(pl.String)
        if self.kind(column) == pl.Float64:
            integer = raw.cast(pl.Int64, strict=False)
            text = pl.when(integer == raw).then(integer.cast(pl.String)).otherwise(text)
        return without_missing(text, self.mapping.missing)

    def number(self, column: str) -> pl.Expr:
        """Return a column as float64, null for missing, NaN for other texts."""
        raw, missing = pl.col(RAW + column), self.mapping.missing
        comma = self.mapping.csv.decimal_comma
        return as_number(column, raw, self.kind(column), missing, decimal_comma=comma)


def _number_faults(name: str, reason: str, is_faulty: pl.Expr) -> Faults:
    """Return the faults of a field's number."""
    value = pl.col(name)
    return {"not_a_number": value.is_nan(), "not_finite": value.is_infinite(), reason: is_faulty}


MAX_WHOLE = 2.0**53
"""From this number on, neighbouring whole numbers are the same float."""


_FIRST_DAY, _END_DAY = date(1970, 1, 1), date(2200, 1, 1)


def day_field(name: str, column: str, columns: RawColumns) -> RowField:
    """Return the field of a day. Raises `ValueError` for a column of another type."""
    raw, value = pl.col(RAW + column), pl.col(name)
    text = raw
    match columns.kind(column):
        case pl.String:
            text = without_missing(raw, columns.mapping.missing)
            days = [text.str.to_date(f, strict=False) for f in ("%Y-%m-%d", "%d.%m.%Y")]
            day = pl.coalesce(days)
        case pl.Date | pl.Datetime:
            day = raw.cast(pl.Date)
        case other:
            raise unfit_column(column, other, "a date such as 2024-05-31")
    outside = (value < pl.lit(_FIRST_DAY)) | (value >= pl.lit(_END_DAY))
    faults = {"missing": text.is_null(), "not_a_time": value.is_null(), "out_of_range": outside}
    return RowField(name, "key", raw, day, faults)


def time_field(column: str, columns: RawColumns) -> RowField:
    """Return the field of the time in s, since 1970 for timestamps. Raises `ValueError`."""
    raw, value, mapping = pl.col(RAW + column), pl.col("time"), columns.mapping
    time, faults = mapping.time, {"missing": value.is_null()}
    if column == OWN_TIME or time.unit is not None:
        faults |= {"not_a_number": value.is_nan(), "not_finite": value.is_infinite()}
    else:
        faults["not_a_time"] = value.is_nan()
        if time.is_dated:
            days = (_END_DAY - _FIRST_DAY).days
            faults["out_of_range"] = (value < 0) | (value >= days * 86_400)
    if column == OWN_TIME:
        return RowField("time", "time", raw, raw, faults)
    dates = None
    if time.date is not None:  # dates of digits only, read as numbers, lost leading zeros
        digits = _FIRST_DAY.strftime(time.date.format)
        dates = columns.text(columns.held(time.date.column))
        dates = dates.str.zfill(len(digits)) if digits.isdigit() else dates
    time_s = time.to_seconds(
        raw,
        columns.kind(column),
        missing=mapping.missing,
        decimal_comma=mapping.csv.decimal_comma,
        dates=dates,
        later=pl.col(RAW + LATER) if RAW + LATER in columns.schema else None,
    )
    return RowField("time", "time", raw, time_s, faults)


# The fields of a mapping: values in SI units and their problems.

MAX_VALUE_CHARACTERS = 200
"""Maximum number of characters of a value in the quarantine."""


def fields_of(columns: RawColumns) -> list[RowField]:
    """Return the fields of a batch: drive metadata, time, signals, conditions.

    Raises `ValueError` if a column's type does not fit the mapping.
    """
    mapping, schema = columns.mapping, columns.schema
    fields = [
        _METADATA[name](name, columns.held(column), columns)
        for name, column in _key_columns(mapping).items()
    ]
    time = OWN_TIME if RAW + OWN_TIME in schema else mapping.time.batch_column
    if time is not None:
        fields.append(time_field(time, columns))
        if RAW + DISORDER in schema:
            # `merge_bases` has found the faults of times within their base.
            reasons = ("time_backwards", "time_duplicate", "isolated")
            faults = {reason: pl.col(RAW + DISORDER) == reason for reason in reasons}
            fields.append(_condition(faults, raw=pl.col(RAW + time), name="time"))
    names = [name for name in mapping.signal_catalog.signals if name in mapping.signals]
    signals = [_signal(name, columns) for name in names]
    is_empty = pl.all_horizontal([pl.col(name).is_null() for name in names])
    fields += [*signals, _condition({"no_value": is_empty}, raw=pl.lit(None, pl.String))]
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


def _condition(faults: Faults, raw: pl.Expr, name: str = "") -> RowField:
    return RowField(name, "condition", raw, raw, faults)


def _signal(name: str, columns: RawColumns) -> RowField:
    """Return the field of a signal in SI units; the count after rounding must be in range."""
    mapping = columns.mapping
    source = mapping.signals[name]
    value = columns.number(source.column)
    if source.sign is not None:
        sign = columns.text(columns.held(source.sign.column))
        is_negative = sign == str(source.sign.negative)
        value = pl.when(is_negative).then(-value).when(sign.is_not_null()).then(value)
    gain, bias = source.linear(mapping.signal_catalog[name].unit)
    if (gain, bias) != (1.0, 0.0):  # an identity would change the sign of zero
        value = value * gain + bias
    signal, low, high = count_range(mapping.signal_catalog, name, source)
    scale = float(signal.scale)
    bounds = (low - 0.5) * scale, (high + 0.5) * scale
    is_inside = pl.col(name).is_between(*bounds, closed="none")
    faults = _number_faults(name, "out_of_range", ~is_inside)
    return RowField(name, "signal", pl.col(RAW + source.column), value, faults)


def _positive(name: str, column: str, columns: RawColumns) -> RowField:
    faults = _number_faults(name, "out_of_range", pl.col(name) <= 0)
    return RowField(name, "key", pl.col(RAW + column), columns.number(column), faults)


def _text(name: str, column: str, columns: RawColumns) -> RowField:
    text = columns.text(column)
    value = text.map_batches(partial(_map_texts, normalize_name), pl.String)
    faults_of_names = pl.col(name).map_batches(partial(_map_texts, find_name_fault), pl.String)
    faulty = faults_of_names.is_not_null()
    if columns.kind(column) == pl.Float64:  # larger numbers have lost digits
        faulty |= pl.col(RAW + column).abs() >= MAX_WHOLE
    faults = {"missing": pl.col(name).is_null(), "out_of_range": faulty}
    return RowField(name, "key", pl.col(RAW + column), value, faults)


def _map_texts(function: Callable[[str], str | None], texts: pl.Series) -> pl.Series:
    """Apply a function to texts, once for each different one."""
    different = texts.drop_nulls().unique()
    values = pl.Series([function(text) for text in different], dtype=pl.String)
    return texts.replace_strict(different, values, default=None, return_dtype=pl.String)


_METADATA: dict[str, Callable[[str, str, RawColumns], RowField]] = {
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


# Checks of rows.

MAX_KEYS = 100_000
"""Maximum number of combinations of drive metadata in one file."""


@dataclass
class IngestCounts:
    """Counts of a file's rows: each row read is left out, kept or quarantined.

    Attributes
    ----------
    rows_left_out
        Rows that do not meet the mapping's conditions.
    quarantined
        Rejected rows by reason.
    ticks
        Rows of the result; equal to `rows_kept` where nothing was resampled.
    """

    rows_read: int = 0
    rows_left_out: int = 0
    rows_kept: int = 0
    quarantined: dict[str, int] = dataclasses.field(default_factory=dict)
    drives: int = 0
    drives_resampled: int = 0
    ticks: int = 0


def check_rows(
    file: Path, mapping: Mapping, keys: "DriveKeys", counts: IngestCounts
) -> Iterator[tuple[pl.DataFrame, pl.DataFrame]]:
    """Yield the good rows of each batch, and the rejected ones.

    Adds new groups to `keys`, and the rows to `counts`. Raises `InputError`.
    """
    for batch in read_batches(file, mapping):
        raw = _without_nan(batch.rename({name: RAW + name for name in batch.columns}))
        try:
            fields, condition = _fields_and_condition(mapping, tuple(raw.schema.items()))
        except ValueError as error:
            raise InputError(f"{quote_name(file)}: {error}") from None
        if RAW + ROW in raw.columns:
            raw = raw.rename({RAW + ROW: "row", RAW + BASE: "base"})
        else:
            first, end = counts.rows_read + 1, counts.rows_read + raw.height + 1
            raw = raw.with_columns(pl.int_range(first, end, dtype=pl.Int64).alias("row"))
        counts.rows_read += raw.height
        if condition is not None:
            selected = raw.filter(condition)
            counts.rows_left_out += raw.height - selected.height
            raw = selected
        groups = keys.assign_groups(raw, fields)
        rows, rejected = _split(raw, groups, fields)
        if len(keys.metadata) > MAX_KEYS:
            raise InputError(
                f"{quote_name(file)}: more than {MAX_KEYS:,} combinations of drive metadata. Check "
                f"the columns under [drive] in the mapping {mapping.name!r}."
            )
        if mapping.time.rate_hz is not None:
            rows = rows.with_columns((pl.col("row") / mapping.time.rate_hz).alias("time"))
        yield rows, rejected
    if not counts.rows_read:
        raise InputError(f"{quote_name(file)}: a header without rows. Export it again.")
    if counts.rows_left_out == counts.rows_read:
        where = [condition.model_dump(exclude_defaults=True) for condition in mapping.where]
        raise InputError(
            f"{quote_name(file)}: none of {counts.rows_read:,} rows meets the condition of mapping "
            f"{mapping.name!r}: where = {where}."
        )


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
def _fields_and_condition(
    mapping: Mapping, columns: tuple[tuple[str, pl.DataType], ...]
) -> tuple[list[RowField], pl.Expr | None]:
    """Return the fields of batches with these columns, and the condition on rows of the mapping.

    The files of a folder usually have the same columns, so that the cache saves time.
    """
    raw = RawColumns(pl.Schema(columns), mapping)
    predicates = []
    for condition in mapping.where:
        read = raw.text if condition.one_of else raw.number
        predicates.append(condition.is_met(read(raw.held(condition.column))))
    return fields_of(raw), pl.all_horizontal(predicates) if predicates else None


class DriveKeys:
    """Groups of rows with the same drive metadata, numbered from 0 in order of appearance."""

    def __init__(self) -> None:
        """Begin without groups."""
        self._numbers: dict[tuple[Any, ...], int] = {}
        self.metadata: list[dict[str, Any]] = []
        """The metadata of each group."""

    def assign_groups(self, batch: pl.DataFrame, fields: list[RowField]) -> pl.Expr | pl.Series:
        """Return the column `group` of a batch, null for faulty metadata; add new groups.

        The fields of the kind `key` contain the metadata. Without such fields all rows are group 0.
        Only the first of consecutive rows with the same raw values is examined.
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
        names = [field.name for field in keys]
        faults = [fault for field in keys for fault in field.faults.values()]
        is_sound = heads.select(~pl.any_horizontal(faults).fill_null(value=False)).to_series()
        combinations = heads.filter(is_sound).select(names).unique(maintain_order=True)
        for key in combinations.iter_rows():
            if key not in self._numbers:
                self._numbers[key] = len(self._numbers)
                self.metadata.append(dict(zip(names, key, strict=True)))
        numbers = [self._numbers[key] for key in combinations.iter_rows()]
        numbered = combinations.with_columns(pl.Series("group", numbers, pl.Int32))
        groups = heads.join(
            numbered, on=names, how="left", nulls_equal=True, maintain_order="left"
        ).select(pl.when(is_sound).then("group"))
        return groups["group"].gather(run.cum_sum() - 1)


LARGE_FILE_BYTES = 2**22
"""Minimum size of a file that `is_grouped` reads: the rows of smaller files fit into memory."""


def is_grouped(file: Path, mapping: Mapping) -> bool:
    """Return True if the rows of each group are together. Reads only the columns of metadata.

    Returns False for small files, several time bases, and a file that `check_rows` refuses.
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
            of_batch = RawColumns(raw.schema, mapping)
            fields = [_METADATA[name](name, column, of_batch) for name, column in columns.items()]
            groups = raw.select(keys.assign_groups(raw, fields))["group"].drop_nulls()
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
    """Split a batch into good rows, in SI units, and rejected ones with the first fault of each.

    Most batches have no fault, so one query first tests if any fault occurs. It tests only the
    range of signals, since NaN and infinity are out of range, too.
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
    is_rejected, pieces = pl.repeat(value=False, n=valued.height, eager=True), [no_rows()]
    for (source, reason, _), mask in zip(faults, masks, strict=True):
        if mask.any():
            bad = valued.filter(mask & ~is_rejected)
            pieces.append(describe_rejected(bad, reason, source.name or None, source.raw))
            is_rejected |= mask
    return valued.filter(~is_rejected).select(columns), pl.concat(pieces)


def describe_rejected(
    rows: pl.DataFrame, reason: str, signal: str | None = "time", value: pl.Expr | None = None
) -> pl.DataFrame:
    """Return rejected rows with a reason, a signal and its value; by default those of the time."""
    text = (pl.col("time") if value is None else value).cast(pl.String)
    return rows.select(
        "row",
        "group",
        pl.lit(reason).alias("reason"),
        pl.lit(signal, pl.String).alias("signal"),
        text.str.slice(0, MAX_VALUE_CHARACTERS).alias("value"),
    )


@cache
def no_rows() -> pl.DataFrame:
    """Return an empty frame of rejected rows."""
    names = {"row": pl.Int64, "group": pl.Int32, "reason": pl.String}
    return pl.DataFrame(schema={**names, "signal": pl.String, "value": pl.String})
