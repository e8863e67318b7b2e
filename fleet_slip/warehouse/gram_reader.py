"""Reader of the Gram rows of a warehouse, for one cohort after another."""

import contextlib
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, Self, TypeVar

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.arrays import BoolArray, IntArray
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.course import TURNED
from fleet_slip.catalog.definitions import CALIBRATION
from fleet_slip.catalog.features import PLAIN
from fleet_slip.catalog.signals import (
    LONGEST_PAUSE_S,
    RECEIVED_FILES,
    RECEIVER,
)
from fleet_slip.errors import DataError, NotComputedError
from fleet_slip.regression.gram import GramTable, packed_size
from fleet_slip.resources import read_sql
from fleet_slip.storage.table import Snapshot, TableFile
from fleet_slip.warehouse.database import Predicate, guarded_query
from fleet_slip.warehouse.table_views import gram_snapshots, lock, open_tables
from fleet_slip.warehouse.warehouse import Warehouse

Rows = TypeVar("Rows", pa.Table, pa.RecordBatch)


def by_signals(batch: Rows) -> Iterator[tuple[str, Rows, BoolArray]]:
    """Yield each set of signals in Gram rows, its rows, and their mask."""
    names = batch["signals"].unique().to_pylist()
    if len(names) == 1:
        yield names[0], batch, np.ones(len(batch), dtype=np.bool_)
        return
    for signals in names:
        mask = pc.equal(batch["signals"], signals)
        yield signals, batch.filter(mask), np.asarray(mask)


def gram_table(signals: str, rows: pa.Table | pa.RecordBatch) -> GramTable:
    """Return Gram rows of the same signals as arrays."""
    names = tuple(signals.split(","))
    k = len(names)
    return GramTable(
        names,
        rows["n"].to_numpy(),
        _matrix(rows["sums"], k),
        _matrix(rows["products"], packed_size(k)),
    )


def _matrix(lists: pa.ChunkedArray | pa.ListArray, width: int) -> IntArray:
    chunks = lists.chunks if isinstance(lists, pa.ChunkedArray) else [lists]
    arrays = [chunk.flatten().to_numpy() for chunk in chunks]
    values: IntArray = arrays[0] if len(arrays) == 1 else np.concatenate(arrays)
    return values.reshape(-1, width)


def is_onboard(rows: pa.Table) -> pa.ChunkedArray:
    """Return a mask of the Gram rows that cars sent without a log."""
    return pc.starts_with(rows["file"].cast(pa.string()), RECEIVED_FILES)


ONBOARD_PREFIX = "received-"
"""Prefix of the names of files with Gram rows from cars."""


def is_onboard_file(file: TableFile) -> bool:
    """Return True for a file of Gram rows from cars."""
    return file.path.startswith(ONBOARD_PREFIX)


def rows_of_set(grams: Snapshot, identity: str, *columns: str) -> Iterator[pa.Table]:
    """Yield the Gram rows of a feature set by file; newer columns are null in older files."""
    for file in grams.files:
        mask = pc.equal(grams.table.read(file.path, ["feature_set"])["feature_set"], identity)
        if not pc.any(mask).as_py():
            continue
        rows = grams.table.read(file.path, [name for name in columns if name in file.null_counts])
        for name in sorted(set(columns).difference(rows.column_names)):
            rows = rows.append_column(name, pa.nulls(len(rows)))
        yield rows.filter(mask)


# Difference between the tables `logs` and `grams`.

BEING_WRITTEN_HOURS = 1.0
"""Age below which a file without a commit may belong to a running job."""


@dataclass(frozen=True)
class Backlog:
    """Difference between `grams` and `logs` for a feature set.

    Attributes
    ----------
    missing
        Active log files without Gram rows of the feature set.
    stale
        Paths in `grams`, of any feature set, that are no active or pending log file.
    """

    missing: tuple[TableFile, ...]
    stale: frozenset[str]


def find_backlog(logs: Snapshot, grams: Snapshot, identity: str = PLAIN) -> Backlog:
    """Compare the active log files with those of the Gram rows of a feature set."""
    computed_files, all_files = named_files(grams, identity)
    active = {file.path for file in logs.files}
    return Backlog(
        missing=tuple(file for file in logs.files if file.path not in computed_files),
        stale=frozenset(all_files - active - _pending_files(logs, all_files - active)),
    )


