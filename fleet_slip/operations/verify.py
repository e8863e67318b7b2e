"""Checks everything below a data root against redundant information.

Data files against the checksums in their names and the Delta log; drives for completeness; Gram
rows against the logs by another path; documents against checksums; model versions against tables;
names against the erasure log. `repair` rebuilds Gram rows and checkpoints.
"""

import contextlib
import os
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence, Set
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal, TypeAlias

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from fleet_slip.base import Progress, Steps, no_progress, no_steps, pluralize
from fleet_slip.catalog.features import PLAIN
from fleet_slip.compute.tasks import LocalThreads, run_tasks
from fleet_slip.errors import (
    DamageError,
    DataError,
    FleetSlipError,
    QuestionError,
    RefusedError,
    StorageError,
)
from fleet_slip.grams.compute import by_kernel, by_sql, has_statement
from fleet_slip.grams.on_board import impossible_rows, onboard_feature_sets
from fleet_slip.grams.update import reconcile, recorded_delays, transaction_name
from fleet_slip.models.registry import Registry
from fleet_slip.operations.rewriting import find_temporary_files, find_unreferenced, path_below
from fleet_slip.regression.gram import Gram
from fleet_slip.rendering import Answer, Part, Remark, TextTable
from fleet_slip.resources import read_sql
from fleet_slip.storage.commits import LATEST, LOG, check_commits, find_commit_faults
from fleet_slip.storage.data_files import checksum_in, checksum_of, read_names
from fleet_slip.storage.documents import document_folders
from fleet_slip.storage.folder import Folder, storage_errors
from fleet_slip.storage.runs import find_changed_lines
from fleet_slip.storage.table import Change, Snapshot, Table, TableFile, retry_if_stale, retrying
from fleet_slip.warehouse.database import database_errors, open_database
from fleet_slip.warehouse.erasure_log import ErasureLog
from fleet_slip.warehouse.gram_reader import find_backlog, is_onboard_file, named_files
from fleet_slip.warehouse.warehouse import Warehouse

DamageKind: TypeAlias = Literal[
    "file", "drive", "gram", "document", "model", "log", "name", "unreferenced", "backlog"
]


@dataclass(frozen=True)
class Damage:
    """A fault of a data root, or a remark.

    `kind` is the place of damage, or a remark: "unreferenced" or "backlog". `path` is a file below
    the root, a drive or a model version.
    """

    kind: DamageKind
    path: str
    problem: str

    @property
    def damage(self) -> bool:
        """True if something is lost, or would be computed wrongly."""
        return self.kind not in {"unreferenced", "backlog"}


@dataclass
class Verification(Answer):
    """The result of a verification: what was read, found, rebuilt and compared."""

    DOCUMENT = (
        "files size_bytes rows log_files_recomputed documents damage remarks rebuilt accepted "
        "grams=compared?"
    )

    files: int = 0
    size_bytes: int = 0
    rows: int = 0
    log_files_recomputed: int = 0
    documents: int = 0
    findings: list[Damage] = field(default_factory=list)
    rebuilt: Sequence[str] = ()
    accepted: Sequence[str] = ()
    """Lost documents whose loss was accepted."""
    repaired: bool = False
    compared: "CheckReport | None" = None

    def note(self, kind: DamageKind, path: str, problem: str) -> None:
        """Add a finding."""
        self.findings.append(Damage(kind, path, problem))

    @property
    def damage(self) -> list[Damage]:
        """The findings that are damage."""
        return [finding for finding in self.findings if finding.damage]

    @property
    def remarks(self) -> list[Damage]:
        """The others, which are worth knowing."""
        return [finding for finding in self.findings if not finding.damage]

    def parts(self) -> Iterator[Part]:
        """Return remarks on rebuilt parts, tables of damage and remarks, and totals."""
        for path in self.rebuilt:
            yield Remark(f"rebuilt {path}")
        for path in self.accepted:
            yield Remark(f"accepted the loss of {path}; repeat the command that wrote it")
        for title in ("damage", "remarks"):
            if findings := getattr(self, title):
                yield TextTable(
                    title, "where|problem", findings, "{path}|{problem}", text_columns=2
                )
        yield Remark(
            f"{pluralize(self.files, 'file')} with {self.size_bytes:,} bytes and "
            f"{pluralize(self.documents, 'document')} were read, the Gram rows of "
            f"{pluralize(self.log_files_recomputed, 'log file')} computed again: "
            + (f"{len(self.damage)} damaged" if self.damage else "no damage found")
        )
        if self.compared:
            yield TextTable("", "way|drives|equal", self.compared.ways)

    @property
    def problem(self) -> DamageError | None:
        """The error for damage, with what to do."""
        advice = (
            "These files cannot be rebuilt: restore them from a backup."
            if self.repaired
            else "Rebuild what can be rebuilt with: fleet-slip verify --repair"
        )
        return DamageError(f"{len(self.damage)} damaged. {advice}") if self.damage else None


