"""Erases drives: those of a car, a single one, or all that exceed the retention.

Rows are removed from `quarantine`, `logs` (files are rewritten in one commit) and `grams`
(reconciled) in this order, so that the remaining rows show an interrupted job what to do. The entry
of the erasure log (`warehouse/erasure_log.py`) is written first, then quarantine and logs are
fenced: commits of jobs that have not read the entry conflict. Then Gram rows are fenced, against
jobs that have not read the new logs. Files of such jobs are deleted by them or here.
"""

import shutil
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import date, timedelta
from functools import partial
from typing import TypeAlias

import polars as pl
import pyarrow as pa
import pyarrow.compute as pc
from pydantic import Field

from fleet_slip.base import Progress, no_progress, pluralize
from fleet_slip.catalog.counts import digest_counts
from fleet_slip.catalog.features import PLAIN
from fleet_slip.config import Config, load_config
from fleet_slip.errors import (
    AlarmError,
    ConfigError,
    FleetSlipError,
    PendingError,
    QuestionError,
    RefusedError,
    StorageError,
)
from fleet_slip.grams.cohort import hash_names
from fleet_slip.grams.on_board import onboard_feature_sets
from fleet_slip.grams.update import gram_digests, read_rows, reconcile
from fleet_slip.models.registry import Registry
from fleet_slip.operations.rewriting import (
    RETENTION_HOURS,
    VacuumReport,
    build_rewriting,
    find_replaced,
    find_temporary_files,
    find_unreferenced,
    path_below,
    vacuum,
    without_rows,
)
from fleet_slip.quality.checks import implausible_day
from fleet_slip.rendering import Answer, Part, Remark
from fleet_slip.resources import Configs, cache_folder
from fleet_slip.storage.commits import LOG
from fleet_slip.storage.folder import StoredFile
from fleet_slip.storage.runs import runs_under_way
from fleet_slip.storage.table import Table, TableFile, retrying, rows_in
from fleet_slip.warehouse.erasure_log import ALLOWED, ErasureLog, ErasureSubject
from fleet_slip.warehouse.gram_reader import is_onboard_file
from fleet_slip.warehouse.warehouse import Warehouse

# Rows of a subject in tables and files.


def rows_of(rows: pa.Table, subject: ErasureSubject) -> pa.ChunkedArray:
    """Return which rows of `logs` or `grams` are of a subject."""
    if subject.kind == "before":
        is_before = pc.less(rows["day"], pa.scalar(date.fromisoformat(subject.value)))
        kept_days = pa.array(sorted(subject.kept_days), pa.date32())
        return pc.and_not(is_before, pc.is_in(rows["day"], kept_days))
    names = rows[subject.column].cast(pa.string())
    return pc.is_in(names, pa.array(subject.select(names.unique().to_pylist()), pa.string()))


def quarantined_of(
    rows: pa.Table, subject: ErasureSubject, drives: Collection[str]
) -> pa.ChunkedArray:
    """Return a mask of the quarantine's rows of a subject or of its drives.

    Rows rejected before a cut at a gap have the name of the uncut drive.
    """
    ids = rows["drive_id"].cast(pa.string())
    if subject.kind == "drive":
        drives = {*drives, subject.value, *subject.select(ids.unique().to_pylist())}
    concerned = {
        name
        for name in ids.unique().to_pylist()
        if name and any(drive == name or drive.startswith(f"{name}-") for drive in drives)
    }
    of_drives = pc.is_in(ids, pa.array(sorted(concerned), pa.string()))
    if subject.kind != "vehicle":
        return of_drives
    return pc.or_(of_drives, rows_of(rows, subject))


DrivesByFile: TypeAlias = Mapping[str, Collection[str]]


