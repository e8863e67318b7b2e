"""Compares everything below a data root with everything else that tells what it must be.

Every byte of every data file with the checksum in its name; files, sizes and counts with the Delta
log; drives with the rule that they are whole; Gram rows with the logs by a path of their own;
documents with their checksums; model versions with the tables that they were made of.
"""

import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import pyarrow as pa
import pyarrow.parquet as pq

from fleet_slip.compute.tasks import LocalThreads, run_tasks
from fleet_slip.delta import Snapshot, Table, TableFile, checksum_in, checksum_of
from fleet_slip.delta.checkpoints import FOLDER as CHECKSUMS
from fleet_slip.delta.checkpoints import checkpoint_faults, unsealed_checkpoints
from fleet_slip.delta.commit_check import log_problems
from fleet_slip.errors import DataError, FleetSlipError, QuestionError, RefusedError, StorageError
from fleet_slip.files.documents import DocumentFolder
from fleet_slip.files.folder import Folder, StoredFile
from fleet_slip.files.storage_errors import storage_errors
from fleet_slip.grams.check import DriveGrams, grams_by_blocks, read_counts, stored_grams
from fleet_slip.maintenance.vacuum import replaced, temporary_files, unreferenced
from fleet_slip.models.versions import Registry
from fleet_slip.resources import read_sql
from fleet_slip.warehouse.database import database_errors, open_database
from fleet_slip.warehouse.tables import Warehouse

SAMPLE = 4
"""Log files whose Gram rows are computed again, evenly chosen, unless all are asked for."""

TASK_BYTES = 2**27
TASK_FILES = 64
"""A task reads about so many bytes, or so many files."""

Progress = Callable[[int, int], None]
"""Called with bytes read since the last call, and bytes to read in all."""


@dataclass(frozen=True)
class Damage:
    """One thing that is not as it must be, or that is worth knowing.

    Attributes:
        kind: where it is. "damage" of a `file`, a `drive`, a `gram` row, a `document`, a `model`,
            or the `log` of a table; or only a remark: "unreferenced" or "backlog".
        path: the file below the root, or the drive or model version.
        problem: what is wrong.
    """

    kind: Literal["file", "drive", "gram", "document", "model", "log", "unreferenced", "backlog"]
    path: str
    problem: str

    @property
    def damage(self) -> bool:
        """Whether something is lost, or would be computed wrongly."""
        return self.kind not in {"unreferenced", "backlog"}


@dataclass
class Verification:
    """What was looked at, and what was found."""

    files: int = 0
    size_bytes: int = 0
    rows: int = 0
    log_files_recomputed: int = 0
    documents: int = 0
    findings: list[Damage] = field(default_factory=list)

    @property
    def damage(self) -> list[Damage]:
        """The findings that are damage."""
        return [finding for finding in self.findings if finding.damage]


def verify(
    warehouse: Warehouse,
    *,
    full: bool = False,
    progress: Progress = lambda _more, _all: None,
    executor: Executor | None = None,
) -> Verification:
    """Verify a data root; `full` computes the Gram rows of all log files again.

    Files are read by the workers of an executor, if there is one, else by threads.
    """
    report = Verification()
    warehouse.require()
    snapshots = _snapshots(warehouse, report)
    good = {table: _verify_files(s, report, progress, executor) for table, s in snapshots.items()}
    logs, grams = (good.get(table, []) for table in ("logs", "grams"))
    if logs:
        _verify_drives(warehouse, logs, report)
    _require_logs(snapshots, report)
    if grams:
        active = {file.path for file in snapshots["logs"].files} if "logs" in snapshots else set()
        _verify_grams(warehouse, logs, grams, active, full, report, executor)
    _verify_documents(warehouse.root, report)
    _verify_models(warehouse, snapshots, report)
    _list_unreferenced(warehouse, snapshots, report)
    if not report.findings and not report.documents and not _any_table(snapshots):
        raise StorageError(
            f"{warehouse.root}: there is nothing to verify, neither tables nor models. Is it the "
            "right folder, and is its disk there? Choose another with --root."
        )
    return report


def _snapshots(warehouse: Warehouse, report: Verification) -> dict[str, Snapshot]:
    found = {}
    for table in warehouse.tables:
        _verify_checkpoints(table, report)
        try:
            snapshot = table.snapshot()
            _ = snapshot.files
        except FleetSlipError as error:
            report.findings.append(Damage("log", table.folder.name, str(error)))
        else:
            found[table.folder.name] = snapshot
            for file, problem in log_problems(snapshot):
                path = f"{table.folder.name}/_delta_log/{file}"
                report.findings.append(Damage("log", path, problem))
    return found


