"""Makes the long histories that `benchmarks.growth` measures: real tables and documents, quickly.

Drives are a dozen rows of Gaussian signals, some of them many times over (weights), so that
Gram rows have the size of real ones; each Gram row is computed from its rows, exactly. Files are
written in the encoding of the warehouse and committed through it, without waiting for the disk.
"""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import date, timedelta
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from fleet_slip.catalog.features import PLAIN
from fleet_slip.grams.update import transaction_name
from fleet_slip.storage.documents import DocumentFolder
from fleet_slip.storage.local import LocalFolder
from fleet_slip.storage.table import AppTransaction, Change
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import CATALOG

SIGNALS = CATALOG.signals.gram_signals
INPUTS = len(CATALOG.signals.inputs)
ROWS = 12
WEIGHT = 16_000
CHUNK = 50_000
LOGS_AT_ONCE = 1000
FIRST_DAY = date(2020, 1, 1)
FILES_PER_DAY = 20
_NO_WAIT = patch("os.fsync", os.fstat)


@dataclass(frozen=True)
class Drives:
    """Consecutive drives: their number, the counts of their rows, and how often each row stands.

    Attributes:
        numbers: shape (drives,).
        counts: shape (drives, ROWS, signals).
        weights: shape (drives, ROWS).
    """

    numbers: NDArray[np.int64]
    counts: NDArray[np.int64]
    weights: NDArray[np.int64]

    @classmethod
    def drawn(cls, first: int, count: int, weight: int) -> "Drives":
        """Draw drives; with `weight` above 1 each row stands up to so many times."""
        rng = np.random.default_rng([first, count])
        inputs = rng.normal(0, 700, (count, ROWS, INPUTS))
        label = inputs @ np.linspace(-0.2, 0.2, INPUTS) + rng.normal(0, 20, (count, ROWS))
        counts = np.concatenate([inputs, label[..., None]], axis=2).round().astype(np.int64)
        weights = rng.integers(1, weight + 1, (count, ROWS))
        return cls(np.arange(first, first + count), counts, weights)

    def metadata(self, rows_each: int = 1) -> dict[str, pa.Array]:
        """Return the columns of drive metadata, each value so many times."""
        tens = (self.numbers * 7919 % 97) / 97
        values: dict[str, Sequence[Any]] = {
            "drive_id": [f"drive-{i:09d}" for i in self.numbers],
            "vehicle_id": [f"car-{i:08d}" for i in self.numbers],
            "vehicle_model": [f"model_{i % 4}" for i in self.numbers],
            "source": ["simulated"] * len(self.numbers),
            "campaign": ["growth"] * len(self.numbers),
            "track": [f"track_{i % 2}" for i in self.numbers],
            "mass_kg": (1200 + 600 * tens).tolist(),
            "adhesion": (0.6 + 0.4 * tens).tolist(),
            "speed_factor": (0.75 + 0.25 * tens).tolist(),
            "saturated": [0] * len(self.numbers),
        }
        schema = CATALOG.signals.drive_schema
        columns = {
            field.name: pa.array(
                values.get(field.name, [None] * len(self.numbers)), type=field.type
            )
            for field in schema
        }
        at = pa.array(np.repeat(np.arange(len(self.numbers)), rows_each))
        return {name: column.take(at) for name, column in columns.items()}

    def grams(self, warehouse: Warehouse, files: Sequence[str], days: Sequence[date]) -> pa.Table:
        """Return the drives' Gram rows, which came from the log files given for each drive."""
        # In float64, where every partial sum is an integer below 2^53.
        counts = self.counts.astype(np.float64)
        weighted = (counts * self.weights[..., None]).transpose(0, 2, 1)
        sums = weighted.sum(axis=2).astype(np.int64)
        matrices = np.matmul(weighted, counts).astype(np.int64)
        row, column = np.tril_indices(len(SIGNALS))
        products = matrices[:, row, column]
        count = len(self.numbers)
        columns = self.metadata() | {
            "feature_set": pa.repeat(CATALOG.identity(PLAIN), count),
            "file": pa.array(files),
            "day": pa.array(days),
            "part": pa.nulls(count, pa.string()),
            "signals": pa.repeat(",".join(SIGNALS), count),
            "n": pa.array(self.weights.sum(axis=1)),
            "clipped": pa.repeat(0, count),
            "sums": _lists(sums),
            "products": _lists(products),
        }
        schema = warehouse.grams.schema
        names = [name for name in schema.names if name not in warehouse.grams.optional]
        return pa.table({name: columns[name].cast(schema.field(name).type) for name in names})

    def log(self, warehouse: Warehouse) -> pa.Table:
        """Return the drives' rows as a log file has them; other signals are absent."""
        count = len(self.numbers)
        columns = self.metadata(ROWS) | {
            "tick": pa.array(np.tile(np.arange(ROWS, dtype=np.int32), count))
        }
        for i, name in enumerate(SIGNALS):
            columns[name] = pa.array(self.counts[:, :, i].reshape(-1).astype(np.int16))
        names = [name for name in warehouse.logs.schema.names if name != "day"]
        missing = pa.nulls(count * ROWS, pa.int16())
        return pa.table({name: columns.get(name, missing) for name in names})


