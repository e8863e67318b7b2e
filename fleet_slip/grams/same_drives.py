"""Which received Gram rows are of drives whose logs are here: these count, and the others go.

A drive is the same if it has the same name; or the same car, day and signals, and exactly the same
n, sums and products: what a car counts is, bit for bit, what its log comes to.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import BoolArray
from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.features import features
from fleet_slip.delta import Snapshot, TableFile
from fleet_slip.grams.gram_files import is_of_received
from fleet_slip.grams.received_rows import is_received


@dataclass
class LoggedDrives:
    """Drives of logs, by their names and by what their Gram rows are."""

    names: set[str] = field(default_factory=set)
    contents: set[bytes] = field(default_factory=set)
    found: int = 0
    """Received Gram rows that were found to be of these drives."""

    def add(self, rows: pa.Table) -> None:
        """Add the drives of Gram rows."""
        self.names.update(rows["drive_id"].cast(pa.string()).to_pylist())
        self.contents.update(content_keys(rows))

    def files_with_received(self, grams: Snapshot) -> list[TableFile]:
        """Return the files that have received Gram rows of these drives."""
        return [file for file, rows in received_by_file(grams) if self._mine(rows).any()]

    def without_received(self, rows: pa.Table) -> pa.Table:
        """Return rows of `grams` without the received ones of these drives; count those."""
        came = np.asarray(is_received(rows).to_numpy(zero_copy_only=False), dtype=np.bool_)
        mine = came.copy()
        mine[came] = self._mine(rows.filter(pa.array(came)))
        self.found += int(mine.sum())
        return rows.filter(pa.array(~mine))

    def _mine(self, rows: pa.Table) -> BoolArray:
        drives = rows["drive_id"].cast(pa.string()).to_pylist()
        known = [drive in self.names for drive in drives]
        same = [key in self.contents for key in content_keys(rows)]
        return np.array(known, dtype=np.bool_) | np.array(same, dtype=np.bool_)


def has_received(grams: Snapshot) -> bool:
    """Whether any Gram row came without a log."""
    return any(is_of_received(file) for file in grams.files)


def received_by_file(grams: Snapshot) -> Iterator[tuple[TableFile, pa.Table]]:
    """Yield the files that have received Gram rows, and these."""
    for file in grams.files:
        if is_of_received(file):
            yield file, grams.table.read(file.path)


def content_keys(rows: pa.Table) -> Iterator[bytes]:
    """Yield what tells whether Gram rows of the logged signals are of the same drive, row by row.

    Rows of other feature sets have keys that none of these has.
    """
    rows = rows.combine_chunks()
    names = ("feature_set", "vehicle_id", "day", "signals", "n")
    told = [rows[name].cast(pa.string()).to_pylist() for name in names]
    sums, products = (_cells(rows[name]) for name in ("sums", "products"))
    identity = features().identity(PLAIN)
    for said, one, other in zip(zip(*told, strict=True), sums, products, strict=True):
        plain = said[0] == identity
        text = "\0".join(str(part) for part in said).encode("utf-8", "surrogatepass")
        yield hashlib.sha256(text + b"\0" + one + other).digest() if plain else b""


def _cells(lists: pa.ChunkedArray) -> Iterator[bytes]:
    for chunk in lists.chunks:
        offsets = chunk.offsets.to_pylist()
        values = chunk.values.to_numpy()
        for first, stop in pairwise(offsets):
            yield values[first:stop].tobytes()
