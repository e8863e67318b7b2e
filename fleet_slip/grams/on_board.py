"""Takes in Gram rows that cars counted on board: a Parquet or Arrow table, beside rows of logs.

The table has the columns of `COLUMNS`. It lands whole, once, in one commit, or not at all: an error
names the first row that cannot be, and why. A row becomes one of `grams`: its drive has the source
`received`, and instead of a log file it names `received/` and the digest of the table's file.
"""

import hashlib
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import date, timedelta
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from fleet_slip.arrays import BoolArray, IntArray
from fleet_slip.base import canonical_json, sha256_of, shown
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
from fleet_slip.catalogue.facts import RECEIVED, RECEIVED_FILES
from fleet_slip.catalogue.features import PLAIN, FeatureSet, features
from fleet_slip.catalogue.signals import COUNT_MAX, SAMPLE_TIME_S, Signal, catalogue
from fleet_slip.catalogue.time_columns import Feature
from fleet_slip.config import read_named_file
from fleet_slip.errors import InputError, RepeatedError
from fleet_slip.grams.compute import Parts
from fleet_slip.grams.gram_files import content_keys, files_to_rewrite, rows_to_keep, write_rows
from fleet_slip.grams.gram_rows import gram_table, is_received
from fleet_slip.regression.exact import is_semidefinite
from fleet_slip.regression.gram import packed_size
from fleet_slip.storage.table import Change, Snapshot, Unit, retry_conflicts
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
        columns: of its Gram rows, in order.
        ranges: the smallest and the largest count of each.
        signals: what a car must know to count it, in catalogue order.
        times: over how many ticks columns change; none where they stand for themselves.
        parts: what those parts of a drive are called; None alone where it is not divided.
        in_time: whether the course is moved by its delay.
        definition: what C code calls it.
    """

    name: str
    identity: str
    columns: tuple[str, ...]
    ranges: tuple[Range, ...]
    signals: tuple[str, ...]
    times: tuple[int, ...]
    parts: tuple[str | None, ...]
    in_time: bool
    definition: int

    @property
    def key(self) -> str:
        """What a table of Gram rows calls it: its name, and what its columns mean."""
        return f"{self.name}:{self.definition:016x}"

    def ranges_of(self, columns: Sequence[str]) -> list[Range]:
        """Return the ranges of some columns."""
        known = dict(zip(self.columns, self.ranges, strict=True))
        return [known[name] for name in columns]


@cache
def counted_sets() -> dict[int, CountedSet]:
    """Return the sets by their definitions, the logged signals first."""
    known = features()
    found = [_counted(name) for name in (PLAIN, *known.sets) if _can_be(known.feature_set(name))]
    return {one.definition: one for one in found}


@cache
def counted_by_identity() -> dict[str, CountedSet]:
    """Return the sets by what their Gram rows carry."""
    return {one.identity: one for one in counted_sets().values()}


def _can_be(one: FeatureSet) -> bool:
    divided = one.regimes or one.block_ticks or one.row_folds or one.lagged
    return not divided and len(one.columns) <= MOST_COLUMNS


def _counted(name: str) -> CountedSet:
    one, known = features().feature_set(name), catalogue()
    used = {*one.signals, known.label}
    if one.change_ticks:
        used = {*one.signals, COURSE, YAW_RATE}
    used |= {signal for f in one.features for signal in features().features[f].inputs}
    used |= {signal for d in features().definitions(name).values() for signal in d.signals}
    signals = tuple(signal for signal in known.signals if signal in used)
    return CountedSet(
        name,
        features().identity(name),
        one.columns,
        tuple(_range(column, one.change_ticks) for column in one.columns),
        signals,
        one.change_ticks,
        Parts.of_set(features(), one).times or (None,),
        one.in_time,
        _definition_of(signals, None if name == PLAIN else features().identity(name)),
    )


def _definition_of(signals: Sequence[str], identity: str | None) -> int:
    known = [
        [name, f"{s.scale:f}", s.min_count, s.max_count]
        for name in signals
        for s in [catalogue()[name]]
    ]
    content = canonical_json(known if identity is None else [identity, known])
    return int.from_bytes(bytes.fromhex(sha256_of(content)[:16]), "little")


def _range(column: str, times: Sequence[int]) -> Range:
    if times and column in (*BESIDE, catalogue().label):
        return _range_beside(column, max(times))
    of = catalogue()[column] if column == catalogue().label else features().of(column)
    if isinstance(of, Signal):
        least, most = of.min_count, of.max_count
    else:
        most = limit_of(of.bits if isinstance(of, Feature) else of.definition.bits)
        least = -most
    return (least - most, most - least) if times else (least, most)


def _range_beside(column: str, ticks: int) -> Range:
    if column == STRAIGHT:
        return 0, 1
    units = course_units()
    most = units.largest // units.divisor + 1
    if column == TURNED:
        most = 2 * ticks * COUNT_MAX // COARSER + 1
    return -most, most


# Which Gram rows no drive of integer counts can have, exactly.
#
# Of n rows whose counts x of a signal are whole numbers from l to h, with the sum s and the sum of
# squares d, and c the sum of products of two signals x and y,
#
#     n l <= s <= n h                               each count is in its range
#     d = s modulo 2                                x^2 and x are both odd or both even
#     d <= (l + h) s - n l h                        (x - l) (h - x) >= 0
#     d >= (2 a + 1) s - n a (a + 1), a = floor(s/n)  (x - a) (x - a - 1) >= 0, for any whole a
#     |c| <= n max|x| max|y|
#
# in 64 bits: n is so small (`most_rows`) that nothing reaches 2^63. And the matrix of n, sums and
# products is positive semidefinite. That is decided in binary64 where it can be, on the matrix
# scaled to a diagonal of ones: its least eigenvalue is computed to within m^2 u or so, 1e-13 for m
# = 33 (Higham, Accuracy and Stability of Numerical Algorithms, section 10.1). Beyond `NEAR` of
# zero its sign is sure; what is between is decided in whole numbers, 0.1 ms each with 11 signals.

NEAR = 1e-11
LARGEST_SUM = 2**61

NO_ROWS = "has no rows, or more than a drive can have"
SUMS = "has sums outside the ranges of its signals"
PRODUCTS = "has products that no integer counts can have"
INDEFINITE = "has a matrix that is not positive semidefinite"


def find_impossible(
    rows: IntArray, sums: IntArray, products: IntArray, ranges: Sequence[tuple[int, int]]
) -> dict[str, IntArray]:
    """Return impossible Gram rows by reason, of n (m,), sums (m, k), products and k ranges."""
    least, most = np.array(ranges, dtype=np.int64).reshape(-1, 2).T
    found: dict[str, IntArray] = {}
    left = np.arange(len(rows))
    for reason in (NO_ROWS, SUMS, PRODUCTS, INDEFINITE):
        n, s, p = rows[left], sums[left], products[left]
        bad: Any
        if reason == NO_ROWS:
            bad = np.array((n < 1) | (n > most_rows(ranges)), dtype=np.bool_)
        elif reason == SUMS:
            bad = ((s < n[:, None] * least) | (s > n[:, None] * most)).any(axis=1)
        elif reason == PRODUCTS:
            bad = _bad_products(n[:, None], s, p, least, most)
        else:
            bad = _indefinite(n, s, p)
        if bad.any():
            found[reason] = left[bad]
            left = left[~bad]
    return found


def most_rows(ranges: Sequence[tuple[int, int]]) -> int:
    """Return of how many rows a Gram row can be: no sum of their products reaches 2^61."""
    largest = max((abs(end) for one in ranges for end in one), default=1)
    return min(ROWS_IN_A_SUM, (LARGEST_SUM - 1) // largest**2)


def _bad_products(
    n: IntArray, sums: IntArray, products: IntArray, least: IntArray, most: IntArray
) -> BoolArray:
    row, column = np.tril_indices(len(least))
    size = np.maximum(np.abs(least), np.abs(most))
    bound = n * (size[row] * size[column])
    squares, below = products[:, np.flatnonzero(row == column)], sums // n
    bad: BoolArray = ((products > bound) | (products < -bound)).any(axis=1)
    bad |= ((squares ^ sums) & 1 != 0).any(axis=1)
    bad |= (squares > (least + most) * sums - n * (least * most)).any(axis=1)
    bad |= (squares < (2 * below + 1) * sums - n * (below * (below + 1))).any(axis=1)
    return bad


def _indefinite(n: IntArray, sums: IntArray, products: IntArray) -> BoolArray:
    """Whether each matrix is not positive semidefinite."""
    k = sums.shape[1]
    row, column = np.tril_indices(k)
    matrix = np.zeros((len(n), k + 1, k + 1))
    matrix[:, 0, 0], matrix[:, 1:, 0] = n, sums
    matrix[:, row + 1, column + 1] = products
    scale = 1 / np.sqrt(np.maximum(np.diagonal(matrix, axis1=1, axis2=2), 1.0))
    matrix *= scale[:, :, None] * scale[:, None, :]
    smallest = np.linalg.eigvalsh(matrix)[:, 0]  # of the lower triangle
    bad: BoolArray = smallest < -NEAR
    for at in np.flatnonzero(np.abs(smallest) <= NEAR).tolist():
        packed = products[at].tolist()
        triangle = [[int(n[at])]]
        for i, total in enumerate(sums[at].tolist()):
            triangle.append([total, *packed[i * (i + 1) // 2 : (i + 1) * (i + 2) // 2]])
        bad[at] = not is_semidefinite(triangle)
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

_NUMBERS = ("sums", "products")
OPTIONAL = ("part", COURSE_LATE)
LARGEST_BYTES, MOST_UNPACKED_BYTES = 2**28, 2**30
MOST_ROWS = 500_000
BATCH_ROWS = 2**13
LONGEST_ROWS = 86_400 * round(1 / SAMPLE_TIME_S)
"""Rows of a day: a drive is over by then."""
FIRST_DAY = date(2000, 1, 1)
"""A car's clock that says less has not been set."""
ONE_AT_A_TIME = "receive"
"""Unit of every such commit: two at once, which could bring the same drive, are a conflict."""


