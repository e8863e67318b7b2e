"""SQL views of a data root, of one moment: its tables, the models and the history of runs."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Self, TypeVar

import duckdb
import pyarrow as pa

from fleet_slip.catalog.signals import ALL_DRIVES, TRAINING_DRIVES
from fleet_slip.errors import QueryGoesOnError, QuestionError
from fleet_slip.storage.folder import Folder
from fleet_slip.storage.runs import add_runs
from fleet_slip.warehouse import table_views
from fleet_slip.warehouse.database import database_errors, interruptible, one_query, reading_files
from fleet_slip.warehouse.warehouse import Warehouse, open_warehouse

VIEWS = frozenset({*table_views.TABLE_VIEWS, "runs", "models", "dictionary"})

_ABOUT_ALL_VIEWS = re.compile(
    r"duckdb_|information_schema|pragma_|pg_|sqlite_|\b(?:show|tables|databases|dictionary)\b", re.I
)

_READS_TABLE = re.compile(r"\b(?:from|join|describe|summarize|pivot|unpivot|table)\b", re.I)

_SOURCE = re.compile(r"\bsource\b", re.I)


def connect(
    root: Folder | Path | str | None = None,
    *,
    config: Path | str | None = None,
    threads: int | None = None,
    query: str | None = None,
) -> duckdb.DuckDBPyConnection:
    """Return a DuckDB connection with the views of the warehouse at `root`, a path or a URL.

    `log` (SI units), `log_counts`, `drives`, `grams`, `models`, `quarantine`, `runs` and
    `dictionary`, which documents every column, all of one snapshot. With a `query`, only those that
    it names, which is faster. Drives that models are tested on are there if it names the column
    `source`.

    It opens the files of the snapshot only, and its settings are locked. DuckDB has no read-only
    access to files: run untrusted SQL through `Fleet.sql`.
    """
    return open_views(open_warehouse(root, config), query, threads)


def open_views(
    warehouse: Warehouse, query: str | None, threads: int | None = None, *, unlocked: bool = False
) -> duckdb.DuckDBPyConnection:
    """Return a connection as `connect` does; `unlocked`, it opens any file and takes settings."""
    warehouse.require()
    views = VIEWS if query is None else needed_views(query)
    snapshots = table_views.table_snapshots(warehouse, views)
    drives = ALL_DRIVES if _SOURCE.search(query or "") else TRAINING_DRIVES
    database = table_views.open_tables(warehouse, views, snapshots, threads=threads, drives=drives)
    if "runs" in views:
        add_runs(database, warehouse.root)
    if "models" in views:
        from fleet_slip.models.registry import Registry

        table_views.add_table(database, "models", Registry.open(warehouse).as_table())
    if "dictionary" in views:
        table_views.add_table(
            database,
            "dictionary",
            table_views.describe_columns(database, warehouse.catalog.signals),
        )
    if not unlocked:
        table_views.lock(database, table_views.paths_of(snapshots, views))
    return database


def needed_views(query: str) -> frozenset[str]:
    """Return the views that a query may need.

    All if it is about tables, or reads a table of another name: its error suggests one of them.
    """
    if _ABOUT_ALL_VIEWS.search(query):
        return VIEWS
    views = table_views.views_in(query, VIEWS)
    return VIEWS if not views and _READS_TABLE.search(query) else views


# Queries.

Result = TypeVar("Result")


@dataclass(frozen=True)
class Session:
    """A connection with the views of one moment, for one thread; `Fleet.session` opens one.

    Close it, or use it in a `with` block. Queries raise `QuestionError` if invalid or, unless it is
    `unlocked`, writing.
    """

    database: duckdb.DuckDBPyConnection
    unlocked: bool = False

    def sql(self, query: str) -> duckdb.DuckDBPyRelation:
        """Return the answer as a relation; relations derived from it keep the connection open."""
        text = query if self.unlocked else one_query(self.database, query)
        with database_errors("the query"):
            relation: duckdb.DuckDBPyRelation | None = self.database.sql(text)
        if relation is None:
            raise QuestionError("the query is empty.")
        return relation

    def table(self, query: str) -> pa.Table:
        """Return the answer as an Arrow table; see `compute`."""
        return self.compute(query, duckdb.DuckDBPyRelation.to_arrow_table)

    def compute(self, query: str, work: Callable[[duckdb.DuckDBPyRelation], Result]) -> Result:
        """Do work with the answer to a query; Ctrl-C ends it within a second.

        Raises `StorageError` if a file does not match its checksum.
        """

        def answer() -> Result:
            with reading_files(self.database, "the query"):
                return work(self.sql(query))

        return interruptible(self.database, answer)

    def close(self) -> None:
        """Close the connection."""
        self.database.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _: object, error: BaseException | None, _traceback: object) -> None:
        if not isinstance(error, QueryGoesOnError):
            self.close()
