"""Reads a file block by block, and checks each row by itself."""

from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import polars as pl

from fleet_slip.errors import InputError
from fleet_slip.ingest.drives.fields import RAW, Field, fields_of, meets_conditions
from fleet_slip.ingest.drives.log_rows import read_batches
from fleet_slip.ingest.drives.quarantine import DriveKeys, check_rows, with_values
from fleet_slip.ingest.drives.time_bases import ROW
from fleet_slip.ingest.formats.columns import shown
from fleet_slip.ingest.formats.source import BASE
from fleet_slip.ingest.mapping.mapping import Mapping
from fleet_slip.ingest.mapping.row_condition import describe

MAX_KEYS = 100_000
"""Combinations of drive metadata in one file, of whatever rows."""


class Block(NamedTuple):
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

    def __init__(self, file: Path, mapping: Mapping) -> None:
        """Take a file that is not open yet."""
        self._file, self._mapping = file, mapping
        self.rows = self.left_out = 0
        self.keys = DriveKeys()

    def blocks(self) -> Iterator[Block]:
        """Yield the rows of each batch. Raises `InputError`."""
        for batch in read_batches(self._file, self._mapping):
            yield self._check(batch)
        if not self.rows:
            raise InputError(f"{shown(self._file)}: it has a header and no rows. Export it again.")
        if self.left_out == self.rows:
            raise InputError(
                f"{shown(self._file)}: none of its {self.rows:,} rows meets the condition of the "
                f"mapping {self._mapping.name!r}: {describe(self._mapping.where)}."
            )

    def _check(self, batch: pl.DataFrame) -> Block:
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
        valued = with_values(raw, fields)
        rows, refused = check_rows(self.keys.number(valued, fields), fields)
        if len(self.keys) > MAX_KEYS:
            raise InputError(
                f"{shown(self._file)}: more than {MAX_KEYS:,} combinations of drive metadata. "
                f"Check the columns under [drive] in the mapping {self._mapping.name!r}."
            )
        if self._mapping.time.rate_hz is not None:
            rows = rows.with_columns((pl.col("row") / self._mapping.time.rate_hz).alias("time"))
        return Block(rows, refused, self.rows)

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
