"""Makes the table `grams` agree with the active files of `logs`.

Log files without Gram rows of a feature set are aggregated by `jobs/gram.sql`; Gram rows of any set
whose file is no longer active are dropped; both in one commit. That one rule covers new days,
interrupted runs, repeated runs, deletions and compaction.
"""

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from itertools import accumulate, chain
from math import ceil

import duckdb
import pyarrow as pa
import pyarrow.compute as pc
from deltalake.transaction import AddAction

from fleet_slip.catalogue.features import PLAIN, features
from fleet_slip.compute.tasks import in_flight, run_tasks
from fleet_slip.delta import (
    Change,
    Snapshot,
    TableFile,
    Unit,
    absent_columns,
    retry_conflicts,
)
from fleet_slip.errors import ConflictError, StorageError
from fleet_slip.grams.statement import gram_statement
from fleet_slip.warehouse.database import database_errors, open_database
from fleet_slip.warehouse.tables import Warehouse

FILES_PER_QUERY = 16
"""Planning 77 aggregates costs 20 ms, so that one query takes many files."""

LAGGED_FILES_PER_QUERY = 2
"""Rows are sorted to find the one before, which takes memory for all rows of a query."""

FILE_ROWS = 100_000
"""Gram rows of a file, some 700 bytes each; a file with fewer is small. Rewriting takes the memory
of a few files, however many Gram rows there are."""

SMALL_FILES_MAX = 32
"""So many small Gram files may stand side by side before a commit merges some."""

Progress = Callable[[int, int], None]
"""Called with rows read since the last call, and rows to read in all."""


@dataclass(frozen=True)
class GramReport:
    """What a run of the job did for one feature set."""

    feature_set: str
    files_read: int
    rows_read: int
    files_dropped: int
    gram_rows: int
    logs_version: int | None
    grams_version: int | None

    @property
    def changed(self) -> bool:
        """Whether there was anything to do."""
        return bool(self.files_read or self.files_dropped)


@dataclass(frozen=True)
class Backlog:
    """How `grams` and `logs` differ."""

    missing: tuple[TableFile, ...]
    """Log files without Gram rows of the feature set."""
    stale: frozenset[str]
    """Paths in `grams`, of any set, that are no active log file."""


def update_grams(
    warehouse: Warehouse,
    progress: Progress = lambda _more, _all: None,
    feature_set: str = PLAIN,
    executor: Executor | None = None,
) -> GramReport:
    """Bring the Gram rows of a feature set up to date. Running it again does nothing.

    An executor runs the queries elsewhere; see `aggregate`. Raises `DataError` for an unknown
    set, `StorageError`, `ConflictError` if other processes keep changing the table, or
    `ClusterError`.
    """
    return retry_conflicts(lambda: _update_once(warehouse, progress, feature_set, executor))


def reconcile(
    warehouse: Warehouse, progress: Progress = lambda _more, _all: None
) -> list[GramReport]:
    """Bring the Gram rows of every feature set up to date that was ever computed here."""
    grams = warehouse.grams.snapshot()
    known = (PLAIN, *features().sets)
    used = [
        name for name in known if grams.landed(unit_name(features().identity(name))) is not None
    ]
    return [update_grams(warehouse, progress, name) for name in used]


def unit_name(identity: str) -> str:
    """Return the name of the unit of work that lands Gram rows of a feature set."""
    return f"gram/{identity}"


