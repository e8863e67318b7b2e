"""Which received Gram rows are of drives whose logs are here: the logs count, the rows go.

Same is a drive of the same name; or of the same car, day and signals, with exactly the same n, sums
and products of logged signals, as its log gives. Rows of other sets go with them.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import date
from itertools import pairwise

import pyarrow as pa
import pyarrow.compute as pc

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
        plain = rows.filter(pc.equal(rows["feature_set"], features().identity(PLAIN)))
        self.contents.update(content_keys(plain))
        self.days.update(plain["day"].unique().to_pylist())

    def files_with_received(self, grams: Snapshot) -> list[TableFile]:
        """Return the files that have received Gram rows of these drives."""
        files = [file for file in grams.files if is_of_received(file)]
        for file in files:
            self.names.update(self._sent(file, grams))
        names = pa.array(sorted(self.names), pa.string())
        return [file for file in files if pc.any(pc.is_in(_drives(file, grams), names)).as_py()]

    def _sent(self, file: TableFile, grams: Snapshot) -> Iterator[str]:
        """Yield a file's received drives of the same days that are these under another name."""
        first, last = file.days or (date.min, date.max)
        if any(first <= day <= last for day in self.days):
            rows = grams.table.read(file.path)
            for drive, key in zip(rows["drive_id"].to_pylist(), content_keys(rows), strict=True):
                if key in self.contents:
                    yield drive

    def without_received(self, rows: pa.Table) -> pa.Table:
        """Return rows of `grams` without the received ones of these drives; count those."""
        names = pa.array(sorted(self.names), pa.string())
        mine = pc.and_(is_received(rows), pc.is_in(rows["drive_id"].cast(pa.string()), names))
        self.found += pc.sum(mine).as_py() or 0
        return rows.filter(pc.invert(mine))


def _drives(file: TableFile, grams: Snapshot) -> pa.ChunkedArray:
    return grams.table.read(file.path, ["drive_id"])["drive_id"].cast(pa.string())


def has_received(grams: Snapshot) -> bool:
    """Whether any Gram row came without a log."""
    return any(is_of_received(file) for file in grams.files)


def content_keys(rows: pa.Table) -> Iterator[bytes]:
    """Yield a key for each Gram row: equal keys mean one drive; other feature sets match none."""
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
