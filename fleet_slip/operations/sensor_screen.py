"""Which drives of a cohort may train a model: those that were examined and have no fault.

Drives are examined once: what was found is kept in the user's cache, as hashes of drives, as long
as Gram rows and thresholds are what they were. Many drives are examined in pieces of whole days, so
that a night costs its own piece. Simulated drives are not examined: what is wrong in them is meant.
Whatever trains, scores or publishes asks here, so that all have the same answer.
"""

import json
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import date
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

from fleet_slip.base import canonical_json, pluralize, sha256_of
from fleet_slip.catalog.drive_sources import MEASURED, RECEIVED
from fleet_slip.catalog.features import PLAIN
from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.errors import DataError, NotComputedError, NotScreenedError
from fleet_slip.grams.update import ensure_grams
from fleet_slip.operations.quality_report import SensorFault, examine_drives
from fleet_slip.quality.checks import CHECKS, Fault
from fleet_slip.quality.peers import thresholds
from fleet_slip.resources import cache_folder, keep_json
from fleet_slip.storage.table import Snapshot
from fleet_slip.warehouse.gram_reader import GramReader
from fleet_slip.warehouse.gram_rows import find_backlog
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

FEW_FILES = 20
"""Gram files of which each is asked by itself whether it has measured drives: milliseconds."""

CHECK_ROWS = 20_000_000
"""Maximum number of log rows that are reduced to check drives: they take seconds."""


