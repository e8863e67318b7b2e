"""The health of a warehouse: freshness, backlog, last runs, disk, champions."""

import contextlib
import shlex
import uuid
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from typing import Any

from fleet_slip.base import pluralize
from fleet_slip.errors import (
    HIDDEN,
    AlarmError,
    DataError,
    FleetSlipError,
    QuestionError,
    RefusedError,
    StorageError,
    printable,
)
from fleet_slip.models.registry import Registry
from fleet_slip.quality.peers import thresholds
from fleet_slip.rendering import Answer, Part, Remark, TextTable
from fleet_slip.resources import read_sql
from fleet_slip.storage.documents import find_lost
from fleet_slip.storage.folder import TEMPORARY_PREFIX, Folder, storage_errors
from fleet_slip.storage.runs import add_runs, find_changed_lines, state_of
from fleet_slip.storage.table import Snapshot
from fleet_slip.warehouse.database import database_errors, open_database
from fleet_slip.warehouse.erasure_log import find_erased
from fleet_slip.warehouse.gram_reader import find_backlog
from fleet_slip.warehouse.warehouse import Warehouse

RETURNED_SHOWN = 5
"""Maximum number of commands shown for erased cars and drives."""

REMEMBERED = timedelta(days=366)
"""Commands that last ran before that are not shown, so that old runs need not be read."""


@dataclass(frozen=True)
class TableStatus:
    """One table of the warehouse."""

    version: int | None
    committed_at: datetime | None
    files: int
    rows: int
    size_bytes: int


@dataclass(frozen=True)
class ChampionStatus:
    """The version of a model that is in use.

    `logs_behind` and `grams_behind` are commits to the tables since it was trained.
    """

    model: str
    version: int
    published_at: datetime | None
    age_hours: float | None
    logs_behind: int
    grams_behind: int


@dataclass(frozen=True)
class WarehouseStatus(Answer):
    """The health of a warehouse; `problems` need attention."""

    root: str
    checked_at: datetime
    newest_day: date | None
    data_age_hours: float | None
    tables: Mapping[str, TableStatus]
    backlog_files: int
    backlog_rows: int
    disk_free_bytes: int | None
    """None where the root is not on a disk of this machine."""
    disk_free_fraction: float | None
    last_runs: tuple[Mapping[str, Any], ...]
    champions: tuple[ChampionStatus, ...]
    problems: tuple[str, ...]

    def __repr__(self) -> str:
        problems = "; ".join(self.problems) or "no problem found"
        return f"<{type(self).__name__}: {self.root}, newest day {self.newest_day}; {problems}>"

    def parts(self) -> Iterator[Part]:
        """Return tables, facts, last runs and champions."""
        yield TextTable(
            f"{self.root} at {self.checked_at:%Y-%m-%d %H:%M} UTC",
            "table|last commit|version|files|rows|size MB",
            (
                {"name": name, "size_mb": table.size_bytes / 1e6, **vars(table)}
                for name, table in self.tables.items()
            ),
            "{name}|{committed_at:%Y-%m-%d %H:%M}|{version}|{files:,}|{rows:,}|{size_mb:,.1f}",
            text_columns=2,
        )
        backlog = f"{pluralize(self.backlog_files, 'file')}, {pluralize(self.backlog_rows, 'row')}"
        facts = {"newest day": str(self.newest_day or "none"), "waiting for the Gram job": backlog}
        if self.disk_free_bytes is not None and self.disk_free_fraction is not None:
            free = f"{self.disk_free_bytes / 1e9:,.1f} GB free, {self.disk_free_fraction:.0%}"
            facts["disk"] = free
        yield TextTable("", "|", facts.items(), text_columns=2)
        if self.last_runs:
            header = "command|started|state|seconds|rows"
            row = "{command}|{started_at:%Y-%m-%d %H:%M:%S}|{state}|{seconds:.1f}|{rows:,}"
            yield TextTable("\nlast runs", header, self.last_runs, row, text_columns=3)
        if self.champions:
            header = "model|published|age h|commits to logs since|commits to grams since"
            row = (
                "{model}@{version}|{published_at:%Y-%m-%d %H:%M}|{age_hours:,.1f}|"
                "{logs_behind}|{grams_behind}"
            )
            yield TextTable("\nchampions", header, self.champions, row, text_columns=2)
        yield from (Remark(f"- {problem}") for problem in self.problems)

    @property
    def problem(self) -> AlarmError | None:
        """Problem of a data root that calls for attention; None without one."""
        count = pluralize(len(self.problems), "problem")
        return AlarmError(f"{count}, see above.") if self.problems else None


