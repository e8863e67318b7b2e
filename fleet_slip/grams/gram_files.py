"""Files of Gram rows: digests of rows, writing, merging, and the course delays they were made with.

A file contains rows of one feature set. Small files are merged, so that there are never too many.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from hashlib import blake2b, sha256
from itertools import accumulate

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from deltalake.transaction import AddAction

from fleet_slip.arrays import BoolArray, Hashes, IntArray
from fleet_slip.catalog.course import COURSE_LATE
from fleet_slip.catalog.features import PLAIN
from fleet_slip.catalog.signals import RECEIVED_FILES
from fleet_slip.errors import ConflictError
from fleet_slip.regression.gram import GramTable
from fleet_slip.resources import read_sql
from fleet_slip.storage.table import Snapshot, Table, TableFile
from fleet_slip.warehouse.database import open_database, reading_files
from fleet_slip.warehouse.gram_reader import (
    ONBOARD_PREFIX,
    by_signals,
    gram_table,
    is_onboard,
    is_onboard_file,
    rows_of_set,
)
from fleet_slip.warehouse.warehouse import Warehouse


def hash_names(ids: pa.Array | pa.ChunkedArray) -> Hashes:
    """Return the hash of each id of a drive or a car, see `Hashes`."""
    starts = b"".join([sha256(text.encode("utf-8")).digest()[:8] for text in ids.to_pylist()])
    return np.frombuffer(starts, dtype=">u8").astype(np.uint64)


# Digests identify Gram rows by their counts, under any name of drive or car and any day.

MIN_EVENTFUL_ROWS = 256
MIN_EVENTFUL_SIGNALS = 2
"""Signals with a variance of one count or more. Rows with fewer, such as those of a standing car,
can be equal by chance."""


def find_eventful(table: GramTable) -> BoolArray:
    """Return a mask of the Gram rows that vary too much to be equal in two drives."""
    n, column = table.n[:, None], np.arange(len(table.signals))
    variances = table.products[:, column * (column + 3) // 2] / n - (table.sums / n) ** 2
    varying: BoolArray = (variances >= 1).sum(axis=1) >= MIN_EVENTFUL_SIGNALS
    return varying & (table.n >= MIN_EVENTFUL_ROWS)


def gram_digests(rows: pa.Table) -> tuple[list[str], BoolArray]:
    """Return a digest of 16 characters of the counts of each Gram row, and the eventful rows.

    The digest of a row that is not eventful depends on its car and day too, as in `digest_counts`.
    """
    digests, eventful = np.empty(len(rows), dtype=object), np.zeros(len(rows), dtype=np.bool_)
    for signals, alike, mask in by_signals(rows):
        numbers, is_eventful = alike["n"].to_numpy()[:, None], eventful[mask]
        if signals:
            table = gram_table(signals, alike)
            numbers = np.column_stack([table.n, table.sums, table.products])
            eventful[mask] = is_eventful = find_eventful(table)
        columns = ("feature_set", "part", "vehicle_id", "day")
        names = zip(*(alike[name].to_pylist() for name in columns), strict=True)
        digests[mask] = [
            _digest(feature_set, block, signals, "" if alone else f"{vehicle}\n{day}", row)
            for (feature_set, block, vehicle, day), alone, row in zip(
                names, is_eventful, numbers, strict=True
            )
        ]
    return digests.tolist(), eventful


def _digest(
    feature_set: str, block: str | None, signals: str, owner: str, numbers: IntArray
) -> str:
    text = f"{feature_set}\n{block or ''}\n{signals}\n{owner}\n"
    return blake2b(text.encode() + numbers.tobytes(), digest_size=8).hexdigest()


# Writing and rewriting of files.

FILE_ROWS = 100_000
"""Gram rows of a full file, some 700 bytes each."""

FILE_BYTES = 2**28
"""Maximum size of the Gram rows of a file in memory; a row of 200 columns has 160,000 bytes."""

SMALL_FILES_MAX = 32
"""Number of small Gram files beyond which a commit merges some."""


class GramWriter:
    """Writes Gram rows into files of usual size, and collects the actions that add them."""

    def __init__(self, warehouse: Warehouse) -> None:
        self._warehouse = warehouse
        self._buffer: list[pa.Table] = []
        self._actions: list[AddAction] = []

    def write(self, rows: pa.Table) -> None:
        """Buffer Gram rows; write files as soon as they are full."""
        step = max(1, min(FILE_ROWS, FILE_BYTES * len(rows) // max(1, rows.nbytes)))
        for start in range(0, rows.num_rows, step):
            self._buffer.append(rows.slice(start, step))
            count = sum(table.num_rows for table in self._buffer)
            if count >= FILE_ROWS or sum(table.nbytes for table in self._buffer) >= FILE_BYTES:
                self._flush()

    def close(self) -> list[AddAction]:
        """Write the remaining Gram rows; return the actions that add all files."""
        if self._buffer:
            self._flush()
        return self._actions

    def _flush(self) -> None:
        """Write a file for each feature set, and others for rows from cars."""
        rows = pa.concat_tables(self._buffer, promote_options="default")  # optional columns differ
        self._buffer.clear()
        table, onboard = self._warehouse.grams, is_onboard(rows)
        for prefix, selected in ((ONBOARD_PREFIX, onboard), ("", pc.invert(onboard))):
            same_origin = _only(rows, selected)
            for identity in sorted(same_origin["feature_set"].unique().to_pylist()):
                same_set = _only(same_origin, pc.equal(same_origin["feature_set"], identity))
                optional = set(table.optional).intersection(same_set.column_names)
                empty = [name for name in optional if same_set[name].null_count == len(same_set)]
                file = table.write_file(f"{prefix}{identity}", same_set.drop_columns(empty))
                self._actions.append(file)


def write_rows(warehouse: Warehouse, tables: Iterable[pa.Table]) -> list[AddAction]:
    """Write Gram rows table by table; return the actions that add the files."""
    writer = GramWriter(warehouse)
    for rows in tables:
        writer.write(rows)
    return writer.close()


def _only(rows: pa.Table, mask: pa.ChunkedArray) -> pa.Table:
    return rows if pc.all(mask).as_py() else rows.filter(mask)


def files_to_rewrite(grams: Snapshot, stale: frozenset[str]) -> list[TableFile]:
    """Return the Gram files that name stale log files, and small ones to merge, if too many."""
    merged = _files_to_merge(grams)
    return [
        file
        for file in grams.files
        if file.path in merged
        or (
            stale and not is_onboard_file(file) and not stale.isdisjoint(_log_files_of(grams, file))
        )
    ]


def _files_to_merge(grams: Snapshot) -> set[str]:
    """Return small files that fill two files together, if there are too many small ones."""
    small = sorted((_fullness(file), file.path) for file in grams.files if _fullness(file) < 1)
    if len(small) <= SMALL_FILES_MAX:
        return set()
    full = list(accumulate(fullness for fullness, _ in small))
    return {path for (_, path), so_far in zip(small, full, strict=True) if so_far <= 2}


def _fullness(file: TableFile) -> float:
    """Return the size of a file over that of a full one; encoding saves up to three quarters."""
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
    """Return the Gram rows of a file in the schema of the table."""
    return in_schema(grams.read(file.path), grams.schema)


def in_schema(rows: pa.Table, schema: pa.Schema) -> pa.Table:
    """Return rows in the columns of a schema, null in those that they lack."""
    columns = [
        rows[field.name].cast(field.type)
        if field.name in rows.column_names
        else pa.nulls(len(rows), field.type)
        for field in schema
    ]
    return pa.table(columns, schema=schema)


_COMPARED = ("drive_id", "feature_set", "vehicle_id", "day", "signals", "n", "sums", "products")


def find_superseded(grams: Snapshot, new_rows: Sequence[pa.Table]) -> tuple[set[str], set[str]]:
    """Return the drives whose logs have arrived after the Gram rows from their cars, and the files.

    Logs supersede the rows from cars in all feature sets.
    """
    paths = {grams.table.uri(file.path): file.path for file in grams.files if is_onboard_file(file)}
    if not paths or not new_rows:
        return set(), set()
    statement = read_sql("jobs", "superseded.sql").format(plain=PLAIN)
    with open_database(reading=grams.table.folder) as database:
        logged = pa.concat_tables([rows.select(_COMPARED) for rows in new_rows])
        database.register("logged", logged)
        database.execute("SET VARIABLE gram_files = $files", {"files": list(paths)})
        with reading_files(database, "finding drives whose logs have arrived"):
            matches = database.execute(statement).fetchall()
    return {drive for drive, _ in matches}, {paths[file] for _, file in matches}


def require_active(logs: Snapshot, files: Collection[TableFile]) -> None:
    """Raise `ConflictError` if the logs have lost a file whose Gram rows are landing."""
    lost = {file.path for file in files} - {file.path for file in logs.files}
    if lost:
        raise ConflictError(
            f"{logs.table.folder}: other processes keep removing files, such as {min(lost)}. Run "
            "the same command again."
        )


# Receiver delays that the courses in Gram rows were corrected for.


def files_of_other_delay(grams: Snapshot, identity: str, delays: Mapping[str, int]) -> set[str]:
    """Return the log files whose Gram rows of a feature set have another delay than their cars."""
    return {
        path
        for path, car, delay in _recorded_delays(grams, identity)
        if delay != delays.get(car, 0) and not path.startswith(RECEIVED_FILES)
    }


def recorded_delays(grams: Snapshot, identity: str, log_file: str) -> dict[str, int]:
    """Return the delays that Gram rows of a log file were corrected for, by car."""
    return {
        car: delay
        for path, car, delay in _recorded_delays(grams, identity)
        if path == log_file and delay
    }


def _recorded_delays(grams: Snapshot, identity: str) -> set[tuple[str, str, int]]:
    """Return the log files, cars and delays in the Gram rows of a feature set; 0 if unknown."""
    triples: set[tuple[str, str, int]] = set()
    for rows in rows_of_set(grams, identity, "file", "vehicle_id", COURSE_LATE):
        paths, cars, delays = (
            rows[name].to_pylist() for name in ("file", "vehicle_id", COURSE_LATE)
        )
        triples.update(zip(paths, cars, (delay or 0 for delay in delays), strict=True))
    return triples
