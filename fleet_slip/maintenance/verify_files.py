"""Compares data files with their checksums and the Delta log; looks for forgotten names in them."""

import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial
from typing import Literal, TypeAlias

import pyarrow as pa
import pyarrow.parquet as pq

from fleet_slip.compute.tasks import LocalThreads, run_tasks
from fleet_slip.delta import Snapshot, Table, TableFile, checksum_in, checksum_of
from fleet_slip.delta.encoding import Names, read_names
from fleet_slip.errors import FleetSlipError
from fleet_slip.files.storage_errors import storage_errors
from fleet_slip.progress import Progress
from fleet_slip.warehouse.audit import Audit
from fleet_slip.warehouse.tables import Warehouse
from fleet_slip.words import number_of

DamageKind: TypeAlias = Literal[
    "file",
    "drive",
    "gram",
    "document",
    "model",
    "log",
    "name",
    "unreferenced",
    "backlog",
    "unchecked",
]

TASK_BYTES = 2**27

TASK_FILES = 64
"""A task reads about so many bytes, or so many files."""


@dataclass(frozen=True)
class Damage:
    """One thing that is not as it must be, or that is worth knowing.

    `kind` is where damage is, or a remark: "unreferenced", "backlog" or "unchecked". `path` is a
    file below the root, a drive or a model version.
    """

    kind: DamageKind
    path: str
    problem: str

    @property
    def damage(self) -> bool:
        """Whether something is lost, or would be computed wrongly."""
        return self.kind not in {"unreferenced", "backlog", "unchecked"}


@dataclass
class Verification:
    """What was looked at, and what was found."""

    files: int = 0
    size_bytes: int = 0
    rows: int = 0
    log_files_recomputed: int = 0
    documents: int = 0
    findings: list[Damage] = field(default_factory=list)

    def note(self, kind: DamageKind, path: str, problem: str) -> None:
        """Add a finding."""
        self.findings.append(Damage(kind, path, problem))

    @property
    def damage(self) -> list[Damage]:
        """The findings that are damage."""
        return [finding for finding in self.findings if finding.damage]


@dataclass(frozen=True)
class ReadFile:
    """What was found in a data file: what is wrong with it, or the names in its dictionaries."""

    file: TableFile
    problem: str | None
    names: Mapping[str, Names] = field(default_factory=dict)


def verify_files(
    snapshot: Snapshot, report: Verification, progress: Progress, executor: Executor | None
) -> list[ReadFile]:
    """Return the files of a table that are what they must be."""
    table = snapshot.table
    read: list[ReadFile] = []
    with LocalThreads(os.cpu_count() or 1) as threads:
        groups = _groups(snapshot.files)
        task = partial(_read_files, table)
        for group, found in run_tasks(executor or threads, task, groups, _group_name):
            read += found
            progress(sum(file.size_bytes for file in group), snapshot.size_bytes)
    read.sort(key=lambda one: one.file.path)
    for one in read:
        if one.problem:
            told = f"{one.problem} (it held {one.file.rows:,} rows)"
            report.note("file", f"{table.folder.name}/{one.file.path}", told)
    report.files += len(snapshot.files)
    report.size_bytes += snapshot.size_bytes
    report.rows += snapshot.rows if table.folder.name == "logs" else 0
    return [one for one in read if not one.problem]


def _groups(files: Sequence[TableFile]) -> Iterator[tuple[TableFile, ...]]:
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


def _read_files(table: Table, files: Sequence[TableFile]) -> list[ReadFile]:
    return [read_whole(table, file) for file in files]


def read_whole(table: Table, file: TableFile) -> ReadFile:
    """Read every byte of a data file, and compare it with what tells of it."""
    path = f"{table.folder}/{file.path}"
    try:
        content = table.folder.read(file.path)
        if len(content) != file.size_bytes:
            problem = f"has {len(content):,} bytes instead of {file.size_bytes:,}"
            return ReadFile(file, problem)
        expected = checksum_in(file.path)
        if expected and checksum_of(content) != expected:
            return ReadFile(file, "its bytes do not match the checksum in its name")
        with storage_errors(path):
            metadata = pq.read_metadata(pa.BufferReader(content))
            names = read_names(pa.BufferReader(content), table.encoding.dictionary)
    except FleetSlipError as error:
        return ReadFile(file, str(error).removeprefix(f"{path}: "))
    return ReadFile(file, _contradiction(file, metadata), names)


def _contradiction(file: TableFile, metadata: pq.FileMetaData) -> str | None:
    if metadata.num_rows != file.rows:
        return f"has {metadata.num_rows:,} rows, the Delta log says {file.rows:,}"
    if (nulls := _null_counts(metadata)).items() - file.null_counts.items():
        wrong = [name for name, count in nulls.items() if file.null_counts.get(name) != count]
        return f"the Delta log states other numbers of nulls of {', '.join(wrong)}"
    if file.day and not file.path.startswith(f"day={file.day}/"):
        return f"the Delta log says that it is of {file.day}"
    return None


def _null_counts(metadata: pq.FileMetaData) -> dict[str, int]:
    counts: dict[str, int] = {}
    for group in range(metadata.num_row_groups):
        for number in range(metadata.num_columns):
            column = metadata.row_group(group).column(number)
            statistics = column.statistics
            if "." not in column.path_in_schema and statistics and statistics.has_null_count:
                name = column.path_in_schema
                counts[name] = counts.get(name, 0) + statistics.null_count
    return counts


def verify_names(
    warehouse: Warehouse, read: Mapping[str, Sequence[ReadFile]], report: Verification, full: bool
) -> None:
    """Look for forgotten cars; for forgotten drives too with `full`."""
    unused = frozenset(name for one in _all(read) for name in _unused(one))
    cars, drives = (_used(_all(read), column) for column in ("vehicle_id", "drive_id"))
    audit = Audit(warehouse.root)
    barred = audit.barred(cars | unused, (drives if full else frozenset()) | unused, ended=True)
    wrong = {"vehicle_id": barred.vehicles, "drive_id": barred.drives}
    for table, files in read.items():
        for one in files:
            if any(not wrong[name].isdisjoint(_used([one], name)) for name in wrong):
                problem = "has rows of a car or drive that was forgotten; give forget again"
            elif not (barred.vehicles | barred.drives).isdisjoint(_unused(one)):
                problem = (
                    "has the name of a car or drive that was forgotten; run: fleet-slip migrate"
                )
            else:
                continue
            report.note("name", f"{table}/{one.file.path}", problem)
        if many := sum(bool(_unused(one)) for one in files):
            problem = (
                f"{number_of(many, 'file')} with names that no row has; run: fleet-slip migrate"
            )
            report.note("backlog", table, problem)


def _all(read: Mapping[str, Sequence[ReadFile]]) -> Iterator[ReadFile]:
    return (one for files in read.values() for one in files)


def _unused(one: ReadFile) -> frozenset[str]:
    return frozenset().union(*(names.unused for names in one.names.values()))


def _used(files: Collection[ReadFile] | Iterator[ReadFile], column: str) -> frozenset[str]:
    return frozenset().union(*(one.names[column].used for one in files if column in one.names))
