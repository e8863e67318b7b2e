"""Loads Gram rows that cars counted on board: a Parquet table, beside rows of logs.

The table has the columns of `COLUMNS`. It is loaded whole, once, in one commit, or not at all: an
error names the first row that cannot be, and why. The drive of a row has the source `received`, and
instead of a log file the row names `received/` and the digest of the table's file.
"""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from fleet_slip.arrays import BoolArray
from fleet_slip.base import canonical_json, number_of, sha256_of, shown
from fleet_slip.catalogue.catalog import Catalog
from fleet_slip.catalogue.course import (
    BESIDE,
    COARSER,
    COURSE,
    COURSE_LATE,
    LATE_PARTS,
    MOST_EARLY,
    MOST_LATE,
    STRAIGHT,
    TURNED,
    YAW_RATE,
    course_units,
)
from fleet_slip.catalogue.definitions import limit_of
from fleet_slip.catalogue.facts import RECEIVED_FILES
from fleet_slip.catalogue.features import PLAIN
from fleet_slip.catalogue.signals import COUNT_MAX, SAMPLE_TIME_S, Signal
from fleet_slip.catalogue.time_columns import Feature
from fleet_slip.config import read_named_file
from fleet_slip.errors import InputError, RepeatedError
from fleet_slip.grams.compute import Parts
from fleet_slip.grams.gram_files import (
    by_signals,
    files_to_rewrite,
    gram_table,
    in_schema,
    rows_to_keep,
    write_rows,
)
from fleet_slip.grams.reader import BATCH_ROWS
from fleet_slip.regression.gram import GramTable
from fleet_slip.rendering import Answer, Part, Remark
from fleet_slip.resources import read_sql
from fleet_slip.storage.table import Change, Snapshot, Unit, retry_conflicts
from fleet_slip.warehouse.database import database_errors, open_database, reading_files
from fleet_slip.warehouse.forgotten import Audit
from fleet_slip.warehouse.tables import Warehouse

# The feature sets that cars can count: their columns, the ranges of these, and their definition.
#
# The definition of a set is the first 8 bytes of the SHA-256 of the canonical JSON of its identity
# and of name, scale and range of each signal that it is made of.

Range = tuple[int, int]

ROWS_IN_A_SUM = 2**31 - 1
"""Rows of a drive: 248 days. No sum of so many products of int16 counts reaches 2^61."""

MOST_SIGNALS = 32
"""That a car counts of a set."""

MOST_COLUMNS = 512
"""Of a feature set that cars count: there is a bit for each."""