def find_rows(
    warehouse: Warehouse, subject: ErasureSubject, drives: Collection[str] = ()
) -> dict[str, DrivesByFile]:
    """Return a subject's drives by table and file, without tables that have none.

    `drives` are names for the quarantine. Drives of `grams` are by log file. Log files with Gram
    rows are not opened.
    """
    in_grams: dict[str, set[str]] = defaultdict(set)
    reduced: set[str] = set()
    for file in warehouse.grams.snapshot().files:
        columns = ["feature_set", "file", "drive_id", "vehicle_id", "day"]
        rows = warehouse.grams.read(file.path, columns)
        is_plain = pc.equal(rows["feature_set"], PLAIN)
        reduced.update(rows["file"].filter(is_plain).unique().to_pylist())
        matches = rows.filter(rows_of(rows, subject)).select(["file", "drive_id"])
        for path, drive in zip(*matches.to_pydict().values(), strict=True):
            in_grams[path].add(drive)
    in_logs = {
        file.path: in_grams.get(file.path)
        if file.path in reduced
        else _drives_in(warehouse.logs, file.path, subject, day=file.day)
        for file in warehouse.logs.snapshot().files
    }
    refused = {
        file.path: _drives_in(warehouse.quarantine, file.path, subject, drives)
        for file in warehouse.quarantine.snapshot().files
    }
    tables: dict[str, Mapping[str, set[str] | None]]
    tables = {"grams": in_grams, "logs": in_logs, "quarantine": refused}
    concerned: dict[str, DrivesByFile] = {
        name: {path: names for path, names in files.items() if names is not None}
        for name, files in tables.items()
    }
    return {name: files for name, files in concerned.items() if files}


def drives_of(tables: Mapping[str, DrivesByFile]) -> frozenset[str]:
    """Return the drives in the answer of `find_rows`."""
    return frozenset(
        drive for files in tables.values() for drives in files.values() for drive in drives
    )


def _drives_in(
    table: Table,
    path: str,
    subject: ErasureSubject,
    drives: Collection[str] = (),
    day: date | None = None,
) -> set[str] | None:
    """Return a subject's drives in a file, None if no row is of the subject."""
    rows = table.read(path, ["drive_id", "vehicle_id"])
    if table.folder.name == "quarantine":
        mask = quarantined_of(rows, subject, drives)
    else:
        mask = rows_of(rows.append_column("day", pa.repeat(day, len(rows))), subject)
    matches = rows["drive_id"].filter(mask)
    return set(matches.drop_null().to_pylist()) if len(matches) else None


def remove_uncommitted(
    warehouse: Warehouse, subject: ErasureSubject, drives: Collection[str]
) -> None:
    """Delete files with rows of a subject that were never committed: the fence refuses them now.

    Log files are deleted last: only they may name a car's drives. Drives before a day may still be
    committed, and are left.
    """
    leftovers: list[StoredFile] = []
    for table in warehouse.tables if subject.kind != "before" else ():
        removals = table.snapshot().removals
        for file in find_unreferenced(table):
            if file.path in removals:
                continue
            with suppress(StorageError):  # half a file, or just deleted
                matches = _drives_in(table, file.path, subject, drives)
                if matches is not None:
                    drives = {*drives, *matches}
                    leftovers.append(file)
    for file in reversed(leftovers):
        file.folder.remove(file)


def find_remains(
    warehouse: Warehouse, subject: ErasureSubject, drives: Collection[str]
) -> Iterator[str]:
    """Yield the files that are in no table and have rows of a subject, or cannot be read.

    Files with drives before a day may be landing: these are not judged.
    """
    for table in warehouse.tables if subject.kind != "before" else ():
        for file in find_unreferenced(table):
            try:
                if _drives_in(table, file.path, subject, drives) is not None:
                    yield path_below(warehouse, file)
            except StorageError:
                if file in find_unreferenced(table):  # not just deleted
                    yield f"{path_below(warehouse, file)} (unreadable)"


