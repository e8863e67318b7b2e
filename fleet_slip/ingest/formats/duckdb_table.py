"""Reads a table or a query of a DuckDB file."""

import json
import os
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import duckdb
import polars as pl
import pyarrow as pa
from pydantic import model_validator

from fleet_slip.config import Config, Name
from fleet_slip.errors import InputError, QuestionError
from fleet_slip.ingest.formats.budget import Budget
from fleet_slip.ingest.formats.log_source import Channel, require_columns
from fleet_slip.ingest.formats.parquet_batches import BATCH_ROWS, plain_column
from fleet_slip.limits import memory_bytes
from fleet_slip.warehouse.database import sql_text
from fleet_slip.warehouse.read_only_sql import one_query
from fleet_slip.words import shown

MAGIC = b"DUCK"
MAGIC_AT = 8
_NAME = "measured"
"""What the file is called as a database."""
_COMPUTED = """
    SELECT view_name FROM duckdb_views() WHERE NOT internal
    UNION ALL SELECT function_name FROM duckdb_functions() WHERE NOT internal
    UNION ALL SELECT table_name FROM duckdb_columns() WHERE is_generated AND NOT internal
"""
_TABLES = "SELECT table_name, estimated_size FROM duckdb_tables() WHERE NOT internal"
_LOOK_S = 0.1


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

    def __init__(
        self, connection: duckdb.DuckDBPyConnection, rows: DuckdbRows, budget: Budget
    ) -> None:
        """Take a connection to a file, which rows of it, and what it may become."""
        self._file, self._connection, self._budget = budget.file, connection, budget
        name = (rows.table or "").replace('"', '""')
        self._query = rows.query or f'SELECT * FROM "{name}"'

    def channels(self) -> list[Channel]:
        """Return the columns."""
        with _duckdb_errors(self._file), _in_time(self._connection, self._budget):
            return [Channel(name) for name in self._connection.sql(self._query).columns]

    def expected_rows(self, _columns: Sequence[str]) -> int:
        """Return 0: of a query only its answer tells."""
        return 0

    def batches(self, columns: Sequence[str]) -> Iterator[pl.DataFrame]:
        """Yield rows. Raises `InputError`."""
        with _duckdb_errors(self._file):
            with _in_time(self._connection, self._budget):
                rows = self._connection.sql(self._query)
                require_columns(self._file, rows.columns, columns)
                batches = rows.to_arrow_reader(BATCH_ROWS)
            while True:
                with _in_time(self._connection, self._budget):
                    batch = next(batches, None)
                if batch is None:
                    return
                plain = {n: plain_column(batch.column(n), n, self._file) for n in columns}
                yield pl.DataFrame(pa.table(plain))


@contextmanager
def open_duckdb(rows: DuckdbRows, budget: Budget) -> Iterator[DuckdbSource]:
    """Open a DuckDB file for reading. Raises `InputError`.

    What is read must stand in the file: no view, macro or generated column of it has a say, since
    these can compute anything, and go by the name of any function.
    """
    file = budget.file
    if os.path.lexists(f"{file}.wal"):
        raise InputError(
            f"{shown(file)}: beside it is a .wal file with rows that are not in it yet. Open and "
            "close it with DuckDB."
        )
    with TemporaryDirectory(prefix="fleet-slip-") as folder, _duckdb_errors(file):
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
            _require_stored(connection, rows, budget)
            connection.execute(f"USE {_NAME}")
            yield DuckdbSource(connection, rows, budget)


def _require_stored(
    connection: duckdb.DuckDBPyConnection, rows: DuckdbRows, budget: Budget
) -> None:
    """Raise `InputError` for rows that do not stand in tables of the file, or too many of them."""
    named = {rows.table or ""}
    if rows.query is not None:
        try:
            named = _names_in(connection, one_query(connection, rows.query))
        except QuestionError as error:
            raise InputError(f"{shown(budget.file)}: [duckdb] in the mapping: {error}") from None
    named = {name.casefold() for name in named}
    for (name,) in connection.execute(_COMPUTED).fetchall():
        if name.casefold() in named:
            raise InputError(
                f"{shown(budget.file)}: {name!r} is a view, a macro or a table with generated "
                "columns, and what a file computes is not read. Store it: CREATE TABLE … AS FROM …"
            )
    for name, size in connection.execute(_TABLES).fetchall():
        if name.casefold() in named:
            budget.require_rows(size)


def _names_in(connection: duckdb.DuckDBPyConnection, query: str) -> set[str]:
    """Return the names of all tables, views and functions in a query."""
    statement = "SELECT json_serialize_sql($text::VARCHAR)"
    [(tree,)] = connection.execute(statement, {"text": query}).fetchall()
    found: set[str] = set()

    def note(node: dict[str, Any]) -> dict[str, Any]:
        found.update(str(node[key]) for key in ("table_name", "function_name") if key in node)
        return node

    json.loads(tree, object_hook=note)
    return found


@contextmanager
def _in_time(connection: duckdb.DuckDBPyConnection, budget: Budget) -> Iterator[None]:
    """Interrupt what a connection does when the time is over. Raises `InputError`."""
    done, over = threading.Event(), threading.Event()

    def watch() -> None:
        if not done.wait(budget.seconds):
            over.set()
            while not done.wait(_LOOK_S):  # it forgets an interruption between two tasks
                connection.interrupt()

    threading.Thread(target=watch, daemon=True).start()
    try:
        yield
    except Exception:
        if over.is_set():
            raise budget.over_time() from None
        raise
    finally:
        done.set()


@contextmanager
def _duckdb_errors(file: Path) -> Iterator[None]:
    try:
        yield
    except duckdb.Error as error:
        reason = " ".join(str(error).split())[:300]
        raise InputError(
            f"{shown(file)}: DuckDB says: {reason} See [duckdb] in the mapping."
        ) from None
