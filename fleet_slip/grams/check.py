"""Checks the Gram rows against two other ways to compute them, bit for bit."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.base import Progress, no_progress
from fleet_slip.catalog.features import PLAIN
from fleet_slip.errors import DataError, StorageError
from fleet_slip.grams.compute import by_sql, has_statement, wide_grams
from fleet_slip.grams.gram_files import recorded_delays
from fleet_slip.grams.update import transaction_name
from fleet_slip.regression.gram import Gram
from fleet_slip.storage.table import TableFile, on_newest
from fleet_slip.warehouse.gram_rows import find_backlog, is_onboard, is_onboard_file
from fleet_slip.warehouse.warehouse import Warehouse

SQL_COSTS = 4
"""The SQL of windows takes minutes for a file: one of so many files is checked."""


@dataclass(frozen=True)
class CheckReport:
    """What was compared. All of it was equal, or `StorageError` would have been raised."""

    files: int
    rows: int
    drives: int
    wide_sets: tuple[str, ...] = ()
    wide_drives: int = 0

    @property
    def ways(self) -> list[tuple[str, int, str]]:
        """What was compared, in how many drives, and that it was equal."""
        ways = ("stored Gram rows against the kernel", "SQL against the kernel")
        found = [(way, self.drives, "yes") for way in ways]
        if wide := ", ".join(self.wide_sets):
            found.append((f"stored against the kernel: {wide}", self.wide_drives, "yes"))
        return found


def check_grams(
    warehouse: Warehouse,
    count: int = 4,
    progress: Progress = no_progress,
    begin: int = 0,
) -> CheckReport:
    """Check the Gram rows of evenly chosen log files, the next ones for the next number `begin`.

    Raises `StorageError` naming the first drive that differs, and `DataError` for nothing to check.
    """
    look = partial(_check, warehouse, count, progress, begin)
    return on_newest((warehouse.logs, warehouse.grams), look)


def _check(warehouse: Warehouse, count: int, progress: Progress, begin: int) -> CheckReport:
    logs, grams = warehouse.logs.snapshot(), warehouse.grams.snapshot()
    if not logs.files:
        raise DataError(
            f"{warehouse.root}: no logs to compute Gram rows from. Load some: fleet-slip "
            "ingest, or fleet-slip run. Gram rows sent by cars are checked by: fleet-slip verify"
        )
    chosen = _evenly(logs.files, count, begin)
    where = find_gram_files(warehouse, grams.files)
    drives = wide_drives = 0
    for file in chosen:
        drives += _compare_ways(warehouse, file, PLAIN, where.get(file.path, ()))
        progress(1, len(chosen))
    catalog = warehouse.catalog
    wide = tuple(
        name
        for name in warehouse.feature_sets()
        if catalog.feature_set(name).windows
        and grams.landed(transaction_name(catalog.identity(name))) is not None
    )
    for name in wide:
        missing = find_backlog(logs, grams, catalog.identity(name)).missing
        computed = [file for file in logs.files if file not in missing]
        for file in _evenly(computed, max(1, count // SQL_COSTS), begin):
            wide_drives += _compare_ways(warehouse, file, name, [one.path for one in grams.files])
    return CheckReport(len(chosen), sum(file.rows for file in chosen), drives, wide, wide_drives)


def _evenly(files: Sequence[TableFile], count: int, begin: int) -> list[TableFile]:
    count = min(count, len(files))
    return [files[(begin + i * len(files) // count) % len(files)] for i in range(count)]


def _compare_ways(
    warehouse: Warehouse, file: TableFile, feature_set: str, places: Iterable[str]
) -> int:
    """Compare the kernel with what is stored, if it is there, and with SQL; count drives."""
    identity = warehouse.catalog.identity(feature_set)
    stored = stored_grams(warehouse, [file], places, identity).get(file.path, {})
    if not stored and feature_set != PLAIN:
        return 0
    late = recorded_delays(warehouse.grams.snapshot(), identity, file.path)
    rows = wide_grams(warehouse, [file], feature_set, late)
    computed, others = grams_of(rows), {"the stored Gram rows": stored}
    if has_statement(warehouse.catalog, feature_set):
        others["SQL"] = grams_of(by_sql(warehouse, [file], feature_set))
    for other, found in others.items():
        if drives := differing_drives(computed, found):
            raise StorageError(
                f"{file.path}: the Gram row of drive {drives[0]} ({feature_set}) differs "
                f"between the kernel and {other}. If the logs have changed since, run: fleet-slip "
                "gram. Otherwise the file or a library is damaged: keep both and report it."
            )
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
    for path in (gram_file.path for gram_file in grams if not is_onboard_file(gram_file)):
        pairs = warehouse.grams.read_combinations(path, ["feature_set", "file"])
        mine = pc.and_(pc.equal(pairs["feature_set"], PLAIN), pc.invert(is_onboard(pairs)))
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
        pairs = warehouse.grams.read(path, ["feature_set", "file"])
        names = pairs["file"].cast(pa.string())
        mine = pc.and_(pc.equal(pairs["feature_set"], identity), pc.is_in(names, paths))
        if pc.any(mine).as_py():
            rows = warehouse.grams.read(path).filter(mine)
            for file in rows["file"].unique().to_pylist():
                found[file] |= grams_of(rows.filter(pc.equal(rows["file"], file)))
    return found