def digests_of(
    warehouse: Warehouse, subject: ErasureSubject, in_logs: DrivesByFile
) -> Iterator[str]:
    """Yield the digests of the counts of a subject's drives: of their Gram rows, and of logs."""
    sets = pa.array(list(onboard_feature_sets(warehouse.catalog)), pa.string())
    for file in warehouse.grams.snapshot().files:
        rows = read_rows(warehouse.grams, file)
        rows = rows.filter(pc.and_(rows_of(rows, subject), pc.is_in(rows["feature_set"], sets)))
        yield from gram_digests(rows)[0]
    for file in warehouse.logs.snapshot().files:
        if file.path not in in_logs:
            continue
        signals = [name for name in warehouse.catalog.signals.signals if name in file.null_counts]
        rows = warehouse.logs.read(file.path, ["drive_id", "vehicle_id", "tick", *signals])
        ids = rows["drive_id"].cast(pa.string())
        for name in sorted(in_logs[file.path]):
            [batch] = rows.filter(pc.equal(ids, name)).combine_chunks().to_batches()
            counts = {signal: batch[signal] for signal in signals}
            car, ticks = str(batch["vehicle_id"][0]), pl.Series(batch["tick"]).to_numpy()
            yield digest_counts(car, str(file.day), ticks, counts)


@retrying
def erase_rows(
    table: Table,
    is_removed: Callable[[pa.Table], pa.ChunkedArray],
    is_examined: Callable[[TableFile], bool] = lambda _: True,
) -> list[pa.Table]:
    """Commit a table without some rows of the examined files; return these rows."""
    snapshot = table.snapshot()
    change, removed_rows = without_rows(snapshot, filter(is_examined, snapshot.files), is_removed)
    if removed_rows:
        snapshot.commit_or_discard(change)
    return removed_rows


# Erasure.

PENDING_SHOWN = 5
"""Maximum number of files and runs named in the error; --json lists all."""


@dataclass(frozen=True)
class ForgetReport(Answer):
    """The result of an erasure."""

    drives: int
    rows: int
    files_rewritten: int
    files_removed: int
    """Log files all of whose drives were forgotten."""
    models: tuple[str, ...]
    """Model versions, NAME@VERSION, that were trained on the drives."""
    old_files_deleted: int
    old_files_left: int
    """Replaced files, which may have the drives, kept for readers of the last week."""
    pending: tuple[str, ...] = ()
    """Tables and files below the root, and runs, that have or may have rows of the drives."""

    @property
    def changed(self) -> bool:
        """True if there was anything to do."""
        return bool(self.drives or self.old_files_deleted)

    def parts(self) -> Iterator[Part]:
        """Return remarks: erased drives, remaining files, and models to train again."""
        if not self.changed:
            yield Remark("nothing to do: it was forgotten before")
            return
        yield Remark(
            f"{pluralize(self.drives, 'drive')} forgotten, {pluralize(self.rows, 'row')}: "
            f"{pluralize(self.files_rewritten, 'file')} rewritten without them, "
            f"{self.files_removed} removed"
        )
        if self.old_files_deleted:
            yield Remark(f"{self.old_files_deleted} old files deleted")
        if self.old_files_left:
            yield Remark(
                f"{self.old_files_left} old files may keep them until the next fleet-slip compact. "
                "To delete these now: --now"
            )
        if self.models:
            names = dict.fromkeys(model.partition("@")[0] for model in self.models)
            again = ", ".join(f"fleet-slip publish {name}" for name in names)
            yield Remark(f"trained on them: {', '.join(self.models)}. To train again: {again}")

    def require_all(self) -> None:
        """Raise `PendingError` while anything has, or may have, rows of the drives."""
        if self.pending:
            runs = any(item.startswith(RUN) for item in self.pending)
            advice = "Repeat this command when the runs have ended." if runs else _NO_RUN
            raise PendingError(
                f"{len(self.pending)} jobs or files may still hold its rows: "
                f"{', '.join(self.pending[:PENDING_SHOWN])}. {advice}"
            )


RUN = "the run "
_NO_RUN = (
    "No other run is under way. Run fleet-slip verify, restore or delete what it finds damaged or "
    "unreferenced there, and repeat this command."
)