def named_files(grams: Snapshot, identity: str) -> tuple[set[str], set[str]]:
    """Return the log files of the Gram rows of a feature set, and those of all Gram rows."""
    computed_files: set[str] = set()
    all_files: set[str] = set()
    for file in grams.files:
        if is_onboard_file(file):  # without logs
            continue
        pairs = grams.table.read_combinations(file.path, ["feature_set", "file"])
        all_files.update(pairs["file"].filter(pc.invert(is_onboard(pairs))).to_pylist())
        computed_files.update(
            pairs["file"].filter(pc.equal(pairs["feature_set"], identity)).to_pylist()
        )
    return computed_files, all_files


def _pending_files(logs: Snapshot, paths: Collection[str]) -> set[str]:
    """Return log files that a job has written, but not committed: Gram rows are committed first."""
    if not paths:
        return set()
    written = {
        file.path
        for file in logs.table.folder.files()
        if file.path in paths and file.age_hours < BEING_WRITTEN_HOURS
    }
    return written.difference(logs.removals) if written else set()


BATCH_ROWS = 2**13
"""Gram rows per batch, some 700 bytes each."""

BATCH_NUMBERS = 2**20
"""Maximum number of sums and products in a batch."""


SUMMED = (
    *("drive_id", "vehicle_id", RECEIVER, "source", "track", "mass_kg", "adhesion"),
    *("speed_factor", "day", "part", "trip", "signals", "n", "sums", "products"),
)
"""Columns of a cohort for its sums and folds."""

HASHES = ("drive_hash", "vehicle_hash", "trip_hash")