def verify(
    warehouse: Warehouse,
    *,
    full: bool = False,
    steps: Steps = no_steps,
    executor: Executor | None = None,
) -> Verification:
    """Verify a data root; `full` computes the Gram rows of all log files again.

    Workers of an executor, or threads, read; `steps` returns the progress of a step, which counts
    bytes or files. Files that jobs remove meanwhile are looked up again.
    """
    warehouse.require()
    return retry_if_stale(
        warehouse.tables,
        lambda: _verify(warehouse, full, steps, executor),
        lambda report: bool(report.damage),
    )


def _verify(
    warehouse: Warehouse, full: bool, steps: Steps, executor: Executor | None
) -> Verification:
    report = Verification()
    snapshots = _open_tables(warehouse, report)
    sound: dict[str, Snapshot] = {}
    read: dict[str, dict[str, Names]] = {}
    for table, snapshot in snapshots.items():
        files = read[table] = verify_files(snapshot, report, steps(f"read {table}"), executor)
        damaged = frozenset(file.path for file in snapshot.files if file.path not in files)
        sound[table] = replace(snapshot, without=damaged)
    verify_names(warehouse, read, report, full)
    verify_rows(sound, report)
    if (grams := sound.get("grams")) and grams.files:
        stale = named_files(grams, PLAIN)[1]
        if logs := snapshots.get("logs"):
            stale -= {file.path for file in logs.files}
            if stale and logs.version is None:  # as of a folder that was not mounted
                problem = f"the table is gone; Gram rows of {pluralize(len(stale), 'file')} remain"
                report.note("log", "logs", problem)
        progress = steps("compute Gram rows")
        verify_grams(
            warehouse, sound.get("logs"), grams, len(stale), report, progress, full, executor
        )
    verify_documents(warehouse.root, report)
    verify_models(warehouse, snapshots, report)
    _list_unreferenced(warehouse, snapshots, report)
    written = any(snapshot.version is not None for snapshot in snapshots.values())
    if not report.findings and not report.documents and not written:
        raise StorageError(
            f"{warehouse.root}: there is nothing to verify, neither tables nor models. Is it the "
            "right folder, and is its disk there? Choose another data root."
        )
    return report


def _open_tables(warehouse: Warehouse, report: Verification) -> dict[str, Snapshot]:
    snapshots = {}
    for table in warehouse.tables:
        name = table.folder.name
        try:
            snapshot = table.snapshot(reload=True)
            _ = snapshot.files
            snapshots[name] = snapshot
            for file, problem in find_commit_faults(snapshot):
                report.note("log", f"{name}/{LOG}/{file}", problem)
        except FleetSlipError as error:
            report.note("log", name, str(error))
    return snapshots


Names: TypeAlias = Mapping[str, frozenset[str]]
"""Names in the dictionaries of a data file, by column."""


