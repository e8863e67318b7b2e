"""Comparison of stored Gram rows with the kernel and with SQL, bit for bit."""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.base import Progress, no_progress
from fleet_slip.catalog.features import PLAIN
from fleet_slip.errors import DataError, StorageError
from fleet_slip.grams.compute import by_sql, has_statement
from fleet_slip.grams.drive_sums import wide_grams
from fleet_slip.grams.gram_files import recorded_delays
from fleet_slip.grams.update import transaction_name
from fleet_slip.regression.gram import Gram
from fleet_slip.storage.table import Snapshot, TableFile, retry_if_stale
from fleet_slip.warehouse.gram_reader import find_backlog
from fleet_slip.warehouse.warehouse import Warehouse

SQL_COSTS = 4
"""Checks of plain features per check of windows, whose SQL takes minutes for a file."""


@dataclass(frozen=True)
class CheckReport:
    """Number of files and drives that were compared and equal."""

    files: int
    rows: int
    drives: int
    wide_sets: tuple[str, ...] = ()
    wide_drives: int = 0

    @property
    def ways(self) -> list[tuple[str, int, str]]:
        """Each comparison, its number of drives, and its result."""
        ways = ("stored Gram rows against the kernel", "SQL against the kernel")
        rows = [(way, self.drives, "yes") for way in ways]
        if wide := ", ".join(self.wide_sets):
            rows.append((f"stored against the kernel: {wide}", self.wide_drives, "yes"))
        return rows


def check_grams(
    warehouse: Warehouse, count: int = 4, progress: Progress = no_progress, begin: int = 0
) -> CheckReport:
    """Check the Gram rows of `count` evenly spaced log files, the first one at `begin`.

    Raises `StorageError` naming the first drive that differs, and `DataError` for nothing to check.
    """
    look = partial(_check, warehouse, count, progress, begin)
    return retry_if_stale((warehouse.logs, warehouse.grams), look)


def _check(warehouse: Warehouse, count: int, progress: Progress, begin: int) -> CheckReport:
    logs, grams = warehouse.logs.snapshot(), warehouse.grams.snapshot()
    if not logs.files:
        raise DataError(
            f"{warehouse.root}: no logs to compute Gram rows from. Load some: fleet-slip "
            "ingest, or fleet-slip run. Gram rows sent by cars are checked by: fleet-slip verify"
        )
    files = _evenly(logs.files, count, begin)
    catalog = warehouse.catalog
    wide = tuple(
        name
        for name in warehouse.feature_sets()
        if catalog.feature_set(name).windows
        and grams.transaction_version(transaction_name(catalog.identity(name))) is not None
    )
    work = [(file, PLAIN) for file in files]
    for name in wide:
        missing = find_backlog(logs, grams, catalog.identity(name)).missing
        computed = [file for file in logs.files if file not in missing]
        work += [(file, name) for file in _evenly(computed, max(1, count // SQL_COSTS), begin)]
    drives = Counter[bool]()
    for file, name in work:
        drives[name == PLAIN] += _compare_ways(warehouse, grams, file, name)
        progress(1, len(work))
    rows = sum(file.rows for file in files)
    return CheckReport(len(files), rows, drives[True], wide, drives[False])


def _evenly(files: Sequence[TableFile], count: int, begin: int) -> list[TableFile]:
    count = min(count, len(files))
    return [files[(begin + i * len(files) // count) % len(files)] for i in range(count)]


def _compare_ways(
    warehouse: Warehouse, stored_in: Snapshot, file: TableFile, feature_set: str
) -> int:
    """Compare the Gram rows of a log file by the kernel with the stored ones and with SQL.

    Returns the number of drives; 0 for windows that were not computed.
    """
    identity = warehouse.catalog.identity(feature_set)
    stored = stored_grams(stored_in, [file], identity).get(file.path, {})
    if not stored and feature_set != PLAIN:
        return 0
    delays = recorded_delays(stored_in, identity, file.path)
    rows = wide_grams(warehouse, [file], feature_set, delays)
    computed, references = grams_of(rows), {"the stored Gram rows": stored}
    if has_statement(warehouse.catalog, feature_set):
        references["SQL"] = grams_of(by_sql(warehouse, [file], feature_set))
    for reference, grams in references.items():
        if drives := differing_drives(computed, grams):
            raise StorageError(
                f"{file.path}: the Gram row of drive {drives[0]} ({feature_set}) differs "
                f"between the kernel and {reference}. If the logs have changed since, run: "
                "fleet-slip gram. Otherwise the file or a library is damaged: keep both and "
                "report it."
            )
    return len(rows["drive_id"].unique())


DriveGrams = dict[tuple[str, tuple[str, ...]], Gram]


def grams_of(rows: pa.Table) -> DriveGrams:
    """Return rows of the table `grams` as Grams, by drive (and block) and signals."""
    grams = {}
    for row in rows.select(["drive_id", "part", "signals", "n", "sums", "products"]).to_pylist():
        signals = tuple(row["signals"].split(",")) if row["signals"] else ()
        drive = row["drive_id"] if row["part"] is None else f"{row['drive_id']}, {row['part']}"
        grams[drive, signals] = Gram(signals, row["n"], tuple(row["sums"]), tuple(row["products"]))
    return grams


def differing_drives(a: DriveGrams, b: DriveGrams) -> list[str]:
    """Return the sorted drives whose Grams differ, regardless of the order of signals."""
    a, b = _sort_signals(a), _sort_signals(b)
    return sorted({key[0] for key in a.keys() | b.keys() if a.get(key) != b.get(key)})


def _sort_signals(grams: DriveGrams) -> DriveGrams:
    ordered = ((drive, tuple(sorted(signals)), gram) for (drive, signals), gram in grams.items())
    return {(drive, signals): gram.restrict(signals) for drive, signals, gram in ordered}


def stored_grams(
    grams: Snapshot, files: Sequence[TableFile], identity: str = PLAIN
) -> dict[str, DriveGrams]:
    """Return the stored Grams of log files and a feature set, by log file."""
    paths = pa.array([file.path for file in files], pa.string())
    stored: dict[str, DriveGrams] = defaultdict(dict)
    for file in grams.files:
        pairs = grams.table.read(file.path, ["feature_set", "file"])
        names = pairs["file"].cast(pa.string())
        mask = pc.and_(pc.equal(pairs["feature_set"], identity), pc.is_in(names, paths))
        if pc.any(mask).as_py():
            rows = grams.table.read(file.path).filter(mask)
            for path in rows["file"].unique().to_pylist():
                stored[path] |= grams_of(rows.filter(pc.equal(rows["file"], path)))
    return stored
