"""A DuckDB connection on the warehouse: views in SI units over one snapshot of its tables."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import duckdb
import pyarrow as pa

from fleet_slip.catalogue.signals import SAMPLE_TIME_S, SignalCatalogue, catalogue
from fleet_slip.delta import Snapshot, absent_columns
from fleet_slip.files.data_root import data_root
from fleet_slip.files.folder import Folder
from fleet_slip.grams.statement import with_absent
from fleet_slip.models.versions import Registry
from fleet_slip.resources import read_sql
from fleet_slip.runs.history import lend_runs
from fleet_slip.runs.log import RECORD_COLUMNS
from fleet_slip.warehouse.database import database_errors, open_database
from fleet_slip.warehouse.tables import Warehouse

VIEWS = ("log_counts", "log", "grams", "drives", "quarantine", "runs")
"""In the order of their dependence; each is a file in `warehouse/`."""

VIEWS_ON_VIEWS = {"log": {"log_counts"}, "drives": {"log_counts", "grams"}}
STORED_IN = {"log_counts": "logs", "grams": "grams", "quarantine": "quarantine"}
TABLES = frozenset({*VIEWS, "models", "dictionary"})

_ABOUT_ALL_TABLES = re.compile(
    r"duckdb_|information_schema|pragma_|pg_|sqlite_|\b(?:show|tables|databases|dictionary)\b", re.I
)


def connect(
    root: Folder | Path | str | None = None,
    *,
    threads: int | None = None,
    locked: bool = True,
    query: str | None = None,
) -> duckdb.DuckDBPyConnection:
    """Return a DuckDB connection with the views of the warehouse at `root`, a path or a URL.

    `log` (SI units), `log_counts`, `drives`, `grams`, `models`, `quarantine`, `runs` and
    `dictionary`, which documents every column. The connection sees one snapshot; connect again to
    see later commits. With a `query`, only the views that it names are there: opening the logs
    takes longer the more files there are, and so does reading every model version.

    Locked, it can open the files of the snapshot and no others, and its settings cannot be
    changed. DuckDB knows no right to read without the right to write: run SQL of others through
    `fleet_slip.warehouse.read_only_sql.one_query` first, as the command line does.
    """
    warehouse = Warehouse(data_root(root))
    warehouse.require()
    wanted = TABLES if query is None else tables_in(query)
    stored = [STORED_IN[name] for name in VIEWS if name in wanted and name in STORED_IN]
    snapshots = [getattr(warehouse, table).snapshot() for table in stored]
    return open_views(warehouse, wanted, snapshots, threads=threads, locked=locked)


def open_views(
    warehouse: Warehouse,
    wanted: frozenset[str],
    snapshots: Sequence[Snapshot],
    *,
    threads: int | None = None,
    locked: bool = True,
) -> duckdb.DuckDBPyConnection:
    """Return a connection with some of the views, on snapshots of the tables that they stand on."""
    database = open_database(threads=threads, reading=warehouse.root, spill=True)
    sources = {
        f"stored_{snapshot.table.folder.name}": _source(database, snapshot)
        for snapshot in snapshots
    }
    paths = [path for snapshot in snapshots for path in snapshot.paths]
    if "runs" in wanted:
        runs = lend_runs(warehouse.root, database)
        sources["stored_runs"] = run_source(database, runs)
        paths += runs
    columns = _generated_columns(warehouse.catalogue)
    with database_errors(f"opening the warehouse {warehouse.root}"):
        for view in VIEWS:
            if view in wanted:
                database.execute(read_sql("warehouse", f"{view}.sql").format(**columns, **sources))
    if "models" in wanted:
        _add_table(database, "models", Registry(warehouse.root / "models").as_table())
    if "dictionary" in wanted:
        _add_table(database, "dictionary", _dictionary(database, warehouse.catalogue))
    if locked:
        _lock(database, paths)
    return database


def tables_in(query: str) -> frozenset[str]:
    """Return the tables and views that a query may need: those whose name occurs in it as a word.

    And what these are made of. All, if it names none, or asks about tables.
    """
    named = {name for name in TABLES if re.search(rf"\b{name}\b", query, re.I)}
    if not named or _ABOUT_ALL_TABLES.search(query):
        return TABLES
    return frozenset(named.union(*(VIEWS_ON_VIEWS.get(name, ()) for name in named)))


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
    _add_table(database, empty, snapshot.table.schema.empty_table())
    return empty


def run_source(database: duckdb.DuckDBPyConnection, files: list[str]) -> str:
    """Return what stands after FROM for the history of runs, or some of its files."""
    columns = ", ".join(f"{name} {kind}" for name, kind in RECORD_COLUMNS.items())
    database.execute("SET VARIABLE run_files = $paths", {"paths": files})
    if files:
        return read_sql("warehouse", "stored_runs.sql").format(run_columns=RECORD_COLUMNS)
    database.execute(f"CREATE TABLE empty_runs ({columns})")
    return "empty_runs"


def _add_table(database: duckdb.DuckDBPyConnection, name: str, rows: pa.Table) -> None:
    database.register("incoming", rows)
    database.execute(f"CREATE TABLE {name} AS FROM incoming")
    database.unregister("incoming")


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


def _dictionary(database: duckdb.DuckDBPyConnection, signals: SignalCatalogue) -> pa.Table:
    """Comment the views' columns, and return all columns with unit and description as a table."""
    described = {name: ("", column.description) for name, column in signals.drive.items()}
    described |= {
        name: (f"{s.scale} {s.unit}", s.description) for name, s in signals.signals.items()
    }
    described |= {s.column: (s.unit, s.description) for s in signals.signals.values()}
    described |= _OTHER_COLUMNS
    found = database.execute(
        "SELECT table_name, column_name, data_type FROM duckdb_columns() "
        "WHERE NOT internal AND NOT starts_with(table_name, 'empty_') "
        "ORDER BY table_name, column_index"
    ).fetchall()
    rows = []
    for view, column, data_type in found:
        unit, description = described.get(column, ("", ""))
        rows.append(
            {
                "view": view,
                "column": column,
                "type": data_type,
                "unit": unit,
                "description": description,
            }
        )
        if description:
            text = f"{description} [{unit}]" if unit else description
            quoted = text.replace("'", "''")
            database.execute(f"COMMENT ON COLUMN {view}.{column} IS '{quoted}'")
    return pa.Table.from_pylist(rows)


