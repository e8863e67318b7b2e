"""Makes the table `grams` agree with the active files of `logs`.

One commit adds Gram rows of new log files and drops those of inactive ones: one rule for new days,
interrupted and repeated runs, deletions and compaction.
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
from fleet_slip.warehouse.gram_reader import cohort_files
from fleet_slip.warehouse.gram_rows import (
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
    """What a run of the job did for one feature set."""

    feature_set: str
    files_read: int
    rows_read: int
    files_dropped: int
    gram_rows: int
    logs_version: int | None
    grams_version: int | None
    received_dropped: int = 0
    """Gram rows that cars had sent, of drives whose logs have come since."""

    @property
    def changed(self) -> bool:
        """Whether there was anything to do."""
        return bool(self.files_read or self.files_dropped)

    def parts(self) -> Iterator[Part]:
        """Return remarks: what was read, and what there is."""
        rows = f"{pluralize(self.gram_rows, 'Gram row')} in all"
        if not self.changed:
            yield Remark(f"gram {self.feature_set}: nothing to do, {rows} are up to date")
            return
        yield Remark(
            f"gram {self.feature_set}: {pluralize(self.files_read, 'new file')}, "
            f"{pluralize(self.rows_read, 'row')} read, "
            f"{pluralize(self.files_dropped, 'file')} dropped; {rows}"
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
    among: Collection[str] | None = None,
) -> GramReport:
    """Bring the Gram rows of a feature set up to date. Running it again does nothing.

    For an executor see `compute_grams`; `among` limits the log files read. Sets corrected for
    receivers' delays bring `delay` up to date first, and are computed again where these moved.
    Raises `QuestionError` for an unknown set, `StorageError`, `ConflictError` and `ClusterError`.
    """
    *auxiliary, last = _needed_sets(warehouse, feature_set)
    for name in auxiliary:
        _update_once(warehouse, progress, name, executor, among)
    return _update_once(warehouse, progress, last, executor, among)


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
    missing = {file.path: file.rows for work in pending for file in work.files}
    files = None
    if missing and cohort is not None:
        files = cohort_files(warehouse, parse_cohort(warehouse.catalog.signals, cohort))
        missing = {path: rows for path, rows in missing.items() if path in files}
    if not missing or (max_rows is not None and sum(missing.values()) > max_rows):
        return None
    LOGGER.info(
        "computing Gram rows of %s from %s (%s): %s",
        feature_set,
        pluralize(len(missing), "log file"),
        pluralize(sum(missing.values()), "row"),
        reason,
    )
    arguments = [f"--features={feature_set}", *([f"--cohort={cohort}"] if cohort else [])]
    with recorded_step(warehouse.root, "ensure_grams", arguments) as figures:
        report = update_grams(warehouse, feature_set=feature_set, among=files)
        figures.rows = report.rows_read
    return report


def _needed_sets(warehouse: Warehouse, feature_set: str) -> tuple[str, ...]:
    """Return a feature set, after the set of receiver delays if it is corrected for them."""
    catalog = warehouse.catalog
    if catalog.feature_set(feature_set).in_time and DELAY in catalog.sets:
        return (DELAY, feature_set)
    return (feature_set,)


@dataclass(frozen=True)
class _Work:
    """What separates the Gram rows of a feature set from the log files.

    Attributes:
        grams, logs: the snapshots that were compared.
        identity: of the feature set.
        files: log files to read: those without Gram rows, and the outdated ones.
        outdated: paths of log files whose Gram rows have another course delay than their cars.
        stale: paths in `grams` that are no active log file.
        delays: course delay of each car, for feature sets that are corrected for it.
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
        """Return the work without the log files that are not among `paths`."""
        files = tuple(file for file in self.files if file.path in paths)
        return replace(self, files=files, outdated=self.outdated & frozenset(paths))


def _find_work(warehouse: Warehouse, feature_set: str) -> _Work:
    """Compare the Gram rows of a feature set with the log files; change nothing."""
    # The logs are looked at last: if they lose a drive from now on, whoever removed it changes its
    # Gram rows after this snapshot of them, and a commit on it is a conflict.
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


def reconcile(warehouse: Warehouse, *, unreadable: Collection[str] = ()) -> list[GramReport]:
    """Bring up to date what was computed here before, but for `unreadable` log files."""
    grams = warehouse.grams.snapshot()
    identities = {name: warehouse.catalog.identity(name) for name in warehouse.feature_sets()}
    used = [n for n, i in identities.items() if grams.landed(transaction_name(i)) is not None]
    over_time = [name for name in used if warehouse.catalog.feature_set(name).windows]
    drives = {name: _unique(grams, identities[name], "drive_id") for name in over_time}
    reports = []
    for name in used:
        among = None
        if name in drives:
            plain = warehouse.grams.snapshot()
            among = set(_unique(plain, PLAIN, "file", drives[name]).to_pylist())
        if unreadable:
            active = {file.path for file in warehouse.logs.snapshot().files}
            among = (active if among is None else among).difference(unreadable)
        reports.append(update_grams(warehouse, feature_set=name, among=among))
    return reports


