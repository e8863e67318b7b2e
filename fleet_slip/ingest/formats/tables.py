"""Reads tables, of Parquet and of DuckDB: text, numbers as float64, dates and timestamps."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import date
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import unquote

import duckdb
import polars as pl
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from pydantic import field_validator

from fleet_slip.base import shown
from fleet_slip.config import Config, Name
from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.source import Budget, Channel, FormatSource, find_column
from fleet_slip.limits import memory_bytes
from fleet_slip.warehouse.database import sql_text

BATCH_ROWS = 2**15
"""Parquet is read in batches of this many rows."""

BUFFER_BYTES = 2**16
"""Bytes of a column that are read at once."""
MAX_FOOTER_BYTES = 2**24
MAX_TEXT = 1_000
"""Characters of one text in Parquet: a dictionary can repeat a long one for the price of a bit."""

PARQUET_MAGIC = b"PAR1"
_PER_DAY = {unit: 86_400 * 10**power for unit, power in {"s": 0, "ms": 3, "us": 6, "ns": 9}.items()}
_FIRST_DAY = date.min.toordinal() - date(1970, 1, 1).toordinal()
_END_DAY = date.max.toordinal() + 1 - date(1970, 1, 1).toordinal()


class ParquetSource(FormatSource):
    """An open Parquet file. Keys in the names of its folders, `car=A7`, are columns of text."""

    has_clock = False

    def __init__(self, stream: pa.NativeFile, budget: Budget) -> None:
        """Take the bytes of a file, and what it may become."""
        _require_small_footer(stream, budget.file)
        self._file, self._stream = budget.file, stream
        parquet = pq.ParquetFile(stream)
        _require_within(budget, parquet.metadata)
        self._schema, self._rows = parquet.schema_arrow, parquet.metadata.num_rows
        keys = partition_keys(budget.file).items()
        self._keys = {name: text for name, text in keys if name not in self._schema.names}

    def channels(self) -> list[Channel]:
        """Return the columns."""
        readable = [f.name for f in self._schema if is_readable(f.type)]
        return [Channel(name) for name in (*readable, *self._keys)]

    def find(self, column: str) -> tuple[str, str | None]:
        """Return what a folder says of a column, or None. Raises `InputError`."""
        find_column(self._file, [*self._schema.names, *self._keys], column)
        if column not in self._keys:  # before anything is decoded: one list can be all of a file
            _require_readable(self._schema.field(column).type, column, self._file)
        return "", self._keys.get(column)

    def count(self, _base: str, _found: dict[str, Any]) -> int:
        """Return how many rows there are."""
        return int(self._rows)

    def read(self, _base: str, found: dict[str, Any]) -> Iterator[pl.DataFrame]:
        """Yield rows. Raises `InputError`."""
        inside = [name for name, text in found.items() if text is None]
        keys = [pl.lit(text).alias(name) for name, text in found.items() if text is not None]
        texts = [name for name in inside if _is_text(self._schema.field(name).type)]
        # Buffered before, the bytes of the whole file would stay in memory until its end; and
        # without a buffer those of each column of a row group, of which a file may have only one.
        parquet = pq.ParquetFile(
            self._stream,
            read_dictionary=texts,
            page_checksum_verification=True,
            pre_buffer=False,
            buffer_size=BUFFER_BYTES,
        )
        for batch in parquet.iter_batches(BATCH_ROWS, columns=inside):
            plain = {name: plain_column(batch.column(name), name, self._file) for name in inside}
            yield pl.DataFrame(pa.table(plain)).with_columns(keys)


@contextmanager
def open_parquet(budget: Budget) -> Iterator[ParquetSource]:
    """Open a Parquet file. Raises `InputError`."""
    # Not Python's own file: each read of Arrow's threads would wait for the interpreter.
    with pa.OSFile(os.fsencode(budget.file), "rb") as stream:
        yield ParquetSource(stream, budget)


def partition_keys(file: Path) -> dict[str, str]:
    """Return what the folders above a file say of it, as Hive writes it: `key=value`."""
    named = (part.partition("=") for part in file.parts[:-1])
    return {key: unquote(text) for key, equals, text in named if key and equals}


def _require_small_footer(stream: pa.NativeFile, file: Path) -> None:
    tail = stream.read_at(8, max(0, stream.size() - 8))
    if tail[4:] == PARQUET_MAGIC and int.from_bytes(tail[:4], "little") > MAX_FOOTER_BYTES:
        raise InputError(
            f"{shown(file)}: its footer is too large. Write fewer columns or row groups."
        )


def _require_within(budget: Budget, metadata: pq.FileMetaData) -> None:
    """Raise `InputError` for more rows or bytes than a file can have, or those of another file."""
    groups = [metadata.row_group(number) for number in range(metadata.num_row_groups)]
    values = [[group.column(i).num_values for i in range(group.num_columns)] for group in groups]
    rows = sum(max([group.num_rows, *of]) for group, of in zip(groups, values, strict=True))
    budget.require_rows(max(rows, metadata.num_rows))
    budget.require_unfolded(sum(group.total_byte_size for group in groups))
    if any(group.num_columns and group.column(0).file_path for group in groups):
        raise InputError(
            f"{shown(budget.file)}: its values are in other files: it is the index of a dataset. "
            "Give the files themselves."
        )


def is_readable(kind: pa.DataType) -> bool:
    """Whether a column of this type is text, a number or a time."""
    if pa.types.is_dictionary(kind):
        kind = kind.value_type
    tests = (_is_text, pa.types.is_integer, pa.types.is_floating, pa.types.is_decimal)
    times = (pa.types.is_date, pa.types.is_timestamp, pa.types.is_null)
    return any(is_it(kind) for is_it in (*tests, *times))


def _is_text(arrow_type: pa.DataType) -> bool:
    if pa.types.is_dictionary(arrow_type):
        arrow_type = arrow_type.value_type
    return bool(pa.types.is_string(arrow_type) or pa.types.is_large_string(arrow_type))


def plain_column(array: pa.Array, name: str, file: Path) -> pa.Array:
    """Return a column as text, float64, date or timestamp. Raises `InputError` for others."""
    array.validate(full=True)  # what Parquet calls text need not be UTF-8, and Polars trusts it
    if pa.types.is_dictionary(array.type):
        longest = pc.max(pc.utf8_length(array.dictionary)).as_py() if _is_text(array.type) else 0
        if longest is not None and longest > MAX_TEXT:
            raise InputError(
                f"{shown(file)}: column {name!r} has texts of {longest:,} characters, "
                f"at most {MAX_TEXT:,} are read."
            )
        array = array.dictionary_decode()
    kind = array.type
    if _is_text(kind):
        return array
    if pa.types.is_date(kind) or pa.types.is_timestamp(kind):
        return _in_calendar(array)
    _require_readable(kind, name, file)  # then it is a number, or null
    return pc.cast(array, pa.float64(), safe=False)


def _require_readable(kind: pa.DataType, name: str, file: Path) -> None:
    if not is_readable(kind):
        raise InputError(
            f"{shown(file)}: column {name!r} has the type {shown(kind)[:80]}, which is neither a "
            "number, text nor a time. Convert it or map another one."
        )


def _in_calendar(array: pa.Array) -> pa.Array:
    """Return dates or timestamps, null outside the years 1 to 9999: Polars would panic."""
    kind = array.type
    if pa.types.is_date32(kind):
        counts, per_day = pc.cast(pc.cast(array, pa.int32()), pa.int64()), 1
    else:
        unit = "ms" if pa.types.is_date64(kind) else kind.unit
        counts, per_day = pc.cast(array, pa.int64()), _PER_DAY[unit]
    first, end = (max(-(2**63), min(2**63 - 1, days * per_day)) for days in (_FIRST_DAY, _END_DAY))
    inside = pc.and_(pc.greater_equal(counts, first), pc.less(counts, end))
    return pc.if_else(inside, array, pa.scalar(None, kind))


# Reads a table of a DuckDB file.

MAGIC = b"DUCK"
MAGIC_AT = 8
_NAME = "measured"
"""What the file is called as a database."""
_STORED = """
    SELECT table_name, estimated_size FROM duckdb_tables()
    WHERE database_name = $name AND schema_name = 'main' AND lower(table_name) = lower($table)
    AND table_oid NOT IN (SELECT table_oid FROM duckdb_columns() WHERE is_generated)