_OTHER_COLUMNS = {
    "day": ("", "Date of the drive"),
    "tick": ("0.01 s", "Samples since the drive began; every drive has a row with tick 0"),
    "time_s": ("s", "Time since the drive began"),
    "rows": ("", "Of a drive: as the Gram job counted them. Of a run: of its largest step"),
    "feature_set": (
        "",
        "Which columns were multiplied: signals, or a set of features.toml",
    ),
    "file": ("", "File below logs/ that the Gram row was computed from, or the file ingested"),
    "signals": ("", "Signals of a Gram row or model, separated by commas, in the order of sums"),
    "part": ("", "Rows of the drive that a Gram row is of, such as a speed band; null: all"),
    "n": ("", "Number of rows in the sums"),
    "clipped": ("", "Number of values of features that were clipped to the range of int16"),
    "sums": ("counts", "Sum of each signal's counts"),
    "products": (
        "counts^2",
        "Sums of products, lower triangle row by row: (0,0), (1,0), (1,1) ...",
    ),
    "row": ("", "Row of the ingested file, from 1"),
    "reason": ("", "Why the row was refused"),
    "signal": ("", "The signal that was wrong"),
    "value": ("", "The refused value, as text"),
    "name": ("", "Name of the model"),
    "version": ("", "Number of the model version: 1, 2, 3 ..."),
    "aliases": ("", "Aliases that point at the version now, separated by commas"),
    "published_at": ("", "When the version was published, UTC"),
    "correlation": ("", "Pooled cross-validated correlation"),
    "rmse_deg": ("deg", "Cross-validated root mean square error"),
    "error_mean_deg": ("deg", "Cross-validated mean of the error, estimate minus truth"),
    "error_std_deg": ("deg", "Cross-validated standard deviation of the error"),
    "cohort": ("", "SQL condition on drives that the model was trained on"),
    "drives": ("", "Number of drives that the model was trained on"),
    "sha256": ("", "Checksum of the manifest"),
    "run_id": ("", "Name of a run of a command; sorts by the time of its start"),
    "command": ("", "The command that ran"),
    "arguments": ("", "Its command line, without what may be secret"),
    "started_at": ("", "When the run started, by the clock of its host"),
    "ended_at": ("", "When the run ended; null if it is under way or was killed"),
    "outcome": ("", "done, failed or interrupted; null if the run is under way or was killed"),
    "exit_code": ("", "Exit code of the command"),
    "error": ("", "Why the run failed"),
    "seconds": ("s", "How long the run took"),
    "size_bytes": ("", "Size of the data files that the run wrote"),
    "steps": ("", "Steps of the run: name, seconds, rows, size of the data files written"),
    "host": ("", "Name of the machine"),
    "process": ("", "Number of the process"),
    "package_version": ("", "Version of fleet-slip"),
}


def _lock(database: duckdb.DuckDBPyConnection, paths: list[str]) -> None:
    database.execute("SET python_enable_replacements = false")
    database.execute("SET allowed_paths = $paths", {"paths": paths})
    database.execute("SET enable_external_access = false")
    database.execute("SET lock_configuration = true")
