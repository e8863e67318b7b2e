"""Faulty sensors, drive by drive, and the screen of training drives.

The checks read the Gram rows of all drives, and the rows of some. Drives that were checked and have
no fault may train a model. They are checked once: results are cached for the user, as hashes of
drives, as long as Gram rows, checks and thresholds stay the same. Many drives are checked in pieces
of whole days, so that a night checks its own piece. Simulated drives are not checked: their faults
are intended. Whatever trains, scores or publishes calls this screen, so that all have the same
drives.
"""

import json
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import date
from math import ceil
from operator import attrgetter
from typing import Any

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import BoolArray, IntArray
from fleet_slip.base import Record, canonical_json, pluralize, sha256_of
from fleet_slip.calibration.course_label import course_moments
from fleet_slip.catalog.features import PLAIN
from fleet_slip.catalog.signals import MEASURED, RECEIVED, TRAINING_DRIVES
from fleet_slip.errors import AlarmError, NotScreenedError
from fleet_slip.grams.cohort import Cohort, empty_cohort_error, load_cohort, require_training
from fleet_slip.grams.update import ensure_grams
from fleet_slip.ingest.recordings import SourceRef
from fleet_slip.quality.checks import CHECKS, Fault
from fleet_slip.quality.course_relation import relate
from fleet_slip.quality.drive_signals import MeanMoments
from fleet_slip.quality.peers import (
    QualityThresholds,
    find_odd_days,
    find_repeated,
    find_reversed_labels,
    settle,
    thresholds,
)
from fleet_slip.quality.plausibility import inspect_drives
from fleet_slip.quality.turning import check_moments
from fleet_slip.regression.gram import GramTable
from fleet_slip.rendering import Answer, Part, TextTable
from fleet_slip.resources import cache_folder, keep_json
from fleet_slip.storage.table import Snapshot
from fleet_slip.warehouse.database import (
    Predicate,
    drive_columns,
    guarded_query,
    hash_drive,
    parse_cohort,
    parse_predicate,
    row_columns,
    sql_text,
    without_drives,
)
from fleet_slip.warehouse.gram_reader import GramReader, find_backlog
from fleet_slip.warehouse.table_views import (
    connect_tables,
    gram_snapshots,
    lock,
    open_tables,
    views_in,
)
from fleet_slip.warehouse.warehouse import Warehouse


@dataclass(frozen=True)
class SensorFault(Record):
    """A drive with faulty sensors."""

    DOCUMENT = "drive_id vehicle_id day kind=fault.kind signals=fault.signals figure=fault.figure"

    drive_id: str
    vehicle_id: str
    day: date
    fault: Fault


BY_DAY = attrgetter("day", "drive_id")

MAX_INSPECTED = 20
"""Drives whose rows are checked: below as many the peers of a drive are too few to show a fault."""


@dataclass(frozen=True)
class QualityReport(Answer):
    """Faulty sensors and labels of a cohort.

    Attributes
    ----------
    drives
        Number of drives that are long enough to be checked.
    compared
        Those among them with enough peers to be compared with.
    findings
        One for each faulty drive, by day and drive.
    systematic
        Faults of most of the drives whose rows were checked. No drive shows what is
        right, so that none is left out of training; `publish` refuses a first champion.
    inspected
        Number of drives whose rows were checked.
    """

    drives: int
    compared: int
    findings: tuple[SensorFault, ...]
    systematic: tuple[Fault, ...] = ()
    inspected: int = 0

    def parts(self) -> Iterator[Part]:
        """Return a table of the findings."""
        peers = "other" if self.compared else "too few"
        checked = (
            f"{pluralize(self.drives, 'drive')} checked, {self.compared:,} of them against peers "
            f"({peers} drives of a car or vehicle model)"
        )
        if self.findings:
            header = "drive|car|fault|signals|what shows it"
            row = "{drive_id}|{vehicle_id}|{fault.kind}|{fault.signals}|{fault.figure}"
            yield TextTable(checked, header, self.findings, row, text_columns=5)
        elif self.systematic:
            yield checked
        else:
            yield f"{checked}: {'no faulty sensor' if self.drives else 'none long enough'}"
        for fault in self.systematic:
            yield f"in most of {pluralize(self.inspected, 'inspected drive')}: {fault}"

    @property
    def problem(self) -> AlarmError | None:
        """Return an error if any drive is faulty."""
        if self.systematic:
            return AlarmError(
                f"most of {pluralize(self.inspected, 'inspected drive')} contradict the motion of "
                "any car. Correct the mapping and run: fleet-slip ingest LOGS --mapping M --replace"
            )
        if self.findings:
            drives = pluralize(self.drives, "drive")
            return AlarmError(f"faulty sensors in {len(self.findings)} of {drives}")
        return None


