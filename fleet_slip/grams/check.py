"""Checks the Gram rows against two other ways to compute them, bit for bit."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.base import Progress, no_progress
from fleet_slip.catalogue.features import PLAIN, features
from fleet_slip.errors import DataError, StorageError
from fleet_slip.grams.backlog import find_backlog
from fleet_slip.grams.compute import aggregate, by_sql, rows_by_drive, wide_grams
from fleet_slip.grams.gram_files import is_of_received
from fleet_slip.grams.gram_rows import is_received
from fleet_slip.grams.job import unit_name
from fleet_slip.grams.receiver_delay import recorded_cars
from fleet_slip.regression.gram import Gram
from fleet_slip.storage.table import TableFile, on_newest
from fleet_slip.warehouse.tables import Warehouse

SQL_COSTS = 4
"""The SQL of windows takes minutes for a file: one of so many files is checked."""

INTEGER_ROWS = 5_000
"""Rows of a drive that are also summed by Python integers, which take 50 us a row."""


@dataclass(frozen=True)
class CheckReport:
    """What was compared. All of it was equal, or `StorageError` would have been raised."""

    files: int
    rows: int
    drives: int
    drives_by_integers: int
    wide_sets: tuple[str, ...] = ()
    wide_drives: int = 0


def check_grams(
    warehouse: Warehouse,
    count: int,
    progress: Progress = no_progress,
    begin: int = 0,
) -> CheckReport:
    """Check the Gram rows of evenly chosen log files, the next ones for the next number `begin`.

    Raises `StorageError` naming the first drive that differs, and `DataError` for nothing to check.
    """
    look = partial(_check, warehouse, count, progress, begin)
    return on_newest((warehouse.logs, warehouse.grams), look)


def _check(warehouse: Warehouse, count: int, progress: Progress, begin: int) -> CheckReport:
    logs = warehouse.logs.snapshot()
    if not logs.files:
        raise DataError(
            f"{warehouse.root}: there are no logs, of which Gram rows are computed again. They "
            "come with: fleet-slip run, or ingest. What cars sent is checked by: fleet-slip verify"
        )
    chosen = _evenly(logs.files, count, begin)
    where = find_gram_files(warehouse, warehouse.grams.snapshot().files)
    drives = by_integers = rows = wide_drives = 0
    wide = _computed_wide_sets(warehouse)
    for file in chosen:
        from_sql = grams_of(aggregate(warehouse, [file]))
        stored = stored_grams(warehouse, [file], where.get(file.path, ()))
        _compare(file, "the stored Gram rows", from_sql, stored.get(file.path, {}))
        counts = read_counts(warehouse, file)
        _compare(file, "float64 blocks", from_sql, grams_by_blocks(warehouse, counts))
        by_integers += _check_by_integers(warehouse, file, counts)
        drives += len(from_sql)
        rows += file.rows
        progress(1, len(chosen))
    for name in wide:
        missing = find_backlog(logs, warehouse.grams.snapshot(), features().identity(name)).missing
        computed = [file for file in logs.files if file not in missing]
        some = _evenly(computed, max(1, count // SQL_COSTS), begin)
        wide_drives += sum(_check_wide(warehouse, file, name) for file in some)
    return CheckReport(len(chosen), rows, drives, by_integers, wide, wide_drives)


def _evenly(files: Sequence[TableFile], count: int, begin: int) -> list[TableFile]:
    many = len(files)
    return [files[(begin + i * many // count) % many] for i in range(min(count, many))]


def _computed_wide_sets(warehouse: Warehouse) -> tuple[str, ...]:
    known, grams = features(), warehouse.grams.snapshot()
    return tuple(
        name
        for name in known.sets
        if known.feature_set(name).windows
        and grams.landed(unit_name(known.identity(name))) is not None
    )


def _check_wide(warehouse: Warehouse, file: TableFile, feature_set: str) -> int:
    """Compare the kernel with its SQL and with what is stored, where it is; count drives."""
    identity = features().identity(feature_set)
    grams = [gram_file.path for gram_file in warehouse.grams.snapshot().files]
    kept = stored_grams(warehouse, [file], grams, identity).get(file.path)
    if not kept:
        return 0
    late = recorded_cars(warehouse.grams.snapshot(), identity, file.path)
    rows = by_sql(warehouse, [file], feature_set, late)
    from_sql = grams_of(rows)
    by_kernel = grams_of(wide_grams(warehouse, [file], feature_set, late))
    _compare(file, "the kernel", from_sql, by_kernel)
    _compare(file, f"the stored Gram rows of {feature_set}", from_sql, kept)
    return len(rows["drive_id"].unique())


DriveGrams = dict[tuple[str, tuple[str, ...]], Gram]


def grams_of(rows: pa.Table) -> DriveGrams:
    """Return rows of the table `grams` as Grams, by the names of drive and part."""
    found = {}
    for row in rows.select(["drive_id", "part", "signals", "n", "sums", "products"]).to_pylist():
        signals = tuple(row["signals"].split(",")) if row["signals"] else ()
        drive = row["drive_id"] if row["part"] is None else f"{row['drive_id']}, {row['part']}"
        found[drive, signals] = Gram(signals, row["n"], tuple(row["sums"]), tuple(row["products"]))
    return found


def differing_drives(one: DriveGrams, two: DriveGrams) -> list[str]:
    """Return the drives whose Grams differ, sorted, whatever the order of signals then and now."""
    one, two = _in_one_order(one), _in_one_order(two)
    return sorted({key[0] for key in one.keys() | two.keys() if one.get(key) != two.get(key)})


def _in_one_order(grams: DriveGrams) -> DriveGrams:
    ordered = ((drive, tuple(sorted(signals)), gram) for (drive, signals), gram in grams.items())
    return {(drive, signals): gram.restrict(signals) for drive, signals, gram in ordered}


def find_gram_files(warehouse: Warehouse, grams: Iterable[TableFile]) -> dict[str, tuple[str, ...]]:
    """Return the paths of the Gram files with rows of the logged signals of each log file."""
    found: dict[str, tuple[str, ...]] = {}
    for path in (gram_file.path for gram_file in grams if not is_of_received(gram_file)):
        pairs = warehouse.grams.read_combinations(path, ["feature_set", "file"])
        mine = pc.and_(pc.equal(pairs["feature_set"], PLAIN), pc.invert(is_received(pairs)))
        for file in pairs.filter(mine)["file"].to_pylist():
            found[file] = (*found.get(file, ()), path)
    return found


def stored_grams(
    warehouse: Warehouse,
    files: Sequence[TableFile],
    grams: Iterable[str],
    identity: str = PLAIN,
) -> dict[str, DriveGrams]:
    """Return the Gram rows of some log files and a feature set in some Gram files, by log file."""
    paths = pa.array([file.path for file in files], pa.string())
    found: dict[str, DriveGrams] = defaultdict(dict)
    for path in grams:
        told = warehouse.grams.read(path, ["feature_set", "file"])
        names = told["file"].cast(pa.string())
        mine = pc.and_(pc.equal(told["feature_set"], identity), pc.is_in(names, paths))
        if pc.any(mine).as_py():
            rows = warehouse.grams.read(path).filter(mine)
            for file in rows["file"].unique().to_pylist():
                found[file] |= grams_of(rows.filter(pc.equal(rows["file"], file)))
    return found


def read_counts(warehouse: Warehouse, file: TableFile) -> pa.Table:
    """Return the columns of a log file that its Gram rows are made of, null where it has none."""
    names = ["drive_id", *warehouse.catalogue.gram_signals]
    present = warehouse.logs.read_metadata(file.path).schema.to_arrow_schema().names
    rows = warehouse.logs.read(file.path, [name for name in names if name in present])
    for name in names:
        if name not in present:
            rows = rows.append_column(name, pa.nulls(len(rows), pa.int16()))
    return rows.select(names)


def grams_by_blocks(warehouse: Warehouse, counts: pa.Table) -> DriveGrams:
    """Compute Gram rows by matrix products in float64, exact because blocks are small."""
    found: DriveGrams = {}
    for rows in rows_by_drive(counts):
        drive = rows["drive_id"][0].as_py()
        for signals, matrix in _complete_parts(warehouse, rows):
            found[drive, signals] = Gram.from_counts(signals, matrix)
    return found


def _complete_parts(
    warehouse: Warehouse, rows: pa.Table
) -> list[tuple[tuple[str, ...], np.ndarray[Any, np.dtype[np.int64]]]]:
    """Divide rows by the signals that they have; return each part's signals and counts."""
    names = warehouse.catalogue.gram_signals
    columns = [rows[name].combine_chunks() for name in names]
    present = np.column_stack(
        [column.is_valid().to_numpy(zero_copy_only=False) for column in columns]
    )
    values = np.column_stack(
        [column.fill_null(0).to_numpy(zero_copy_only=False).astype(np.int64) for column in columns]
    )
    parts = []
    number_of_row = present @ (1 << np.arange(len(names)))
    for number in np.unique(number_of_row).tolist():
        pattern = [bool(number >> i & 1) for i in range(len(names))]
        signals = tuple(name for name, there in zip(names, pattern, strict=True) if there)
        parts.append((signals, values[number_of_row == number][:, pattern]))
    return parts


