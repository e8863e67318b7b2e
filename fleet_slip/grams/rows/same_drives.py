"""Which received Gram rows are of drives whose logs are here: the logs count, the rows go.

A drive is the same if it has the same name; or the same car, day and signals, and exactly the same
n, sums and products: what a car counts is, bit for bit, what its log comes to.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import date
from itertools import pairwise

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.arrays import BoolArray
from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.features import features
from fleet_slip.delta import Snapshot, TableFile
from fleet_slip.grams.rows.gram_files import is_of_received
from fleet_slip.grams.rows.gram_rows import is_received


@dataclass
class LoggedDrives:
    """Drives with logs, by their names and by the content of their Gram rows."""

    names: set[str] = field(default_factory=set)
    contents: set[bytes] = field(default_factory=set)
    days: set[date] = field(default_factory=set)
    found: int = 0
    """Received Gram rows that were found to be of these drives."""

    def add(self, rows: pa.Table) -> None:
        """Add the drives of Gram rows."""
        self.names.update(rows["drive_id"].cast(pa.string()).to_pylist())
        self.contents.update(content_keys(rows))
        self.days.update(rows["day"].unique().to_pylist())

    def files_with_received(self, grams: Snapshot) -> list[TableFile]:
        """Return the files that have received Gram rows of these drives."""
        names = pa.array(sorted(self.names), pa.string())
        return [
            file for file in grams.files if is_of_received(file) and self._in(file, names, grams)
        ]

    def _in(self, file: TableFile, names: pa.StringArray, grams: Snapshot) -> bool:
        """Whether a file has received Gram rows of these drives.

        The same content is of the same day: rows of other days are told by their names alone.
        """
        drives = grams.table.read(file.path, ["drive_id"])["drive_id"].cast(pa.string())
        if pc.any(pc.is_in(drives, names)).as_py():
            return True
        first, last = file.days or (date.min, date.max)
        if not any(first <= day <= last for day in self.days):
            return False
        return bool(self._mine(grams.table.read(file.path)).any())

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


def content_keys(rows: pa.Table) -> Iterator[bytes]:
    """Yield a key for each Gram row of the logged signals; equal keys mean the same drive.

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