def _unique(
    grams: Snapshot, identity: str, column: str, drives: pa.Array | None = None
) -> pa.Array:
    found = [pa.array([], pa.string())]
    for rows in rows_of_set(grams, identity, *{"drive_id", column}):
        values = rows[column].cast(pa.string())
        if drives is not None:
            values = values.filter(pc.is_in(rows["drive_id"].cast(pa.string()), drives))
        found.append(values.unique())
    return pa.concat_arrays(found).unique()


def transaction_name(identity: str) -> str:
    """Return the name of the transaction that lands Gram rows of a feature set."""
    return f"gram/{identity}"


@retrying
def _update_once(
    warehouse: Warehouse,
    progress: Progress,
    feature_set: str,
    executor: Executor | None,
    among: Collection[str] | None,
) -> GramReport:
    work = _find_work(warehouse, feature_set)
    if work.logs.version is None and work.stale:
        raise StorageError(
            f"{warehouse.logs.folder}: the logs that Gram rows were computed from are gone, of "
            f"{pluralize(len(work.stale), 'file')}. Nothing is changed: restore the folder from "
            "a backup."
        )
    if among is not None:
        work = work.limited_to(among)
    grams, dropped = work.grams, 0
    if work:
        new_rows = compute_grams(
            warehouse, work.files, progress, feature_set, executor, work.delays
        )
        add, replaced, dropped = _write_merged(
            warehouse, work.grams, new_rows, work.stale, work.identity, work.outdated
        )
        _land(work.grams, work.logs, work.identity, add, replaced)
        # Who removed a file may have found no Gram row of its drives, and so have changed none; the
        # next attempt drops those that landed.
        require_active(work.logs.renewed(), work.files)
        grams = warehouse.grams.snapshot()
    return GramReport(
        feature_set=work.identity,
        files_read=len(work.files),
        rows_read=sum(file.rows for file in work.files),
        files_dropped=len(work.stale),
        gram_rows=grams.rows,
        logs_version=work.logs.version,
        grams_version=grams.version,
        received_dropped=dropped,
    )


def _write_merged(
    warehouse: Warehouse,
    grams: Snapshot,
    new_rows: Iterable[pa.Table],
    stale: frozenset[str],
    identity: str,
    again: frozenset[str],
) -> tuple[list[AddAction], list[TableFile], int]:
    """Write new Gram rows, and those that stay of the files that are written again with them.

    Log files that are gone are `stale`; the feature set of an `identity` is computed `again` for
    some. Returns what adds the new files, the files that give way to them, and how many rows left
    that cars had sent, of drives whose logs have come since.
    """
    looked_for = any(is_onboard_file(file) for file in grams.files)
    replaced: list[TableFile] = []
    superseded = 0

    def merged() -> Iterator[pa.Table]:
        nonlocal superseded
        new: list[pa.Table] = []
        for rows in new_rows:
            new += [rows] if looked_for else []
            yield rows
        drives, paths = find_superseded(grams, new)
        paths |= {file.path for file in files_to_rewrite(grams, stale | again)}
        replaced.extend(file for file in grams.files if file.path in paths)
        logged, computed = (pa.array(sorted(some), pa.string()) for some in (drives, again))
        for rows in rows_to_keep(grams, replaced, stale):
            dropped = pc.and_(
                pc.equal(rows["feature_set"], identity), pc.is_in(rows["file"], computed)
            )
            ids = rows["drive_id"].cast(pa.string())
            sent = pc.and_(is_onboard(rows), pc.is_in(ids, logged))
            superseded += pc.sum(sent).as_py() or 0
            yield rows.filter(pc.invert(pc.or_(dropped, sent)))

    added = write_rows(warehouse, merged())
    return added, replaced, superseded


# Lands the Gram rows of log files before the files themselves, where others are written again.
#
# They count while their log file is active: one commit exchanges both.


def commit_ahead(
    warehouse: Warehouse, new: Sequence[AddAction], replaced: Collection[TableFile]
) -> None:
    """Land the Gram rows of new log files, of the feature sets that replaced ones have.

    Raises `ConflictError` if a replaced file is gone, or the Gram rows change at that moment.
    """
    files = [_as_file(action) for action in new]
    for name in warehouse.feature_sets():
        identity = warehouse.catalog.identity(name)
        grams = warehouse.grams.snapshot()
        done, _ = named_files(grams, identity)
        missing = [file for file in files if file.path not in done]
        if done.isdisjoint(file.path for file in replaced) or not missing:
            continue
        # The logs are looked at last. Whoever removes a file from them fences the Gram rows after
        # it: a commit of Gram rows that has not seen the file go is in conflict.
        logs = Snapshot(warehouse.logs, warehouse.logs.open_delta())  # in whatever scales
        require_active(logs, replaced)
        late = None
        if warehouse.catalog.feature_set(name).in_time:
            active = frozenset(file.path for file in logs.files)
            late = course_delays(warehouse, grams, active)
        rows = aggregate(warehouse, missing, feature_set=name, late=late)
        _land(grams, logs, identity, write_rows(warehouse, [rows]))


def _land(
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
    stated = json.loads(action.stats)
    day = action.partition_values.get("day")
    return TableFile(
        action.path,
        stated["numRecords"],
        action.size,
        stated["nullCount"],
        date.fromisoformat(day) if day else None,
    )
