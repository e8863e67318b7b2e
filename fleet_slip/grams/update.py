"""Update of the table `grams` to the active files of the table `logs`.

One commit adds the Gram rows of new log files and drops those of inactive files. The same rule
serves new days, interrupted and repeated runs, deletions and compaction.
"""

import json
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from datetime import date
from hashlib import blake2b
from itertools import accumulate

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from deltalake.transaction import AddAction

from fleet_slip.arrays import BoolArray
from fleet_slip.base import Progress, no_progress, pluralize
from fleet_slip.calibration.receiver_delay import course_delays
from fleet_slip.catalog.course import COURSE_LATE
from fleet_slip.catalog.definitions import DELAY
from fleet_slip.catalog.features import PLAIN
from fleet_slip.errors import ConflictError, StorageError
from fleet_slip.grams.compute import aggregate, compute_grams
from fleet_slip.regression.gram import GramTable
from fleet_slip.rendering import Answer, Part, Remark
from fleet_slip.resources import read_sql
from fleet_slip.storage.runs import LOGGER, recorded_step
from fleet_slip.storage.table import AppTransaction, Change, Snapshot, Table, TableFile, retrying
from fleet_slip.warehouse.database import open_database, parse_cohort, reading_files
from fleet_slip.warehouse.gram_reader import (
    ONBOARD_PREFIX,
    by_signals,
    cohort_files,
    find_backlog,
    gram_table,
    is_onboard,
    is_onboard_file,
    named_files,
    rows_of_set,
)
from fleet_slip.warehouse.warehouse import Warehouse

# The job.


@dataclass(frozen=True)
class GramReport(Answer):
    """Result of an update of one feature set."""

    feature_set: str
    files_read: int
    rows_read: int
    files_dropped: int
    gram_rows: int
    logs_version: int | None
    grams_version: int | None
    received_dropped: int = 0
    """Gram rows from cars that the logs of the same drives replaced."""

    @property
    def total(self) -> str:
        """Return the number of Gram rows in the table, with its scope."""
        return f"{pluralize(self.gram_rows, 'Gram row')} of all drives and feature sets"

    @property
    def changed(self) -> bool:
        """Return True if Gram rows were added or dropped."""
        return bool(self.files_read or self.files_dropped)

    def parts(self) -> Iterator[Part]:
        """Return remarks on the files read and the Gram rows."""
        if not self.changed:
            yield Remark(f"gram {self.feature_set}: nothing to do, {self.total} are up to date")
            return
        yield Remark(
            f"gram {self.feature_set}: {pluralize(self.files_read, 'new file')}, "
            f"{pluralize(self.rows_read, 'row')} read, "
            f"{pluralize(self.files_dropped, 'file')} dropped; {self.total}"
        )
        if dropped := self.received_dropped:
            yield Remark(
                f"{pluralize(dropped, 'Gram row')} that cars had sent dropped: the logs of the "
                "same drives are here now"
            )


def update_grams(
    warehouse: Warehouse,
    progress: Progress = no_progress,
    feature_set: str = PLAIN,
    executor: Executor | None = None,
    paths: Collection[str] | None = None,
) -> GramReport:
    """Bring the Gram rows of a feature set up to date; repeating it does nothing.

    `paths` limits the log files that are read; for `executor` see `compute_grams`. A feature set
    corrected for receiver delays updates `delay` first; log files whose delays changed are computed
    again. Raises `QuestionError` for an unknown set, `StorageError`, `ConflictError` and
    `ClusterError`.
    """
    *auxiliary, last = _needed_sets(warehouse, feature_set)
    for name in auxiliary:
        _update_set(warehouse, progress, name, executor, paths)
    return _update_set(warehouse, progress, last, executor, paths)


def ensure_grams(
    warehouse: Warehouse,
    feature_set: str,
    cohort: str | None = None,
    *,
    reason: str,
    max_rows: int | None = None,
) -> GramReport | None:
    """Compute the Gram rows of a feature set that the log files of a cohort, or all, lack.

    Changes nothing and returns None if no Gram row is missing or outdated, or if more than
    `max_rows` rows of logs would be read. Otherwise logs a line with the `reason`, and records a
    step of the run under way, or a run `ensure_grams`. Raises as `update_grams`.
    """
    pending = [_find_work(warehouse, name) for name in _needed_sets(warehouse, feature_set)]
    rows = {file.path: file.rows for work in pending for file in work.files}
    paths = None
    if rows and cohort is not None:
        paths = cohort_files(warehouse, parse_cohort(warehouse.catalog.signals, cohort))
        rows = {path: count for path, count in rows.items() if path in paths}
    if not rows or (max_rows is not None and sum(rows.values()) > max_rows):
        return None
    LOGGER.info(
        "computing Gram rows of %s from %s (%s): %s",
        feature_set,
        pluralize(len(rows), "log file"),
        pluralize(sum(rows.values()), "row"),
        reason,
    )
    arguments = [f"--features={feature_set}", *([f"--cohort={cohort}"] if cohort else [])]
    with recorded_step(warehouse.root, "ensure_grams", arguments) as figures:
        report = update_grams(warehouse, feature_set=feature_set, paths=paths)
        figures.rows = report.rows_read
    return report