def forget(
    warehouse: Warehouse,
    subject: ErasureSubject,
    *,
    now: bool = False,
    progress: Progress = no_progress,
) -> ForgetReport:
    """Forget drives; with `now`, delete all replaced files at once instead of by `vacuum`.

    It can be repeated after interruptions. `progress` counts files. Raises `QuestionError` for no
    such drive, `StorageError`, `ConflictError`.
    """
    _require_delta_logs(warehouse)
    erasure_log = ErasureLog(warehouse.root)
    tables = find_rows(warehouse, subject)
    drives = drives_of(tables)
    state = erasure_log.state(subject)
    if not drives and state is None and subject.kind != "before":
        raise QuestionError(
            f"no drive has {subject.column} {subject.value!r}. See: "
            'fleet-slip sql "SELECT drive_id, vehicle_id, day FROM drives"'
        )
    models = erasure_log.models_of(subject)
    if state == ALLOWED or (drives and state != "begun"):
        models = _begin(warehouse, erasure_log, subject, tables)
    for table in (warehouse.quarantine, warehouse.logs):
        if drives or state:
            table.fence()
    tables = find_rows(warehouse, subject)
    if not drives_of(tables) <= drives:  # they landed before the fence
        drives |= drives_of(tables)
        models = _begin(warehouse, erasure_log, subject, tables)
    if drives:
        erase_rows(warehouse.quarantine, lambda rows: quarantined_of(rows, subject, drives))
    rows, rewritten, files_removed = _rewrite_logs(warehouse, subject, progress)
    if drives or state:
        warehouse.grams.fence()
    of_subject = partial(rows_of, subject=subject)
    onboard = erase_rows(warehouse.grams, of_subject, is_onboard_file)
    rows += sum(pc.sum(removed["n"]).as_py() for removed in onboard)
    remove_uncommitted(warehouse, subject, drives)
    reconcile(warehouse)
    replaced = find_replaced(warehouse)
    deleted = sum(file.folder.remove(file) for file in replaced) if now else 0
    look = (drives or state) and subject.kind != "before"  # such drives may be landing
    remaining = list(find_rows(warehouse, subject, drives)) if look else []
    if not remaining and (drives or state in ("begun", ALLOWED)):
        erasure_log.end(subject, warehouse.grams.snapshot().version)
    pending: list[str] = []
    if drives or state:
        pending = [*remaining, *_find_pending(warehouse, subject, drives, now=now)]
    return ForgetReport(
        drives=len(drives),
        rows=rows,
        files_rewritten=rewritten,
        files_removed=files_removed,
        models=tuple(models),
        old_files_deleted=deleted,
        old_files_left=0 if now else len(replaced),
        pending=tuple(pending),
    )


def _require_delta_logs(warehouse: Warehouse) -> None:
    """Raise `StorageError` if a Delta log was lost: a fence begins a new one."""
    for table in (warehouse.logs, warehouse.grams):
        if table.snapshot().version is None and find_unreferenced(table):
            raise StorageError(
                f"{table.folder}: files without a Delta log. Restore the log from a backup. If a "
                "job is writing the first files, wait for its end; if it was killed, delete them."
            )


def _begin(
    warehouse: Warehouse,
    erasure_log: ErasureLog,
    subject: ErasureSubject,
    tables: Mapping[str, DrivesByFile],
) -> list[str]:
    """Record the beginning of an erasure; return the models trained on the drives."""
    drives, registry = drives_of(tables), Registry.open(warehouse)
    examined = {name: max(registry.versions(name), default=0) for name in registry.names()}
    models = models_trained_on(warehouse, drives)
    by_age = subject.kind == "before"
    digests = () if by_age else digests_of(warehouse, subject, tables.get("logs", {}))
    erasure_log.begin(subject, len(drives), models, examined, set(digests))
    return models