def examine_drives(
    warehouse: Warehouse, predicate: str | Predicate = TRAINING_DRIVES
) -> QualityReport:
    """Run the checks of Gram rows on all drives of a cohort, and those of rows on some.

    Labels are compared among all drives, signals among those of a vehicle model. Drives with
    different sets of signals are checked alike.
    Raises like `fleet_slip.grams.cohort.load_cohort`.
    """
    drives = parse_cohort(warehouse.catalog.signals, predicate)
    with GramReader(warehouse) as reader:
        models = _vehicle_models(reader, drives)
        faulty = _faulty_courses(reader, drives)
        faulty |= find_wrong_labels(load_cohort(reader, drives))
        reports = [examine(load_cohort(reader, drives & of_model), faulty) for of_model in models]
    findings = {finding.drive_id: finding for report in reports for finding in report.findings}
    inspection = inspect_drives(warehouse, drives, MAX_INSPECTED)
    systematic: dict[tuple[str, tuple[str, ...]], Fault] = {}
    for drive in inspection.drives:
        for fault in drive.faults:
            if inspection.is_systematic(fault):
                systematic.setdefault((fault.kind, fault.signals), fault)
            else:
                finding = SensorFault(drive.drive_id, drive.vehicle_id, drive.day, fault)
                findings.setdefault(drive.drive_id, finding)
    return QualityReport(
        sum(report.drives for report in reports),
        sum(report.compared for report in reports),
        tuple(sorted(findings.values(), key=BY_DAY)),
        tuple(systematic.values()),
        len(inspection.drives),
    )


def _faulty_courses(reader: GramReader, predicate: Predicate) -> dict[str, Fault]:
    """Return the drives whose course is not one, if Gram rows of its changes are there."""
    return {
        drive: fault
        for drives in course_moments(reader, predicate).values()
        for drive, moments in drives.items()
        if (relation := relate(moments)) and (fault := relation.fault)
    }


def _vehicle_models(reader: GramReader, predicate: Predicate) -> list[Predicate]:
    """Return, for each vehicle model of a cohort, the predicate that a drive is of it."""
    opened = reader.opened(PLAIN, predicate)
    sources = opened.values_of("source", predicate).to_pylist()
    if not sources:
        raise empty_cohort_error(opened, predicate)
    require_training(sources, predicate)
    models = sorted(opened.values_of("vehicle_model", predicate).to_pylist(), key=str)
    return [
        parse_predicate(
            reader.catalog.signals, f"vehicle_model IS NOT DISTINCT FROM {sql_text(model)}"
        )
        for model in models
    ]


def find_wrong_labels(cohort: Cohort) -> dict[str, Fault]:
    """Return the drives whose label contradicts that of the others, of all vehicle models.

    Such a label is reversed, or has another factor or zero since a day or in a file. A fault of
    many drives at once may be usual within one vehicle model.
    """
    catalog = cohort.catalog
    limits = thresholds(catalog.configs).quality
    faults: dict[str, Fault] = {}
    for table, metadata in _long_drives(cohort, limits.min_rows):
        in_order = np.ones(len(table), dtype=np.bool_)
        in_order[list(check_moments(table, catalog.signals, limits.min_correlation))] = False
        if in_order.sum() >= limits.min_drives:
            wrong = find_reversed_labels(table, in_order, catalog.signals.label)
            in_order[list(wrong)] = False
            by_group = _days_and_files(metadata)
            wrong |= find_odd_days(catalog.signals, table, in_order, *by_group, limits)
            names = metadata["drive_id"].to_pylist()
            faults |= {names[drive]: fault for drive, fault in wrong.items()}
    return faults


def examine(cohort: Cohort, faulty: Mapping[str, Fault] | None = None) -> QualityReport:
    """Run the checks of Gram rows on each drive, with its car's and its vehicle model's drives.

    First those that need no peers, then the comparison with peers, if there are `min_drives` of
    them; see `_peer_groups`. `faulty` are the faults of drives that other checks reported. A drive
    with several sets of signals has several Gram rows, and is one drive.
    """
    catalog = cohort.catalog
    limits = thresholds(catalog.configs).quality
    drives, compared = set[str](), set[str]()
    faulty = {**(faulty or {}), **find_repeated(cohort.drives)}
    findings: dict[str, SensorFault] = {}
    for table, metadata in _groups(cohort, limits.min_rows):
        names = np.array(metadata["drive_id"].to_pylist(), dtype=object)
        faults = check_moments(table, catalog.signals, limits.min_correlation)
        faults |= _saturated(table, metadata, limits)
        faults = {
            drive: faulty[name] for drive, name in enumerate(names) if name in faulty
        } | faults
        in_order = np.array([drive not in faults for drive in range(len(table))])
        for group in _peer_groups(metadata, limits.min_drives):
            if in_order[group].sum() >= limits.min_drives:
                compared |= set(names[group])
                unlike = _unlike_peers(catalog.signals.label, table, group, in_order, limits)
                faults |= {drive: fault for drive, fault in unlike.items() if drive not in faults}
        drives |= set(names)
        rows = metadata.select(["drive_id", "vehicle_id", "day"]).to_pylist()
        for drive, fault in faults.items():
            findings.setdefault(names[drive], SensorFault(**rows[drive], fault=fault))
    return QualityReport(len(drives), len(compared), tuple(sorted(findings.values(), key=BY_DAY)))