"""


class DuckdbRows(Config):
    """The table of a DuckDB file that is the log."""

    table: Name
    query: None = None
    """Read by earlier releases; part of a mapping's identity."""

    @field_validator("query", mode="before")
    @classmethod
    def _no_query(cls, query: object) -> None:
        if query is not None:
            raise ValueError("only tables are read: store the answer, CREATE TABLE … AS …")


class DuckdbSource(FormatSource):
    """A table of an open DuckDB file, in its order."""

    has_clock = False

    def __init__(
        self, connection: duckdb.DuckDBPyConnection, table: str, rows: int, file: Path
    ) -> None:
        """Take a connection to a file, the table, and how many rows it has."""
        self._file, self._connection, self._rows = file, connection, rows
        name = table.replace('"', '""')
        self._query = f'SELECT * FROM {_NAME}.main."{name}"'

    def channels(self) -> list[Channel]:
        """Return the columns."""
        return [Channel(name) for name in self._connection.sql(self._query).columns]

    def find(self, column: str) -> tuple[str, int]:
        """Return where a column is. Raises `InputError`."""
        return "", find_column(self._file, [one.name for one in self.channels()], column)

    def count(self, _base: str, _found: dict[str, Any]) -> int:
        """Return how many rows there are."""
        return self._rows

    def read(self, _base: str, found: dict[str, Any]) -> Iterator[pl.DataFrame]:
        """Yield rows. Raises `InputError`."""
        for batch in self._connection.sql(self._query).to_arrow_reader(BATCH_ROWS):
            plain = {n: plain_column(batch.column(n), n, self._file) for n in found}
            yield pl.DataFrame(pa.table(plain))