@retrying
def _rewrite_logs(
    warehouse: Warehouse, subject: ErasureSubject, progress: Progress
) -> tuple[int, int, int]:
    """Commit the logs without a subject; return the rows, and the files rewritten and removed."""
    logs = warehouse.logs.snapshot()
    drives = find_rows(warehouse, subject).get("logs", {})
    concerned = [file for file in logs.files if file.path in drives]
    if not concerned:
        return 0, 0, 0
    change = build_rewriting(warehouse, logs, [[file] for file in concerned], drives, progress)
    logs.commit_or_discard(replace(change, note={"job": "forget"}))
    rows = sum(file.rows for file in concerned) - sum(map(rows_in, change.add))
    return rows, len(change.add), len(concerned) - len(change.add)


def _find_pending(
    warehouse: Warehouse, subject: ErasureSubject, drives: Collection[str], *, now: bool
) -> list[str]:
    """Return runs, and files outside the tables, that have or may have rows of a subject.

    With `now`, first delete the cache of sensor checks, which has hashes of names, and temporary
    files, unless a run that may write them is under way.
    """
    if now:
        shutil.rmtree(cache_folder("examined"), ignore_errors=True)
    files = _half_written(warehouse)  # listed before the runs: a run that begins later has none
    runs = [f"{RUN}{run}" for run in runs_under_way(warehouse.root)] if now else []
    if now and not runs:
        for file in files:
            file.folder.remove(file)
    temporary = [path_below(warehouse, file) for file in _half_written(warehouse)]
    remains = find_remains(warehouse, subject, drives) if now else ()
    return [*remains, *temporary, *runs]


def _half_written(warehouse: Warehouse) -> list[StoredFile]:
    """Return the temporary files that may have rows of any drive."""
    return [file for file in find_temporary_files(warehouse) if f"/{LOG}/" not in file.path]


# How long data is kept: `configs/retention.toml`, or a file of the user's own.


class Retention(Config):
    """How long drives and replaced files are kept."""

    drives_days: int = Field(ge=1, le=36_500)
    replaced_files_hours: int = Field(ge=1, le=RETENTION_HOURS)
    max_days_without_drives: int = Field(default=31, ge=1)
    """Days between the latest drive and the clock, beyond which the clock may be wrong."""


@dataclass(frozen=True)
class RetentionReport(Answer):
    """The erased drives, and the removed files."""

    before: date
    forgotten: ForgetReport
    vacuumed: VacuumReport
    implausible_days: tuple[str, ...] = ()
    """Days that cannot be those of drives, with the reason: their drives are kept."""

    @property
    def problem(self) -> AlarmError | None:
        """The drives that are kept because their day is implausible."""
        if not self.implausible_days:
            return None
        return AlarmError(
            f"drives of {pluralize(len(self.implausible_days), 'implausible day')} were not erased "
            f"by age, such as {self.implausible_days[0]}. Erase them with fleet-slip forget "
            "--drive DRIVE, or correct the day in the mapping and ingest them again."
        )

    def parts(self) -> Iterator[Part]:
        """Return remarks: the erased drives and the removed files."""
        if self.forgotten.changed:
            yield from self.forgotten.parts()
        else:
            yield Remark(f"no drive of a plausible day is older than {self.before}")
        yield self.vacuumed.remark


def load_retention(path: str | None, configs: Configs) -> Retention:
    """Read a retention file, by default `retention.toml` of the configs. Raises `ConfigError`."""
    file = configs.file("retention.toml") if path is None else configs.find("retention", path)
    return load_config(file, Retention)


