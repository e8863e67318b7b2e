"""DuckDB views of the tables of a data root, over one snapshot of each."""

import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Any

import duckdb
import pyarrow as pa

from fleet_slip.catalog.course import COURSE_LATE
from fleet_slip.catalog.signals import ALL_DRIVES, SAMPLE_TIME_S, SignalCatalog
from fleet_slip.columns.column_sql import with_absent
from fleet_slip.config import load_toml
from fleet_slip.errors import ConflictError
from fleet_slip.resources import folder, read_sql
from fleet_slip.storage.table import Snapshot, absent_columns
from fleet_slip.warehouse.database import database_errors, open_database
from fleet_slip.warehouse.erasure_log import find_erased, without_erased
from fleet_slip.warehouse.warehouse import Warehouse

TABLE_VIEWS = ("log_counts", "log", "grams", "drives", "quarantine")
"""Views in the order of their dependence; each is a file in `warehouse/`."""

_VIEWS_ON_VIEWS = {"log": {"log_counts"}, "drives": {"log_counts", "grams"}}
_STORED_IN = {"log_counts": "logs", "grams": "grams", "quarantine": "quarantine"}

SNAPSHOTS = 100
"""Attempts to read two tables at one moment while others change them."""


def connect_tables(warehouse: Warehouse, query: str) -> duckdb.DuckDBPyConnection:
    """Return a locked connection with the views that a query names. Raises `StorageError`."""
    warehouse.require()
    views = views_in(query)
    snapshots = table_snapshots(warehouse, views)
    database = open_tables(warehouse, views, snapshots)
    lock(database, paths_of(snapshots, views))
    return database


def views_in(query: str, views: Iterable[str] = TABLE_VIEWS) -> frozenset[str]:
    """Return the views that a query may need: those whose name occurs in it as a word.

    Includes the views that these are made of. DuckDB's `get_table_names` binds the query, so that
    JOIN USING, UNPIVOT, COLUMNS and parameters are errors without the views.
    """
    named = {name for name in views if re.search(rf"\b{name}\b", query, re.I)}
    return frozenset(named.union(*(_VIEWS_ON_VIEWS.get(name, ()) for name in named)))


def table_snapshots(warehouse: Warehouse, views: Iterable[str]) -> list[Snapshot]:
    """Return snapshots of the tables that some views read."""
    stored = {_STORED_IN[name] for name in views if name in _STORED_IN}
    snapshots = [warehouse.quarantine.snapshot()] if "quarantine" in stored else []
    if "grams" in stored:  # Gram rows count while their log file is active
        return [*snapshots, *gram_snapshots(warehouse)]
    return [*snapshots, warehouse.logs.snapshot()] if "logs" in stored else snapshots


def gram_snapshots(
    warehouse: Warehouse, grams: Snapshot | None = None, logs: Snapshot | None = None
) -> tuple[Snapshot, Snapshot]:
    """Return the newest `grams` and `logs` of the same moment.

    Returns the given snapshots if nobody committed since. Raises `ConflictError` if the Gram rows
    change faster than they can be read.
    """
    grams = grams.refresh() if grams else warehouse.grams.snapshot()
    for _ in range(SNAPSHOTS):
        logs = logs.refresh() if logs else warehouse.logs.snapshot()
        newest_grams = grams.refresh()
        if newest_grams is grams or newest_grams.version == grams.version:
            return grams, logs
        grams = newest_grams
    raise ConflictError(
        f"{warehouse.root}: other processes keep changing it. Run the same command again."
    )


def paths_of(snapshots: Iterable[Snapshot], views: Iterable[str]) -> list[str]:
    """Return the data files of snapshots that some views read, as DuckDB opens them."""
    read = {_STORED_IN[name] for name in views if name in _STORED_IN}
    return [
        path
        for snapshot in snapshots
        if snapshot.table.folder.name in read
        for path in snapshot.paths
    ]


