"""Checks each row of a file by itself: values in SI units of good ones, the reason of bad ones."""

import unicodedata
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import polars as pl

from fleet_slip.arrays import BoolArray
from fleet_slip.errors import InputError
from fleet_slip.ingest.drives.fields import (
    LONGEST_TEXT,
    fields_of,
    meets_conditions,
)
from fleet_slip.ingest.drives.log_rows import read_batches
from fleet_slip.ingest.drives.raw_columns import RAW, REASONS, Field
from fleet_slip.ingest.drives.time_bases import ROW
from fleet_slip.ingest.formats.log_source import BASE
from fleet_slip.ingest.formats.meter import Meter
from fleet_slip.ingest.mapping.mapping import Mapping
from fleet_slip.ingest.mapping.row_condition import describe
from fleet_slip.words import shown

MAX_KEYS = 100_000
"""Combinations of drive metadata in one file, of whatever rows."""
_PROBLEM = "problem"


class CheckedBlock(NamedTuple):
    """Some rows of a file: the good ones, the bad ones, and how many were read until its end."""

    rows: pl.DataFrame
    refused: pl.DataFrame
    read: int


class RowChecker:
    """The rows of a file, good and bad, and what was counted on the way.

    Attributes:
        rows: read so far.
        left_out: of these, those that do not meet the mapping's conditions.
        keys: what the numbers in the column `group` stand for.
    """

    def __init__(self, file: Path, mapping: Mapping, meter: Meter) -> None:
        """Take a file that is not open yet."""
        self._file, self._mapping, self._meter = file, mapping, meter
        self.rows = self.left_out = 0
        self.keys = DriveKeys()

    def blocks(self) -> Iterator[CheckedBlock]:
        """Yield the rows of each batch. Raises `InputError`."""
        for batch in read_batches(self._file, self._mapping, self._meter):
            yield self._check(batch)
        if not self.rows:
            raise InputError(f"{shown(self._file)}: it has a header and no rows. Export it again.")
        if self.left_out == self.rows:
            raise InputError(
                f"{shown(self._file)}: none of its {self.rows:,} rows meets the condition of the "
                f"mapping {self._mapping.name!r}: {describe(self._mapping.where)}."
            )

    def _check(self, batch: pl.DataFrame) -> CheckedBlock:
        raw = batch.select(pl.all().name.prefix(RAW))
        fields, meeting = self._understand(raw.schema)
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
        if len(self.keys) > MAX_KEYS:
            raise InputError(
                f"{shown(self._file)}: more than {MAX_KEYS:,} combinations of drive metadata. "
                f"Check the columns under [drive] in the mapping {self._mapping.name!r}."
            )
        if self._mapping.time.rate_hz is not None:
            rows = rows.with_columns((pl.col("row") / self._mapping.time.rate_hz).alias("time"))
        return CheckedBlock(rows, refused, self.rows)

    def _understand(self, schema: pl.Schema) -> tuple[list[Field], pl.Expr | None]:
        """Return the fields of batches with a schema, and the condition on their rows."""
        try:
            return _understand(self._mapping, tuple(schema.items()))
        except InputError as error:
            raise InputError(f"{shown(self._file)}: {error}") from None


@lru_cache(maxsize=64)
def _understand(
    mapping: Mapping, columns: tuple[tuple[str, pl.DataType], ...]
) -> tuple[list[Field], pl.Expr | None]:
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
        """What each number stands for."""

    def __len__(self) -> int:
        """Return how many there are so far."""
        return len(self._numbers)

    def number(self, batch: pl.DataFrame, fields: list[Field]) -> pl.DataFrame:
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
        numbers = [self._number(dict(zip(names, key, strict=True))) for key in keys.rows()]
        keys = keys.with_columns(pl.Series("group", numbers, pl.Int32))
        joined = batch.join(keys, on=names, how="left", nulls_equal=True, maintain_order="left")
        return joined.with_columns(pl.when(sound).then("group").alias("group"))

    def _number(self, key: dict[str, Any]) -> int:
        number = self._numbers.setdefault(tuple(key.values()), len(self._numbers))
        if number == len(self.metadata):
            self.metadata.append(key)
        return number


def _split(batch: pl.DataFrame, fields: list[Field]) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Split a batch that has the fields' values and the columns `row` and `group`.

    Returns the good rows, with `row`, `group`, `base` if there are several, the time and the
    signals in SI units; and the bad ones, with `row`, `group`, `reason`, `signal` and `value`. The
    first problem of a row counts.
    """
    values = [field.name for field in fields if field.kind in {"time", "signal"}]
    kept = ["row", "group", *({"base"} & set(batch.columns)), *values]
    codes = [
        field.problem + len(REASONS) * i
        for i, field in enumerate(fields)
        if not field.is_sound(batch)
    ]
    if not codes:
        return batch.select(kept), no_rows()
    checked = batch.with_columns(pl.coalesce(codes).alias(_PROBLEM))
    good = checked.filter(pl.col(_PROBLEM).is_null()).select(kept)
    bad = checked.filter(pl.col(_PROBLEM).is_not_null())
    explained = [_explain(rows, fields) for rows in bad.partition_by(_PROBLEM)]
    return good, pl.concat([no_rows(), *explained])


def find_look_alikes(names: Iterable[str]) -> tuple[tuple[str, ...], ...]:
    """Return the groups of names that differ only in their Unicode form (NFC, NFD)."""
    groups = defaultdict(set)
    for name in names:
        groups[unicodedata.normalize("NFC", name)].add(name)
    return tuple(sorted(tuple(sorted(group)) for group in groups.values() if len(group) > 1))


def describe_refused(rows: pl.DataFrame, which: BoolArray | None, reason: str) -> pl.DataFrame:
    """Return rows as bad ones, because of their time: those of a mask, or all."""
    bad = rows if which is None else rows.filter(pl.Series(which))
    return bad.select(
        pl.col("row"),
        pl.col("group"),
        pl.lit(reason).alias("reason"),
        pl.lit("time").alias("signal"),
        pl.col("time").cast(pl.String).alias("value"),
    )


def join_refused(frames: Sequence[pl.DataFrame]) -> pl.DataFrame:
    """Return the bad rows of all frames; most have none, and joining takes a while."""
    some = [frame for frame in frames if frame.height]
    return pl.concat(some) if len(some) > 1 else next(iter(some), frames[0])


@cache
def no_rows() -> pl.DataFrame:
    """Return an empty frame of bad rows."""
    names = {"row": pl.Int64, "group": pl.Int32, "reason": pl.String}
    return pl.DataFrame(schema={**names, "signal": pl.String, "value": pl.String})


def _explain(bad: pl.DataFrame, fields: list[Field]) -> pl.DataFrame:
    """Describe rows that all have the same problem."""
    index, reason = divmod(bad[_PROBLEM][0], len(REASONS))
    field = fields[index]
    return bad.select(
        "row",
        "group",
        pl.lit(REASONS[reason]).alias("reason"),
        pl.lit(field.name or None, pl.String).alias("signal"),
        field.raw.cast(pl.String).str.slice(0, LONGEST_TEXT).alias("value"),
    )