def _update_once(
    warehouse: Warehouse, progress: Progress, feature_set: str, executor: Executor | None
) -> GramReport:
    # The logs are looked at last: if they lose a drive from now on, whoever removed it changes its
    # Gram rows after this snapshot of them, and this job's commit is a conflict.
    grams = warehouse.grams.snapshot()
    logs = warehouse.logs.snapshot()
    if logs.version is None and grams.rows:
        raise StorageError(
            f"{warehouse.logs.folder}: the logs that {grams.rows:,} Gram rows were computed from "
            "are gone. Nothing is changed: restore the folder from a backup."
        )
    identity = features().identity(feature_set)
    backlog = find_backlog(logs, grams, identity)
    version, gram_rows = grams.version, grams.rows
    logs_version = logs.version
    if backlog.missing or backlog.stale:
        new_rows = aggregate(warehouse, backlog.missing, progress, None, feature_set, executor)
        replaced = _files_to_rewrite(grams, backlog.stale)
        kept = _rows_to_keep(grams, replaced, backlog.stale)
        grams.commit(
            Change(
                add=_write_rows(warehouse, chain(kept, [new_rows])),
                remove=replaced,
                units=[Unit(unit_name(identity), logs_version or 0)],
                note={
                    "job": "gram",
                    "feature_set": identity,
                    "logs_version": logs_version,
                },
            )
        )
        _require_active(logs, backlog.missing)
        after = warehouse.grams.snapshot()
        version, gram_rows = after.version, after.rows
    return GramReport(
        feature_set=identity,
        files_read=len(backlog.missing),
        rows_read=sum(file.rows for file in backlog.missing),
        files_dropped=len(backlog.stale),
        gram_rows=gram_rows,
        logs_version=logs_version,
        grams_version=version,
    )


def _require_active(logs: Snapshot, files: Iterable[TableFile]) -> None:
    """Raise `ConflictError` if the logs have lost a file whose Gram rows have just landed.

    Who removed it may have found no Gram row of its drives, and so have changed none. The next
    attempt drops those that landed.
    """
    lost = {file.path for file in files} - {file.path for file in logs.renewed().files}
    if lost:
        raise ConflictError(
            f"{logs.table.folder}: other processes keep removing files, such as {min(lost)}. Run "
            "the same command again."
        )


def find_backlog(logs: Snapshot, grams: Snapshot, identity: str = PLAIN) -> Backlog:
    """Compare the active log files with the files that Gram rows name.

    `identity` is that of a feature set, as its Gram rows carry it.
    """
    done: set[str] = set()
    named: set[str] = set()
    for file in grams.files:
        rows = grams.table.read(file.path, ["feature_set", "file"])
        named.update(rows["file"].unique().to_pylist())
        mine = rows.filter(pc.equal(rows["feature_set"], identity))
        done.update(mine["file"].unique().to_pylist())
    active = {file.path for file in logs.files}
    return Backlog(
        missing=tuple(file for file in logs.files if file.path not in done),
        stale=frozenset(named - active),
    )


def aggregate(
    warehouse: Warehouse,
    files: Sequence[TableFile],
    progress: Progress = lambda _more, _all: None,
    threads: int | None = None,
    feature_set: str = PLAIN,
    executor: Executor | None = None,
) -> pa.Table:
    """Return the Gram rows of log files, in the schema of `grams`, sorted by file and drive.

    The query runs in this process, on all of its cores unless `threads` says how many; or, with an
    executor of other processes, as tasks of some files and one thread each.
    """
    lagged = features().feature_set(feature_set).lagged
    step = LAGGED_FILES_PER_QUERY if lagged else FILES_PER_QUERY
    total = sum(file.rows for file in files)
    parts = [warehouse.grams.schema.empty_table()]
    if executor is None:
        with open_database(reading=warehouse.logs.folder, threads=threads) as database:
            for group in _groups(files, step):
                parts.append(_query(database, warehouse, group, feature_set))
                progress(sum(file.rows for file in group), total)
        return pa.concat_tables(parts)
    groups = _groups(files, min(step, max(1, ceil(len(files) / in_flight(executor)))))
    task = partial(_aggregate_group, warehouse, feature_set)
    done: dict[str, pa.Table] = {}
    for group, rows in run_tasks(executor, task, groups, _group_name):
        done[group[0].path] = rows
        progress(sum(file.rows for file in group), total)
    return pa.concat_tables([*parts, *(done[group[0].path] for group in groups)])


def _groups(files: Sequence[TableFile], step: int) -> list[Sequence[TableFile]]:
    return [files[first : first + step] for first in range(0, len(files), step)]


def _group_name(group: Sequence[TableFile]) -> str:
    return f"the Gram rows of {len(group)} log files from {group[0].path}"


def _aggregate_group(
    warehouse: Warehouse, feature_set: str, files: Sequence[TableFile]
) -> pa.Table:
    with open_database(reading=warehouse.logs.folder, threads=1) as database:
        return _query(database, warehouse, files, feature_set)