@dataclass(frozen=True)
class CountedSet:
    """A feature set that cars can count.

    Attributes:
        name, identity: of the set.
        ranges: the smallest and the largest count of each column of its Gram rows, in order.
        signals: what a car must know to count it, in catalogue order.
        times: over how many ticks columns change; none where they stand for themselves.
        parts: what those parts of a drive are called; None alone where it is not divided.
        in_time: whether the course is moved by its delay.
        definition: what C code calls it.
    """

    name: str
    identity: str
    ranges: Mapping[str, Range]
    signals: tuple[str, ...]
    times: tuple[int, ...]
    parts: tuple[str | None, ...]
    in_time: bool
    definition: int

    @property
    def key(self) -> str:
        """What a table of Gram rows calls it: its name, and what its columns mean."""
        return f"{self.name}:{self.definition:016x}"

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns of its Gram rows, in order."""
        return tuple(self.ranges)


def counted_sets(catalog: Catalog) -> dict[str, CountedSet]:
    """Return the sets by their identities, which Gram rows carry, the logged signals first."""
    sets = {}
    for name in (PLAIN, *catalog.sets):
        feature_set = catalog.feature_set(name)
        if not feature_set.block_ticks and len(feature_set.columns) <= MOST_COLUMNS:
            identity = catalog.identity(name)
            sets[identity] = _counted(catalog, name, identity)
    return sets


def _counted(catalog: Catalog, name: str, identity: str) -> CountedSet:
    signals, resolved = catalog.signals, catalog.feature_set(name)
    used = {*resolved.signals, *([COURSE, YAW_RATE] if resolved.change_ticks else [signals.label])}
    used |= {signal for f in resolved.features for signal in catalog.features[f].inputs}
    used |= {signal for d in catalog.definitions(name).values() for signal in d.signals}
    made_of = {signal: about for signal, about in signals.signals.items() if signal in used}
    defined: list[Any] = [
        [signal, f"{about.scale:f}", about.min_count, about.max_count]
        for signal, about in made_of.items()
    ]
    content = defined if name == PLAIN else [identity, defined]
    digest = sha256_of(canonical_json(content))
    return CountedSet(
        name,
        identity,
        {column: _range(catalog, column, resolved.change_ticks) for column in resolved.columns},
        tuple(made_of),
        resolved.change_ticks,
        Parts.of_set(resolved).times or (None,),
        resolved.in_time,
        int.from_bytes(bytes.fromhex(digest[:16]), "little"),
    )


def _range(catalog: Catalog, column: str, times: Sequence[int]) -> Range:
    signals, label = catalog.signals, catalog.signals.label
    if times and column in (*BESIDE, label):
        if column == STRAIGHT:
            return 0, 1
        units = course_units(signals)
        most = units.largest // units.divisor + 1
        if column == TURNED:
            most = 2 * max(times) * COUNT_MAX // COARSER + 1
        return -most, most
    of = signals[column] if column == label else catalog.input(column)
    if isinstance(of, Signal):
        least, most = of.min_count, of.max_count
    else:
        most = limit_of(of.bits if isinstance(of, Feature) else of.definition.bits)
        least = -most
    return (least - most, most - least) if times else (least, most)


# Which Gram rows no drive of integer counts can have.
#
# Of n rows whose counts x of a signal are from l to h, with the sum s, and c the sum of products of
# two signals x and y: n l <= s <= n h, and |c| <= n max|x| max|y|, in 64 bits: n is so small
# (`most_rows`) that nothing reaches 2^63. The matrix of n, sums and products is positive
# semidefinite: scaled to a diagonal of ones, its least eigenvalue is not below zero by more than
# is computed wrongly (Higham, Accuracy and Stability of Numerical Algorithms, section 10.1).

NEAR = 1e-11
LARGEST_SUM = 2**61

NO_ROWS = "has no rows, or more than a drive can have"
SUMS = "has sums outside the ranges of its signals"
PRODUCTS = "has products outside the ranges of its signals"
INDEFINITE = "has a matrix that is not positive semidefinite"


def find_impossible(table: GramTable, ranges: Sequence[tuple[int, int]]) -> dict[int, str]:
    """Return why Gram rows are impossible, by place, given the range of each of their signals."""
    sums, products = table.sums, table.products
    least, most = np.array(ranges, dtype=np.int64).reshape(-1, 2).T
    row, column = np.tril_indices(len(least))
    size = np.maximum(np.abs(least), np.abs(most))
    possible = (table.n >= 1) & (table.n <= most_rows(ranges))
    n = np.where(possible, table.n, 1)[:, None]
    bound = n * (size[row] * size[column])
    judged = {
        NO_ROWS: ~possible,
        SUMS: ((sums < n * least) | (sums > n * most)).any(axis=1),
        PRODUCTS: ((products > bound) | (products < -bound)).any(axis=1),
        INDEFINITE: _indefinite(replace(table, n=n[:, 0])),
    }
    reasons = np.select([*judged.values()], [*judged], "").tolist()
    return {place: reason for place, reason in enumerate(reasons) if reason}


def impossible_rows(
    rows: pa.Table, sets: Mapping[str, CountedSet]
) -> Iterator[tuple[dict[str, Any], str]]:
    """Yield the Gram rows that no drive can have, and why, given the sets by their names there.

    Rows of other sets, which were defined otherwise, are passed over.
    """
    for name in rows["feature_set"].unique().to_pylist():
        if name not in sets:
            continue
        ranges = sets[name].ranges
        mine = rows.filter(pc.equal(rows["feature_set"], name)).combine_chunks()
        for batch in mine.to_batches(BATCH_ROWS):
            for signals, alike, _ in by_signals(batch):
                names = signals.split(",") if signals else []
                found: dict[int, str] = {}
                if not set(names) <= ranges.keys():
                    found = dict.fromkeys(range(len(alike)), "has signals that there are not")
                elif names:
                    known = [ranges[name] for name in names]
                    found = find_impossible(gram_table(signals, alike), known)
                for place, reason in found.items():
                    yield alike.slice(place, 1).to_pylist()[0], reason


def most_rows(ranges: Sequence[tuple[int, int]]) -> int:
    """Return of how many rows a Gram row can be: no sum of their products reaches 2^61."""
    largest = max((abs(end) for one in ranges for end in one), default=1)
    return min(ROWS_IN_A_SUM, (LARGEST_SUM - 1) // largest**2)


def _indefinite(table: GramTable) -> BoolArray:
    """Whether each matrix is not positive semidefinite."""
    matrix = table.moments()
    scale = 1 / np.sqrt(np.maximum(np.diagonal(matrix, axis1=1, axis2=2), 1.0))
    matrix *= scale[:, :, None] * scale[:, None, :]
    bad: BoolArray = np.linalg.eigvalsh(matrix)[:, 0] < -NEAR
    return bad


COLUMNS = pa.schema(
    [
        ("source", pa.string()),
        ("vehicle_id", pa.string()),
        ("drive_id", pa.string()),
        ("day", pa.date32()),
        ("feature_set", pa.string()),
        ("part", pa.string()),
        (COURSE_LATE, pa.int64()),
        ("signals", pa.string()),
        ("n", pa.int64()),
        ("sums", pa.list_(pa.int64())),
        ("products", pa.list_(pa.int64())),
    ]
)
"""The table of Gram rows; `part` and `course_late` may be null or absent (`docs/export.md`)."""

OPTIONAL = ("part", COURSE_LATE)
LARGEST_BYTES, MOST_UNPACKED_BYTES = 2**28, 2**30
MOST_ROWS = 500_000
LONGEST_ROWS = 86_400 * round(1 / SAMPLE_TIME_S)
"""Rows of a day: a drive is over by then."""
ONE_AT_A_TIME = "receive"
"""Unit of every such commit: two at once, which could bring the same drive, are a conflict."""


@dataclass(frozen=True)
class CountedReport(Answer):
    """What became of a file of Gram rows: whether it is new, its drives, and rows behind them."""

    file: str
    new: bool
    gram_rows: int
    drives: int
    rows: int

    def parts(self) -> Iterator[Part]:
        """Return what was loaded, as a remark."""
        grams, drives = number_of(self.gram_rows, "Gram row"), number_of(self.drives, "drive")
        said = f"{grams} of {drives}, {number_of(self.rows, 'row')}"
        yield Remark(
            f"{self.file}: {said if self.new else 'nothing to do, it was ingested before'}"
        )


def ingest_counted(warehouse: Warehouse, file: Path) -> CountedReport:
    """Load the Gram rows of a file, once. Raises `InputError`, `RepeatedError`, `ConflictError`."""
    content = read_named_file(file, LARGEST_BYTES, InputError)
    table = _read(file, content)
    digest = hashlib.sha256(content).hexdigest()
    unit = Unit(f"receive/{digest}", 1)
    drives, rows = pc.count_distinct(table["drive_id"]).as_py(), pc.sum(table["n"]).as_py()
    new = warehouse.grams.snapshot().landed(unit.name) is None
    report = CountedReport(str(file), new, len(table), drives, rows or 0)
    if not new:
        return report
    sets = counted_sets(warehouse.catalog)
    _require_possible(sets, file, table)
    mine = _gram_rows(sets, table, warehouse.grams.schema, f"{RECEIVED_FILES}{digest[:24]}")

    def attempt() -> None:
        grams = warehouse.grams.snapshot()
        if grams.landed(unit.name) is not None:  # meanwhile, by another process
            return
        # Asked after the snapshot: who forgets a car from now on makes this commit a conflict.
        _require_allowed(file, warehouse, mine)
        _require_new(warehouse.catalog, file, grams, mine)
        replaced = files_to_rewrite(grams, frozenset())
        kept = list(rows_to_keep(grams, replaced, frozenset()))
        single = Unit(ONE_AT_A_TIME, (grams.version or 0) + 1)
        grams.commit_or_discard(
            Change(write_rows(warehouse, [*kept, mine]), replaced, [unit, single], _NOTE)
        )

    retry_conflicts(attempt)
    return report


def _read(file: Path, content: bytes) -> pa.Table:
    """Return the rows of a file in the order of `COLUMNS`. Raises `InputError`."""
    try:
        parquet = pq.ParquetFile(pa.BufferReader(content), page_checksum_verification=True)
        rows = parquet.metadata.num_rows
        unpacked_bytes = _require_checksums(file, content, parquet.metadata)
        if not rows:
            raise InputError(f"{file}: has no Gram rows.")
        if rows > MOST_ROWS or unpacked_bytes > MOST_UNPACKED_BYTES:
            raise InputError(
                f"{file}: more than {MOST_ROWS:,} Gram rows, or than 1 GiB of them. Split it."
            )
        table = parquet.read()
        absent = [name for name in COLUMNS.names if name not in {*table.column_names, *OPTIONAL}]
        if absent:
            raise InputError(
                f"{file}: not a table of Gram rows, column {absent[0]} is missing. {_SEE}"
            )
        return in_schema(table, COLUMNS).combine_chunks()
    except (pa.ArrowException, OSError, ValueError, IndexError):
        raise InputError(f"{file}: not a table of Gram rows (docs/export.md). {_SEE}") from None


_NOTE = {"job": "receive"}
_SEE = "If it is a log, give its --mapping, as drafted by: fleet-slip mapping suggest LOG"


def _require_checksums(file: Path, content: bytes, metadata: pq.FileMetaData) -> int:
    """Return the bytes unpacked. Raises `InputError` for pages without a checksum.

    Without it a flipped bit of a product goes unseen. Arrow compares checksums where there are any,
    and does not say where: they are the field 4 of a page's header, after type and sizes.
    """
    unpacked = 0
    for group in range(metadata.num_row_groups):
        for column in range(metadata.num_columns):
            chunk = metadata.row_group(group).column(column)
            unpacked += chunk.total_uncompressed_size
            at = chunk.dictionary_page_offset or chunk.data_page_offset
            for _ in range(3):  # a byte that says field and type, then a number of 7 bits a byte
                at += 1
                while content[at] & 0x80:
                    at += 1
                at += 1
            if content[at] != _NEXT_FIELD_I32:
                raise InputError(
                    f"{file}: its pages have no checksums. Write it with them, as by "
                    "pyarrow.parquet.write_table(..., write_page_checksum=True)."
                )
    return unpacked


_NEXT_FIELD_I32 = 0x15
"""In Thrift's compact protocol: the next field, an integer of 32 bits."""