@contextmanager
def open_duckdb(rows: DuckdbRows, budget: Budget) -> Iterator[DuckdbSource]:
    """Open a DuckDB file for reading. Raises `InputError`.

    What is read must stand in the file: views, macros and generated columns can compute anything.
    """
    file = budget.file
    if os.path.lexists(f"{file}.wal"):
        raise InputError(
            f"{shown(file)}: beside it is a .wal file with rows that are not in it yet. Open and "
            "close it with DuckDB."
        )
    with TemporaryDirectory(prefix="fleet-slip-") as folder:
        # One thread: the order of rows, and so the ticks, may depend on nothing but the file.
        settings: dict[str, Any] = {
            "threads": 1,
            "memory_limit": f"{memory_bytes() // 2 // 2**20}MiB",
            "temp_directory": folder,
            "max_temp_directory_size": f"{budget.unfolded}B",
            "autoinstall_known_extensions": False,
            "autoload_known_extensions": False,
        }
        with duckdb.connect(config=settings) as connection:
            connection.execute(f"ATTACH {sql_text(str(file))} AS {_NAME} (TYPE duckdb, READ_ONLY)")
            connection.execute("SET enable_external_access = false")
            connection.execute("SET lock_configuration = true")
            asked = {"name": _NAME, "table": rows.table}
            stored = connection.execute(_STORED, asked).fetchall()
            if not stored:
                raise InputError(
                    f"{shown(file)}: it has no table {rows.table!r}, or it is a view, or has "
                    "generated columns: what a file computes is not read. Store it: CREATE TABLE "
                    "… AS FROM …"
                )
            budget.require_rows(stored[0][1])
            yield DuckdbSource(connection, rows.table, stored[0][1], file)