@dataclass(frozen=True)
class CountedReport:
    """What became of a file of Gram rows: whether it is new, its drives, and rows behind them."""

    file: str
    new: bool
    gram_rows: int
    drives: int
    rows: int


def ingest_counted(warehouse: Warehouse, file: Path) -> CountedReport:
    """Land the Gram rows of a file, once. Raises `InputError`, `RepeatedError`, `ConflictError`."""
    content = read_named_file(file, LARGEST_BYTES, InputError)
    table = _read(file, content)
    digest = hashlib.sha256(content).hexdigest()
    unit = Unit(f"receive/{digest}", 1)
    drives, rows = pc.count_distinct(table["drive_id"]).as_py(), pc.sum(table["n"]).as_py()
    report = CountedReport(str(file), True, len(table), drives, rows or 0)
    if warehouse.grams.snapshot().landed(unit.name) is not None:
        return CountedReport(str(file), False, len(table), drives, rows or 0)
    mine = _gram_rows(file, table, warehouse.grams.schema, f"{RECEIVED_FILES}{digest[:24]}")

    def attempt() -> None:
        grams = warehouse.grams.snapshot()
        if grams.landed(unit.name) is not None:  # meanwhile, by another process
            return
        # Asked after the snapshot: who forgets a car from now on makes this commit a conflict.
        _require_allowed(file, warehouse, mine)
        _require_new(file, grams, mine)
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
        if content[:4] == b"PAR1":
            parquet = pq.ParquetFile(pa.BufferReader(content), page_checksum_verification=True)
            metadata = parquet.metadata
            _require_size(file, metadata.num_rows, _require_checksums(file, content, metadata))
            table = parquet.read()
        else:
            table = pa.ipc.open_file(pa.BufferReader(content)).read_all()
            table.validate(full=True)
            _require_size(file, len(table), table.nbytes)
        absent = [name for name in COLUMNS.names if name not in {*table.column_names, *OPTIONAL}]
        if absent:
            raise InputError(f"{file}: no table of Gram rows: no column {absent[0]}. {_SEE}")
        columns = [
            table[one.name].cast(one.type)
            if one.name in table.column_names
            else pa.nulls(len(table), one.type)
            for one in COLUMNS
        ]
    except (pa.ArrowException, OSError, ValueError, IndexError) as error:
        raise InputError(
            f"{file}: cannot be read as a table of Gram rows: {error}. {_SEE}"
        ) from None
    return pa.table(columns, schema=COLUMNS).combine_chunks()