def retain(
    warehouse: Warehouse, retention: Retention, today: date, progress: Progress = no_progress
) -> RetentionReport:
    """Erase the drives that exceed the retention, then vacuum; `progress` counts files.

    Keeps and reports drives of implausible days: no such day is a reason to erase. Raises
    `RefusedError` if no drive would remain, or if drives would be erased by a clock that is
    further from the latest drive than plausible: it may be ahead.
    """
    warehouse.require()
    try:
        before = today - timedelta(days=retention.drives_days)
    except OverflowError:
        raise ConfigError(f"drives_days = {retention.drives_days}: too long ago.") from None
    all_days = _days_of_drives(warehouse, today)
    implausible = {day: why for day, why in all_days.items() if why}
    days = all_days.keys() - implausible.keys()
    if days and max(days) < before:
        raise RefusedError(
            f"{warehouse.root}: its latest drive is of {max(days)} and all before {before} would "
            "be forgotten, which leaves none. Check the clock, or drives_days of the retention."
        )
    idle_days = (today - max(days, default=today)).days
    if idle_days > retention.max_days_without_drives and min(days) < before:
        raise RefusedError(
            f"{warehouse.root}: its latest drive is of {max(days)}, {idle_days} days before the "
            f"date of the clock, {today}; plausible are {retention.max_days_without_drives}. A "
            f"clock that is ahead would erase too many drives, so none before {before} was erased. "
            "Check the clock. If it is right, raise max_days_without_drives in the retention file."
        )
    subject = ErasureSubject("before", before.isoformat(), frozenset(implausible))
    forgotten = forget(warehouse, subject, progress=progress)
    vacuumed = vacuum(warehouse, retention.replaced_files_hours)
    spared = [day for day in sorted(implausible) if day < before or day > today]
    reasons = tuple(f"{day}{implausible[day]}" for day in spared)
    return RetentionReport(before, forgotten, vacuumed, reasons)


def _days_of_drives(warehouse: Warehouse, today: date) -> dict[date, str]:
    """Return the days of all drives, and why a day is implausible, empty for others."""
    logs = warehouse.logs.snapshot()
    committed = logs.commit_days()
    dated = [(file.day, committed[file.path]) for file in logs.files if file.day is not None]
    for file in filter(is_onboard_file, warehouse.grams.snapshot().files):
        days = pc.unique(warehouse.grams.read(file.path, ["day"])["day"]).to_pylist()
        dated += [(day, today) for day in days]
    reasons: dict[date, str] = {}
    for day, written in sorted(set(dated)):
        reasons[day] = reasons.get(day) or implausible_day(day, written)
    return reasons


# Marks of model versions that were trained on drives erased later.
#
# An erasure examines the versions that exist. Later ones are marked while it is under way, and
# afterwards if they were trained on Gram rows from before its end.


def marked_models(warehouse: Warehouse) -> frozenset[str]:
    """Return the model versions, NAME@VERSION, that were or may have been trained on them."""
    entries = ErasureLog(warehouse.root).entries()
    marked = {name for entry in entries for name in entry.get("models", ())}
    examined: dict[str, dict[str, int]] = {}
    ended: dict[str, int | None] = {}
    for entry in entries:
        if entry["event"] == "begun" and "judged" in entry:
            examined[entry["subject"]] = entry["judged"]
            ended[entry["subject"]] = None
        elif entry["event"] == "done":
            ended[entry["subject"]] = entry.get("grams_version")
    registry = Registry.open(warehouse)
    for name in registry.names() if examined else ():
        for number in registry.versions(name):
            later = [ended[s] for s, numbers in examined.items() if number > numbers.get(name, 0)]
            if not later:
                continue
            with suppress(FleetSlipError):  # an unreadable version is marked
                trained_on = registry.load(name, number).manifest.trained_on.grams_version
                if all(end is not None and trained_on >= end for end in later):
                    continue
            marked.add(f"{name}@{number}")
    return frozenset(marked)


def models_trained_on(warehouse: Warehouse, drives: Collection[str]) -> list[str]:
    """Return the model versions that were trained on one of the drives, or may have been."""
    registry = Registry.open(warehouse)
    hashes = hash_names(pa.array(sorted(drives), pa.string()))
    references: list[str] = []
    for name in registry.names():
        for number in registry.versions(name):
            with suppress(FleetSlipError):  # an unreadable version is marked
                trained = registry.trained_drives(registry.load(name, number).manifest)
                if not trained.among(hashes).any():
                    continue
            references.append(f"{name}@{number}")
    return sorted(references)
