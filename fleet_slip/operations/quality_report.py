"""Faulty sensors, drive by drive: from the Gram rows of all drives, and from the rows of some."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import date
from math import ceil
from operator import attrgetter

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import BoolArray, IntArray
from fleet_slip.base import Record, pluralize
from fleet_slip.calibration.course_label import course_moments
from fleet_slip.catalog.features import PLAIN
from fleet_slip.catalog.signals import TRAINING_DRIVES
from fleet_slip.errors import AlarmError
from fleet_slip.grams.cohort import Cohort, empty_cohort_error, load_cohort, require_training
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
from fleet_slip.warehouse.database import sql_text
from fleet_slip.warehouse.gram_reader import GramReader
from fleet_slip.warehouse.predicate import Predicate, parse_cohort, parse_predicate
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