@dataclass(frozen=True)
class SensorScreen:
    """What was found.

    Attributes:
        cohort: the predicate without the faulty drives.
        drives: how many were long enough to be examined.
        found: the fault of each faulty drive, by its hash.
        missing: how many measured drives were not, since they have no Gram rows.
    """

    cohort: str
    drives: int = 0
    found: Mapping[str, Fault] = field(default_factory=dict)
    missing: int = 0

    @property
    def faults(self) -> Mapping[str, int]:
        """How many drives have each fault, such as `reversed sideslip`."""
        return Counter(" ".join((one.kind, *one.signals)) for one in self.found.values())

    @property
    def lacking(self) -> str:
        """What was not examined and what to do, as a sentence; nothing if all were examined."""
        if not self.missing:
            return ""
        return (
            f"{pluralize(self.missing, 'measured drive')} not checked for faulty sensors: their "
            "Gram rows are missing. Run: fleet-slip gram"
        )

    def __str__(self) -> str:
        """Return what is left out, and what was not examined; nothing if none is faulty."""
        said = []
        if self.found:
            out = pluralize(len(self.found), "drive")
            said.append(
                f"{out} of {self.drives:,} left out: faulty sensors ({self._faults_text}). See: "
                "fleet-slip quality. To use them anyway: --include-faulty"
            )
        return " ".join([*said, self.lacking]).strip()

    @property
    def _faults_text(self) -> str:
        return ", ".join(f"{number:,} {fault}" for fault, number in self.faults.items())

    @contextmanager
    def explaining(self) -> Iterator[None]:
        """Say in the error of a cohort without a drive that all were left out, if they were."""
        try:
            yield
        except DataError as error:
            if (
                len(self.found) < self.drives
                or not self.found
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
        if not self.found:
            return ()
        query = "SELECT DISTINCT drive_id, vehicle_id, day FROM grams ORDER BY day, drive_id"
        with connect_tables(warehouse, query) as database:
            rows = database.execute(query).fetchall()
        named = ((hash_drive(NAME, drive), (drive, car, day)) for drive, car, day in rows)
        return tuple(SensorFault(*row, self.found[one]) for one, row in named if one in self.found)


class _Piece(NamedTuple):
    """Days whose drives are examined together; `rows` are hashes of their Gram rows."""

    first: date
    last: date
    drives: int
    rows: list[int]

    def and_then(self, other: "_Piece") -> "_Piece":
        drives, rows = self.drives + other.drives, self.rows + other.rows
        return _Piece(self.first, other.last, drives, rows)

    def predicate(self, signals: SignalCatalog) -> Predicate:
        days = f"day BETWEEN DATE '{self.first}' AND DATE '{self.last}'"
        return parse_predicate(signals, days)


def screen_computed_drives(warehouse: Warehouse, cohort: str) -> SensorScreen:
    """Examine the drives of a cohort like `quality`; return it without the faulty ones.

    Drives without Gram rows of `signals` are not examined, and counted. Of a predicate on rows all
    drives are examined. Raises what `examine_drives` raises; where no drive is measured there is
    nothing to examine.
    """
    signals = warehouse.catalog.signals
    measured = parse_predicate(signals, f"source IN ('{MEASURED}', '{RECEIVED}')")
    asked = parse_predicate(signals, cohort, row_columns(signals))
    predicate = measured if asked.columns - set(drive_columns(signals)) else asked & measured
    grams, logs = gram_snapshots(warehouse)
    missing = _count_unreduced(warehouse, grams, logs, predicate)
    parts: list[Mapping[str, Any]] = []
    for piece in _pieces(warehouse, predicate) if _has_measured(grams) else []:
        about = {"cohort": predicate.text, "from": piece.first, "root": warehouse.root.uri}
        limits = thresholds(warehouse.configs).quality.model_dump(mode="json")
        state = [piece.rows, sha256(f"{CHECKS}{canonical_json(limits)}".encode()).hexdigest()]
        name = sha256(canonical_json({k: str(v) for k, v in about.items()}).encode()).hexdigest()
        kept = cache_folder("examined") / f"{name[:32]}.json"
        parts.append(
            _known(kept, state) or _examine(warehouse, predicate & piece.predicate(signals))
        )
        content = {**parts[-1], "state": state}
        keep_json(kept, {**content, "sha256": sha256_of(canonical_json(content))})
    found = {
        name: Fault(kind, tuple(signals), figure)
        for one in parts
        for name, (kind, signals, figure) in one["found"].items()
    }
    kept_cohort = without_drives(cohort, NAME, found)
    examined = sum(one["examined"] for one in parts)
    return SensorScreen(kept_cohort, examined, found, missing)


def screen_drives(warehouse: Warehouse, cohort: str) -> SensorScreen:
    """Screen a cohort like `screen_computed_drives`; compute missing Gram rows first.

    Raises `NotScreenedError` if that takes more than seconds.
    """
    examined = screen_computed_drives(warehouse, cohort)
    if examined.missing:
        ensure_grams(warehouse, PLAIN, reason="the sensor check needs them", max_rows=CHECK_ROWS)
        examined = screen_computed_drives(warehouse, cohort)
    if examined.missing:
        raise NotScreenedError(f"{examined.lacking}, or use them unchecked: --include-faulty")
    return examined


def _examine(warehouse: Warehouse, predicate: Predicate) -> Mapping[str, Any]:
    report = examine_drives(warehouse, predicate)
    found = {
        hash_drive(NAME, one.drive_id): [one.fault.kind, list(one.fault.signals), one.fault.figure]
        for one in report.findings
    }
    return {"found": found, "examined": report.drives}


def _known(kept: Path, state: list[Any]) -> Mapping[str, Any] | None:
    with suppress(OSError, ValueError, KeyError, TypeError):
        known = json.loads(kept.read_bytes())
        checksum = known.pop("sha256")
        if known["state"] == state and checksum == sha256_of(canonical_json(known)):
            return dict(known)
    return None


def _has_measured(grams: Snapshot) -> bool:
    """Return True if there may be Gram rows of measured drives. Does not search many files."""
    if len(grams.files) > FEW_FILES:
        return True
    read = (grams.table.read_combinations(file.path, ["source"]) for file in grams.files)
    sources = {source for rows in read for source in rows["source"].to_pylist()}
    return not sources.isdisjoint((MEASURED, RECEIVED))


def _pieces(warehouse: Warehouse, predicate: Predicate) -> list[_Piece]:
    """Divide a cohort's days, so that new days change the last piece alone."""
    with GramReader(warehouse) as reader:
        opened = reader.opened(PLAIN, predicate)
        statement = opened.statement("examined_days.sql", predicate)
        with guarded_query(opened.database, predicate):
            found = opened.database.execute(statement).fetchall()
    pieces: list[_Piece] = []
    for day in (_Piece(day, day, drives, [rows]) for day, drives, rows in found if drives):
        if pieces and pieces[-1].drives < PIECE:
            pieces[-1] = pieces[-1].and_then(day)
        else:
            pieces.append(day)
    if len(pieces) > 1 and 4 * pieces[-1].drives < PIECE:
        pieces[-2:] = [pieces[-2].and_then(pieces[-1])]
    return pieces


def _count_unreduced(
    warehouse: Warehouse, grams: Snapshot, logs: Snapshot, predicate: Predicate
) -> int:
    """Return the number of a cohort's drives in log files without Gram rows."""
    missing = find_backlog(logs, grams).missing
    if not missing:
        return 0
    query = f"SELECT count(*) FROM drives WHERE {predicate.sql} AND source <> '{RECEIVED}'"
    others = frozenset(f.path for f in logs.files) - frozenset(f.path for f in missing)
    only = [grams, replace(logs, without=others)]
    with open_tables(warehouse, views_in(query), only) as database:
        lock(database, [path for one in only for path in one.paths])
        with guarded_query(database, predicate):
            [(drives,)] = database.execute(query).fetchall()
    return int(drives)