_NOTE = {"job": "receive"}
_SEE = "docs/export.md has its columns."


def _require_size(file: Path, rows: int, unpacked_bytes: int) -> None:
    if not rows:
        raise InputError(f"{file}: has no Gram rows.")
    if rows > MOST_ROWS or unpacked_bytes > MOST_UNPACKED_BYTES:
        raise InputError(f"{file}: more than {MOST_ROWS:,} Gram rows or 1 GiB of them. Divide it.")


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


def _gram_rows(file: Path, table: pa.Table, schema: pa.Schema, name: str) -> pa.Table:
    """Return rows of `grams`. Raises `InputError` for the first row that no drive can have."""
    wrong = dict(_find_wrong(table))
    if wrong:
        _refuse(file, table, min(wrong), wrong[min(wrong)])
    identities = {one.key: one.identity for one in counted_sets().values()}
    known: dict[str, Any] = {one: table[one] for one in COLUMNS.names}
    known["feature_set"] = [identities[key] for key in table["feature_set"].to_pylist()]
    known |= {"file": pa.repeat(name, len(table)), "clipped": pa.repeat(0, len(table))}
    columns = [
        pa.array(known[one.name], one.type)
        if isinstance(known.get(one.name), list)
        else known[one.name].cast(one.type)
        if one.name in known
        else pa.nulls(len(table), one.type)
        for one in schema
    ]
    return pa.table(columns, schema=schema)


