"""Everything that SQL can ask of a data root: its tables, the models and the history of runs."""

import re
from pathlib import Path

import duckdb

from fleet_slip.catalogue.facts import ALL_DRIVES, CALIBRATION, DELAY, TRAINING_DRIVES
from fleet_slip.catalogue.features import features
from fleet_slip.models.registry import Registry
from fleet_slip.storage.data_root import data_root
from fleet_slip.storage.folder import Folder
from fleet_slip.storage.runs import add_runs
from fleet_slip.warehouse.tables import (
    TABLE_VIEWS,
    Warehouse,
    add_table,
    describe_columns,
    lock,
    open_tables,
    paths_of,
    table_snapshots,
    views_in,
)

VIEWS = frozenset({*TABLE_VIEWS, CALIBRATION, "runs", "models", "dictionary"})

_ABOUT_ALL_VIEWS = re.compile(
    r"duckdb_|information_schema|pragma_|pg_|sqlite_|\b(?:show|tables|databases|dictionary)\b", re.I
)

_SOURCE = re.compile(r"\bsource\b", re.I)


def connect(
    root: Folder | Path | str | None = None,
    *,
    threads: int | None = None,
    query: str | None = None,
    scenarios: bool = False,
) -> duckdb.DuckDBPyConnection:
    """Return a DuckDB connection with the views of the warehouse at `root`, a path or a URL.

    `log` (SI units), `log_counts`, `drives`, `grams`, `models`, `calibration`, `quarantine`, `runs`
    and `dictionary`, which documents every column, all of one snapshot. With a `query`, only those
    that it names, which is faster; without, `calibration` waits for `add_calibration`. Drives that
    models are tested on are there with `scenarios`, or if the query names the column `source`.

    It opens the files of the snapshot and no others, and its settings cannot be changed. DuckDB
    knows no right to read without the right to write: ask SQL of others through `Fleet.sql`.
    """
    return open_views(data_root(root), query, threads, scenarios=scenarios)


def open_views(
    root: Folder,
    query: str | None,
    threads: int | None = None,
    *,
    scenarios: bool,
    unlocked: bool = False,
) -> duckdb.DuckDBPyConnection:
    """Return a connection as `connect` does; `unlocked`, it opens any file and takes settings."""
    warehouse = Warehouse(root)
    warehouse.require()
    wanted = VIEWS - {CALIBRATION} if query is None else needed_views(query)
    if CALIBRATION in wanted:
        wanted |= {"grams"}
    snapshots = table_snapshots(warehouse, wanted)
    scenarios = scenarios or _SOURCE.search(query or "") is not None
    of = ALL_DRIVES if scenarios else TRAINING_DRIVES
    database = open_tables(warehouse, wanted, snapshots, threads=threads, of=of)
    if "runs" in wanted:
        add_runs(database, warehouse.root)
    if "models" in wanted:
        add_table(database, "models", Registry(warehouse.root / "models").as_table())
    if CALIBRATION in wanted:
        _calibrate(database)
    if "dictionary" in wanted:
        add_table(database, "dictionary", describe_columns(database))
    if not unlocked:
        lock(database, paths_of(snapshots, wanted))
    return database


def add_calibration(database: duckdb.DuckDBPyConnection, query: str) -> None:
    """Compute the view `calibration` if a query names it and the connection has not got it.

    Of the Gram rows that the connection has. Raises `StorageError` if one of them is damaged.
    """
    if not views_in(query, (CALIBRATION,)):
        return
    there = database.execute("SELECT table_name FROM duckdb_tables()").fetchall()
    if (CALIBRATION,) not in there:
        _calibrate(database)


def _calibrate(database: duckdb.DuckDBPyConnection) -> None:
    # Imported when it is asked for: most queries are not about it.
    from fleet_slip.grams.calibration import calibration_table  # noqa: PLC0415
    from fleet_slip.grams.reader import OpenedGrams  # noqa: PLC0415

    numbers, delays = (
        OpenedGrams(database, features().identity(name), 0, 0) for name in (CALIBRATION, DELAY)
    )
    add_table(database, CALIBRATION, calibration_table(numbers, delays))


def needed_views(query: str) -> frozenset[str]:
    """Return the views that a query may need; all, if it names none or asks about tables."""
    named = views_in(query, VIEWS)
    return VIEWS if not named or _ABOUT_ALL_VIEWS.search(query) else named