@dataclass(frozen=True)
class OpenedGrams:
    """A connection to Gram rows."""

    catalog: Catalog
    database: duckdb.DuckDBPyConnection
    identity: str
    logs_version: int
    grams_version: int

    def statement(self, name: str, predicate: Predicate, **values: str) -> str:
        """Return a statement from `jobs/` for a predicate."""
        trips = read_sql("jobs", "trips.sql").format(
            feature_set=self.identity, longest_pause_s=LONGEST_PAUSE_S
        )
        values |= {"predicate": predicate.sql, "feature_set": self.identity, "trips": trips}
        has_receiver = RECEIVER in self.catalog.signals.drive
        values |= {"receiver": RECEIVER if has_receiver else f"NULL AS {RECEIVER}"}
        return read_sql("jobs", name).format(**values)

    def rows(self, predicate: Predicate) -> pa.Table:
        """Return the sorted Gram rows of a cohort with all metadata."""
        text = self.statement("cohort.sql", predicate)
        with guarded_query(self.database, predicate):
            return self.database.sql(
                f"FROM ({text}) ORDER BY signals, drive_id, part"
            ).to_arrow_table()

    def batches(self, predicate: Predicate, *extra_columns: str) -> Iterator[pa.RecordBatch]:
        """Yield the Gram rows of a cohort in any order, with the columns `SUMMED` and `more`."""
        columns = ", ".join([*SUMMED, *extra_columns])
        feature_set = self.catalog.feature_set(self.catalog.name_of(self.identity))
        rows = max(1, min(BATCH_ROWS, BATCH_NUMBERS // packed_size(len(feature_set.columns))))
        text = f"SELECT {columns} FROM ({self.statement('cohort.sql', predicate)})"
        with guarded_query(self.database, predicate):
            yield from self.database.sql(text).to_arrow_reader(rows)

    def values_of(self, column: str, predicate: Predicate, limit: int | None = None) -> pa.Array:
        """Return the distinct values of a cohort's column, at most so many."""
        text = self.statement("cohort.sql", predicate)
        query = f"SELECT DISTINCT {column} FROM ({text}){f' LIMIT {limit}' if limit else ''}"
        with guarded_query(self.database, predicate):
            return self.database.sql(query).to_arrow_table()[column].combine_chunks()

    def count_left_out(self, predicate: Predicate) -> int:
        """Return the number of drives of a cohort without Gram rows, whose cars sent no log."""
        if self.identity == self.catalog.identity(PLAIN):
            return 0
        [(count,)] = self._rows(self.statement("count_without_log.sql", predicate), predicate)
        return int(count)

    def label_sources(self, predicate: Predicate) -> list[tuple[str, str | None, int]]:
        """Return source, campaign and number of the rows of a cohort with the label."""
        statement = self.statement("label_sources.sql", predicate, label=self.catalog.signals.label)
        return [(source, name, int(n)) for source, name, n in self._rows(statement, predicate)]

    def files(self, predicate: Predicate) -> set[str]:
        """Return the log files that contain a drive of a cohort."""
        return {f for (f,) in self._rows(self.statement("cohort_files.sql", predicate), predicate)}

    def _rows(self, statement: str, predicate: Predicate) -> list[tuple[Any, ...]]:
        with guarded_query(self.database, predicate):
            return self.database.execute(statement).fetchall()

    def course_delays(self, predicate: Predicate) -> Iterator[tuple[str, tuple[int, int]]]:
        """Yield cars with a course, and the smallest and largest delay of their Gram rows."""
        statement = self.statement("course_delays.sql", predicate, turned=TURNED)
        for car, smallest, largest in self._rows(statement, predicate):
            yield car, (smallest, largest)


class GramReader:
    """The newest Gram rows of a warehouse, for one cohort after another in one thread.

    A database is reused until the next commit, so that a cohort costs only its query.
    """

    def __init__(self, warehouse: Warehouse) -> None:
        self.warehouse, self.catalog = warehouse, warehouse.catalog
        self._logs: Snapshot | None = None
        self._grams: Snapshot | None = None
        self._database: duckdb.DuckDBPyConnection | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def opened(self, feature_set: str, predicate: Predicate) -> OpenedGrams:
        """Open the Gram rows of a feature set, which are valid until the next call.

        Raises `DataError` for missing Gram rows, or a feature set incomplete for the cohort.
        """
        grams, logs = gram_snapshots(self.warehouse, self._grams, self._logs)
        if grams is not self._grams or logs is not self._logs:
            self._close()
        self._logs, self._grams = logs, grams
        if not grams.rows:
            fill = "fleet-slip simulate CAMPAIGN (or fleet-slip ingest FILE --mapping M), then "
            raise DataError(
                f"{self.warehouse.root}: there are no Gram rows yet. "
                f"Run: {'' if logs.rows else fill}fleet-slip gram."
            )
        calibrated = self.catalog.feature_set(feature_set).calibrated
        for name in (feature_set, *([CALIBRATION] if calibrated else [])):
            if name != PLAIN:
                rows = partial(self._opened, grams, logs, name)
                _require_complete(self.catalog, logs, grams, rows, name, predicate)
        return self._opened(grams, logs, feature_set)

    def _opened(self, grams: Snapshot, logs: Snapshot, feature_set: str) -> OpenedGrams:
        if self._database is None:
            self._database = open_tables(self.warehouse, {"grams"}, [grams, logs])
            lock(self._database, grams.paths)
        return OpenedGrams(
            self.catalog,
            self._database,
            self.catalog.identity(feature_set),
            logs.version or 0,
            grams.version or 0,
        )

    def _close(self) -> None:
        if self._database is not None:
            self._database.close()
            self._database = None


@contextlib.contextmanager
def open_grams(
    source: Warehouse | GramReader, feature_set: str, predicate: Predicate
) -> Iterator[OpenedGrams]:
    """Open the Gram rows of a feature set by a reader, or by a new one; see `opened`."""
    if isinstance(source, GramReader):
        yield source.opened(feature_set, predicate)
    else:
        with GramReader(source) as reader:
            yield reader.opened(feature_set, predicate)


def _require_complete(
    catalog: Catalog,
    logs: Snapshot,
    grams: Snapshot,
    opened: Callable[[], OpenedGrams],
    feature_set: str,
    predicate: Predicate,
) -> None:
    backlog = find_backlog(logs, grams, catalog.identity(feature_set))
    if not backlog.missing and not backlog.stale:
        return
    files = opened().files(predicate)
    missing = [file for file in backlog.missing if file.path in files]
    if not files and feature_set != CALIBRATION:  # that may come from another root
        missing = list(find_backlog(logs, grams, catalog.identity(PLAIN)).missing)
    if missing or backlog.stale & files:
        raise NotComputedError(
            f"{feature_set} features are missing for {len(missing)} log files. Run: "
            f"fleet-slip gram && fleet-slip gram --features {feature_set}"
        )


def cohort_files(source: Warehouse | GramReader, predicate: Predicate) -> set[str]:
    """Return the log files that contain a drive of a cohort. Raises `DataError` for none."""
    with open_grams(source, PLAIN, predicate) as opened:
        files = opened.files(predicate)
    if not files:
        raise DataError(f"no drive with a log satisfies {predicate.quoted}.")
    return files