def _refuse(
    file: Path, table: pa.Table, row: int, reason: str, error: type[InputError] = InputError
) -> None:
    drive = shown(str(table["drive_id"][row].as_py()))
    raise error(
        f"{file}: row {row + 1} (drive {drive}) {reason}. Nothing of the file landed: mend the row "
        "or leave it out, and give the file again."
    )


def _find_wrong(table: pa.Table) -> Iterator[tuple[int, str]]:
    """Yield rows that cannot be, by number from 0, and why."""
    sets = {one.key: one for one in counted_sets().values()}
    kinds: dict[tuple[str, str], list[int]] = defaultdict(list)
    rows_of: Counter[tuple[str, ...]] = Counter()
    first_of: dict[tuple[str, ...], int] = {}
    car_of: dict[str, tuple[str, date]] = {}
    plain = table.select([name for name in COLUMNS.names if name not in _NUMBERS])
    lists = [table[name].combine_chunks() for name in _NUMBERS]
    lengths = zip(*(pc.list_value_length(one).to_pylist() for one in lists), strict=True)
    holes = any(one.flatten().null_count for one in lists)
    for row, (said, sizes) in enumerate(zip(plain.to_pylist(), lengths, strict=True)):
        one = sets.get(said["feature_set"])
        if reason := _contradiction(said, sizes, one):
            yield row, reason
            continue
        drive, signals = said["drive_id"], said["signals"]
        whole = (drive, said["feature_set"], said["part"] or "")
        rows_of[whole] += said["n"]
        car = said["vehicle_id"], said["day"]
        if car_of.setdefault(drive, car) != car:
            yield row, "is of another car or day than a row of its drive before"
        elif first_of.setdefault((*whole, signals), row) != row:
            yield row, "is there twice"
        elif rows_of[whole] > LONGEST_ROWS:
            yield row, "has more rows than the day of a drive has time for"
        elif holes:
            yield row, "or another has a sum or a product that is null"
        else:
            kinds[said["feature_set"], signals].append(row)
    for (key, signals), rows in kinds.items():
        for first in range(0, len(rows) if signals else 0, BATCH_ROWS):
            some = rows[first : first + BATCH_ROWS]
            told = gram_table(signals, table.take(pa.array(some)))
            ranges = sets[key].ranges_of(told.signals)
            for reason, at in find_impossible(told.n, told.sums, told.products, ranges).items():
                yield from ((some[place], reason) for place in at.tolist())