def verify_files(
    snapshot: Snapshot, report: Verification, progress: Progress, executor: Executor | None
) -> dict[str, Names]:
    """Read the files of a table; return the names in those without faults, by path."""
    table = snapshot.table
    read: dict[str, Names] = {}
    with LocalThreads(os.cpu_count() or 1) as threads:
        task, files = partial(read_whole, table), snapshot.files
        for file, result in run_tasks(executor or threads, task, files, lambda f: f.path):
            if isinstance(result, str):
                problem = f"{result} (it held {file.rows:,} rows)"
                report.note("file", f"{table.folder.name}/{file.path}", problem)
            else:
                read[file.path] = result
            progress(file.size_bytes, snapshot.size_bytes)
    report.files += len(snapshot.files)
    report.size_bytes += snapshot.size_bytes
    report.rows += snapshot.rows if table.folder.name == "logs" else 0
    return read


def read_whole(table: Table, file: TableFile) -> Names | str:
    """Compare every byte of a data file with its name and the log; return its names, or a fault."""
    path = f"{table.folder}/{file.path}"
    try:
        content = table.folder.read(file.path)
        if len(content) != file.size_bytes:
            return f"has {len(content):,} bytes instead of {file.size_bytes:,}"
        if checksum_of(content) != checksum_in(file.path):
            return "its bytes do not match the checksum in its name"
        with storage_errors(path):
            rows = pq.read_metadata(pa.BufferReader(content)).num_rows
            names = read_names(pa.BufferReader(content), table.encoding.dictionary)
    except FleetSlipError as error:
        return str(error).removeprefix(f"{path}: ")
    if rows != file.rows:
        return f"has {rows:,} rows, the Delta log says {file.rows:,}"
    if file.day and not file.path.startswith(f"day={file.day}/"):
        return f"its folder is not that of the day in the Delta log, {file.day}"
    return names


def verify_names(
    warehouse: Warehouse, read: Mapping[str, Mapping[str, Names]], report: Verification, full: bool
) -> None:
    """Find files with rows of erased cars; with `full`, also of erased drives."""
    cars, drives = (
        {name for files in read.values() for names in files.values() for name in names.get(c, ())}
        for c in ("vehicle_id", "drive_id")
    )
    try:
        log = ErasureLog(warehouse.root)
        erased = log.erased(cars, drives if full else (), ended=True).by_column
    except StorageError:  # a lost or damaged document, which is reported as such
        return
    for table, files in read.items():
        for path, names in sorted(files.items()):
            if any(not names.get(c, frozenset()).isdisjoint(erased[c]) for c in erased):
                problem = "has rows of a car or drive that was forgotten; give forget again"
                report.note("name", f"{table}/{path}", problem)


def verify_rows(sound: Mapping[str, Snapshot], report: Verification) -> None:
    """Find incomplete drives, drives in several files, and doubled Gram rows."""

    def rows_of(name: str, statement: str) -> list[tuple[Any, ...]]:
        snapshot = sound.get(name)
        if snapshot is None or not snapshot.files:
            return []
        with (
            open_database(reading=snapshot.table.folder) as database,
            database_errors(f"verifying the rows of {snapshot.table.folder}"),
        ):
            database.execute("SET VARIABLE files = $files", {"files": snapshot.paths})
            return database.execute(read_sql("jobs", statement)).fetchall()

    for drive, in_files, beginnings, n, file in rows_of("logs", "verify_drives.sql"):
        problem = (
            f"{n:,} rows in {pluralize(in_files, 'file')} with {pluralize(beginnings, 'row')} of "
            f"tick 0; one is {file}"
        )
        report.note("drive", drive, problem)
    for identity, file, drive, n in rows_of("grams", "verify_grams.sql"):
        problem = f"the Gram row {identity} of drive {drive} is stored {n} times"
        report.note("gram", f"logs/{file}", problem)


DriveGrams = dict[tuple[str, tuple[str, ...]], Gram]


def grams_of(rows: pa.Table) -> DriveGrams:
    """Return rows of the table `grams` as Grams, by drive (and block) and sorted signals."""
    grams = {}
    for row in rows.select(["drive_id", "part", "signals", "n", "sums", "products"]).to_pylist():
        signals = tuple(row["signals"].split(",")) if row["signals"] else ()
        drive = row["drive_id"] if row["part"] is None else f"{row['drive_id']}, {row['part']}"
        gram = Gram(signals, row["n"], tuple(row["sums"]), tuple(row["products"]))
        ordered = tuple(sorted(signals))
        grams[drive, ordered] = gram.restrict(ordered)
    return grams


