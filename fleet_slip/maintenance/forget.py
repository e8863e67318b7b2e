"""Forgets drives: one car's, a single one, or all before a day.

Their rows leave `quarantine`, `logs` and `grams`, in this order, so that an interrupted job finds
by what is left what it still has to do. The log files concerned are written again without them,
in one commit; the Gram rows follow by reconciliation. `fleet_slip/warehouse/audit.py` is the
record of it.

Jobs under way neither undo nor outlive it. The record is written first, then quarantine and logs
are fenced: a commit that has not seen the record is a conflict. Once the logs are without the
drives the Gram rows are fenced: a commit of Gram rows that has not seen the logs without them is
a conflict. What such jobs have written is never committed, and deleted by them or here.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.delta import Change, retry_conflicts, rows_in
from fleet_slip.errors import FleetSlipError, QuestionError
from fleet_slip.grams.rows.gram_job import reconcile
from fleet_slip.grams.rows.rollup import hash_numbers
from fleet_slip.maintenance.find_drives import (
    Located,
    cars_with_rows,
    drives_by_file,
    locate,
    recordings_of,
)
from fleet_slip.maintenance.marks import newest_versions
from fleet_slip.maintenance.old_files import quarantined_of, remove_old_files
from fleet_slip.maintenance.rewriting import Rewriting, drop_unused_names, forget_received, rewrite
from fleet_slip.models.manifest import TrainedOn
from fleet_slip.models.trained_drives import hash_drives, read_trained_drives
from fleet_slip.models.versions import Registry
from fleet_slip.progress import Progress, no_progress
from fleet_slip.runs.history import runs_under_way
from fleet_slip.views import connect
from fleet_slip.warehouse.audit import ALLOWED, Audit, Forgettable
from fleet_slip.warehouse.cleared_cars import ClearedCars
from fleet_slip.warehouse.condition import asking, parse_condition
from fleet_slip.warehouse.tables import Warehouse


@dataclass(frozen=True)
class ForgetReport:
    """What was done."""

    drives: int
    rows: int
    files_rewritten: int
    files_removed: int
    """Log files all of whose drives were forgotten."""
    models: tuple[str, ...]
    """Model versions, NAME@VERSION, that were trained on the drives."""
    old_files_deleted: int
    old_files_left: int
    """Files with the drives that no version refers to, kept for readers of the last week."""
    pending: tuple[str, ...] = ()
    """Files below the root, and runs, that may still have the drives: repeat it when they ended."""

    @property
    def changed(self) -> bool:
        """Whether there was anything to do."""
        return bool(self.drives or self.old_files_deleted)


def forget(
    warehouse: Warehouse,
    subject: Forgettable,
    *,
    now: bool = False,
    progress: Progress = no_progress,
) -> ForgetReport:
    """Forget drives; with `now`, delete the replaced files at once instead of by `vacuum`.

    It can be repeated after any interruption. `progress` counts files to rewrite. Raises
    `QuestionError` if there never was such a drive, `StorageError`, or `ConflictError`.
    """
    audit = Audit(warehouse.root)
    located = locate(warehouse.grams.snapshot(), subject)
    drives = _drives_of(warehouse, subject, located)
    state = audit.state(subject)
    if not drives and state is None and subject.kind != "before":
        raise QuestionError(
            f"no drive has {subject.column} {subject.value!r}. See: "
            'fleet-slip sql "SELECT drive_id, vehicle_id, day FROM drives"'
        )
    models = audit.models_of(subject)
    if state == ALLOWED or (drives and state != "begun"):
        models = _begin(warehouse, audit, subject, drives, located)
    cleared, present = ClearedCars(warehouse.root), partial(cars_with_rows, warehouse)
    cleared.forget(audit, subject, present)
    for table in (warehouse.quarantine, warehouse.logs):
        if drives or state:
            table.fence()
    landed = _drives_of(warehouse, subject, located)
    if not landed <= drives:  # they landed before the fence
        drives |= landed
        models = _begin(warehouse, audit, subject, drives, located)
        cleared.forget(audit, subject, present)
    _forget_quarantined(warehouse, subject, drives)
    rows, rewritten, removed = _rewrite_logs(warehouse, subject, located, progress)
    if not audit.names_are_exact:
        drop_unused_names(warehouse)
    if drives or state:
        warehouse.grams.fence()
    rows += forget_received(warehouse, subject)
    uncommitted = remove_old_files(warehouse, subject, replaced=False)
    reconcile(warehouse)
    cleared.keep(present)
    old = remove_old_files(warehouse, subject, replaced=now)
    if drives or state in ("begun", ALLOWED):
        audit.end(subject, warehouse.grams.snapshot().version)
    under_way = [f"the run {run}" for run in runs_under_way(warehouse.root)] if now else []
    return ForgetReport(
        drives=len(drives),
        rows=rows,
        files_rewritten=rewritten,
        files_removed=removed,
        models=tuple(models),
        old_files_deleted=uncommitted.deleted + old.deleted,
        old_files_left=old.kept,
        pending=(*old.pending, *under_way) if drives or state else (),
    )


def _begin(
    warehouse: Warehouse,
    audit: Audit,
    subject: Forgettable,
    drives: Collection[str],
    located: Located,
) -> list[str]:
    """Record what is to be forgotten; return the model versions that were trained on it."""
    judged = newest_versions(warehouse.root)
    models = models_trained_on(warehouse, drives)
    known = () if subject.kind == "before" else recordings_of(warehouse, subject, located)
    audit.begin(subject, len(drives), models, judged, [one.kept() for one in known])
    return models


def _drives_of(warehouse: Warehouse, subject: Forgettable, located: Located) -> frozenset[str]:
    """Return the drives in the logs and the quarantine, and what interrupted jobs left in grams."""
    in_logs = drives_by_file(warehouse.logs.snapshot(), subject, located)
    found: set[str] = set().union(*in_logs.values(), *located.drives.values())
    for file in warehouse.quarantine.snapshot().files:
        rows = warehouse.quarantine.read(file.path)
        names = rows.filter(quarantined_of(rows, subject, ()))["drive_id"].drop_null()
        found.update(names.to_pylist())
    return frozenset(found)


def _rewrite_logs(
    warehouse: Warehouse, subject: Forgettable, located: Located, progress: Progress
) -> tuple[int, int, int]:
    """Commit the logs without the drives; return rows forgotten, files rewritten, removed."""

    def attempt() -> tuple[int, int, int]:
        logs = warehouse.logs.snapshot()
        drives = drives_by_file(logs, subject, located)
        concerned = [file for file in logs.files if file.path in drives]
        if not concerned:
            return 0, 0, 0
        kept = rewrite(
            warehouse,
            logs,
            [Rewriting("kept", [file], drives[file.path]) for file in concerned],
            note={"job": "forget"},
            data_change=True,
            progress=progress,
        )
        rows = sum(file.rows for file in concerned) - sum(map(rows_in, kept))
        return rows, len(kept), len(concerned) - len(kept)

    return retry_conflicts(attempt)


def _forget_quarantined(
    warehouse: Warehouse, subject: Forgettable, drives: Collection[str]
) -> None:
    def attempt() -> None:
        snapshot = warehouse.quarantine.snapshot()
        add, remove = [], []
        for file in snapshot.files:
            rows = warehouse.quarantine.read(file.path)
            kept = rows.filter(pc.invert(quarantined_of(rows, subject, drives)))
            if kept.num_rows < rows.num_rows:
                remove.append(file)
                if kept.num_rows:
                    add.append(warehouse.quarantine.write_file("kept", kept))
        if remove:
            snapshot.commit_or_discard(Change(add=add, remove=remove, note={"job": "forget"}))

    if drives:
        retry_conflicts(attempt)


def models_trained_on(warehouse: Warehouse, drives: Collection[str]) -> list[str]:
    """Return the model versions that were trained on one of the drives.

    Each keeps which drives those were. Of one from before that was kept, the question of its cohort
    is asked again, of the Gram rows that it could see. Where it cannot be told, because they are
    gone or the version is damaged, it counts as trained on them.
    """
    registry = Registry(warehouse.root / "models")
    versions: dict[str, TrainedOn] = {}
    known: list[str] = []
    for name in registry.names():
        hashed = hash_drives(name, hash_numbers(pa.array(sorted(drives), pa.string())))
        for number in registry.versions(name):
            reference = f"{name}@{number}"
            try:
                manifest = registry.load(name, number).manifest
                kept = read_trained_drives(registry.folder_of(name), manifest)
            except FleetSlipError:
                known.append(reference)
                continue
            if kept is None:
                versions[reference] = manifest.trained_on
            elif np.isin(hashed, kept).any():
                known.append(reference)
    return sorted([*known, *_asked_again(warehouse, versions, drives)])


def _asked_again(
    warehouse: Warehouse, versions: Mapping[str, TrainedOn], drives: Collection[str]
) -> list[str]:
    cohorts = {trained.cohort for trained in versions.values()}
    chosen = _in_cohorts(warehouse, cohorts, drives)
    seen = _Seen(warehouse, drives)
    return [
        reference
        for reference, trained in versions.items()
        if seen.any(chosen[trained.cohort], trained.grams_version)
    ]


def _in_cohorts(
    warehouse: Warehouse, cohorts: Collection[str], drives: Collection[str]
) -> dict[str, frozenset[str]]:
    """Return which of some drives each cohort has; all, of a cohort that cannot be asked for."""
    found = {}
    with connect(warehouse.root, query="grams") as database:
        database.register(
            "forgotten", pa.table({"drive_id": pa.array(sorted(drives), pa.string())})
        )
        for cohort in cohorts:
            asked = "SELECT DISTINCT drive_id FROM grams WHERE drive_id IN (FROM forgotten) AND "
            try:
                condition = parse_condition(cohort)
                with asking(database, condition):
                    rows = database.execute(asked + condition.sql).fetchall()
                found[cohort] = frozenset(row[0] for row in rows)
            except FleetSlipError:
                found[cohort] = frozenset(drives)
    return found


class _Seen:
    """Which of some drives the Gram rows of each version of their table have.

    A file of Gram rows is read once, however many versions it is part of.
    """

    def __init__(self, warehouse: Warehouse, drives: Collection[str]) -> None:
        self._grams = warehouse.grams
        self._drives = frozenset(drives)
        self._of_file: dict[str, frozenset[str]] = {}
        self._of_version: dict[int, frozenset[str]] = {}

    def any(self, drives: frozenset[str], version: int) -> bool:
        """Whether a version has one of the drives; true where the version is gone."""
        if not drives:
            return False
        try:
            return not drives.isdisjoint(self._at(version))
        except FleetSlipError:
            return True

    def _at(self, version: int) -> frozenset[str]:
        if version not in self._of_version:
            files = self._grams.snapshot(version).files
            self._of_version[version] = frozenset().union(*(self._in(f.path) for f in files))
        return self._of_version[version]

    def _in(self, path: str) -> frozenset[str]:
        if path not in self._of_file:
            ids = self._grams.read(path, ["drive_id"])["drive_id"].cast(pa.string())
            self._of_file[path] = self._drives.intersection(ids.unique().to_pylist())
        return self._of_file[path]
