"""The screen of training drives: those that were checked and have no fault may train a model.

Drives are checked once: results are cached for the user, as hashes of drives, as long as Gram rows,
checks and thresholds stay the same. Many drives are checked in pieces of whole days, so that a
night checks its own piece. Simulated drives are not checked: their faults are intended. Whatever
trains, scores or publishes calls this screen, so that all have the same drives.
"""

import json
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import date
from typing import Any

from fleet_slip.base import canonical_json, pluralize, sha256_of
from fleet_slip.catalog.features import PLAIN
from fleet_slip.catalog.signals import MEASURED, RECEIVED
from fleet_slip.errors import DataError, NotComputedError, NotScreenedError
from fleet_slip.grams.update import ensure_grams
from fleet_slip.operations.quality_report import SensorFault, examine_drives
from fleet_slip.quality.checks import CHECKS, Fault
from fleet_slip.quality.peers import thresholds
from fleet_slip.resources import cache_folder, keep_json
from fleet_slip.storage.table import Snapshot
from fleet_slip.warehouse.gram_reader import GramReader, find_backlog
from fleet_slip.warehouse.predicate import (
    Predicate,
    drive_columns,
    guarded_query,
    hash_drive,
    parse_predicate,
    row_columns,
    without_drives,
)
from fleet_slip.warehouse.table_views import (
    connect_tables,
    gram_snapshots,
    lock,
    open_tables,
    views_in,
)
from fleet_slip.warehouse.warehouse import Warehouse

NAME = "drive"
"""Stands for a model's name in the hashes of drives."""

PIECE = 100_000
"""Drives that are compared with one another, or a quarter more: some 10 s and 600 MiB."""

CHECK_ROWS = 20_000_000
"""Maximum number of log rows that are reduced to check drives: they take seconds."""


@dataclass(frozen=True)
class SensorScreen:
    """The result of checking the drives of a cohort.

    Attributes
    ----------
    cohort
        The predicate without the faulty drives.
    drives
        Number of drives that were long enough to be checked.
    faults_by_hash
        The fault of each faulty drive, by its hash.
    missing
        Number of measured drives without Gram rows, which were not checked.
    """

    cohort: str
    drives: int = 0
    faults_by_hash: Mapping[str, Fault] = field(default_factory=dict)
    missing: int = 0

    @property
    def faults(self) -> Mapping[str, int]:
        """Return the number of drives with each fault, such as `reversed sideslip`."""
        faults = self.faults_by_hash.values()
        return Counter(" ".join((fault.kind, *fault.signals)) for fault in faults)

    @property
    def remaining_text(self) -> str:
        """Return which drives were not checked and what to do; nothing if all were checked."""
        if not self.missing:
            return ""
        return (
            f"{pluralize(self.missing, 'measured drive')} not checked for faulty sensors: their "
            "Gram rows are missing. Run: fleet-slip gram"
        )

    def __str__(self) -> str:
        """Return which drives are left out, and which were not checked; nothing if none is."""
        sentences = []
        if self.faults_by_hash:
            out = pluralize(len(self.faults_by_hash), "drive")
            sentences.append(
                f"{out} of {self.drives:,} left out: faulty sensors ({self._faults_text}). See: "
                "fleet-slip quality. To use them anyway: --include-faulty"
            )
        return " ".join([*sentences, self.remaining_text]).strip()

    @property
    def _faults_text(self) -> str:
        return ", ".join(f"{number:,} {fault}" for fault, number in self.faults.items())

    @contextmanager
    def explaining(self) -> Iterator[None]:
        """Explain the error of an empty cohort if all its drives were left out."""
        try:
            yield
        except DataError as error:
            if (
                len(self.faults_by_hash) < self.drives
                or not self.faults_by_hash
                or isinstance(error, NotComputedError)
            ):
                raise
            raise DataError(
                f"All {pluralize(self.drives, 'drive')} have faulty sensors "
                f"({self._faults_text}); none left to train on. See: fleet-slip quality. To use "
                "them anyway: --include-faulty"
            ) from None

    def findings(self, warehouse: Warehouse) -> tuple[SensorFault, ...]:
        """Return the faulty drives by name, by day and drive."""
        if not self.faults_by_hash:
            return ()
        query = "SELECT DISTINCT drive_id, vehicle_id, day FROM grams ORDER BY day, drive_id"
        with connect_tables(warehouse, query) as database:
            rows = database.execute(query).fetchall()
        drives = ((hash_drive(NAME, drive), (drive, car, day)) for drive, car, day in rows)
        faults = self.faults_by_hash
        return tuple(SensorFault(*row, faults[name]) for name, row in drives if name in faults)