def _query(
    database: duckdb.DuckDBPyConnection,
    warehouse: Warehouse,
    files: Sequence[TableFile],
    feature_set: str,
) -> pa.Table:
    paths = {warehouse.logs.uri(file.path): file.path for file in files}
    whole = feature_set == PLAIN and _signals_are_whole(warehouse, files)
    absent = absent_columns(files, warehouse.catalogue.signals)
    statement = gram_statement(warehouse.catalogue, feature_set, whole=whole, absent=absent)
    identity = features().identity(feature_set)
    with database_errors(f"the Gram query over {len(files)} log files in {warehouse.logs.folder}"):
        database.execute("SET VARIABLE log_files = $files", {"files": list(paths)})
        rows = database.sql(statement, params={"feature_set": identity}).to_arrow_table()
    relative = pa.array([paths[path] for path in rows["file"].to_pylist()], pa.string())
    return rows.set_column(rows.schema.get_field_index("file"), "file", relative).cast(
        warehouse.grams.schema
    )


def _signals_are_whole(warehouse: Warehouse, files: Sequence[TableFile]) -> bool:
    """Whether each signal is in all rows of a file or in none, by the Delta log's statistics."""
    return all(
        file.null_counts.get(signal, file.rows) in (0, file.rows)
        for file in files
        for signal in warehouse.catalogue.gram_signals
    )


def _write_rows(warehouse: Warehouse, parts: Iterable[pa.Table]) -> list[AddAction]:
    actions: list[AddAction] = []
    waiting: list[pa.Table] = []
    for part in parts:
        for first in range(0, part.num_rows, FILE_ROWS):
            waiting.append(part.slice(first, FILE_ROWS))
            if sum(rows.num_rows for rows in waiting) >= FILE_ROWS:
                actions += _write_files(warehouse, pa.concat_tables(waiting))
                waiting.clear()
    return actions + (_write_files(warehouse, pa.concat_tables(waiting)) if waiting else [])


def _write_files(warehouse: Warehouse, rows: pa.Table) -> list[AddAction]:
    """Write one file for each feature set, so that reading one set reads no other."""
    actions = []
    for identity in sorted(rows["feature_set"].unique().to_pylist()):
        part = rows.filter(pc.equal(rows["feature_set"], identity))
        actions.append(warehouse.grams.write_file(f"{identity}-{_content_digest(part)}", part))
    return actions


def _files_to_rewrite(grams: Snapshot, stale: frozenset[str]) -> list[TableFile]:
    merged = _files_to_merge(grams)
    return [
        file
        for file in grams.files
        if file.path in merged or (stale and not stale.isdisjoint(_log_files_of(grams, file)))
    ]


def _files_to_merge(grams: Snapshot) -> set[str]:
    """Return the smallest files, enough for one file of the usual size, where too many are small.

    Each night merges a few, so that none has to merge all.
    """
    small = sorted((file.rows, file.path) for file in grams.files if file.rows < FILE_ROWS)
    if len(small) <= SMALL_FILES_MAX:
        return set()
    rows = list(accumulate(rows for rows, _ in small))
    return {path for (_, path), so_far in zip(small, rows, strict=True) if so_far <= 2 * FILE_ROWS}


def _log_files_of(grams: Snapshot, file: TableFile) -> set[str]:
    return set(grams.table.read(file.path, ["file"])["file"].unique().to_pylist())


def _rows_to_keep(
    grams: Snapshot, files: Sequence[TableFile], stale: frozenset[str]
) -> Iterator[pa.Table]:
    dropped = pa.array(sorted(stale), pa.string())
    for file in files:
        rows = grams.table.read(file.path).cast(grams.table.schema)
        yield rows.filter(pc.invert(pc.is_in(rows["file"], dropped)))


def _content_digest(rows: pa.Table) -> str:
    """Name a Gram file by its content, so that a repeated run writes the same file again."""
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, rows.schema) as writer:
        writer.write_table(rows.combine_chunks())
    return hashlib.sha256(sink.getvalue()).hexdigest()[:16]