def _verify_checkpoints(table: Table, report: Verification) -> None:
    name = table.folder.name
    documents = DocumentFolder(table.folder / CHECKSUMS)
    report.documents += len(documents.numbers())
    if faults := documents.faults():
        for file, problem in faults.items():
            where = f"{name}/{CHECKSUMS}/{file.rpartition('/')[2]}"
            report.findings.append(Damage("document", where, problem))
        return
    for fault in checkpoint_faults(table.folder):
        where = f"{name}/_delta_log/{fault.name}"
        report.findings.append(Damage("log", where, fault.problem))
    for checkpoint in unsealed_checkpoints(table.folder):
        problem = "no checksum was kept of this checkpoint; the next one comes with both"
        report.findings.append(Damage("backlog", f"{name}/_delta_log/{checkpoint}", problem))


def _any_table(snapshots: Mapping[str, Snapshot]) -> bool:
    return any(snapshot.version is not None for snapshot in snapshots.values())


def _require_logs(snapshots: Mapping[str, Snapshot], report: Verification) -> None:
    """Report a table of logs that is gone, as a folder that was not mounted is."""
    logs, grams = snapshots.get("logs"), snapshots.get("grams")
    if logs and grams and logs.version is None and grams.rows:
        problem = f"the table is gone that {grams.rows:,} Gram rows were computed from"
        report.findings.append(Damage("log", "logs", problem))


def _verify_files(
    snapshot: Snapshot, report: Verification, progress: Progress, executor: Executor | None
) -> list[TableFile]:
    """Return the files of a table that are what they must be."""
    table = snapshot.table
    problems: dict[str, str | None] = {}
    with LocalThreads(os.cpu_count() or 1) as threads:
        groups = _groups(snapshot.files)
        task = partial(_problems_of, table)
        for group, found in run_tasks(executor or threads, task, groups, _group_name):
            problems |= found
            progress(sum(file.size_bytes for file in group), snapshot.size_bytes)
    for path, problem in sorted(problems.items()):
        if problem:
            report.findings.append(Damage("file", f"{table.folder.name}/{path}", problem))
    report.files += len(snapshot.files)
    report.size_bytes += snapshot.size_bytes
    report.rows += snapshot.rows if table.folder.name == "logs" else 0
    return [file for file in snapshot.files if not problems[file.path]]


def _groups(files: Sequence[TableFile]) -> Iterator[tuple[TableFile, ...]]:
    """Divide files into groups that each take a task about a second."""
    group: tuple[TableFile, ...] = ()
    for file in files:
        group = (*group, file)
        if sum(one.size_bytes for one in group) >= TASK_BYTES or len(group) == TASK_FILES:
            yield group
            group = ()
    if group:
        yield group


def _group_name(group: Sequence[TableFile]) -> str:
    return f"the bytes of {len(group)} files from {group[0].path}"


def _problems_of(table: Table, files: Sequence[TableFile]) -> dict[str, str | None]:
    return {file.path: problem_of(table, file) for file in files}


def problem_of(table: Table, file: TableFile) -> str | None:
    """Return what is wrong with a data file, or None."""
    path = f"{table.folder}/{file.path}"
    try:
        content = table.folder.read(file.path)
        if len(content) != file.size_bytes:
            return f"has {len(content):,} bytes instead of {file.size_bytes:,}"
        expected = checksum_in(file.path)
        if expected and checksum_of(content) != expected:
            return "its bytes do not match the checksum in its name"
        with storage_errors(path):
            metadata = pq.read_metadata(pa.BufferReader(content))
    except FleetSlipError as error:
        return str(error).removeprefix(f"{path}: ")
    return _contradiction(file, metadata)


def _contradiction(file: TableFile, metadata: pq.FileMetaData) -> str | None:
    """Return in what a file's footer and the Delta log differ, or None."""
    if metadata.num_rows != file.rows:
        return f"has {metadata.num_rows:,} rows, the Delta log says {file.rows:,}"
    if (nulls := _null_counts(metadata)).items() - file.null_counts.items():
        wrong = [name for name, count in nulls.items() if file.null_counts.get(name) != count]
        return f"the Delta log states other numbers of nulls of {', '.join(wrong)}"
    if file.day and not file.path.startswith(f"day={file.day}/"):
        return f"the Delta log says that it is of {file.day}"
    return None


def _null_counts(metadata: pq.FileMetaData) -> dict[str, int]:
    """Return the number of nulls of each plain column, from the file's own statistics."""
    counts: dict[str, int] = {}
    for group in range(metadata.num_row_groups):
        for number in range(metadata.num_columns):
            column = metadata.row_group(group).column(number)
            statistics = column.statistics
            if "." not in column.path_in_schema and statistics and statistics.has_null_count:
                name = column.path_in_schema
                counts[name] = counts.get(name, 0) + statistics.null_count
    return counts


def _verify_drives(warehouse: Warehouse, files: Sequence[TableFile], report: Verification) -> None:
    paths = [warehouse.logs.uri(file.path) for file in files]
    database = open_database(reading=warehouse.logs.folder)
    with database, database_errors("verifying the drives"):
        database.execute("SET VARIABLE log_files = $files", {"files": paths})
        rows = database.execute(read_sql("jobs", "verify_drives.sql")).fetchall()
    for drive, in_files, beginnings, n, file in rows:
        problem = f"{n:,} rows in {in_files} files with {beginnings} rows of tick 0; one is {file}"
        report.findings.append(Damage("drive", drive, problem))


