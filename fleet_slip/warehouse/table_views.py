"""DuckDB views of the tables of a data root, over one snapshot of each."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import duckdb
import pyarrow as pa

from fleet_slip.catalogue.feature_sql import with_absent
from fleet_slip.catalogue.signals import SAMPLE_TIME_S, SignalCatalogue, catalogue
from fleet_slip.delta import Snapshot, absent_columns
from fleet_slip.resources import read_sql
from fleet_slip.warehouse.database import database_errors, open_database
from fleet_slip.warehouse.tables import Warehouse

TABLE_VIEWS = ("log_counts", "log", "grams", "drives", "quarantine")
"""In the order of their dependence; each is a file in `warehouse/`."""

_VIEWS_ON_VIEWS = {"log": {"log_counts"}, "drives": {"log_counts", "grams"}}
_STORED_IN = {"log_counts": "logs", "grams": "grams", "quarantine": "quarantine"}


def connect_tables(warehouse: Warehouse, query: str) -> duckdb.DuckDBPyConnection:
    """Return a locked connection with the views of the tables that a query names.

    Raises `StorageError` if there is no data root.
    """
    warehouse.require()
    wanted = views_in(query)
    snapshots = table_snapshots(warehouse, wanted)
    database = open_tables(warehouse, wanted, snapshots)
    lock(database, paths_of(snapshots))
    return database


def views_in(query: str, known: Iterable[str] = TABLE_VIEWS) -> frozenset[str]:
    """Return the views that a query may need: those whose name occurs in it as a word.

    And what these are made of. DuckDB's own `get_table_names` is no help here: it binds the query,
    so that JOIN USING, UNPIVOT, COLUMNS and parameters are errors before the views are there. A
    word too many only opens a view too many.
    """
    named = {name for name in known if re.search(rf"\b{name}\b", query, re.I)}
    return frozenset(named.union(*(_VIEWS_ON_VIEWS.get(name, ()) for name in named)))


def table_snapshots(warehouse: Warehouse, wanted: Iterable[str]) -> list[Snapshot]:
    """Return snapshots of the tables that some views stand on."""
    stored = [_STORED_IN[name] for name in TABLE_VIEWS if name in wanted and name in _STORED_IN]
    return [getattr(warehouse, table).snapshot() for table in stored]


def paths_of(snapshots: Iterable[Snapshot]) -> list[str]:
    """Return the data files of snapshots, as DuckDB opens them."""
    return [path for snapshot in snapshots for path in snapshot.paths]


def open_tables(
    warehouse: Warehouse,
    wanted: Iterable[str],
    snapshots: Sequence[Snapshot],
    *,
    threads: int | None = None,
) -> duckdb.DuckDBPyConnection:
    """Return a connection with some of the views, on snapshots of the tables that they stand on.

    It is not locked yet; see `lock`.
    """
    database = open_database(threads=threads, reading=warehouse.root, spill=True)
    sources = {
        f"stored_{snapshot.table.folder.name}": _source(database, snapshot)
        for snapshot in snapshots
    }
    columns = _generated_columns(warehouse.catalogue)
    with database_errors(f"opening the warehouse {warehouse.root}"):
        for view in TABLE_VIEWS:
            if view in wanted:
                database.execute(read_sql("warehouse", f"{view}.sql").format(**columns, **sources))
    return database


def lock(database: duckdb.DuckDBPyConnection, paths: Sequence[str]) -> None:
    """Let a connection open some files and no others, and its settings not be changed."""
    database.execute("SET python_enable_replacements = false")
    database.execute("SET allowed_paths = $paths", {"paths": list(paths)})
    database.execute("SET enable_external_access = false")
    database.execute("SET lock_configuration = true")


def add_table(database: duckdb.DuckDBPyConnection, name: str, rows: pa.Table) -> None:
    """Copy rows into a table of the connection."""
    database.register("incoming", rows)
    database.execute(f"CREATE TABLE {name} AS FROM incoming")
    database.unregister("incoming")


def _source(database: duckdb.DuckDBPyConnection, snapshot: Snapshot) -> str:
    """Return what stands after FROM for a stored table, empty ones included."""
    variable = f"{snapshot.table.folder.name.removesuffix('s')}_files"
    database.execute(f"SET VARIABLE {variable} = $paths", {"paths": snapshot.paths})
    if snapshot.paths:
        rows = read_sql("warehouse", f"stored_{snapshot.table.folder.name}.sql").replace("{{", "{")
        if snapshot.table.folder.name != "logs":
            return rows
        differ = not snapshot.has_same_columns
        database.execute("SET VARIABLE log_columns_differ = $differ", {"differ": differ})
        return with_absent(rows, absent_columns(snapshot.files, catalogue().signals))
    empty = f"empty_{snapshot.table.folder.name}"
    add_table(database, empty, snapshot.table.schema.empty_table())
    return empty


def _generated_columns(signals: SignalCatalogue) -> Mapping[str, Any]:
    separator = ",\n    "
    return {
        "drive_columns": separator.join(signals.drive),
        "signals": separator.join(signals.signals),
        "si_columns": separator.join(
            f"{name} * {signal.scale}::DOUBLE AS {signal.column}"
            for name, signal in signals.signals.items()
        ),
        "samples_per_second": int(1 / SAMPLE_TIME_S),
    }