def differing_drives(a: DriveGrams, b: DriveGrams) -> list[str]:
    """Return the sorted drives whose Grams differ, regardless of the order of signals."""
    return sorted({key[0] for key in a.keys() | b.keys() if a.get(key) != b.get(key)})


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


SAMPLE = 4
"""Log files whose Gram rows are computed again, evenly chosen, unless all are asked for."""

FILES_IN_MEMORY = 1_000
"""Log files whose stored Gram rows are in memory at a time."""


def verify_grams(
    warehouse: Warehouse,
    logs: Snapshot | None,
    grams: Snapshot,
    stale: int,
    report: Verification,
    progress: Progress,
    full: bool,
    executor: Executor | None,
) -> None:
    """Find Gram rows that are missing, or wrong (in a sample, or all).

    `logs` and `grams` have the files whose bytes are sound; `stale` is the number of removed log
    files that still have Gram rows.
    """
    sets = onboard_feature_sets(warehouse.catalog)
    for file in filter(is_onboard_file, grams.files):
        for row, why in impossible_rows(warehouse.grams.read(file.path), sets):
            problem = f"the Gram row of drive {row['drive_id']}, sent by a car, {why}"
            report.note("gram", f"grams/{file.path}", problem)
    computed_files, log_files = named_files(grams, PLAIN)[0], logs.files if logs else ()
    covered = [file for file in log_files if file.path in computed_files]
    chosen = covered if full else _evenly(covered, SAMPLE, 0)
    task = partial(_compute_grams, warehouse)
    for start in range(0, len(chosen), FILES_IN_MEMORY):
        files = chosen[start : start + FILES_IN_MEMORY]
        stored = stored_grams(grams, files)
        for file, computed in run_tasks(
            executor, task, files, lambda f: f"the Gram rows of {f.path}"
        ):
            for drive in differing_drives(stored[file.path], computed):
                problem = f"the stored Gram row of drive {drive} does not match its rows"
                report.note("gram", f"logs/{file.path}", problem)
            report.log_files_recomputed += 1
            progress(1, len(chosen))
    missing = len(log_files) - len(covered)
    if missing or stale:
        problem = (
            f"no Gram rows of {pluralize(missing, 'log file')}, Gram rows of {stale} that are gone"
        )
        report.note("backlog", "grams", f"{problem}; run: fleet-slip gram")


def _compute_grams(warehouse: Warehouse, file: TableFile) -> DriveGrams:
    return grams_of(by_kernel(warehouse, [file], PLAIN))


def verify_documents(root: Folder, report: Verification) -> None:
    """Report documents that are lost, moved or changed, and changed lines of the history."""
    for folder in document_folders(root):
        report.documents += len(folder.inventory().present)
        for file, problem in folder.faults().items():
            report.note("document", file.removeprefix(f"{root}/"), problem)
    for path, problem in find_changed_lines(root):
        report.note("document", path, problem)


def verify_models(
    warehouse: Warehouse, snapshots: Mapping[str, Snapshot], report: Verification
) -> None:
    """Find versions without their drives or tables, and aliases of versions that do not exist.

    Lost and damaged documents are reported as such.
    """
    registry = Registry.open(warehouse)
    for name in registry.names():
        with contextlib.suppress(FleetSlipError, ValueError):
            numbers = registry.versions(name)
            for number in numbers:
                for problem in _faults_of_version(registry, name, number, snapshots):
                    report.note("model", f"{name}@{number}", problem)
            for alias, number in registry.history(name).aliases().items():
                if number not in numbers:
                    problem = f"points at version {number}, which does not exist"
                    report.note("model", f"{name}@{alias}", problem)