def _gram_rows(
    sets: Mapping[str, CountedSet], table: pa.Table, schema: pa.Schema, name: str
) -> pa.Table:
    """Return rows of `grams`."""
    identities = {counted.key: identity for identity, counted in sets.items()}
    names = pa.array([identities[key] for key in table["feature_set"].to_pylist()])
    rows = table.set_column(table.column_names.index("feature_set"), "feature_set", names)
    rows = rows.append_column("file", pa.repeat(name, len(table)))
    return in_schema(rows.append_column("clipped", pa.repeat(0, len(table))), schema)


def _refuse(
    file: Path, row: int, drive: object, reason: str, error: type[InputError] = InputError
) -> NoReturn:
    raise error(
        f"{file}: row {row} (drive {shown(str(drive))}) {reason}. Nothing of the file was loaded: "
        "correct or remove the row, and load the file again."
    )


def _numbered(table: pa.Table) -> pa.Table:
    return table.append_column("number", pa.array(range(1, len(table) + 1)))


def _require_possible(sets: Mapping[str, CountedSet], file: Path, table: pa.Table) -> None:
    """Raise `InputError` for the first row that no drive can have."""
    by_key = {counted.key: counted for counted in sets.values()}
    described = [
        {"columns": counted.columns, "parts": [part or "" for part in counted.parts]}
        | {"key": key, "in_time": counted.in_time}
        for key, counted in by_key.items()
    ]
    late = {"earliest": LATE_PARTS * MOST_EARLY, "latest": LATE_PARTS * MOST_LATE}
    with open_database() as database, database_errors("checking Gram rows"):
        database.register("counted", _numbered(table))
        database.register("known", pa.Table.from_pylist(described))
        statement = read_sql("jobs", "counted_wrong.sql")
        wrong = database.execute(statement, {**late, "longest": LONGEST_ROWS}).fetchone()
    if wrong:
        _refuse(file, *wrong)
    for row, reason in impossible_rows(_numbered(table), by_key):
        _refuse(file, row["number"], row["drive_id"], reason)


