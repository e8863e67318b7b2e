"""Rows of the table `grams` as arrays, and the difference between the tables `grams` and `logs`."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.arrays import BoolArray, IntArray
from fleet_slip.catalog.drive_sources import RECEIVED_FILES
from fleet_slip.catalog.features import PLAIN
from fleet_slip.regression.gram import GramTable, packed_size
from fleet_slip.storage.table import Snapshot, TableFile

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
        stored = grams.table.read_metadata(file.path).schema.to_arrow_schema().names
        rows = grams.table.read(file.path, [name for name in columns if name in stored])
        for name in sorted(set(columns).difference(stored)):
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
    done, named = named_files(grams, identity)
    active = {file.path for file in logs.files}
    return Backlog(
        missing=tuple(file for file in logs.files if file.path not in done),
        stale=frozenset(named - active - _pending_files(logs, named - active)),
    )


def named_files(grams: Snapshot, identity: str) -> tuple[set[str], set[str]]:
    """Return the log files of the Gram rows of a feature set, and those of all Gram rows."""
    done: set[str] = set()
    named: set[str] = set()
    for file in grams.files:
        if is_onboard_file(file):  # without logs
            continue
        pairs = grams.table.read_combinations(file.path, ["feature_set", "file"])
        named.update(pairs["file"].filter(pc.invert(is_onboard(pairs))).to_pylist())
        done.update(pairs["file"].filter(pc.equal(pairs["feature_set"], identity)).to_pylist())
    return done, named


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
