"""Import of Gram rows that cars computed on board, from a Parquet table with `COLUMNS`.

A file is imported completely, once, in one commit, or not at all: an error names the first invalid
row and the reason. Its drives have the source `received`, and the column `file` contains
`received/` and the digest of the Parquet file.
"""

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

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
from fleet_slip.catalog import course
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.definitions import limit_of
from fleet_slip.catalog.features import PLAIN, Feature
from fleet_slip.catalog.signals import COUNT_MAX, RECEIVED_FILES, SAMPLE_TIME_S, Signal
from fleet_slip.config import read_named_file
from fleet_slip.errors import InputError, RepeatedError
from fleet_slip.grams.compute import block_name
from fleet_slip.grams.update import (
    files_to_rewrite,
    gram_digests,
    in_schema,
    rows_to_keep,
    write_rows,
)
from fleet_slip.regression.gram import GramTable
from fleet_slip.rendering import Answer, Part, Remark
from fleet_slip.resources import read_sql
from fleet_slip.storage.table import AppTransaction, Change, Snapshot, retry_conflicts
from fleet_slip.warehouse.database import database_errors, open_database, reading_files
from fleet_slip.warehouse.erasure_log import ErasureLog
from fleet_slip.warehouse.gram_reader import BATCH_ROWS, by_signals, gram_table
from fleet_slip.warehouse.warehouse import Warehouse

# Feature sets that cars can compute, with the ranges of their columns and their definition.
#
# The definition is the first 8 bytes of the SHA-256 of the canonical JSON of the identity and of
# name, scale and range of each source signal.

Range = tuple[int, int]

ROWS_IN_A_SUM = 2**31 - 1
"""Maximum number of rows of a Gram row, 248 days: sums of products of int16 stay below 2^61."""

MAX_SIGNALS = 32
"""Maximum number of columns of a feature set that a car computes."""

MAX_COLUMNS = 512
"""Maximum number of columns of a feature set on board: the bits of a mask."""