def _check_by_integers(warehouse: Warehouse, file: TableFile, counts: pa.Table) -> int:
    """Compare the float64 blocks with plain Python sums on the first drive's first rows."""
    rows = next(rows_by_drive(counts))
    drive = rows["drive_id"][0].as_py()
    for signals, matrix in _complete_parts(warehouse, rows.slice(0, INTEGER_ROWS)):
        columns = [[int(count) for count in column] for column in matrix.T]
        by_integers = Gram(
            signals,
            len(matrix),
            tuple(map(sum, columns)),
            tuple(
                sum(a * b for a, b in zip(columns[i], columns[j], strict=True))
                for i in range(len(columns))
                for j in range(i + 1)
            ),
        )
        by_blocks = Gram.from_counts(signals, matrix)
        _compare(
            file, "Python integers", {(drive, signals): by_blocks}, {(drive, signals): by_integers}
        )
    return 1


def _compare(file: TableFile, other: str, one: DriveGrams, two: DriveGrams) -> None:
    if drives := differing_drives(one, two):
        raise StorageError(
            f"{file.path}: the Gram of drive {drives[0]} by SQL and by {other} differ. If the Gram "
            "job has not run since the logs changed, run: fleet-slip gram. Otherwise the file or "
            "a library is damaged: keep both and report it."
        )
