"""Rows of the table `grams` as arrays, and how the table differs from the log files."""

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
    """Yield each set of signals in some Gram rows, its rows, and which those are."""
    names = batch["signals"].unique().to_pylist()
    if len(names) == 1:
        yield names[0], batch, np.ones(len(batch), dtype=np.bool_)
        return
    for signals in names:
        mask = pc.equal(batch["signals"], signals)
        yield signals, batch.filter(mask), np.asarray(mask)


def gram_table(signals: str, rows: pa.Table | pa.RecordBatch) -> GramTable:
    """Return Gram rows, all of the same signals, as arrays."""
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
    parts = [chunk.flatten().to_numpy() for chunk in chunks]
    values: IntArray = parts[0] if len(parts) == 1 else np.concatenate(parts)
    return values.reshape(-1, width)


def is_onboard(rows: pa.Table) -> pa.ChunkedArray:
    """Return which rows of `grams` came without a log."""
    return pc.starts_with(rows["file"].cast(pa.string()), RECEIVED_FILES)


ONBOARD_PREFIX = "received-"
"""Before the name of a file of rows that cars sent."""


def is_onboard_file(file: TableFile) -> bool:
    """Whether a Gram file holds rows that cars sent."""
    return file.path.startswith(ONBOARD_PREFIX)


def rows_of_set(grams: Snapshot, identity: str, *columns: str) -> Iterator[pa.Table]:
    """Yield the Gram rows of a feature set, file by file; null in columns that came later."""
    for file in grams.files:
        mask = pc.equal(grams.table.read(file.path, ["feature_set"])["feature_set"], identity)
        if not pc.any(mask).as_py():
            continue
        stored = grams.table.read_metadata(file.path).schema.to_arrow_schema().names
        rows = grams.table.read(file.path, [name for name in columns if name in stored])
        for name in sorted(set(columns).difference(stored)):
            rows = rows.append_column(name, pa.nulls(len(rows)))
        yield rows.filter(mask)


# How the tables `logs` and `grams` differ.

BEING_WRITTEN_HOURS = 1.0
"""A file that no commit ever knew and that is younger may belong to a job that is running."""


@dataclass(frozen=True)
class Backlog:
    """How `grams` and `logs` differ."""

    missing: tuple[TableFile, ...]
    stale: frozenset[str]
    """Paths in `grams`, of any set, that are no active log file, and none that may become one."""


def find_backlog(logs: Snapshot, grams: Snapshot, identity: str = PLAIN) -> Backlog:
    """Compare active log files with those that Gram rows of a feature set's `identity` name."""
    done, named = named_files(grams, identity)
    active = {file.path for file in logs.files}
    return Backlog(
        missing=tuple(file for file in logs.files if file.path not in done),
        stale=frozenset(named - active - _about_to_land(logs, named - active)),
    )


def named_files(grams: Snapshot, identity: str) -> tuple[set[str], set[str]]:
    """Return the log files that Gram rows of a feature set name, and those that any name."""
    done: set[str] = set()
    named: set[str] = set()
    for file in grams.files:
        if is_onboard_file(file):  # of no log
            continue
        pairs = grams.table.read_combinations(file.path, ["feature_set", "file"])
        named.update(pairs["file"].filter(pc.invert(is_onboard(pairs))).to_pylist())
        done.update(pairs["file"].filter(pc.equal(pairs["feature_set"], identity)).to_pylist())
    return done, named


def _about_to_land(logs: Snapshot, paths: Collection[str]) -> set[str]:
    """Return the log files that a job has written and not committed: their Gram rows land first."""
    if not paths:
        return set()
    written = {
        file.path
        for file in logs.table.folder.files()
        if file.path in paths and file.age_hours < BEING_WRITTEN_HOURS
    }
    return written.difference(logs.removals) if written else set()