def _days_and_files(metadata: pa.Table) -> tuple[list[IntArray], IntArray]:
    """Return numberings of drives by day and by file, and by car."""
    sources = [SourceRef.of_drive(drive) for drive in metadata["drive_id"].to_pylist()]
    files = [source.digest if source else "" for source in sources]
    of_day, of_file, of_car = (
        np.unique(np.array(values, dtype=str), return_inverse=True)[1]
        for values in (metadata["day"].to_pylist(), files, metadata["vehicle_id"].to_pylist())
    )
    return [of_day, of_file], of_car


def _peer_groups(metadata: pa.Table, min_drives: int) -> Iterator[BoolArray]:
    """Yield masks of drives to compare with one another: those of a car, and those of many cars.

    A car with enough drives is compared with itself, which shows differences between its drives.
    The comparison with other cars shows faults of all its drives. There it has no more drives than
    they have, the first by name, so that a car that is logged every day does not define the usual.
    """
    ids, cars = (np.array(metadata[n].to_pylist(), dtype=str) for n in ("drive_id", "vehicle_id"))
    of_car = np.unique(cars, return_inverse=True)[1]
    counts = np.bincount(of_car)
    for car in np.flatnonzero(counts >= min_drives):
        yield of_car == car
    if len(counts) > 1:
        small = counts[counts < min_drives]
        median = int(np.median(small)) if len(small) else 1
        max_drives = max(ceil(min_drives / len(counts)), median)
        number = np.empty(len(cars), dtype=np.int64)  # of each drive among those of its car
        number[np.lexsort((ids, of_car))] = np.concatenate([np.arange(n) for n in counts])
        yield (counts[of_car] < min_drives) | (number < max_drives)


def _long_drives(cohort: Cohort, min_rows: int) -> Iterator[tuple[GramTable, pa.Table]]:
    """Yield the drives of each set of signals that are long enough, with their metadata."""
    start = 0
    for table in cohort.tables:
        long = table.n >= min_rows
        if long.any():
            yield table.take(long), cohort.drives.slice(start, len(table)).filter(pa.array(long))
        start += len(table)


def _groups(cohort: Cohort, min_rows: int) -> Iterator[tuple[GramTable, pa.Table]]:
    """Yield long drives by set of signals and vehicle model, with their metadata."""
    for table, metadata in _long_drives(cohort, min_rows):
        models = np.array([str(name) for name in metadata["vehicle_model"].to_pylist()])
        for model in sorted(set(models)):
            yield table.take(models == model), metadata.filter(pa.array(models == model))


def _saturated(table: GramTable, metadata: pa.Table, limits: QualityThresholds) -> dict[int, Fault]:
    clipped = np.array([count or 0 for count in metadata["saturated"].to_pylist()])
    fraction = clipped / table.n
    return {
        int(drive): CHECKS["saturation"].fault(count=clipped[drive])
        for drive in np.flatnonzero(fraction > limits.max_saturated_per_row)
    }


def _unlike_peers(
    label: str, table: GramTable, group: BoolArray, in_order: BoolArray, limits: QualityThresholds
) -> dict[int, Fault]:
    """Return the faults of the drives of a group that differ from its others."""
    moments = MeanMoments.from_table(table.take(group))
    peers, suspects = settle(moments, in_order[group], label, limits)
    if not suspects.any():
        return {}
    faults = peers.explain(moments.take(suspects))
    return dict(zip(np.flatnonzero(group)[suspects].tolist(), faults, strict=True))


# The screen of training drives.


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
            faults = ", ".join(f"{number:,} {fault}" for fault, number in self.faults.items())
            sentences.append(
                f"{out} of {self.drives:,} left out: faulty sensors ({faults}). See: "
                "fleet-slip quality. To use them anyway: --include-faulty"
            )
        return " ".join([*sentences, self.remaining_text]).strip()

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