def status_of(
    warehouse: Warehouse, max_age_hours: float | None = None, now: datetime | None = None
) -> WarehouseStatus:
    """Examine a warehouse. Reads the Delta logs, the history of runs and the manifests.

    Data older than `max_age_hours`, and log files that old without Gram rows, are a problem; so are
    a command whose last run failed or was killed, a disk that is nearly full, a champion that
    cannot be loaded, and an object store that lets a file be made twice.
    `jobs/last_runs.sql` excludes failures by mistakes of a user. Raises `StorageError` if there is
    no data root.
    """
    now = now or datetime.now(UTC)
    warehouse.require()
    parts = (warehouse.logs, warehouse.grams, warehouse.quarantine)
    snapshots = {table.folder.name: table.snapshot() for table in parts}
    tables = {name: _table(snapshot) for name, snapshot in snapshots.items()}
    logs, grams = snapshots["logs"], snapshots["grams"]
    backlog = find_backlog(logs, grams).missing
    free_bytes, disk_bytes = warehouse.root.free_bytes() or (None, 0)
    free = None if free_bytes is None else free_bytes / disk_bytes
    champions, damaged = _champions(warehouse, logs, grams, now)
    since = f"{now - REMEMBERED:%Y-%m}"
    changed = list(find_changed_lines(warehouse.root, since))
    last_runs = () if changed else tuple(_last_runs(warehouse.root, since))
    age = _age_hours(tables["logs"].committed_at, now)
    waiting = {file.path for file in backlog}
    files = logs.table.folder.files() if waiting else ()
    written = [file.modified_ns for file in files if file.path in waiting]
    backlog_age = _age_hours(_from_ms(min(written) // 10**6 if written else None), now)
    least = thresholds(warehouse.configs).status.min_free_fraction
    problems = [
        *(_stale(age, backlog_age, max_age_hours) if max_age_hours is not None else ()),
        *_returned(warehouse, tuple(snapshots.values())),
        *_failed(last_runs),
        *_unsafe_store(warehouse.root),
        *(
            [f"disk {free:.1%} free, below {least:.0%}"]
            if free is not None and free < least
            else []
        ),
        *dict.fromkeys([*damaged, *find_lost(warehouse.root)]),
        *(f"{path}: {problem}" for path, problem in changed),
    ]
    return WarehouseStatus(
        root=str(warehouse.root),
        checked_at=now,
        newest_day=max((file.day for file in logs.files if file.day), default=None),
        data_age_hours=age,
        tables=tables,
        backlog_files=len(backlog),
        backlog_rows=sum(file.rows for file in backlog),
        disk_free_bytes=free_bytes,
        disk_free_fraction=free,
        last_runs=last_runs,
        champions=champions,
        problems=tuple(problems),
    )


def _table(snapshot: Snapshot) -> TableStatus:
    with storage_errors(snapshot.table.folder):
        last = snapshot.delta.history(limit=1) if snapshot.delta else []
    return TableStatus(
        version=snapshot.version,
        committed_at=_from_ms(last[0].get("timestamp") if last else None),
        files=len(snapshot.files),
        rows=snapshot.rows,
        size_bytes=snapshot.size_bytes,
    )


def _age_hours(moment: datetime | None, now: datetime) -> float | None:
    return None if moment is None else (now - moment) / timedelta(hours=1)


def _from_ms(milliseconds: int | None) -> datetime | None:
    return None if milliseconds is None else datetime.fromtimestamp(milliseconds / 1000, UTC)


def _last_runs(root: Folder, since: str) -> list[dict[str, Any]]:
    # Not through connect(), which fails for a damaged manifest, which the status must report.
    with (
        open_database(reading=root) as database,
        database_errors(f"reading the history of runs in {root}"),
    ):
        add_runs(database, root, since)
        rows = database.sql(read_sql("jobs", "last_runs.sql")).to_arrow_table().to_pylist()
    return [row | {"state": state_of(row)} for row in rows]


def _champions(
    warehouse: Warehouse, logs: Snapshot, grams: Snapshot, now: datetime
) -> tuple[tuple[ChampionStatus, ...], list[str]]:
    registry = Registry.open(warehouse)
    champions, damaged = [], []
    for name in registry.names():
        try:
            champion = registry.champion(name)
            history = registry.history(name)
            published_at = history.published_at(champion.version) if champion else None
        except (StorageError, RefusedError, DataError, QuestionError) as error:
            damaged.append(str(error))
            continue
        if champion is None:
            continue
        trained = champion.manifest.trained_on
        champions.append(
            ChampionStatus(
                model=name,
                version=champion.version,
                published_at=published_at,
                age_hours=_age_hours(published_at, now),
                logs_behind=(logs.version or 0) - trained.logs_version,
                grams_behind=(grams.version or 0) - trained.grams_version,
            )
        )
    return tuple(champions), damaged


def _stale(age: float | None, backlog_age: float | None, limit: float) -> Iterator[str]:
    if age is None:
        yield "no data has ever been committed"
    elif age > limit:
        yield f"no data has been committed for {age:.1f} h, more than {limit:g} h"
    if backlog_age is not None and backlog_age > limit:
        yield f"a log file has had no Gram rows for {backlog_age:.1f} h"


def _returned(warehouse: Warehouse, snapshots: Sequence[Snapshot]) -> Iterator[str]:
    """Yield a problem for erased cars and drives that the tables have again."""
    try:
        erased = find_erased(warehouse.root, warehouse.grams, snapshots, ended=True)
    except StorageError:  # a lost document, which `find_lost` reports
        return
    options = [f"--vehicle {shlex.quote(printable(name))}" for name in sorted(erased.vehicles)]
    options += [f"--drive {shlex.quote(printable(name))}" for name in sorted(erased.drives)]
    if options:
        commands = "; ".join(f"fleet-slip forget {name} --now" for name in options[:RETURNED_SHOWN])
        yield (
            f"the tables have rows of {pluralize(len(options), 'erased name')} again, as after "
            f"restoring an old backup. Views and models leave them out. Erase them: {commands}"
        )


def _failed(runs: Iterable[Mapping[str, Any]]) -> Iterator[str]:
    for run in runs:
        when = f"{run['command']} of {run['started_at']:%Y-%m-%d %H:%M}"
        if run["state"] == "failed":
            why = f" ({HIDDEN}: a name that is not recorded)" if HIDDEN in str(run["error"]) else ""
            yield f"{when} failed with exit code {run['exit_code']}: {run['error']}{why}"
        elif run["state"] in ("killed", "interrupted"):
            yield f"{when} was {run['state']}"


def _unsafe_store(root: Folder) -> Iterator[str]:
    """Yield a problem for an object store that lets a file be made twice."""
    if root.free_bytes() is not None:
        return  # a local disk
    probe = f"{TEMPORARY_PREFIX}probe-{uuid.uuid4().hex}"
    with contextlib.suppress(FleetSlipError):  # a monitor may have the right to read alone
        if root.create(probe, b"one") and root.create(probe, b"two"):
            yield f"{root}: this store creates files twice: commits can be lost. Use another"
        root.delete(probe)