def reconcile(warehouse: Warehouse, *, unreadable: Collection[str] = ()) -> list[GramReport]:
    """Update all feature sets that were computed before, except for `unreadable` log files."""
    grams = warehouse.grams.snapshot()
    reports = []
    for name in warehouse.feature_sets():
        identity = warehouse.catalog.identity(name)
        if grams.transaction_version(transaction_name(identity)) is None:
            continue
        paths = None
        if warehouse.catalog.feature_set(name).windows:  # only the drives that had Gram rows before
            drives = _distinct(grams, identity, "drive_id")
            current = warehouse.grams.snapshot()
            paths = set(_distinct(current, PLAIN, "file", drives).to_pylist())
        if unreadable:
            active = {file.path for file in warehouse.logs.snapshot().files}
            paths = (active if paths is None else paths).difference(unreadable)
        reports.append(update_grams(warehouse, feature_set=name, paths=paths))
    return reports


def _distinct(
    grams: Snapshot, identity: str, column: str, drives: pa.Array | None = None
) -> pa.Array:
    """Return the distinct values of a column in the Gram rows of a feature set, or some drives."""
    values = [pa.array([], pa.string())]
    for rows in rows_of_set(grams, identity, *dict.fromkeys(["drive_id", column])):
        texts = rows[column].cast(pa.string())
        if drives is not None:
            texts = texts.filter(pc.is_in(rows["drive_id"].cast(pa.string()), drives))
        values.append(texts.unique())
    return pa.concat_arrays(values).unique()


def transaction_name(identity: str) -> str:
    """Return the name of the transaction that adds Gram rows of a feature set."""
    return f"gram/{identity}"


def _needed_sets(warehouse: Warehouse, feature_set: str) -> tuple[str, ...]:
    """Return a feature set, after the set of receiver delays if it is corrected for them."""
    catalog = warehouse.catalog
    if catalog.feature_set(feature_set).in_time and DELAY in catalog.sets:
        return (DELAY, feature_set)
    return (feature_set,)


@retrying
def _update_set(
    warehouse: Warehouse,
    progress: Progress,
    feature_set: str,
    executor: Executor | None,
    paths: Collection[str] | None,
) -> GramReport:
    """Update one feature set: find the work, compute and write Gram rows, commit."""
    work = _find_work(warehouse, feature_set, paths)
    if work.logs.version is None and work.stale:
        raise StorageError(
            f"{warehouse.logs.folder}: the logs that Gram rows were computed from are gone, of "
            f"{pluralize(len(work.stale), 'file')}. Nothing is changed: restore the folder from "
            "a backup."
        )
    grams, superseded = work.grams, 0
    if work.files or work.stale:
        rows = compute_grams(warehouse, work.files, progress, feature_set, executor, work.delays)
        added, replaced, superseded = _write_files(warehouse, work, rows)
        _commit(work.grams, work.logs, work.identity, added, replaced)
        # A process that removed a log file meanwhile did not drop the rows that were committed
        # here. After this conflict the next attempt drops them.
        require_active(work.logs.refresh(), work.files)
        grams = warehouse.grams.snapshot()
    return GramReport(
        feature_set=work.identity,
        files_read=len(work.files),
        rows_read=sum(file.rows for file in work.files),
        files_dropped=len(work.stale),
        gram_rows=grams.rows,
        logs_version=work.logs.version,
        grams_version=grams.version,
        received_dropped=superseded,
    )


@dataclass(frozen=True)
class _Work:
    """Difference between the Gram rows of a feature set and the log files.

    Attributes
    ----------
    grams, logs
        The snapshots that were compared.
    identity
        Identity of the feature set.
    files
        Log files to read: those without Gram rows, and the outdated ones.
    outdated
        Paths of log files whose Gram rows have another course delay than their cars.
    stale
        Paths in `grams` that are not active log files.
    delays
        Course delay of each car, for feature sets that are corrected for it.
    """

    grams: Snapshot
    logs: Snapshot
    identity: str
    files: tuple[TableFile, ...]
    outdated: frozenset[str]
    stale: frozenset[str]
    delays: Mapping[str, int] | None


