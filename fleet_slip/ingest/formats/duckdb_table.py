"""Reads a table or a query of a DuckDB file."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import duckdb
import polars as pl
import pyarrow as pa
from pydantic import model_validator

from fleet_slip.config import Config
from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.columns import require_columns, shown
from fleet_slip.ingest.formats.parquet_batches import BATCH_ROWS, plain_column
from fleet_slip.ingest.formats.source import Channel
from fleet_slip.ingest.mapping.names import Name

MAGIC = b"DUCK"
MAGIC_AT = 8


class DuckdbRows(Config):
    """What of a DuckDB file is the log: a table, or the answer of a query."""

    table: Name | None = None
    query: str | None = None

    @model_validator(mode="after")
    def _one_of_both(self) -> "DuckdbRows":
        if (self.table is None) == (self.query is None):
            raise ValueError("needs either 'table' or 'query'")
        return self


class DuckdbSource:
    """Rows of an open DuckDB file, in the table's order or the query's."""

    has_clock = False

    def __init__(self, file: Path, connection: duckdb.DuckDBPyConnection, rows: DuckdbRows) -> None:
        """Take the file's path, a connection to it, and which rows of it."""
        self._file, self._connection = file, connection
        name = (rows.table or "").replace('"', '""')
        self._query = rows.query or f'SELECT * FROM "{name}"'

    def channels(self) -> list[Channel]:
        """Return the columns."""
        with _duckdb_errors(self._file):
            return [Channel(name) for name in self._connection.sql(self._query).columns]

    def batches(self, columns: Sequence[str]) -> Iterator[pl.DataFrame]:
        """Yield rows. Raises `InputError`."""
        with _duckdb_errors(self._file):
            rows = self._connection.sql(self._query)
            require_columns(self._file, rows.columns, columns)
            for batch in rows.to_arrow_reader(BATCH_ROWS):
                plain = {n: plain_column(batch.column(n), n, self._file) for n in columns}
                yield pl.DataFrame(pa.table(plain))


@contextmanager
def open_duckdb(file: Path, rows: DuckdbRows) -> Iterator[DuckdbSource]:
    """Open a DuckDB file for reading. Raises `InputError`."""
    # One thread: the order of rows, and so the ticks, may depend on nothing but the file.
    settings: dict[str, Any] = {
        "threads": 1,
        "enable_external_access": False,
    }
    with _duckdb_errors(file):
        connection = duckdb.connect(str(file), read_only=True, config=settings)
    with connection:
        yield DuckdbSource(file, connection, rows)


@contextmanager
def _duckdb_errors(file: Path) -> Iterator[None]:
    try:
        yield
    except duckdb.Error as error:
        reason = " ".join(str(error).split())[:300]
        raise InputError(
            f"{shown(file)}: DuckDB says: {reason} See [duckdb] in the mapping."
        ) from None