def open_tables(
    warehouse: Warehouse,
    views: Iterable[str],
    snapshots: Sequence[Snapshot],
    *,
    threads: int | None = None,
    drives: str = ALL_DRIVES,
) -> duckdb.DuckDBPyConnection:
    """Return an unlocked connection with some views on snapshots of their tables.

    Logs and Gram rows are those of `drives`, an SQL predicate. No view has rows of
    erased cars and drives, even if the tables have them again.
    """
    database = open_database(threads=threads, reading=warehouse.root, spill=True)
    tables = {snapshot.table.folder.name: snapshot for snapshot in snapshots}
    if "grams" in tables:
        active = [file.path for file in tables["logs"].files]
        database.execute("SET VARIABLE active_log_files = $active", {"active": active})
    read = {_STORED_IN[name] for name in views if name in _STORED_IN}
    if not read:
        return database
    signals = warehouse.catalog.signals
    sources = {f"stored_{name}": _source(database, tables[name], signals) for name in read}
    if drives != ALL_DRIVES:
        for name in sources.keys() - {"stored_quarantine"}:
            sources[name] = f"(FROM {sources[name]} WHERE {drives})"
    erased = find_erased(warehouse.root, warehouse.grams, snapshots)
    for column, names in erased.by_column.items():
        database.execute(f"SET VARIABLE erased_{column} = $names", {"names": names})
    sources = {name: without_erased(rows, erased) for name, rows in sources.items()}
    columns = _generated_columns(signals)
    with database_errors(f"opening the warehouse {warehouse.root}"):
        for view in TABLE_VIEWS:
            if view in views:
                database.execute(read_sql("warehouse", f"{view}.sql").format(**columns, **sources))
    return database


def lock(database: duckdb.DuckDBPyConnection, paths: Sequence[str]) -> None:
    """Restrict a connection to some files, and lock its settings."""
    database.execute("SET python_enable_replacements = false")
    database.execute("SET allowed_paths = $paths", {"paths": list(paths)})
    database.execute("SET enable_external_access = false")
    database.execute("SET lock_configuration = true")


def add_table(database: duckdb.DuckDBPyConnection, name: str, rows: pa.Table) -> None:
    """Copy rows into a table of the connection."""
    database.register("incoming", rows)
    database.execute(f"CREATE TABLE {name} AS FROM incoming")
    database.unregister("incoming")


def _source(database: duckdb.DuckDBPyConnection, snapshot: Snapshot, signals: SignalCatalog) -> str:
    """Return the SQL after FROM for a stored table, also for an empty one."""
    variable = f"{snapshot.table.folder.name.removesuffix('s')}_files"
    database.execute(f"SET VARIABLE {variable} = $paths", {"paths": snapshot.paths})
    if snapshot.paths:
        rows = read_sql("warehouse", f"stored_{snapshot.table.folder.name}.sql").replace("{{", "{")
        if snapshot.table.folder.name == "logs":
            differ = not snapshot.has_same_columns
            database.execute("SET VARIABLE log_columns_differ = $differ", {"differ": differ})
        columns = [n for n in signals.stored_columns if n in snapshot.table.schema.names]
        if COURSE_LATE in absent_columns(snapshot.files, snapshot.table.optional):
            rows = f"(SELECT *, NULL::BIGINT AS {COURSE_LATE} FROM {rows})"
        return with_absent(signals, rows, absent_columns(snapshot.files, columns))
    empty = f"empty_{snapshot.table.folder.name}"
    add_table(database, empty, snapshot.table.schema.empty_table())
    return empty


def _generated_columns(signals: SignalCatalog) -> Mapping[str, Any]:
    separator = ",\n    "
    return {
        "drive_columns": separator.join(signals.drive),
        "drive_columns_but_rows": separator.join(n for n in signals.drive if n != "rows"),
        "signals": separator.join(signals.signals),
        "si_columns": separator.join(
            f"{name} * {signal.scale}::DOUBLE AS {signal.column}"
            for name, signal in signals.signals.items()
        ),
        "samples_per_second": int(1 / SAMPLE_TIME_S),
    }


# Descriptions of the columns of all views, as a table.

COMMON = "common"
"""Section of `warehouse/columns.toml` for columns of several views."""


@cache
def column_descriptions() -> dict[str, dict[str, dict[str, str]]]:
    """Return description and unit of columns, by view and column, from `warehouse/columns.toml`."""
    return load_toml(folder("warehouse") / "columns.toml")


def describe_columns(database: duckdb.DuckDBPyConnection, signals: SignalCatalog) -> pa.Table:
    """Return the columns of all views with unit and description."""
    by_view = column_descriptions()
    common = {name: {"description": column.description} for name, column in signals.drive.items()}
    for name, signal in signals.signals.items():
        for column, unit in ((name, f"{signal.scale} {signal.unit}"), (signal.column, signal.unit)):
            common[column] = {"description": signal.description, "unit": unit}
    common |= by_view[COMMON]
    columns = database.execute(
        "SELECT table_name, column_name, data_type FROM duckdb_columns() "
        "WHERE NOT internal AND NOT starts_with(table_name, 'empty_') "
        "ORDER BY table_name, column_index"
    ).fetchall()
    rows = []
    for view, column, data_type in columns:
        description = by_view.get(view, {}).get(column) or common.get(column) or {}
        row = {"view": view, "column": column, "type": data_type}
        rows.append(row | {key: description.get(key, "") for key in ("unit", "description")})
    return pa.Table.from_pylist(rows)