def _faults_of_version(
    registry: Registry, name: str, number: int, snapshots: Mapping[str, Snapshot]
) -> Iterator[str]:
    try:
        manifest = registry.load(name, number).manifest
        registry.trained_drives(manifest)
    except (RefusedError, StorageError, DataError, QuestionError) as error:
        # Faults other than of format and drives are reported with the document.
        if isinstance(error, RefusedError) or "drives" in str(error):
            yield str(error)
        return
    trained = manifest.trained_on
    made_of = {"grams": trained.grams_version}
    if trained.drives_without_log != trained.drives:
        made_of["logs"] = trained.logs_version
    for table, version in made_of.items():
        latest = snapshots[table].version if table in snapshots else None
        if latest is None or version > latest:
            yield f"was made of version {version} of {table}, which does not exist"


def _list_unreferenced(
    warehouse: Warehouse, snapshots: Mapping[str, Snapshot], report: Verification
) -> None:
    for snapshot in snapshots.values():
        with contextlib.suppress(StorageError):  # of a damaged log, which is reported as such
            for file in find_unreferenced(snapshot.table):
                advice = "fleet-slip compact removes it in time"
                if snapshot.version is None:
                    advice = "if the table had a Delta log, restore that from a backup"
                problem = f"no version refers to it; {advice}"
                report.note("unreferenced", path_below(warehouse, file), problem)
    for file in find_temporary_files(warehouse):
        problem = "left by a killed job, or being written"
        report.note("unreferenced", path_below(warehouse, file), problem)


# Comparison of stored Gram rows with the kernel and with SQL, bit for bit.


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
        work += [(file, name) for file in _evenly(computed, count, begin)]
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
    recorded = recorded_delays(stored_in, identity)
    delays = {car: delay for path, car, delay in recorded if path == file.path and delay}
    rows = by_kernel(warehouse, [file], feature_set, delays)
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


# Repair: Gram rows are rebuilt from the logs, and checkpoints from the commits.


def repair(warehouse: Warehouse, verification: Verification) -> list[str]:
    """Rebuild damaged parts; return their paths below the root. Nothing else is deleted."""
    paths: dict[str, set[str]] = defaultdict(set)
    for finding in verification.damage:
        paths[finding.kind].add(finding.path)
    rebuilt = _write_checkpoints(warehouse, paths["log"])
    rebuilt += _drop_wrong(warehouse, paths["file"], paths["gram"])
    lost = {path.removeprefix("logs/") for path in paths["file"]}
    reconcile(warehouse, unreadable=lost)  # also files that an interrupted repair has dropped
    return rebuilt


def _write_checkpoints(warehouse: Warehouse, damaged: Set[str]) -> list[str]:
    """Write the checkpoints of damaged logs again whose commits are all there, and sound."""
    rebuilt = []
    for table in warehouse.tables:
        name, log = table.folder.name, table.folder / LOG
        lost = damaged & {name, f"{name}/{LOG}/{LATEST}"}
        commits, faults = check_commits(log) if lost else ([], {})
        if not commits or commits[0].version or faults:
            continue
        for file in log.files():
            if ".checkpoint." in file.name or file.name == LATEST:
                log.remove(file)
        delta = table.open_delta()
        if delta is not None:
            with storage_errors(table.folder):
                delta.create_checkpoint()
        rebuilt += sorted(lost)
    return rebuilt


@retrying
def _drop_wrong(warehouse: Warehouse, damaged: Set[str], wrong: Set[str]) -> list[str]:
    """Drop the Gram files that are damaged, or have wrong rows of log files; return them."""
    snapshot = warehouse.grams.snapshot()
    bad = []
    for file in snapshot.files:
        if f"grams/{file.path}" in damaged:
            is_bad = not is_onboard_file(file)
        else:
            names = warehouse.grams.read_combinations(file.path, ["file"])["file"].to_pylist()
            is_bad = not wrong.isdisjoint(f"logs/{name}" for name in names)
        if is_bad:
            bad.append(file)
    if bad:
        snapshot.commit(Change(remove=bad, note={"job": "repair"}))
    return [f"grams/{file.path}" for file in bad]
