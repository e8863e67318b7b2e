"""The warehouse of one data root: which tables it holds and how they are encoded."""

import json
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import duckdb
import pyarrow as pa
from pydantic import Field, RootModel, ValidationError

from fleet_slip.catalog.catalog import Catalog, load_catalog
from fleet_slip.catalog.course import COURSE_LATE
from fleet_slip.catalog.drive_sources import ALL_DRIVES
from fleet_slip.catalog.features import PLAIN
from fleet_slip.catalog.first_stage import FirstStageModel
from fleet_slip.catalog.signals import SAMPLE_TIME_S, SignalCatalog
from fleet_slip.columns.column_sql import with_absent
from fleet_slip.config import Config, load_toml
from fleet_slip.errors import ConflictError, StorageError
from fleet_slip.resources import SHIPPED_CONFIGS, Configs, folder, read_sql
from fleet_slip.storage.data_root import data_root
from fleet_slip.storage.documents import DocumentFolder
from fleet_slip.storage.encoding import Encoding
from fleet_slip.storage.folder import Folder
from fleet_slip.storage.table import SCALE, Snapshot, Table, absent_columns
from fleet_slip.warehouse.connections import ConnectionCache
from fleet_slip.warehouse.database import database_errors, open_database
from fleet_slip.warehouse.erasure_log import find_erased, without_erased

QUARANTINE_SCHEMA = pa.schema(
    [
        ("file", pa.string()),
        ("row", pa.int64()),
        ("drive_id", pa.string()),
        ("vehicle_id", pa.string()),
        ("reason", pa.string()),
        ("signal", pa.string()),
        ("value", pa.string()),
    ]
)
"""One row per rejected row of a file. `row` counts its rows of data from 1; `drive_id` is the drive
that it belongs to and `vehicle_id` its car, null if that is what is wrong; `signal` is the signal
or metadata concerned, or `time`; `value` is what stood there, as text."""


LINES = "lines"
"""Folder of the first-stage models of a data root."""


class StackedModels:
    """The first-stage models of a data root: a folder of documents for each, by its digest."""

    def __init__(self, root: Folder) -> None:
        self.root = root
        self._models: dict[str, FirstStageModel] = {}

    def digests(self) -> list[str]:
        """Return the digests of all models, sorted."""
        return sorted((self.root / LINES).names())

    def find(self, digest: str) -> FirstStageModel | None:
        """Return a model by its digest; None if there is none. Raises `StorageError`."""
        if digest not in self._models:
            documents = DocumentFolder(self.root, f"{LINES}/{digest}")
            if 1 not in documents.numbers():
                return None
            try:
                content = documents.read(1).content["line"]
                model = FirstStageModel.model_validate_json(json.dumps(content))
            except (ValidationError, KeyError):
                model = None
            if model is None or model.digest != digest:
                file = documents.file(1)
                raise StorageError(f"{file}: no line of that checksum. Restore the folder.")
            self._models[digest] = model
        return self._models[digest]

    def keep(self, model: FirstStageModel) -> None:
        """Write a model durably, unless it exists."""
        documents = DocumentFolder(self.root, f"{LINES}/{model.digest}")
        documents.create(1, {"line": model.model_dump(mode="json")})

    def clear(self) -> None:
        """Forget the models that were read; they are read again when needed."""
        self._models.clear()