def _verify_grams(
    warehouse: Warehouse,
    logs: Sequence[TableFile],
    grams: Sequence[TableFile],
    active: Collection[str],
    full: bool,
    report: Verification,
    executor: Executor | None,
) -> None:
    paths = [warehouse.grams.uri(file.path) for file in grams]
    database = open_database(reading=warehouse.grams.folder)
    with database, database_errors("verifying the Gram rows"):
        database.execute("SET VARIABLE gram_files = $files", {"files": paths})
        twice = database.execute(read_sql("jobs", "verify_grams.sql")).fetchall()
    for identity, file, drive, n in twice:
        problem = f"the Gram row {identity} of drive {drive} stands {n} times"
        report.findings.append(Damage("gram", f"logs/{file}", problem))
    stored = stored_grams(warehouse, grams)
    covered = [file for file in logs if file.path in stored]
    step = 1 if full else max(1, len(covered) // SAMPLE)
    task = partial(_computed, warehouse)
    for file, computed in run_tasks(executor, task, covered[::step], _recomputing):
        for drive in _different(stored[file.path], computed):
            problem = f"the stored Gram row of drive {drive} is not that of its rows"
            report.findings.append(Damage("gram", f"logs/{file.path}", problem))
        report.log_files_recomputed += 1
    missing = len(logs) - len(covered)
    stale = stored.keys() - set(active)
    if missing or stale:
        problem = f"{missing} log files have no Gram rows, {len(stale)} with Gram rows are gone"
        report.findings.append(Damage("backlog", "grams", f"{problem}; run: fleet-slip gram"))


def _computed(warehouse: Warehouse, file: TableFile) -> DriveGrams:
    return grams_by_blocks(warehouse, read_counts(warehouse, file))


def _recomputing(file: TableFile) -> str:
    return f"the Gram rows of {file.path}"


def _different(one: DriveGrams, two: DriveGrams) -> list[str]:
    return sorted({key[0] for key in one.keys() | two.keys() if one.get(key) != two.get(key)})


def _verify_documents(root: Folder, report: Verification) -> None:
    for folder in _document_folders(root):
        report.documents += len(folder.numbers())
        for file, problem in folder.faults().items():
            report.findings.append(Damage("document", file.removeprefix(f"{root}/"), problem))


def _document_folders(root: Folder) -> list[DocumentFolder]:
    found: set[str] = set()
    for name in root.names():
        if not (root / name / "_delta_log").exists():
            files = (root / name).files()
            found.update(f"{name}/{f.path}".rpartition("/")[0] for f in files if _is_document(f))
    return [DocumentFolder(root / path) for path in sorted(found)]


def _is_document(file: StoredFile) -> bool:
    return file.path.endswith(".json")


def _verify_models(
    warehouse: Warehouse, snapshots: dict[str, Snapshot], report: Verification
) -> None:
    registry = Registry(warehouse.root / "models")
    for name in registry.names():
        numbers = registry.versions(name)
        for number in numbers:
            try:
                trained = registry.load(name, number).manifest.trained_on
            except RefusedError as error:  # its signature
                report.findings.append(Damage("model", f"{name}@{number}", str(error)))
                continue
            except (StorageError, DataError, QuestionError):
                continue  # told as a document
            made_of = {"logs": trained.logs_version, "grams": trained.grams_version}
            for table, version in made_of.items():
                latest = snapshots[table].version if table in snapshots else None
                if latest is None or version > latest:
                    problem = f"was made of version {version} of {table}, which does not exist"
                    report.findings.append(Damage("model", f"{name}@{number}", problem))
        try:
            aliases = registry.history(name).aliases()
        except (FleetSlipError, ValueError):
            continue
        for alias, version in aliases.items():
            if version not in numbers:
                problem = f"points at version {version}, which does not exist"
                report.findings.append(Damage("model", f"{name}@{alias}", problem))


def _list_unreferenced(
    warehouse: Warehouse, snapshots: dict[str, Snapshot], report: Verification
) -> None:
    for snapshot in snapshots.values():
        known = replaced(snapshot)
        for file in unreferenced(snapshot.table):
            what = "replaced" if file.path in known else "never committed"
            then = "fleet-slip vacuum removes it in time"
            if snapshot.version is None:
                then = "if the table had a Delta log, restore that from a backup"
            _remark(warehouse, file, f"{what}; {then}", report)
    for file in temporary_files(warehouse):
        _remark(warehouse, file, "left by a killed job, or being written", report)


def _remark(warehouse: Warehouse, file: StoredFile, problem: str, report: Verification) -> None:
    where = str(file).removeprefix(f"{warehouse.root}/")
    report.findings.append(Damage("unreferenced", where, problem))