def _contradiction(said: dict[str, Any], sizes: tuple[Any, ...], one: CountedSet | None) -> str:
    """Return why a row cannot be of a feature set, by all but its numbers; nothing if it can."""
    if absent := [name for name, value in said.items() if value is None and name not in OPTIONAL]:
        return f"has no {absent[0]}"
    if one is None:
        return "is of a feature set, or of signals, that mean something else here"
    signals, late = _names(said["signals"]), said[COURSE_LATE]
    least, most = (LATE_PARTS * ticks * one.in_time for ticks in (MOST_EARLY, MOST_LATE))
    wrong = {
        f"has another source than {RECEIVED!r}": said["source"] != RECEIVED,
        "has no rows": said["n"] < 1,
        "has no name of a car": not said["vehicle_id"].strip(),
        "has no name of a drive": not said["drive_id"].strip(),
        "has signals that its set has not, or in another order": signals
        != [name for name in one.columns if name in signals],
        "has not the sums and products of its signals": sizes
        != (len(signals), packed_size(len(signals))),
        "has a part that its set has not": said["part"] not in one.parts,
        "is corrected by a delay that no course has": one.in_time != (late is not None)
        or not least <= (late or 0) <= most,
        "is of a day before 2000 or in the future": not FIRST_DAY
        <= said["day"]
        <= date.today() + timedelta(days=1),
    }
    return next((reason for reason, holds in wrong.items() if holds), "")


def _names(signals: str) -> list[str]:
    return signals.split(",") if signals else []


def _require_allowed(file: Path, warehouse: Warehouse, rows: pa.Table) -> None:
    """Raise `InputError` for a car or a drive that was forgotten."""
    cars, drives = (rows[name].cast(pa.string()) for name in ("vehicle_id", "drive_id"))
    barred = Audit(warehouse.root).barred(cars.unique().to_pylist(), drives.unique().to_pylist())
    for row, names in enumerate(zip(cars.to_pylist(), drives.to_pylist(), strict=True)):
        if names[0] in barred.vehicles or names[1] in barred.drives:
            _refuse(file, rows, row, "was forgotten; fleet-slip forget --allow lets it come back")


def _require_new(file: Path, grams: Snapshot, rows: pa.Table) -> None:
    """Raise `RepeatedError` for a drive that is there, with a log or without, under any name.

    A drive that cars sent may come again with the rows of another feature set.
    """
    columns = [rows[name].cast(pa.string()) for name in ("drive_id", "feature_set", "vehicle_id")]
    drives, sets, cars = (one.to_pylist() for one in columns)
    asked: dict[Any, int] = {}
    for row, drive in enumerate(drives):
        asked.setdefault((drive, sets[row]), row)
        asked.setdefault((drive, None), row)
    asked |= {key: row for row, key in enumerate(content_keys(rows)) if key}
    of = pa.array(sorted({*cars}), pa.string()), pa.array(sorted({*drives}), pa.string())
    for one in grams.files:
        there = grams.table.read(one.path)
        told = (there[name].cast(pa.string()) for name in ("vehicle_id", "drive_id"))
        there = there.filter(pc.or_(*(pc.is_in(a, b) for a, b in zip(told, of, strict=True))))
        came, names = is_received(there).to_pylist(), there["drive_id"].to_pylist()
        identities = there["feature_set"].to_pylist()
        for at, content in enumerate(content_keys(there)):
            named = (names[at], identities[at] if came[at] else None)
            found = asked.get(named, asked.get(content))
            if found is not None:
                why = f"is there already, as {shown(names[at])}"
                _refuse(file, rows, found, why, RepeatedError)
