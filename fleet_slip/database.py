"""DuckDB connections: how they are opened, and how their errors are told."""

import contextlib
import re
from collections.abc import Iterator

import duckdb

from fleet_slip.errors import FleetSlipError, SelectionError, StorageError


def open_database(*, threads: int | None = None) -> duckdb.DuckDBPyConnection:
    """Open an in-memory database. Data stays in Parquet, so that no lock can block a reader."""
    config: dict[str, str | bool | int | float | list[str]] = {
        "autoinstall_known_extensions": False,
        "autoload_known_extensions": False,
    }
    if threads is not None:
        config["threads"] = threads
    return duckdb.connect(":memory:", config=config)


@contextlib.contextmanager
def database_errors(doing: str) -> Iterator[None]:
    """Turn DuckDB's errors into ours, saying what was being done."""
    try:
        yield
    except FleetSlipError:
        raise
    except (duckdb.IOException, duckdb.InvalidInputException, duckdb.OutOfMemoryException) as error:
        raise StorageError(f"{doing} failed: {_message(error)}. {_RESTORE}") from None
    except duckdb.Error as error:
        raise SelectionError(f"{doing} failed: {_message(error)}") from None


def _message(error: duckdb.Error) -> str:
    """Return DuckDB's message on one line, without the excerpt of the statement."""
    return " ".join(str(error).partition("\n\nLINE ")[0].split()).rstrip(".")


_RESTORE = "If a file is missing or damaged, restore it from a backup."

READING = frozenset({duckdb.StatementType.SELECT, duckdb.StatementType.EXPLAIN})


def one_query(database: duckdb.DuckDBPyConnection, text: str) -> str:
    """Return the text if it is one statement that only reads.

    Raises `SelectionError` otherwise: a query must not write files or change settings.
    """
    try:
        statements = database.extract_statements(text)
    except duckdb.Error as error:
        raise SelectionError(f"not valid SQL: {_message(error)}") from None
    if len(statements) != 1:
        raise SelectionError(f"one SQL statement is expected, not {len(statements)}.")
    statement = statements[0]
    explained = statement.type == duckdb.StatementType.EXPLAIN
    inner = (
        re.sub(r"(?is)^\s*explain(\s+analyze)?\s*(\([^)]*\))?\s*", "", text) if explained else text
    )
    if statement.type not in READING or (explained and one_query(database, inner) != inner):
        raise SelectionError(
            "only queries are allowed here (SELECT, WITH, DESCRIBE, SUMMARIZE, EXPLAIN): the "
            "warehouse is written by the jobs alone."
        )
    return text
