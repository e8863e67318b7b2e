"""Writes Gram rows to files: of one feature set each, neither too many nor too large."""

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import date
from itertools import accumulate, pairwise

import pyarrow as pa
import pyarrow.compute as pc
from deltalake.transaction import AddAction

from fleet_slip.catalogue.facts import RECEIVED_FILES
from fleet_slip.catalogue.features import PLAIN, features
from fleet_slip.grams.gram_rows import is_received
from fleet_slip.storage.table import Snapshot, Table, TableFile
from fleet_slip.warehouse.tables import Warehouse

FILE_ROWS = 100_000
"""Gram rows of a file, some 700 bytes each; with fewer it is small, and may be merged."""

FILE_BYTES = 2**28
"""Most bytes of the Gram rows of a file; a row of 200 columns has 160,000."""

RECEIVED_NAME = "received-"
"""Before the name of a file of rows that cars sent."""

SMALL_FILES_MAX = 32
"""So many small Gram files may stand side by side before a commit merges some."""


def write_rows(warehouse: Warehouse, parts: Iterable[pa.Table]) -> list[AddAction]:
    """Write Gram rows part by part; return the actions that add the files."""
    actions: list[AddAction] = []
    waiting: list[pa.Table] = []
    for part in parts:
        step = max(1, min(FILE_ROWS, FILE_BYTES * len(part) // max(1, part.nbytes)))
        for first in range(0, part.num_rows, step):
            waiting.append(part.slice(first, step))
            rows = sum(some.num_rows for some in waiting)
            if rows >= FILE_ROWS or sum(some.nbytes for some in waiting) >= FILE_BYTES:
                actions += _write_files(warehouse, _together(waiting))
                waiting.clear()
    return actions + (_write_files(warehouse, _together(waiting)) if waiting else [])


def _together(parts: Sequence[pa.Table]) -> pa.Table:
    return pa.concat_tables(parts, promote_options="default")  # some lack an optional column


def _write_files(warehouse: Warehouse, rows: pa.Table) -> list[AddAction]:
    """Write a file for each feature set, and others for received rows, not to be computed again."""
    came = pc.starts_with(rows["file"].cast(pa.string()), RECEIVED_FILES)
    actions = []
    for prefix, some in ((RECEIVED_NAME, came), ("", pc.invert(came))):
        mine = _only(rows, some)
        for identity in sorted(mine["feature_set"].unique().to_pylist()):
            part = _only(mine, pc.equal(mine["feature_set"], identity))
            empty = [name for name in warehouse.grams.optional if _is_empty(part, name)]
            part = part.drop_columns(empty)
            name = f"{prefix}{identity}"
            actions.append(warehouse.grams.write_file(name, part))
    return actions


def _is_empty(rows: pa.Table, name: str) -> bool:
    return name in rows.column_names and rows[name].null_count == len(rows)


def _only(rows: pa.Table, some: pa.ChunkedArray) -> pa.Table:
    return rows if pc.all(some).as_py() else rows.filter(some)


def is_of_received(file: TableFile) -> bool:
    """Whether a Gram file holds rows that cars sent."""
    return file.path.startswith(RECEIVED_NAME)


def files_to_rewrite(grams: Snapshot, stale: frozenset[str]) -> list[TableFile]:
    """Return the Gram files that name stale log files, and small ones to merge, if too many."""
    merged = _files_to_merge(grams)
    return [
        file
        for file in grams.files
        if file.path in merged
        or (stale and not is_of_received(file) and not stale.isdisjoint(_log_files_of(grams, file)))
    ]


def _files_to_merge(grams: Snapshot) -> set[str]:
    """Return small files that make one of usual size, if too many are: each night merges a few."""
    small = sorted((_fullness(file), file.path) for file in grams.files if _fullness(file) < 1)
    if len(small) <= SMALL_FILES_MAX:
        return set()
    full = list(accumulate(fullness for fullness, _ in small))
    return {path for (_, path), so_far in zip(small, full, strict=True) if so_far <= 2}


def _fullness(file: TableFile) -> float:
    """Return how full a file is; encoded, Gram rows take down to a quarter of their memory."""
    return max(file.rows / FILE_ROWS, file.size_bytes / (FILE_BYTES / 4))


def _log_files_of(grams: Snapshot, file: TableFile) -> set[str]:
    return set(grams.table.read_combinations(file.path, ["file"])["file"].to_pylist())


def rows_to_keep(
    grams: Snapshot, files: Sequence[TableFile], stale: frozenset[str]
) -> Iterator[pa.Table]:
    """Yield the Gram rows of files without those of stale log files."""
    dropped = pa.array(sorted(stale), pa.string())
    for file in files:
        rows = read_rows(grams.table, file)
        yield rows.filter(pc.invert(pc.is_in(rows["file"], dropped)))


def read_rows(grams: Table, file: TableFile) -> pa.Table:
    """Return the Gram rows of a file in the schema of the table; null in columns that it lacks."""
    rows = grams.read(file.path)
    columns = [
        rows[field.name].cast(field.type)
        if field.name in rows.column_names
        else pa.nulls(len(rows), field.type)
        for field in grams.schema
    ]
    return pa.table(columns, schema=grams.schema)


# Which received Gram rows are of drives whose logs are here: the logs count, the rows go.
#
# Same is a drive of the same name; or of the same car, day and signals, with exactly the same n,
# sums and products of logged signals, as its log gives. Rows of other sets go with them.


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