@dataclass(frozen=True)
class Warehouse:
    """The tables and the catalog of a data root. Creating one reads and writes nothing.

    Attributes
    ----------
    root
        Folder of the data root.
    configs
        Configuration files that the catalog is loaded from.
    connections
        The idle connection to the Gram rows.
    """

    root: Folder
    configs: Configs = SHIPPED_CONFIGS
    connections: ConnectionCache = field(
        default_factory=ConnectionCache, init=False, repr=False, compare=False
    )

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle without connections; with the catalog, unless it is the shipped one.

        A worker elsewhere need not have the folder of configs.
        """
        if self.configs == SHIPPED_CONFIGS:
            return Warehouse, (self.root,)
        return _unpickle, (self.root, self.configs, self.catalog)

    def close(self) -> None:
        """Release the idle connection and the first-stage models that were read."""
        self.connections.close()
        self.stacked_models.clear()

    @cached_property
    def catalog(self) -> Catalog:
        """Signals, features, feature sets and first-stage models. Raises `ConfigError`."""
        return replace(load_catalog(self.configs), first_stage_models=self.stacked_models)

    @cached_property
    def stacked_models(self) -> StackedModels:
        """The first-stage models of this data root."""
        return StackedModels(self.root)

    def require(self) -> None:
        """Raise `StorageError` if there is no data root: a wrong path is not an empty warehouse."""
        if not self.root.exists():
            raise StorageError(
                f"{self.root}: no data root. Create one with fleet-slip learn or ingest (own "
                "logs) or fleet-slip run (simulated), or choose another: --root."
            )

    @cached_property
    def logs(self) -> Table:
        """Counts at 100 Hz, partitioned by day; a file holds whole drives."""
        signals = self.catalog.signals
        return Table(
            folder=self.root / "logs",
            schema=stored_schema(signals),
            encoding=Encoding(
                dictionary=tuple(signals.drive),
                delta_packed=("tick", *signals.signals),
            ),
            partition_by=("day",),
            description="Logs of drives at 100 Hz as integer counts: physical = scale * count",
            optional=signals.optional,
        )

    @cached_property
    def grams(self) -> Table:
        """Gram rows of drives, by feature set: n, sums and sums of products of counts."""
        return Table(
            folder=self.root / "grams",
            schema=gram_schema(self.catalog.signals),
            encoding=Encoding(
                dictionary=("feature_set", "file", "part", "signals", *self.catalog.signals.drive),
                # A seventh smaller, and twice as fast to write and read, as zstd alone.
                delta_packed=("sums.list.element", "products.list.element"),
                compression="zstd",
            ),
            description="Gram rows: exact sums and sums of products of counts, one a drive",
            optional=(COURSE_LATE,),
        )

    def computed_schema(self, *, in_time: bool) -> pa.Schema:
        """Return the schema of computed Gram rows, with delays corrected in them or not."""
        usual = self.grams.usual_schema
        return usual.append(self.grams.schema.field(COURSE_LATE)) if in_time else usual

    @cached_property
    def quarantine(self) -> Table:
        """Rows of measured logs that were refused, with the reason."""
        return Table(
            folder=self.root / "quarantine",
            schema=QUARANTINE_SCHEMA,
            encoding=Encoding(
                dictionary=("file", "vehicle_id", "reason", "signal"), compression="zstd"
            ),
            description="Rows of measured logs that were refused, with the reason",
        )

    def feature_sets(self) -> tuple[str, ...]:
        """Return the feature sets that Gram rows can be of, with those of first-stage models."""
        catalog = self.catalog
        digests = self.stacked_models.digests() if catalog.stacked_sets else []
        models = [model for digest in digests if (model := self.stacked_models.find(digest))]
        stacked = [
            f"{name}_{model.digest}"
            for name, estimate in catalog.stacked_sets.items()
            for model in models
            if model.estimate == estimate and model.scale == catalog.estimates[estimate].scale
        ]
        plain = (name for name in catalog.sets if name not in catalog.stacked_sets)
        return (PLAIN, *plain, *stacked)

    @property
    def tables(self) -> tuple[Table, ...]:
        """All tables."""
        return (self.logs, self.grams, self.quarantine)


def _unpickle(root: Folder, configs: Configs, catalog: Catalog) -> Warehouse:
    warehouse = Warehouse(root, configs)
    models = warehouse.stacked_models
    warehouse.__dict__["catalog"] = replace(catalog, first_stage_models=models)
    return warehouse


ROOT_VARIABLE, CONFIG_VARIABLE = "FLEET_SLIP_ROOT", "FLEET_SLIP_CONFIG"
"""Environment variables that stand for `root` and `config` of `open_warehouse`."""


def open_warehouse(
    root: Folder | Path | str | None = None, config: Path | str | None = None
) -> Warehouse:
    """Return the warehouse that arguments, else the environment, else the defaults name.

    `fleet_slip.open` and the command line call this; no other function reads the environment.
    Raises `StorageError` for an unusable root and `ConfigError` for an unusable folder of configs.
    """
    chosen = config or os.environ.get(CONFIG_VARIABLE)
    configs = Configs(Path(chosen)) if chosen else SHIPPED_CONFIGS
    return Warehouse(data_root(root or os.environ.get(ROOT_VARIABLE)), configs)


def stored_schema(signals: SignalCatalog) -> pa.Schema:
    """Return the schema of the table `logs`, with each signal's scale in its field's metadata."""
    return pa.schema(
        [
            field.with_metadata({SCALE: str(signals[field.name].scale)})
            if field.name in signals.signals
            else field
            for field in signals.log_schema
        ]
    )


def gram_schema(signals: SignalCatalog) -> pa.Schema:
    """Return the Arrow schema of the table `grams`.

    `part` is null where a Gram row is of a whole drive, else which of its rows it is of. `clipped`
    is how many values of the features were out of the range of int16.
    `signals` names the signals that the drive has, separated by commas, in the order of `sums`;
    `products` is the packed lower triangle, row by row: (0,0), (1,0), (1,1), (2,0), ...
    `course_late` is by how many parts of a tick the course was taken to be late.
    """
    return pa.schema(
        [
            ("feature_set", pa.string()),
            ("file", pa.string()),
            ("day", pa.date32()),
            *signals.drive_schema,
            ("part", pa.string()),
            ("signals", pa.string()),
            ("n", pa.int64()),
            ("clipped", pa.int64()),
            ("sums", pa.list_(pa.int64())),
            ("products", pa.list_(pa.int64())),
            (COURSE_LATE, pa.int64()),
        ]
    )


# DuckDB views of the tables of a data root, over one snapshot of each.

TABLE_VIEWS = ("log_counts", "log", "grams", "drives", "quarantine")
"""In the order of their dependence; each is a file in `warehouse/`."""

_VIEWS_ON_VIEWS = {"log": {"log_counts"}, "drives": {"log_counts", "grams"}}
_STORED_IN = {"log_counts": "logs", "grams": "grams", "quarantine": "quarantine"}

SNAPSHOTS = 100
"""So often two tables are looked at again that change while they are looked at."""


def connect_tables(warehouse: Warehouse, query: str) -> duckdb.DuckDBPyConnection:
    """Return a locked connection with the views that a query names. Raises `StorageError`."""
    warehouse.require()
    wanted = views_in(query)
    snapshots = table_snapshots(warehouse, wanted)
    database = open_tables(warehouse, wanted, snapshots)
    lock(database, paths_of(snapshots, wanted))
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
    stored = {_STORED_IN[name] for name in wanted if name in _STORED_IN}
    found = [warehouse.quarantine.snapshot()] if "quarantine" in stored else []
    if "grams" in stored:  # the log files tell which Gram rows count
        return [*found, *gram_snapshots(warehouse)]
    return [*found, warehouse.logs.snapshot()] if "logs" in stored else found


def gram_snapshots(
    warehouse: Warehouse, grams: Snapshot | None = None, logs: Snapshot | None = None
) -> tuple[Snapshot, Snapshot]:
    """Return the newest `grams` and `logs` that stood beside each other at one moment.

    Earlier snapshots of them are the result if nobody has committed since. Raises `ConflictError`
    if the Gram rows change faster than they are looked at.
    """
    grams = grams.renewed() if grams else warehouse.grams.snapshot()
    for _ in range(SNAPSHOTS):
        logs = logs.renewed() if logs else warehouse.logs.snapshot()
        again = grams.renewed()
        if again is grams or again.version == grams.version:
            return grams, logs
        grams = again
    raise ConflictError(
        f"{warehouse.root}: other processes keep changing it. Run the same command again."
    )


def paths_of(snapshots: Iterable[Snapshot], wanted: Iterable[str]) -> list[str]:
    """Return the data files of snapshots that some views read, as DuckDB opens them."""
    read = {_STORED_IN[name] for name in wanted if name in _STORED_IN}
    return [path for one in snapshots if one.table.folder.name in read for path in one.paths]


def open_tables(
    warehouse: Warehouse,
    wanted: Iterable[str],
    snapshots: Sequence[Snapshot],
    *,
    threads: int | None = None,
    of: str = ALL_DRIVES,
) -> duckdb.DuckDBPyConnection:
    """Return a connection, to be locked yet, with some views on snapshots of their tables.

    Logs and Gram rows are `of` the drives that satisfy this SQL predicate. No view has rows of
    erased cars and drives, even if the tables have them again.
    """
    database = open_database(threads=threads, reading=warehouse.root, spill=True)
    tables = {snapshot.table.folder.name: snapshot for snapshot in snapshots}
    if "grams" in tables:
        active = [file.path for file in tables["logs"].files]
        database.execute("SET VARIABLE active_log_files = $active", {"active": active})
    read = {_STORED_IN[name] for name in wanted if name in _STORED_IN}
    signals = warehouse.catalog.signals
    sources = {f"stored_{name}": _source(database, tables[name], signals) for name in read}
    if of != ALL_DRIVES:
        for name in sources.keys() - {"stored_quarantine"}:
            sources[name] = f"(FROM {sources[name]} WHERE {of})"
    erased = find_erased(warehouse.root, warehouse.grams, snapshots)
    for column, names in erased.by_column.items():
        database.execute(f"SET VARIABLE erased_{column} = $names", {"names": names})
    sources = {name: without_erased(rows, erased) for name, rows in sources.items()}
    columns = _generated_columns(signals)
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


def _source(database: duckdb.DuckDBPyConnection, snapshot: Snapshot, signals: SignalCatalog) -> str:
    """Return what stands after FROM for a stored table, empty ones included."""
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


# What every column of every view means, as a table.

COMMON = "common"
"""Section of `warehouse/columns.toml` for columns of several views."""


class ColumnDescription(Config):
    """What a column means."""

    description: str = Field(min_length=1)
    unit: str = ""


class _Descriptions(RootModel[dict[str, dict[str, ColumnDescription]]]):
    """By view and column."""


@cache
def column_descriptions() -> dict[str, dict[str, ColumnDescription]]:
    """Return the descriptions that stand beside the SQL of the views, by view and column."""
    return _Descriptions.model_validate(load_toml(folder("warehouse") / "columns.toml")).root


def describe_columns(database: duckdb.DuckDBPyConnection, signals: SignalCatalog) -> pa.Table:
    """Return the columns of all views with unit and description."""
    by_view = column_descriptions()
    common = {n: ColumnDescription(description=c.description) for n, c in signals.drive.items()}
    for name, signal in signals.signals.items():
        for column, unit in ((name, f"{signal.scale} {signal.unit}"), (signal.column, signal.unit)):
            common[column] = ColumnDescription(description=signal.description, unit=unit)
    common |= by_view[COMMON]
    found = database.execute(
        "SELECT table_name, column_name, data_type FROM duckdb_columns() "
        "WHERE NOT internal AND NOT starts_with(table_name, 'empty_') "
        "ORDER BY table_name, column_index"
    ).fetchall()
    rows = []
    for view, column, data_type in found:
        described = by_view.get(view, {}).get(column) or common.get(column)
        unit, description = (described.unit, described.description) if described else ("", "")
        row = {"view": view, "column": column, "type": data_type}
        rows.append(row | {"unit": unit, "description": description})
    return pa.Table.from_pylist(rows)
