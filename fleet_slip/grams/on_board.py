"""Loads Gram rows that cars counted on board: a Parquet table, beside rows of logs.

The table has the columns of `COLUMNS`. It is loaded whole, once, in one commit, or not at all: an
error names the first row that cannot be, and why. The drive of a row has the source `received`, and
instead of a log file the row names `received/` and the digest of the table's file.
"""

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from fleet_slip.arrays import BoolArray
from fleet_slip.base import (
    MAX_NAME_CHARACTERS,
    canonical_json,
    find_name_fault,
    normalize_name,
    pluralize,
    quote_name,
    sha256_of,
)
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.course import (
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
from fleet_slip.catalog.definitions import limit_of
from fleet_slip.catalog.drive_sources import RECEIVED_FILES
from fleet_slip.catalog.features import PLAIN
from fleet_slip.catalog.signals import COUNT_MAX, SAMPLE_TIME_S, Signal
from fleet_slip.catalog.time_columns import Feature
from fleet_slip.config import read_named_file
from fleet_slip.errors import InputError, RepeatedError
from fleet_slip.grams.compute import DriveBlocks
from fleet_slip.grams.gram_files import (
    files_to_rewrite,
    gram_digests,
    in_schema,
    rows_to_keep,
    write_rows,
)
from fleet_slip.ingest.formats.parquet_footer import (
    DELTA_BYTE_ARRAY,
    RowGroup,
    read_page_headers,
)
from fleet_slip.ingest.formats.tables import read_footer
from fleet_slip.regression.gram import GramTable
from fleet_slip.rendering import Answer, Part, Remark
from fleet_slip.resources import read_sql
from fleet_slip.storage.table import AppTransaction, Change, Snapshot, retry_conflicts
from fleet_slip.warehouse.database import database_errors, open_database, reading_files
from fleet_slip.warehouse.erasure_log import ErasureLog
from fleet_slip.warehouse.gram_reader import BATCH_ROWS
from fleet_slip.warehouse.gram_rows import by_signals, gram_table
from fleet_slip.warehouse.warehouse import Warehouse

# The feature sets that cars can count: their columns, the ranges of these, and their definition.
#
# The definition of a set is the first 8 bytes of the SHA-256 of the canonical JSON of its identity
# and of name, scale and range of each signal that it is made of.

Range = tuple[int, int]

ROWS_IN_A_SUM = 2**31 - 1
"""Rows of a drive: 248 days. No sum of so many products of int16 counts reaches 2^61."""

MAX_SIGNALS = 32
"""That a car counts of a set."""

MOST_COLUMNS = 512
"""Of a feature set that cars count: there is a bit for each."""


@dataclass(frozen=True)
class OnboardFeatureSet:
    """A feature set that cars can count.

    Attributes:
        name, identity: of the set.
        ranges: the smallest and the largest count of each column of its Gram rows, in order.
        signals: what a car must know to count it, in catalog order.
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


def onboard_feature_sets(catalog: Catalog) -> dict[str, OnboardFeatureSet]:
    """Return the sets by their identities, which Gram rows carry, the logged signals first."""
    sets = {}
    for name in (PLAIN, *catalog.sets):
        feature_set = catalog.feature_set(name)
        if not feature_set.block_ticks and len(feature_set.columns) <= MOST_COLUMNS:
            identity = catalog.identity(name)
            sets[identity] = _counted(catalog, name, identity)
    return sets


def _counted(catalog: Catalog, name: str, identity: str) -> OnboardFeatureSet:
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
    return OnboardFeatureSet(
        name,
        identity,
        {column: _range(catalog, column, resolved.change_ticks) for column in resolved.columns},
        tuple(made_of),
        resolved.change_ticks,
        DriveBlocks.of_set(resolved).durations or (None,),
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
    rows: pa.Table, sets: Mapping[str, OnboardFeatureSet]
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
NAMES = ("vehicle_id", "drive_id")
TEXTS = tuple(field.name for field in COLUMNS if field.type == pa.string())
MAX_FILE_BYTES = 2**28
MAX_ROWS, MAX_DECODED_BYTES = 500_000, 2**30
MAX_TEXT_BYTES = 2**28
"""Texts of a file; as many rows as a file may have have some 300 bytes of them each."""
BATCH_ROWS_READ = 2**12
"""Rows that are decoded at once; a row of 200 columns has 160,000 bytes."""
LONGEST_ROWS = 86_400 * round(1 / SAMPLE_TIME_S)
"""Rows of a day: the drives of a car that begin on one day have no more together."""
ONE_AT_A_TIME = "receive"
"""Transaction of every such commit, so that two at once, perhaps of one drive, are a conflict."""


@dataclass(frozen=True)
class OnboardImport(Answer):
    """What became of a file of Gram rows: whether it is new, its drives, and rows behind them."""

    file: str
    new: bool
    gram_rows: int
    drives: int
    rows: int

    def parts(self) -> Iterator[Part]:
        """Return what was loaded, as a remark."""
        grams, drives = pluralize(self.gram_rows, "Gram row"), pluralize(self.drives, "drive")
        said = f"{grams} of {drives}, {pluralize(self.rows, 'row')}"
        yield Remark(
            f"{self.file}: {said if self.new else 'nothing to do, it was ingested before'}"
        )


def import_onboard_grams(warehouse: Warehouse, file: Path) -> OnboardImport:
    """Load the Gram rows of a file, once. Raises `InputError`, `RepeatedError`, `ConflictError`."""
    content = read_named_file(file, MAX_FILE_BYTES, InputError)
    table = _read(file, content)
    digest = hashlib.sha256(content).hexdigest()
    transaction = AppTransaction(f"receive/{digest}", 1)
    drives, rows = pc.count_distinct(table["drive_id"]).as_py(), pc.sum(table["n"]).as_py()
    new = warehouse.grams.snapshot().transaction_version(transaction.name) is None
    report = OnboardImport(str(file), new, len(table), drives, rows or 0)
    if not new:
        return report
    sets = onboard_feature_sets(warehouse.catalog)
    _require_possible(sets, file, table)
    new_rows = _gram_rows(sets, table, warehouse.grams.schema, f"{RECEIVED_FILES}{digest[:24]}")
    numbered = _numbered(_with_digests(new_rows))
    _require_different(file, numbered)

    def attempt() -> None:
        grams = warehouse.grams.snapshot()
        if grams.transaction_version(transaction.name) is not None:  # meanwhile, by another process
            return
        # Asked after the snapshot: who forgets a car from now on makes this commit a conflict.
        _require_allowed(file, warehouse, numbered)
        _require_new(file, grams, numbered)
        replaced = files_to_rewrite(grams, frozenset())
        merged = list(rows_to_keep(grams, replaced, frozenset()))
        single = AppTransaction(ONE_AT_A_TIME, (grams.version or 0) + 1)
        grams.commit_or_discard(
            Change(
                write_rows(warehouse, [*merged, new_rows]), replaced, [transaction, single], _NOTE
            )
        )

    retry_conflicts(attempt)
    return report


def _read(file: Path, content: bytes) -> pa.Table:
    """Return the rows of a file in the order of `COLUMNS`. Raises `InputError`."""
    stream = pa.BufferReader(content)
    try:
        _require_decodable(file, content, read_footer(stream, file))
        parquet = pq.ParquetFile(stream)
        columns = _documented_columns(file, parquet.schema_arrow)
        # Texts stay in dictionaries until their length is known: one can stand in every row.
        texts = [
            name
            for name in TEXTS
            if name in columns and not pa.types.is_null(parquet.schema_arrow.field(name).type)
        ]
        parquet = pq.ParquetFile(stream, read_dictionary=texts, page_checksum_verification=True)
        batches = list(_decode(file, parquet.iter_batches(BATCH_ROWS_READ, columns=columns)))
    except (pa.ArrowException, OSError, ValueError, IndexError):
        raise InputError(f"{file}: not a table of Gram rows (docs/export.md). {_SEE}") from None
    if not batches:
        raise InputError(f"{file}: has no Gram rows.")
    return pa.concat_tables(batches).combine_chunks()


_NOTE = {"job": "receive"}
_SEE = "If it is a log, give its --mapping, as drafted by: fleet-slip mapping suggest LOG"


def _documented_columns(file: Path, schema: pa.Schema) -> list[str]:
    """Return the columns of Gram rows that a file has. Raises `InputError` for missing ones."""
    for field in COLUMNS:
        if field.name not in {*schema.names, *OPTIONAL}:
            raise InputError(
                f"{file}: not a table of Gram rows, column {field.name} is missing. {_SEE}"
            )
        places = schema.get_all_field_indices(field.name)
        if len(places) > 1:
            raise InputError(f"{file}: has two columns {field.name}. Leave one of them out.")
        for kind in (schema.field(place).type for place in places):
            if not _is_convertible(kind, field.type):
                raise InputError(
                    f"{file}: column {field.name} has the type {quote_name(kind)[:80]}; write it "
                    "as "
                    f"{field.type} (docs/export.md)."
                )
    return [name for name in COLUMNS.names if name in schema.names]


def _is_convertible(kind: pa.DataType, to: pa.DataType) -> bool:
    types = pa.types
    if types.is_list(to):
        is_list = types.is_list(kind) or types.is_large_list(kind)
        return bool(is_list and types.is_integer(kind.value_type))
    if to == pa.string():
        kind = kind.value_type if types.is_dictionary(kind) else kind
        return bool(types.is_string(kind) or types.is_large_string(kind) or types.is_null(kind))
    is_same = types.is_date if types.is_date(to) else types.is_integer
    return bool(is_same(kind) or types.is_null(kind))


def _decode(file: Path, batches: Iterable[pa.RecordBatch]) -> Iterator[pa.Table]:
    """Yield the rows of batches, with normalized names. Raises `InputError` for what is too long.

    Texts are converted only if all of them fit.
    """
    first, text_bytes = 1, 0
    for batch in batches:
        batch.validate(full=True)  # texts are UTF-8
        columns = {name: batch[name] for name in batch.schema.names}
        for name in (name for name in TEXTS if name in columns):
            texts = columns[name].cast(pa.dictionary(pa.int32(), pa.string()))
            if name in NAMES:
                names = [normalize_name(text) for text in texts.dictionary.to_pylist()]
                for place, text in enumerate(names):
                    if text and (fault := find_name_fault(text)):
                        row = pc.index(texts.indices, place).as_py()
                        _refuse(
                            file, first + row, batch["drive_id"][row], f"has a {name} that {fault}"
                        )
                texts = pa.DictionaryArray.from_arrays(texts.indices, pa.array(names, pa.string()))
            lengths = pc.binary_length(texts.dictionary).take(texts.indices)
            text_bytes += pc.sum(lengths).as_py() or 0
            if text_bytes > MAX_TEXT_BYTES:
                raise _too_large(file)
            columns[name] = texts.dictionary_decode()
        yield in_schema(pa.table(columns), COLUMNS)
        first += len(batch)


def _too_large(file: Path) -> InputError:
    return InputError(
        f"{file}: it decodes to more than {MAX_ROWS:,} Gram rows, 1 GiB of them or 256 MiB of "
        "their texts. Split it."
    )


def _require_decodable(file: Path, content: bytes, groups: Sequence[RowGroup]) -> None:
    """Raise `InputError` for pages that decode to too much, or that have no checksum.

    The headers of all pages are read, since the footer can state other sizes. Without a checksum a
    flipped bit of a product goes unseen.
    """
    if any(chunk.is_in_other_file for group in groups for chunk in group.chunks):
        raise ValueError("columns in another file")
    if sum(group.rows for group in groups) > MAX_ROWS:
        raise _too_large(file)
    decoded, pages = 0, 0
    for group in groups:
        for chunk in (chunk for chunk in group.chunks if chunk.column in COLUMNS.names):
            values = 0
            for page in read_page_headers(content, chunk):
                if not page.has_checksum:
                    raise InputError(
                        f"{file}: its pages have no checksums. Write it with them, as by "
                        "pyarrow.parquet.write_table(..., write_page_checksum=True)."
                    )
                if page.encoding == DELTA_BYTE_ARRAY:
                    raise InputError(
                        f"{file}: column {chunk.column} has the encoding DELTA_BYTE_ARRAY. Write "
                        "it with the default encodings of pyarrow."
                    )
                decoded += max(page.size_bytes, page.values * VALUE_BYTES)
                values += 0 if page.is_dictionary else page.values
                pages += 1
                if decoded > MAX_DECODED_BYTES or pages > MAX_PAGES:
                    raise _too_large(file)
            if values != chunk.values:  # the reader would go on behind the pages
                raise ValueError("the footer and the pages state different numbers of values")


VALUE_BYTES = 8
MAX_PAGES = 2**18
"""Pages of a file; a header takes some 10 µs to read."""


def _gram_rows(
    sets: Mapping[str, OnboardFeatureSet], table: pa.Table, schema: pa.Schema, name: str
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
        f"{file}: row {row} (drive {quote_name(str(drive)[:MAX_NAME_CHARACTERS])}) {reason}. "
        "Nothing "
        "of the file was loaded: correct or remove the row, and load the file again."
    )


def _numbered(table: pa.Table) -> pa.Table:
    return table.append_column("number", pa.array(range(1, len(table) + 1)))


def _with_digests(rows: pa.Table) -> pa.Table:
    digests, eventful = gram_digests(rows)
    rows = rows.append_column("digest", pa.array(digests, pa.string()))
    return rows.append_column("is_eventful", pa.array(eventful))


def _require_different(file: Path, rows: pa.Table) -> None:
    """Raise `InputError` for the first row with the counts of a row before it."""
    seen: dict[str, str] = {}
    drives, digests = rows["drive_id"].to_pylist(), rows["digest"].to_pylist()
    for row, (drive, digest) in enumerate(zip(drives, digests, strict=True), 1):
        if (other := seen.setdefault(digest, drive)) != drive:
            _refuse(file, row, drive, f"is there twice, first as {quote_name(other)}")


def _require_possible(sets: Mapping[str, OnboardFeatureSet], file: Path, table: pa.Table) -> None:
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
    """Raise `InputError` for a car or a drive that was forgotten, or that has such counts."""
    erasure_log = ErasureLog(warehouse.root)
    cars, drives = (rows[name].to_pylist() for name in NAMES)
    erased, counts = erasure_log.erased(set(cars), set(drives)), erasure_log.erased_count_digests()
    for row, (car, drive, digest) in enumerate(
        zip(cars, drives, rows["digest"].to_pylist(), strict=True), 1
    ):
        if car in erased.vehicles or drive in erased.drives:
            _refuse(file, row, drive, "was forgotten; fleet-slip forget --allow lets it come back")
        if digest in counts:
            _refuse(file, row, drive, "has the counts of a drive that was forgotten")


def _require_new(file: Path, grams: Snapshot, rows: pa.Table) -> None:
    """Raise `RepeatedError` for a drive that is there, with a log or without, under any name.

    Raises `InputError` for a car that would drive more than 24 hours on a day.
    """
    if not grams.paths:
        return
    with open_database(reading=grams.table.folder) as database:
        database.register("counted", rows)
        database.execute("SET VARIABLE gram_files = $files", {"files": grams.paths})
        with reading_files(database, "looking for drives that are there"):
            statement = read_sql("jobs", "counted_again.sql").format(received=RECEIVED_FILES)
            again = database.execute(statement).fetchone()
            statement = read_sql("jobs", "counted_time.sql")
            over = None if again else database.execute(statement, [LONGEST_ROWS]).fetchone()
    if again:
        row, drive, there = again
        _refuse(file, row, drive, f"is there already, as {quote_name(there)}", RepeatedError)
    if over:
        row, drive = over
        reason = "makes its car drive more than 24 hours on a day, with what is stored"
        _refuse(file, row, drive, reason)
