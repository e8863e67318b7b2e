"""Gram rows as arrays, and their files: of which log files they are, and how they are written.

Each file is of one feature set; they are neither too many nor too large.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from hashlib import blake2b, sha256
from itertools import accumulate

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from deltalake.transaction import AddAction
from numpy.typing import NDArray

from fleet_slip.arrays import BoolArray, IntArray
from fleet_slip.catalog.course import COURSE_LATE
from fleet_slip.catalog.drive_sources import RECEIVED_FILES
from fleet_slip.catalog.features import PLAIN
from fleet_slip.errors import ConflictError
from fleet_slip.regression.gram import GramTable
from fleet_slip.resources import read_sql
from fleet_slip.storage.table import Snapshot, Table, TableFile
from fleet_slip.warehouse.database import open_database, reading_files
from fleet_slip.warehouse.gram_rows import (
    ONBOARD_PREFIX,
    by_signals,
    gram_table,
    is_onboard,
    is_onboard_file,
    rows_of_set,
)
from fleet_slip.warehouse.warehouse import Warehouse

Hashes = NDArray[np.uint64]
"""Hashes of drives or cars: what tells one from others, in 8 bytes."""


def hash_names(ids: pa.Array | pa.ChunkedArray) -> Hashes:
    """Return the hash of each id of a drive or a car, see `Hashes`."""
    first = b"".join([sha256(one.encode("utf-8")).digest()[:8] for one in ids.to_pylist()])
    return np.frombuffer(first, dtype=">u8").astype(np.uint64)


# Digests identify Gram rows by their counts, whatever their drive, car or day is called.

MIN_EVENTFUL_ROWS = 256
MIN_EVENTFUL_SIGNALS = 2
"""Signals with a variance of one count or more. Rows with less, as of a car that stands, can be
equal by chance."""


def find_eventful(table: GramTable) -> BoolArray:
    """Return which Gram rows vary so much that no two drives have equal ones."""
    n, column = table.n[:, None], np.arange(len(table.signals))
    variances = table.products[:, column * (column + 3) // 2] / n - (table.sums / n) ** 2
    varying: BoolArray = (variances >= 1).sum(axis=1) >= MIN_EVENTFUL_SIGNALS
    return varying & (table.n >= MIN_EVENTFUL_ROWS)


def gram_digests(rows: pa.Table) -> tuple[list[str], BoolArray]:
    """Return 16 characters for each Gram row that depend on its counts, and which are eventful.

    Those of a row that is not depend on its car and day too, as those of `digest_counts` do.
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
            _digest(feature_set, part, signals, "" if alone else f"{vehicle}\n{day}", row)
            for (feature_set, part, vehicle, day), alone, row in zip(
                names, is_eventful, numbers, strict=True
            )
        ]
    return digests.tolist(), eventful


def _digest(feature_set: str, part: str | None, signals: str, owner: str, numbers: IntArray) -> str:
    text = f"{feature_set}\n{part or ''}\n{signals}\n{owner}\n"
    return blake2b(text.encode() + numbers.tobytes(), digest_size=8).hexdigest()


# How files are written, and written again.

FILE_ROWS = 100_000
"""Gram rows of a file, some 700 bytes each; with fewer it is small, and may be merged."""

FILE_BYTES = 2**28
"""Most bytes of the Gram rows of a file; a row of 200 columns has 160,000."""

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
    came = is_onboard(rows)
    actions = []
    for prefix, some in ((ONBOARD_PREFIX, came), ("", pc.invert(came))):
        mine = _only(rows, some)
        for identity in sorted(mine["feature_set"].unique().to_pylist()):
            part = _only(mine, pc.equal(mine["feature_set"], identity))
            optional = set(warehouse.grams.optional).intersection(part.column_names)
            empty = [name for name in optional if part[name].null_count == len(part)]
            part = part.drop_columns(empty)
            name = f"{prefix}{identity}"
            actions.append(warehouse.grams.write_file(name, part))
    return actions


def _only(rows: pa.Table, some: pa.ChunkedArray) -> pa.Table:
    return rows if pc.all(some).as_py() else rows.filter(some)


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
    """Return the drives without a log that new rows of logs are of, and the files that have them.

    The logs count, and the rows that cars sent go, those of other feature sets with them.
    """
    paths = {grams.table.uri(file.path): file.path for file in grams.files if is_onboard_file(file)}
    if not paths or not new_rows:
        return set(), set()
    statement = read_sql("jobs", "superseded.sql").format(plain=PLAIN)
    with open_database(reading=grams.table.folder) as database:
        logged = pa.concat_tables([rows.select(_COMPARED) for rows in new_rows])
        database.register("logged", logged)
        database.execute("SET VARIABLE gram_files = $files", {"files": list(paths)})
        with reading_files(database, "looking for drives whose logs have come"):
            found = database.execute(statement).fetchall()
    return {drive for drive, _ in found}, {paths[file] for _, file in found}


def require_active(logs: Snapshot, files: Collection[TableFile]) -> None:
    """Raise `ConflictError` if the logs have lost a file whose Gram rows are landing."""
    lost = {file.path for file in files} - {file.path for file in logs.files}
    if lost:
        raise ConflictError(
            f"{logs.table.folder}: other processes keep removing files, such as {min(lost)}. Run "
            "the same command again."
        )


# Delays of receivers that the courses in Gram rows were corrected for.


def files_of_other_delay(grams: Snapshot, identity: str, late: Mapping[str, int]) -> set[str]:
    """Return the log files that have Gram rows of a set with another delay than their cars have."""
    return {
        name
        for name, car, recorded in _recorded(grams, identity)
        if recorded != late.get(car, 0) and not name.startswith(RECEIVED_FILES)
    }


def recorded_cars(grams: Snapshot, identity: str, log_file: str) -> dict[str, int]:
    """Return the delays that the Gram rows of a set of one log file were corrected by, by car."""
    return {
        car: recorded
        for name, car, recorded in _recorded(grams, identity)
        if name == log_file and recorded
    }


def _recorded(grams: Snapshot, identity: str) -> set[tuple[str, str, int]]:
    """Return each log file, car and delay that Gram rows of a set are of; 0 where none is known."""
    found: set[tuple[str, str, int]] = set()
    for rows in rows_of_set(grams, identity, "file", "vehicle_id", COURSE_LATE):
        files, cars, recorded = (
            rows[name].to_pylist() for name in ("file", "vehicle_id", COURSE_LATE)
        )
        found.update(zip(files, cars, (late or 0 for late in recorded), strict=True))
    return found