def _find_work(
    warehouse: Warehouse, feature_set: str, paths: Collection[str] | None = None
) -> _Work:
    """Compare the Gram rows of a feature set with the log files, or some; change nothing."""
    # The Gram rows are opened first. A process that removes a drive from the logs changes its Gram
    # rows afterwards, so that a commit on this snapshot of the Gram rows is a conflict.
    grams = warehouse.grams.snapshot()
    logs = warehouse.logs.snapshot()
    identity = warehouse.catalog.identity(feature_set)
    backlog = find_backlog(logs, grams, identity)
    delays = _delays(warehouse, feature_set, grams, logs)
    recorded = recorded_delays(grams, identity) if delays is not None else set()
    changed = {path for path, car, delay in recorded if delay != (delays or {}).get(car, 0)}
    requested = [file for file in logs.files if paths is None or file.path in paths]
    missing = {file.path for file in backlog.missing}
    outdated = [file for file in requested if file.path in changed]
    files = (*(file for file in requested if file.path in missing), *outdated)
    outdated_paths = frozenset(file.path for file in outdated)
    return _Work(grams, logs, identity, files, outdated_paths, backlog.stale, delays)


def _delays(
    warehouse: Warehouse, feature_set: str, grams: Snapshot, logs: Snapshot
) -> Mapping[str, int] | None:
    """Return the course delay of each car; None for a feature set that is not corrected for it."""
    if not warehouse.catalog.feature_set(feature_set).in_time:
        return None
    return course_delays(warehouse, grams, frozenset(file.path for file in logs.files))


def _write_files(
    warehouse: Warehouse, work: _Work, new_rows: Iterable[pa.Table]
) -> tuple[list[AddAction], list[TableFile], int]:
    """Write new Gram rows, and the remaining rows of the Gram files that the commit replaces.

    Returns the actions that add files, the replaced files, and the number of dropped Gram rows from
    cars: logs of the same drives supersede them.
    """
    grams, writer, logged = work.grams, GramWriter(warehouse), []
    has_onboard = any(is_onboard_file(file) for file in grams.files)
    for rows in new_rows:
        writer.write(rows)
        if has_onboard:
            logged.append(rows)
    drives, paths = find_superseded(grams, logged)
    paths |= {file.path for file in files_to_rewrite(grams, work.stale | work.outdated)}
    replaced = [file for file in grams.files if file.path in paths]
    superseded_drives = pa.array(sorted(drives), pa.string())
    outdated_files = pa.array(sorted(work.outdated), pa.string())
    superseded = 0
    for rows in rows_to_keep(grams, replaced, work.stale):
        is_outdated = pc.and_(
            pc.equal(rows["feature_set"], work.identity), pc.is_in(rows["file"], outdated_files)
        )
        ids = rows["drive_id"].cast(pa.string())
        is_superseded = pc.and_(is_onboard(rows), pc.is_in(ids, superseded_drives))
        superseded += pc.sum(is_superseded).as_py() or 0
        writer.write(rows.filter(pc.invert(pc.or_(is_outdated, is_superseded))))
    return writer.close(), replaced, superseded


def commit_ahead(
    warehouse: Warehouse, new: Sequence[AddAction], replaced: Collection[TableFile]
) -> None:
    """Commit the Gram rows of log files that are about to replace others.

    Gram rows count while their log file is active, so the commit of the log files exchanges both at
    once. Computes the feature sets that the replaced files have. Raises `ConflictError` if a
    replaced file is gone, or the Gram rows change at that moment.
    """
    files = [_as_file(action) for action in new]
    for name in warehouse.feature_sets():
        identity = warehouse.catalog.identity(name)
        grams = warehouse.grams.snapshot()
        done, _ = named_files(grams, identity)
        missing = [file for file in files if file.path not in done]
        if done.isdisjoint(file.path for file in replaced) or not missing:
            continue
        # The logs are opened last, as in `_find_work`, in the scales that they have.
        logs = Snapshot(warehouse.logs, warehouse.logs.open_delta())
        require_active(logs, replaced)
        rows = aggregate(warehouse, missing, name, _delays(warehouse, name, grams, logs))
        _commit(grams, logs, identity, write_rows(warehouse, [rows]))


def _commit(
    grams: Snapshot,
    logs: Snapshot,
    identity: str,
    add: Sequence[AddAction],
    remove: Sequence[TableFile] = (),
) -> None:
    transactions = [AppTransaction(transaction_name(identity), logs.version or 0)]
    note = {"job": "gram", "feature_set": identity, "logs_version": logs.version}
    grams.commit_or_discard(Change(add, remove, transactions, note))