def _require_allowed(file: Path, warehouse: Warehouse, rows: pa.Table) -> None:
    """Raise `InputError` for a car or a drive that was forgotten."""
    cars, drives = (rows[name].cast(pa.string()) for name in ("vehicle_id", "drive_id"))
    barred = Audit(warehouse.root).barred(cars.unique().to_pylist(), drives.unique().to_pylist())
    for row, (car, drive) in enumerate(zip(cars.to_pylist(), drives.to_pylist(), strict=True), 1):
        if car in barred.vehicles or drive in barred.drives:
            _refuse(file, row, drive, "was forgotten; fleet-slip forget --allow lets it come back")


def _require_new(catalog: Catalog, file: Path, grams: Snapshot, rows: pa.Table) -> None:
    """Raise `RepeatedError` for a drive that is there, with a log or without, under any name."""
    if not grams.paths:
        return
    statement = read_sql("jobs", "counted_again.sql").format(
        received=RECEIVED_FILES, plain=catalog.identity(PLAIN)
    )
    with open_database(reading=grams.table.folder) as database:
        database.register("counted", _numbered(rows))
        database.execute("SET VARIABLE gram_files = $files", {"files": grams.paths})
        with reading_files(database, "looking for drives that are there"):
            found = database.execute(statement).fetchone()
    if found:
        row, drive, there = found
        _refuse(file, row, drive, f"is there already, as {shown(there)}", RepeatedError)