@dataclass(frozen=True)
class OnboardFeatureSet:
    """A feature set that cars can compute.

    Attributes
    ----------
    name, identity
        Name and identity of the feature set.
    ranges
        Smallest and largest count of each column, in order.
    signals
        Source signals, in the order of the catalog.
    times
        Durations of changes in ticks; empty for a feature set without changes.
    blocks
        Names of the blocks of a drive; None for an undivided drive.
    in_time
        True if the course is corrected for its delay.
    definition
        Number of the feature set in C code.
    """

    name: str
    identity: str
    ranges: Mapping[str, Range]
    signals: tuple[str, ...]
    times: tuple[int, ...]
    blocks: tuple[str | None, ...]
    in_time: bool
    definition: int

    @property
    def key(self) -> str:
        """Name and definition: the value of the column `feature_set` in a Parquet file."""
        return f"{self.name}:{self.definition:016x}"

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns of the Gram rows, in order."""
        return tuple(self.ranges)


def onboard_feature_sets(catalog: Catalog) -> dict[str, OnboardFeatureSet]:
    """Return the feature sets that cars can compute by identity, the logged signals first."""
    sets = {}
    for name in (PLAIN, *catalog.sets):
        feature_set = catalog.feature_set(name)
        if not feature_set.block_ticks and len(feature_set.columns) <= MAX_COLUMNS:
            identity = catalog.identity(name)
            sets[identity] = _onboard_feature_set(catalog, name, identity)
    return sets


def _onboard_feature_set(catalog: Catalog, name: str, identity: str) -> OnboardFeatureSet:
    signals, resolved = catalog.signals, catalog.feature_set(name)
    labels = [course.COURSE, course.YAW_RATE] if resolved.change_ticks else [signals.label]
    names = {*resolved.signals, *labels}
    names |= {signal for f in resolved.features for signal in catalog.features[f].inputs}
    names |= {signal for d in catalog.definitions(name).values() for signal in d.signals}
    sources = {key: signal for key, signal in signals.signals.items() if key in names}
    described: list[Any] = [
        [key, f"{signal.scale:f}", signal.min_count, signal.max_count]
        for key, signal in sources.items()
    ]
    content = described if name == PLAIN else [identity, described]
    digest = sha256_of(canonical_json(content))
    return OnboardFeatureSet(
        name,
        identity,
        {column: _range(catalog, column, resolved.change_ticks) for column in resolved.columns},
        tuple(sources),
        resolved.change_ticks,
        tuple(block_name(resolved, i) for i in range(len(resolved.change_s) or 1)),
        resolved.in_time,
        int.from_bytes(bytes.fromhex(digest[:16]), "little"),
    )


def _range(catalog: Catalog, column: str, times: Sequence[int]) -> Range:
    """Return the smallest and largest count of a column, or of its changes over `times`."""
    signals, label = catalog.signals, catalog.signals.label
    if times and column in (*course.AUXILIARY, label):
        if column == course.STRAIGHT:
            return 0, 1
        units = course.course_units(signals)
        limit = units.largest // units.divisor + 1
        if column == course.TURNED:
            limit = 2 * max(times) * COUNT_MAX // course.TURNED_DIVISOR + 1
        return -limit, limit
    source = signals[column] if column == label else catalog.input(column)
    if isinstance(source, Signal):
        low, high = source.min_count, source.max_count
    else:
        high = limit_of(source.bits if isinstance(source, Feature) else source.definition.bits)
        low = -high
    return (low - high, high - low) if times else (low, high)


# Validity of Gram rows of integer counts.
#
# Let the counts x of a signal in n rows be from l to h, with the sum s, and let c be the sum of the
# products of two signals x and y. Then n l <= s <= n h, and |c| <= n max|x| max|y|. All fit into 64
# bits, since `max_gram_rows` limits n. The matrix of n, sums and products is positive
# semidefinite: scaled to a diagonal of ones, its smallest eigenvalue is not below zero by more than
# the rounding error (Higham, Accuracy and Stability of Numerical Algorithms, section 10.1).

EIGENVALUE_TOLERANCE = 1e-11
LARGEST_SUM = 2**61

NO_ROWS = "has no rows, or more than a drive can have"
SUMS = "has sums outside the ranges of its signals"
PRODUCTS = "has products outside the ranges of its signals"
INDEFINITE = "has a matrix that is not positive semidefinite"


def find_impossible(table: GramTable, ranges: Sequence[tuple[int, int]]) -> dict[int, str]:
    """Return the reasons of impossible Gram rows by position, given the range of each signal."""
    sums, products = table.sums, table.products
    low, high = np.array(ranges, dtype=np.int64).reshape(-1, 2).T
    row, column = np.tril_indices(len(low))
    size = np.maximum(np.abs(low), np.abs(high))
    possible = (table.n >= 1) & (table.n <= max_gram_rows(ranges))
    n = np.where(possible, table.n, 1)[:, None]
    bound = n * (size[row] * size[column])
    faults = {
        NO_ROWS: ~possible,
        SUMS: ((sums < n * low) | (sums > n * high)).any(axis=1),
        PRODUCTS: ((products > bound) | (products < -bound)).any(axis=1),
        INDEFINITE: _indefinite(replace(table, n=n[:, 0])),
    }
    reasons = np.select([*faults.values()], [*faults], "").tolist()
    return {position: reason for position, reason in enumerate(reasons) if reason}


def impossible_rows(
    rows: pa.Table, sets: Mapping[str, OnboardFeatureSet]
) -> Iterator[tuple[dict[str, Any], str]]:
    """Yield impossible Gram rows with the reason, given the feature sets by their name in `rows`.

    Rows of other feature sets are skipped.
    """
    for name in rows["feature_set"].unique().to_pylist():
        if name not in sets:
            continue
        ranges = sets[name].ranges
        same_set = rows.filter(pc.equal(rows["feature_set"], name)).combine_chunks()
        for batch in same_set.to_batches(BATCH_ROWS):
            for signals, alike, _ in by_signals(batch):
                names = signals.split(",") if signals else []
                reasons: dict[int, str] = {}
                if not set(names) <= ranges.keys():
                    reasons = dict.fromkeys(range(len(alike)), "has unknown signals")
                elif names:
                    limits = [ranges[signal] for signal in names]
                    reasons = find_impossible(gram_table(signals, alike), limits)
                for position, reason in reasons.items():
                    yield alike.slice(position, 1).to_pylist()[0], reason


def max_gram_rows(ranges: Sequence[tuple[int, int]]) -> int:
    """Return the maximum number of rows of a Gram row, whose sums stay below 2^61."""
    largest = max((abs(limit) for limits in ranges for limit in limits), default=1)
    return min(ROWS_IN_A_SUM, (LARGEST_SUM - 1) // largest**2)


def _indefinite(table: GramTable) -> BoolArray:
    """Return a mask of the matrices that are not positive semidefinite."""
    matrix = table.moments()
    scale = 1 / np.sqrt(np.maximum(np.diagonal(matrix, axis1=1, axis2=2), 1.0))
    matrix *= scale[:, :, None] * scale[:, None, :]
    indefinite: BoolArray = np.linalg.eigvalsh(matrix)[:, 0] < -EIGENVALUE_TOLERANCE
    return indefinite


COLUMNS = pa.schema(
    [
        ("source", pa.string()),
        ("vehicle_id", pa.string()),
        ("drive_id", pa.string()),
        ("day", pa.date32()),
        ("feature_set", pa.string()),
        ("part", pa.string()),
        (course.COURSE_LATE, pa.int64()),
        ("signals", pa.string()),
        ("n", pa.int64()),
        ("sums", pa.list_(pa.int64())),
        ("products", pa.list_(pa.int64())),
    ]
)
"""Schema of the Parquet file; `part` and `course_late` are optional (`docs/export.md`)."""

OPTIONAL = ("part", course.COURSE_LATE)
NAMES = ("vehicle_id", "drive_id")
TEXTS = tuple(field.name for field in COLUMNS if field.type == pa.string())
MAX_FILE_BYTES = 2**28
MAX_ROWS, MAX_DECODED_BYTES = 500_000, 2**30
MAX_TEXT_BYTES = 2**28
"""Maximum size of the texts of a file; with `MAX_ROWS` rows some 300 bytes each."""
MAX_PAGES = 2**18
"""Maximum number of pages of a file; reading a header takes some 10 µs."""
BATCH_ROWS_READ = 2**12
"""Rows per decoded batch; a row of 200 columns has 160,000 bytes."""
MAX_ROWS_OF_A_DAY = 86_400 * round(1 / SAMPLE_TIME_S)
"""Maximum number of rows of the drives of a car that begin on one day: 24 hours."""
ONE_AT_A_TIME = "receive"
"""Transaction of every import, so that two imports at the same time are a conflict."""


@dataclass(frozen=True)
class OnboardImport(Answer):
    """Result of an import of Gram rows; `new` is False for a file that was imported before."""

    file: str
    new: bool
    gram_rows: int
    drives: int
    rows: int

    def parts(self) -> Iterator[Part]:
        """Return a remark on the imported rows."""
        grams, drives = pluralize(self.gram_rows, "Gram row"), pluralize(self.drives, "drive")
        content = f"{grams} of {drives}, {pluralize(self.rows, 'row')}"
        yield Remark(
            f"{self.file}: {content if self.new else 'nothing to do, it was ingested before'}"
        )


def import_onboard_grams(warehouse: Warehouse, file: Path) -> OnboardImport:
    """Import a file of Gram rows once. Raises `InputError`, `RepeatedError` and `ConflictError`."""
    content = read_named_file(file, MAX_FILE_BYTES, InputError)
    table = _read(file, content)
    digest = hashlib.sha256(content).hexdigest()
    transaction = AppTransaction(f"receive/{digest}", 1)
    drives, rows = pc.count_distinct(table["drive_id"]).as_py(), pc.sum(table["n"]).as_py() or 0
    new = warehouse.grams.snapshot().transaction_version(transaction.name) is None
    report = OnboardImport(str(file), new, len(table), drives, rows)
    if not new:
        return report
    sets = onboard_feature_sets(warehouse.catalog)
    _require_possible(sets, file, table)
    new_rows = _gram_rows(sets, table, warehouse.grams.schema, f"{RECEIVED_FILES}{digest[:24]}")
    numbered = _with_digests(new_rows)
    _require_different(file, numbered)

    def attempt() -> None:
        grams = warehouse.grams.snapshot()
        if grams.transaction_version(transaction.name) is not None:
            return  # another process has imported it in the meantime
        # Checked after the snapshot: an erasure from now on makes this commit a conflict.
        _require_allowed(file, warehouse, numbered)
        _require_new(file, grams, numbered)
        replaced = files_to_rewrite(grams, frozenset())
        merged = list(rows_to_keep(grams, replaced, frozenset()))
        transactions = [transaction, AppTransaction(ONE_AT_A_TIME, (grams.version or 0) + 1)]
        added = write_rows(warehouse, [*merged, new_rows])
        grams.commit_or_discard(Change(added, replaced, transactions, {"job": "receive"}))

    retry_conflicts(attempt)
    return report


_SEE = "If it is a log, give its --mapping, as drafted by: fleet-slip mapping suggest LOG"
VALUE_BYTES = 8


def _read(file: Path, content: bytes) -> pa.Table:
    """Return the rows of a file in the order of `COLUMNS`. Raises `InputError`."""
    stream = pa.BufferReader(content)
    try:
        _require_decodable(file, content)
        schema = pq.ParquetFile(stream).schema_arrow
        columns = _documented_columns(file, schema)
        # Texts stay in dictionaries until their total length is known: one can be in every row.
        texts = [name for name in TEXTS if name in columns and schema.field(name).type != pa.null()]
        parquet = pq.ParquetFile(stream, read_dictionary=texts, page_checksum_verification=True)
        batches = list(_decode(file, parquet.iter_batches(BATCH_ROWS_READ, columns=columns)))
    except (pa.ArrowException, OSError, ValueError, LookupError):
        raise InputError(f"{file}: not a table of Gram rows (docs/export.md). {_SEE}") from None
    if not batches:
        raise InputError(f"{file}: has no Gram rows.")
    return pa.concat_tables(batches).combine_chunks()


def _documented_columns(file: Path, schema: pa.Schema) -> list[str]:
    """Return the columns of `COLUMNS` in a file.

    Raises `InputError` for a missing or repeated column, and for a column of another type.
    """
    columns = [name for name in COLUMNS.names if name in schema.names]
    if missing := set(COLUMNS.names).difference(columns, OPTIONAL):
        raise InputError(
            f"{file}: not a table of Gram rows, column {min(missing)} is missing. {_SEE}"
        )
    for field in map(COLUMNS.field, columns):
        indices = schema.get_all_field_indices(field.name)
        if len(indices) > 1:
            raise InputError(f"{file}: has two columns {field.name}. Leave one of them out.")
        kind = schema.field(indices[0]).type
        if not _is_convertible(kind, field.type):
            raise InputError(
                f"{file}: column {field.name} has the type {quote_name(kind)[:80]}; write it "
                f"as {field.type} (docs/export.md)."
            )
    return columns


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


def _require_decodable(file: Path, content: bytes) -> None:
    """Raise `InputError` for pages that decode to too many bytes, or that have no checksum.

    Reads the headers of all pages, since the footer can state other sizes. Without a checksum a
    flipped bit of a product remains undetected.
    """
    rows, pages = read_pages(content)
    if rows > MAX_ROWS:
        raise _too_large(file)
    decoded = 0
    for number, page in enumerate(page for page in pages if page.column in COLUMNS.names):
        if not page.has_checksum:
            raise InputError(
                f"{file}: its pages have no checksums. Write it with them, as by "
                "pyarrow.parquet.write_table(..., write_page_checksum=True)."
            )
        decoded += max(page.size_bytes, page.values * VALUE_BYTES)
        if decoded > MAX_DECODED_BYTES or number >= MAX_PAGES:
            raise _too_large(file)


# Footer and page headers of a Parquet file, which bound what it decodes to.
#
# They are structs in the compact protocol of Thrift (`parquet.thrift`). pyarrow does not expose
# page headers, and aborts the process for some damaged footers if asked for a column.

_DATA, _DICTIONARY, _DATA_V2 = 5, 7, 8
_MAX_FOOTER_BYTES, _MAX_HEADER_BYTES, _DEEPEST, _MAX_SHIFT = 2**24, 2**16, 12, 63


class Page(NamedTuple):
    """A page of a column: the size and the number of the values that it decodes to."""

    column: str
    size_bytes: int
    values: int
    has_checksum: bool


def read_pages(content: bytes) -> tuple[int, Iterator[Page]]:
    """Return the rows and the pages of a file. Raises `ValueError` or `IndexError` for damage."""
    size, end = int.from_bytes(content[-8:-4], "little"), len(content) - 8
    if content[-4:] != b"PAR1" or size > min(_MAX_FOOTER_BYTES, end):
        raise ValueError("a file without a footer, or with a large one")
    footer = _ThriftReader(memoryview(content)[end - size : end]).struct()
    groups = _field(footer, 4, list) if footer.get(3) else []
    chunks = [_field(chunk, 3, dict) for group in groups for chunk in _field(group, 1, list)]
    rows = sum(_field(group, 3, int) for group in groups)
    return rows, (page for chunk in chunks for page in _pages_of(content, chunk))


def _pages_of(content: bytes, chunk: dict[int, Any]) -> Iterator[Page]:
    """Yield the pages of a column in a row group."""
    column = bytes(_field(chunk, 3, list)[0]).decode()
    at = min(offset for offset in (chunk.get(11), _field(chunk, 9, int)) if offset)
    end = at + _field(chunk, 7, int)
    remaining = _field(chunk, 5, int)
    while at < end:
        reader = _ThriftReader(memoryview(content)[at : at + _MAX_HEADER_BYTES])
        header = reader.struct()
        kind = next((kind for kind in (_DATA, _DICTIONARY, _DATA_V2) if kind in header), 0)
        values = _field(_field(header, kind, dict), 1, int)
        remaining -= 0 if kind == _DICTIONARY else values
        yield Page(column, _field(header, 2, int), values, has_checksum=4 in header)
        at += reader.at + _field(header, 3, int)
    if remaining:  # pyarrow can continue behind the pages
        raise ValueError("the footer and the pages state different numbers of values")


def _field(fields: Any, number: int, kind: type) -> Any:
    """Return a field of a struct. Raises `ValueError` if missing, negative or of another type."""
    value = fields.get(number) if isinstance(fields, dict) else None
    if not isinstance(value, kind) or (isinstance(value, int) and value < 0):
        raise ValueError(f"the field {number} of a struct is not as it must be")
    return value


class _ThriftReader:
    """Reads values in their order; `at` is the position behind the last one."""

    def __init__(self, content: memoryview) -> None:
        self.content, self.at, self._depth = content, 0, 0

    def struct(self) -> dict[int, Any]:
        """Return the fields of a struct by their numbers."""
        fields: dict[int, Any] = {}
        number = 0
        while byte := self._byte():
            number = number + (byte >> 4) if byte >> 4 else self._value(4)
            fields[number] = self._value(byte & 15)
        return fields

    def _byte(self) -> int:
        self.at += 1
        return self.content[self.at - 1]

    def _varint(self) -> int:
        value = 0
        for shift in range(0, _MAX_SHIFT + 1, 7):
            byte = self._byte()
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value
        raise ValueError("a number is too long")

    def _value(self, kind: int) -> Any:
        """Return a value of a type. The type of a Boolean contains its value."""
        match kind:
            case 1 | 2:
                return kind == 1
            case 3:
                return self._byte()
            case 4 | 5 | 6:
                zigzag = self._varint()
                return (zigzag >> 1) ^ -(zigzag & 1)
            case 7:
                self.at += 8
                return None
            case 8:
                size = self._varint()
                self.at += size
                return bytes(self.content[self.at - size : self.at])
            case 9 | 10 | 12 if self._depth < _DEEPEST:
                self._depth += 1
                value = self.struct() if kind == 12 else self._list()
                self._depth -= 1
                return value
        raise ValueError("a type that Parquet does not use, or structs that are nested too deeply")

    def _list(self) -> list[Any]:
        head = self._byte()
        size = self._varint() if head >> 4 == 15 else head >> 4
        if size > len(self.content):
            raise ValueError("a list is too long")
        return [self._value(head & 15) for _ in range(size)]


def _too_large(file: Path) -> InputError:
    return InputError(
        f"{file}: it decodes to more than {MAX_ROWS:,} Gram rows, 1 GiB of them or 256 MiB of "
        "their texts. Split it."
    )


def _decode(file: Path, batches: Iterable[pa.RecordBatch]) -> Iterator[pa.Table]:
    """Yield the rows of batches with normalized names. Raises `InputError` for too long texts."""
    first, text_bytes = 1, 0
    for batch in batches:
        batch.validate(full=True)  # texts are UTF-8
        columns = {}
        for field in (field for field in COLUMNS if field.name in batch.schema.names):
            is_text = field.name in TEXTS
            kind = pa.dictionary(pa.int32(), pa.string()) if is_text else field.type
            column = batch[field.name].cast(kind)
            if field.name in NAMES:
                column = _normalize_names(file, batch, field.name, column, first)
            if is_text:
                lengths = pc.binary_length(column.dictionary).take(column.indices)
                text_bytes += pc.sum(lengths).as_py() or 0
                if text_bytes > MAX_TEXT_BYTES:
                    raise _too_large(file)
                column = column.dictionary_decode()
            columns[field.name] = column
        yield in_schema(pa.table(columns), COLUMNS)
        first += len(batch)


def _normalize_names(
    file: Path, batch: pa.RecordBatch, column: str, texts: pa.DictionaryArray, first: int
) -> pa.DictionaryArray:
    """Return the names of drives or cars without spaces around them, composed."""
    names = [normalize_name(text) for text in texts.dictionary.to_pylist()]
    for index, name in enumerate(names):
        if name and (fault := find_name_fault(name)):
            row = pc.index(texts.indices, index).as_py()
            _refuse(file, first + row, batch["drive_id"][row], f"has a {column} that {fault}")
    return pa.DictionaryArray.from_arrays(texts.indices, pa.array(names, pa.string()))


def _gram_rows(
    sets: Mapping[str, OnboardFeatureSet], table: pa.Table, schema: pa.Schema, name: str
) -> pa.Table:
    """Return the rows in the schema of the table `grams`."""
    identities = {feature_set.key: identity for identity, feature_set in sets.items()}
    names = pa.array([identities[key] for key in table["feature_set"].to_pylist()])
    rows = table.set_column(table.column_names.index("feature_set"), "feature_set", names)
    rows = rows.append_column("file", pa.repeat(name, len(table)))
    return in_schema(rows.append_column("clipped", pa.repeat(0, len(table))), schema)


def _refuse(
    file: Path, row: int, drive: object, reason: str, error: type[InputError] = InputError
) -> NoReturn:
    raise error(
        f"{file}: row {row} (drive {quote_name(str(drive)[:MAX_NAME_CHARACTERS])}) {reason}. "
        "Nothing of the file was loaded: correct or remove the row, and load the file again."
    )


def _numbered(table: pa.Table) -> pa.Table:
    return table.append_column("number", pa.array(range(1, len(table) + 1)))


def _with_digests(rows: pa.Table) -> pa.Table:
    digests, eventful = gram_digests(rows)
    rows = _numbered(rows).append_column("digest", pa.array(digests, pa.string()))
    return rows.append_column("is_eventful", pa.array(eventful))


def _require_different(file: Path, rows: pa.Table) -> None:
    """Raise `InputError` for the first row with the counts of an earlier row."""
    first_drives: dict[str, str] = {}
    drives, digests = rows["drive_id"].to_pylist(), rows["digest"].to_pylist()
    for row, (drive, digest) in enumerate(zip(drives, digests, strict=True), 1):
        if (other := first_drives.setdefault(digest, drive)) != drive:
            _refuse(file, row, drive, f"appears twice, first as {quote_name(other)}")


def _require_possible(sets: Mapping[str, OnboardFeatureSet], file: Path, table: pa.Table) -> None:
    """Raise `InputError` for the first impossible row."""
    by_key = {feature_set.key: feature_set for feature_set in sets.values()}
    described = [
        {"columns": feature_set.columns, "parts": [block or "" for block in feature_set.blocks]}
        | {"key": key, "in_time": feature_set.in_time}
        for key, feature_set in by_key.items()
    ]
    delays = {
        "earliest": course.LATE_PARTS * course.MIN_COURSE_DELAY,
        "latest": course.LATE_PARTS * course.MAX_COURSE_DELAY,
    }
    with open_database() as database, database_errors("checking Gram rows"):
        database.register("counted", _numbered(table))
        database.register("known", pa.Table.from_pylist(described))
        statement = read_sql("jobs", "counted_wrong.sql")
        fault = database.execute(statement, {**delays, "longest": MAX_ROWS_OF_A_DAY}).fetchone()
    if fault:
        _refuse(file, *fault)
    for row, reason in impossible_rows(_numbered(table), by_key):
        _refuse(file, row["number"], row["drive_id"], reason)


def _require_allowed(file: Path, warehouse: Warehouse, rows: pa.Table) -> None:
    """Raise `InputError` for an erased car or drive, or for the counts of an erased drive."""
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
    """Raise `RepeatedError` for a drive in the data root, with a log or without, under any name.

    Raises `InputError` for a car that would drive more than 24 hours on a day.
    """
    if not grams.paths:
        return
    with open_database(reading=grams.table.folder) as database:
        database.register("counted", rows)
        database.execute("SET VARIABLE gram_files = $files", {"files": grams.paths})
        with reading_files(database, "finding repeated drives"):
            repetitions = read_sql("jobs", "counted_again.sql").format(received=RECEIVED_FILES)
            repeated = database.execute(repetitions).fetchone()
            excesses = read_sql("jobs", "counted_time.sql")
            excess = database.execute(excesses, [MAX_ROWS_OF_A_DAY]).fetchone()
    if repeated:
        row, drive, stored = repeated
        _refuse(file, row, drive, f"is stored already, as {quote_name(stored)}", RepeatedError)
    if excess:
        reason = "exceeds 24 hours of driving of its car on a day, with the stored rows"
        _refuse(file, excess[0], excess[1], reason)
