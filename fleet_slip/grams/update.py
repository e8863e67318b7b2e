"""Update of the table `grams` to the active files of the table `logs`.

One commit adds the Gram rows of new log files and drops those of inactive files. The same rule
serves new days, interrupted and repeated runs, deletions and compaction.
"""

import json
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from datetime import date

import pyarrow as pa
import pyarrow.compute as pc
from deltalake.transaction import AddAction

from fleet_slip.base import Progress, no_progress, pluralize
from fleet_slip.calibration.receiver_delay import course_delays
from fleet_slip.catalog.calibration_parameters import DELAY
from fleet_slip.catalog.features import PLAIN
from fleet_slip.errors import StorageError
from fleet_slip.grams.compute import aggregate, compute_grams
from fleet_slip.grams.gram_files import (
    GramWriter,
    files_of_other_delay,
    files_to_rewrite,
    find_superseded,
    require_active,
    rows_to_keep,
    write_rows,
)
from fleet_slip.rendering import Answer, Part, Remark
from fleet_slip.storage.runs import LOGGER, recorded_step
from fleet_slip.storage.table import AppTransaction, Change, Snapshot, TableFile, retrying
from fleet_slip.warehouse.gram_reader import (
    cohort_files,
    find_backlog,
    is_onboard,
    is_onboard_file,
    named_files,
    rows_of_set,
)
from fleet_slip.warehouse.predicate import parse_cohort
from fleet_slip.warehouse.warehouse import Warehouse


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
    catalog = warehouse.catalog
    identities = {name: catalog.identity(name) for name in warehouse.feature_sets()}
    computed = {
        name: identity
        for name, identity in identities.items()
        if grams.transaction_version(transaction_name(identity)) is not None
    }
    drives = {
        name: _distinct(grams, identity, "drive_id")
        for name, identity in computed.items()
        if catalog.feature_set(name).windows
    }
    reports = []
    for name in computed:
        paths = None
        if name in drives:  # windows are computed for the drives that had them, not for all
            plain = warehouse.grams.snapshot()
            paths = set(_distinct(plain, PLAIN, "file", drives[name]).to_pylist())
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
    for rows in rows_of_set(grams, identity, *{"drive_id", column}):
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
    work = _find_work(warehouse, feature_set)
    if work.logs.version is None and work.stale:
        raise StorageError(
            f"{warehouse.logs.folder}: the logs that Gram rows were computed from are gone, of "
            f"{pluralize(len(work.stale), 'file')}. Nothing is changed: restore the folder from "
            "a backup."
        )
    if paths is not None:
        work = work.limited_to(paths)
    grams, superseded = work.grams, 0
    if work:
        rows = compute_grams(warehouse, work.files, progress, feature_set, executor, work.delays)
        added, replaced, superseded = _write_files(warehouse, work, rows)
        _commit(work.grams, work.logs, work.identity, added, replaced)
        # Who removed a log file may have found no Gram row of its drives, and so changed none: the
        # next attempt drops the rows that were committed here.
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
        Of the feature set.
    files
        Log files to read: those without Gram rows, and the outdated ones.
    outdated
        Paths of log files whose Gram rows have another course delay than their cars.
    stale
        Paths in `grams` that are no active log file.
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

    def __bool__(self) -> bool:
        return bool(self.files or self.stale)

    def limited_to(self, paths: Collection[str]) -> "_Work":
        """Return the work without the log files that are not in `paths`."""
        files = tuple(file for file in self.files if file.path in paths)
        return replace(self, files=files, outdated=self.outdated & frozenset(paths))


def _find_work(warehouse: Warehouse, feature_set: str) -> _Work:
    """Compare the Gram rows of a feature set with the log files; change nothing."""
    # The snapshot of the logs is the later one. Who removes a drive from the logs after it changes
    # the Gram rows after the snapshot of these, and a commit on that snapshot is a conflict.
    grams = warehouse.grams.snapshot()
    logs = warehouse.logs.snapshot()
    identity = warehouse.catalog.identity(feature_set)
    backlog = find_backlog(logs, grams, identity)
    files, delays, outdated = backlog.missing, None, frozenset[str]()
    if warehouse.catalog.feature_set(feature_set).in_time:
        active = {file.path: file for file in logs.files}
        delays = course_delays(warehouse, grams, frozenset(active))
        outdated = frozenset(files_of_other_delay(grams, identity, delays) & active.keys())
        files += tuple(active[path] for path in sorted(outdated))
    return _Work(grams, logs, identity, files, outdated, backlog.stale, delays)


def _write_files(
    warehouse: Warehouse, work: _Work, new_rows: Iterable[pa.Table]
) -> tuple[list[AddAction], list[TableFile], int]:
    """Write new Gram rows, and those that remain of the files that the commit replaces.

    Returns the actions that add files, the replaced files, and the number of Gram rows from cars
    that logs of the same drives supersede.
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
        delays = None
        if warehouse.catalog.feature_set(name).in_time:
            active = frozenset(file.path for file in logs.files)
            delays = course_delays(warehouse, grams, active)
        rows = aggregate(warehouse, missing, name, delays)
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
    """Return a file that is not committed yet as a file of a snapshot."""
    statistics = json.loads(action.stats)
    day = action.partition_values.get("day")
    return TableFile(
        action.path,
        statistics["numRecords"],
        action.size,
        statistics["nullCount"],
        date.fromisoformat(day) if day else None,
    )