def _as_file(action: AddAction) -> TableFile:
    """Return an uncommitted file as a file of a snapshot."""
    statistics = json.loads(action.stats)
    day = action.partition_values.get("day")
    return TableFile(
        action.path,
        statistics["numRecords"],
        action.size,
        statistics["nullCount"],
        date.fromisoformat(day) if day else None,
    )


# Digests identify Gram rows by their counts, under any name of drive or car and any day.

MIN_EVENTFUL_ROWS = 256
MIN_EVENTFUL_SIGNALS = 2
"""Signals with a variance of one count or more. Rows with fewer, such as those of a standing car,
can be equal by chance."""


def find_eventful(table: GramTable) -> BoolArray:
    """Return a mask of the Gram rows that vary too much to be equal by chance in two drives."""
    n, column = table.n[:, None], np.arange(len(table.signals))
    variances = table.products[:, column * (column + 3) // 2] / n - (table.sums / n) ** 2
    varying: BoolArray = (variances >= 1).sum(axis=1) >= MIN_EVENTFUL_SIGNALS
    return varying & (table.n >= MIN_EVENTFUL_ROWS)


def gram_digests(rows: pa.Table) -> tuple[list[str], BoolArray]:
    """Return a digest of 16 characters of the counts of each Gram row, and the eventful rows.

    The digest of a row that is not eventful depends on its car and day too, as in `digest_counts`.
    """
    digests, eventful = np.empty(len(rows), dtype=object), np.zeros(len(rows), dtype=np.bool_)
    for signals, alike, mask in by_signals(rows):
        numbers, is_eventful = alike["n"].to_numpy()[:, None], eventful[mask]
        if signals:
            table = gram_table(signals, alike)
            numbers = np.column_stack([table.n, table.sums, table.products])
            eventful[mask] = is_eventful = find_eventful(table)
        names = alike.select(["feature_set", "part", "vehicle_id", "day"]).to_pylist()
        row_digests = []
        for name, is_unique, row in zip(names, is_eventful, numbers, strict=True):
            owner = "" if is_unique else f"{name['vehicle_id']}\n{name['day']}"
            text = f"{name['feature_set']}\n{name['part'] or ''}\n{signals}\n{owner}\n"
            content = text.encode() + row.tobytes()
            row_digests.append(blake2b(content, digest_size=8).hexdigest())
        digests[mask] = row_digests
    return digests.tolist(), eventful


# Writing and rewriting of files.

FILE_ROWS = 100_000
"""Gram rows of a full file, some 700 bytes each."""

FILE_BYTES = 2**28
"""Maximum size of the Gram rows of a file in memory; a row of 200 columns has 160,000 bytes."""

SMALL_FILES_MAX = 32
"""Number of small Gram files beyond which a commit merges some."""


class GramWriter:
    """Writes Gram rows into files of usual size, and collects the actions that add them."""

    def __init__(self, warehouse: Warehouse) -> None:
        self._warehouse = warehouse
        self._buffer: list[pa.Table] = []
        self._actions: list[AddAction] = []

    def write(self, rows: pa.Table) -> None:
        """Buffer Gram rows; write files as soon as they are full."""
        step = max(1, min(FILE_ROWS, FILE_BYTES * len(rows) // max(1, rows.nbytes)))
        for start in range(0, rows.num_rows, step):
            self._buffer.append(rows.slice(start, step))
            count = sum(table.num_rows for table in self._buffer)
            if count >= FILE_ROWS or sum(table.nbytes for table in self._buffer) >= FILE_BYTES:
                self._flush()

    def close(self) -> list[AddAction]:
        """Write the remaining Gram rows; return the actions that add all files."""
        if self._buffer:
            self._flush()
        return self._actions

    def _flush(self) -> None:
        """Write a file for each feature set, and separate files for rows from cars."""
        rows = pa.concat_tables(self._buffer, promote_options="default")  # optional columns differ
        self._buffer.clear()
        table, onboard = self._warehouse.grams, is_onboard(rows)
        for prefix, selected in ((ONBOARD_PREFIX, onboard), ("", pc.invert(onboard))):
            same_origin = _only(rows, selected)
            for identity in sorted(same_origin["feature_set"].unique().to_pylist()):
                same_set = _only(same_origin, pc.equal(same_origin["feature_set"], identity))
                optional = set(table.optional).intersection(same_set.column_names)
                empty = [name for name in optional if same_set[name].null_count == len(same_set)]
                file = table.write_file(f"{prefix}{identity}", same_set.drop_columns(empty))
                self._actions.append(file)


def write_rows(warehouse: Warehouse, tables: Iterable[pa.Table]) -> list[AddAction]:
    """Write Gram rows table by table; return the actions that add the files."""
    writer = GramWriter(warehouse)
    for rows in tables:
        writer.write(rows)
    return writer.close()


def _only(rows: pa.Table, mask: pa.ChunkedArray) -> pa.Table:
    return rows if pc.all(mask).as_py() else rows.filter(mask)


def files_to_rewrite(grams: Snapshot, stale: frozenset[str]) -> list[TableFile]:
    """Return the Gram files with rows of stale log files, and small files to merge, if too many."""
    merged = _files_to_merge(grams)
    return [
        file
        for file in grams.files
        if file.path in merged
        or (
            stale and not is_onboard_file(file) and not stale.isdisjoint(_log_files_of(grams, file))
        )
    ]


def _files_to_merge(grams: Snapshot) -> set[str]:
    """Return small files to merge into two full ones, if there are too many small files."""
    small = sorted((_fullness(file), file.path) for file in grams.files if _fullness(file) < 1)
    if len(small) <= SMALL_FILES_MAX:
        return set()
    full = list(accumulate(fullness for fullness, _ in small))
    return {path for (_, path), so_far in zip(small, full, strict=True) if so_far <= 2}


def _fullness(file: TableFile) -> float:
    """Return the size of a file over that of a full file; encoding saves up to three quarters."""
    return max(file.rows / FILE_ROWS, file.size_bytes / (FILE_BYTES / 4))


def _log_files_of(grams: Snapshot, file: TableFile) -> set[str]:
    return set(grams.table.read_combinations(file.path, ["file"])["file"].to_pylist())


def rows_to_keep(
    grams: Snapshot, files: Sequence[TableFile], stale: frozenset[str]
) -> Iterator[pa.Table]:
    """Yield the Gram rows of files without those of stale log files."""
    dropped = pa.array(sorted(stale), pa.string())
    for file in files:
        rows = read_rows(grams.table, file)
        yield rows.filter(pc.invert(pc.is_in(rows["file"], dropped)))


def read_rows(grams: Table, file: TableFile) -> pa.Table:
    """Return the Gram rows of a file in the schema of the table."""
    return in_schema(grams.read(file.path), grams.schema)


def in_schema(rows: pa.Table, schema: pa.Schema) -> pa.Table:
    """Return rows in the columns of a schema, null in those that they lack."""
    columns = [
        rows[field.name].cast(field.type)
        if field.name in rows.column_names
        else pa.nulls(len(rows), field.type)
        for field in schema
    ]
    return pa.table(columns, schema=schema)


_COMPARED = ("drive_id", "feature_set", "vehicle_id", "day", "signals", "n", "sums", "products")


def find_superseded(grams: Snapshot, new_rows: Sequence[pa.Table]) -> tuple[set[str], set[str]]:
    """Return the drives whose logs have arrived after the Gram rows from their cars, and the files.

    Logs supersede the rows from cars in all feature sets.
    """
    paths = {grams.table.uri(file.path): file.path for file in grams.files if is_onboard_file(file)}
    if not paths or not new_rows:
        return set(), set()
    statement = read_sql("jobs", "superseded.sql").format(plain=PLAIN)
    with open_database(reading=grams.table.folder) as database:
        logged = pa.concat_tables([rows.select(_COMPARED) for rows in new_rows])
        database.register("logged", logged)
        database.execute("SET VARIABLE gram_files = $files", {"files": list(paths)})
        with reading_files(database, "finding drives whose logs have arrived"):
            matches = database.execute(statement).fetchall()
    return {drive for drive, _ in matches}, {paths[file] for _, file in matches}


def require_active(logs: Snapshot, files: Collection[TableFile]) -> None:
    """Raise `ConflictError` if the logs have lost a file whose Gram rows are landing."""
    lost = {file.path for file in files} - {file.path for file in logs.files}
    if lost:
        raise ConflictError(
            f"{logs.table.folder}: other processes keep removing files, such as {min(lost)}. Run "
            "the same command again."
        )


def recorded_delays(grams: Snapshot, identity: str) -> set[tuple[str, str, int]]:
    """Return the log files, cars and delays in the Gram rows of a feature set; 0 if unknown."""
    triples: set[tuple[str, str, int]] = set()
    for rows in rows_of_set(grams, identity, "file", "vehicle_id", COURSE_LATE):
        paths, cars, delays = (
            rows[name].to_pylist() for name in ("file", "vehicle_id", COURSE_LATE)
        )
        triples.update(zip(paths, cars, (delay or 0 for delay in delays), strict=True))
    return triples