def screen_computed_drives(warehouse: Warehouse, cohort: str) -> SensorScreen:
    """Check the drives of a cohort like `quality`; return the cohort without the faulty ones.

    Drives without Gram rows of `signals` are counted, and not checked. A predicate on rows does not
    limit the drives. Raises what `examine_drives` raises; without measured drives nothing is
    checked.
    """
    signals = warehouse.catalog.signals
    measured = parse_predicate(signals, f"source IN ('{MEASURED}', '{RECEIVED}')")
    requested = parse_predicate(signals, cohort, row_columns(signals))
    is_on_rows = bool(requested.columns - set(drive_columns(signals)))
    predicate = measured if is_on_rows else requested & measured
    grams, logs = gram_snapshots(warehouse)
    missing = _count_unreduced(warehouse, grams, logs, predicate)
    pieces = _pieces(warehouse, predicate) if grams.files else []
    results = [_check_piece(warehouse, predicate, *piece) for piece in pieces]
    faults = {
        name: Fault(kind, tuple(names), figure)
        for result in results
        for name, (kind, names, figure) in result["faults"].items()
    }
    checked = sum(result["checked"] for result in results)
    return SensorScreen(without_drives(cohort, NAME, faults), checked, faults, missing)


def screen_drives(warehouse: Warehouse, cohort: str) -> SensorScreen:
    """Screen a cohort like `screen_computed_drives`; compute missing Gram rows first.

    Raises `NotScreenedError` if that takes more than seconds, and `QuestionError` for columns of
    rows.
    """
    parse_predicate(warehouse.catalog.signals, cohort)
    screen = screen_computed_drives(warehouse, cohort)
    if screen.missing:
        ensure_grams(warehouse, PLAIN, reason="the sensor check needs them", max_rows=CHECK_ROWS)
        screen = screen_computed_drives(warehouse, cohort)
    if screen.missing:
        raise NotScreenedError(f"{screen.remaining_text}, or use them unchecked: --include-faulty")
    return screen


def _pieces(warehouse: Warehouse, predicate: Predicate) -> list[tuple[date, date, list[int]]]:
    """Divide a cohort into pieces: the first and last day, and hashes of the Gram rows."""
    with GramReader(warehouse) as reader:
        opened = reader.opened(PLAIN, predicate)
        statement = opened.statement("examined_days.sql", predicate)
        with guarded_query(opened.database, predicate):
            return opened.database.execute(statement, {"piece": PIECE}).fetchall()


def _check_piece(
    warehouse: Warehouse, predicate: Predicate, first: date, last: date, rows: list[int]
) -> Mapping[str, Any]:
    """Return the faults of the drives of some days, and how many were checked; from a cache."""
    about = f"{predicate.text}\n{first}\n{warehouse.root.uri}"
    cached = cache_folder("examined") / f"{sha256_of(about)[:32]}.json"
    limits = thresholds(warehouse.configs).quality.model_dump(mode="json")
    state = [rows, sha256_of(f"{CHECKS}{canonical_json(limits)}")]
    with suppress(OSError, ValueError, KeyError, TypeError):
        content = json.loads(cached.read_bytes())
        checksum = content.pop("sha256")
        if content["state"] == state and checksum == sha256_of(canonical_json(content)):
            return dict(content)
    days = f"day BETWEEN DATE '{first}' AND DATE '{last}'"
    report = examine_drives(warehouse, predicate & parse_predicate(warehouse.catalog.signals, days))
    faults = {
        hash_drive(NAME, finding.drive_id): [
            finding.fault.kind,
            list(finding.fault.signals),
            finding.fault.figure,
        ]
        for finding in report.findings
    }
    content = {"faults": faults, "checked": report.drives, "state": state}
    keep_json(cached, {**content, "sha256": sha256_of(canonical_json(content))})
    return content


def _count_unreduced(
    warehouse: Warehouse, grams: Snapshot, logs: Snapshot, predicate: Predicate
) -> int:
    """Return the number of a cohort's drives in log files without Gram rows."""
    missing = find_backlog(logs, grams).missing
    if not missing:
        return 0
    query = f"SELECT count(*) FROM drives WHERE {predicate.sql} AND source <> '{RECEIVED}'"
    reduced = frozenset(f.path for f in logs.files) - frozenset(f.path for f in missing)
    snapshots = [grams, replace(logs, without=reduced)]
    with open_tables(warehouse, views_in(query), snapshots) as database:
        lock(database, [path for snapshot in snapshots for path in snapshot.paths])
        with guarded_query(database, predicate):
            [(drives,)] = database.execute(query).fetchall()
    return int(drives)