def _lists(values: NDArray[np.int64]) -> pa.Array:
    offsets = np.arange(0, values.size + 1, values.shape[1], dtype=np.int32)
    return pa.ListArray.from_arrays(pa.array(offsets), pa.array(values.reshape(-1)))


def day_of(file: int) -> date:
    """Return the day of a log file by its number."""
    return FIRST_DAY + timedelta(days=file // FILES_PER_DAY)


def write_logs(warehouse: Warehouse, files: int) -> list[str]:
    """Commit log files of one drive each; return their paths."""
    actions = []
    with _NO_WAIT:
        for drives in drawn_for(files):
            rows = drives.log(warehouse)
            for i, number in enumerate(drives.numbers.tolist()):
                part, name = rows.slice(i * ROWS, ROWS), f"growth-{number:07d}"
                actions.append(warehouse.logs.write_file(name, part, day_of(number)))
    warehouse.logs.snapshot().commit(Change(add=actions, note={"job": "growth"}))
    delta = warehouse.logs.snapshot().delta
    assert delta is not None
    delta.create_checkpoint()
    return [action.path for action in actions]


def drawn_for(files: int) -> Iterator[Drives]:
    """Draw the drives of log files that have one each."""
    for first in range(0, files, LOGS_AT_ONCE):
        yield Drives.drawn(first, min(LOGS_AT_ONCE, files - first), 1)


def write_grams(
    warehouse: Warehouse, paths: Sequence[str], rows: int, weight: int = 1, chunk: int = CHUNK
) -> None:
    """Commit Gram rows, evenly of the log files, through the writer of the warehouse."""
    actions = []
    for first in range(0, rows, chunk):
        drives = Drives.drawn(first, min(chunk, rows - first), weight)
        files = (drives.numbers * len(paths) // rows).tolist()
        table = drives.grams(warehouse, [paths[f] for f in files], [day_of(f) for f in files])
        actions.append(warehouse.grams.write_file(f"growth-{first:09d}", table))
    identity = CATALOG.identity(PLAIN)
    transaction = AppTransaction(transaction_name(identity), warehouse.logs.snapshot().version or 0)
    warehouse.grams.snapshot().commit(Change(add=actions, transactions=[transaction]))


def write_fleet(warehouse: Warehouse, files: int, grams: int | None = None) -> None:
    """Write log files, and a Gram row of each, or as many Gram rows as given."""
    paths = write_logs(warehouse, files)
    if grams is None:  # the very rows of the log files, so that they agree
        write_grams(warehouse, paths, files, chunk=LOGS_AT_ONCE)
    else:
        write_grams(warehouse, paths, grams, WEIGHT)


def write_versions(root: Path, name: str, versions: int) -> None:
    """Repeat the first version of a model and the first move of its alias so many times."""
    for kind, number in (("versions", "trained_on"), ("history", "version")):
        folder = DocumentFolder(LocalFolder(root), f"models/{name}/{kind}")
        first = folder.read(1).content
        for i in range(2, versions + 1):
            changed = {**first[number], "grams_version": i % 2} if kind == "versions" else i
            with _NO_WAIT:
                folder.create(i, {**first, number: changed})
