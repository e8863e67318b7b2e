"""What a model is published for: drives and courses that a car can have.

A fault of all drives, such as a label with the other sign, shows in no comparison.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from fleet_slip.base import pluralize
from fleet_slip.calibration.course_label import course_moments
from fleet_slip.calibration.receiver_delay import GRAIN_S, ReceiverDelay, receiver_delays
from fleet_slip.catalog.calibration_parameters import DELAY
from fleet_slip.catalog.drive_sources import ALL_DRIVES, MEASURED
from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.errors import RefusedError
from fleet_slip.grams.gram_files import hash_names
from fleet_slip.models.acceptance import load_thresholds, missing_evidence
from fleet_slip.models.manifest import Manifest, TrainedDrives
from fleet_slip.quality.checks import Fault
from fleet_slip.quality.course_relation import relate
from fleet_slip.quality.drive_signals import Signals, to_regular_grid
from fleet_slip.quality.plausibility import check_plausibility
from fleet_slip.warehouse.gram_reader import GramReader, open_grams
from fleet_slip.warehouse.predicate import guarded_query, parse_cohort, parse_predicate
from fleet_slip.warehouse.table_views import connect_tables
from fleet_slip.warehouse.warehouse import Warehouse

DRIVES = 5
"""That are looked at, of as many cars if there are so many."""

FEWEST_NEW = 3
"""New drives that are looked at if there is a champion: one alone may be odd."""

MOST_TICKS = 100_000

_LONGEST = """
    SELECT drive_id, day FROM drives WHERE source = $source AND ({predicate})
    ORDER BY row_number() OVER (PARTITION BY vehicle_id ORDER BY rows DESC, drive_id),
        rows DESC, drive_id
"""


def require_sound_drives(
    warehouse: Warehouse, manifest: Manifest, made: TrainedDrives | None = None, settled: int = 0
) -> None:
    """Raise `RefusedError` if most of some measured drives of a cohort contradict any car.

    `made` are the drives that made the champion, of `settled` columns: one of more columns needs as
    much data for them as a first champion does. What is looked at is the label, and the signals
    that a model has columns of. Simulated drives, and those of cars that sent no log, are passed
    over.
    """
    found, looked_at, measured = _look(warehouse, manifest, made)
    lacks = missing_evidence(load_thresholds(warehouse.configs), manifest)
    if measured and len(manifest.terms) > settled and lacks:
        raise RefusedError(
            f"{manifest.name} was not published: {'; '.join(lacks)}. Ingest more drives or choose "
            "fewer columns. To publish it anyway: --force"
        )
    if made is not None and looked_at < FEWEST_NEW:
        return
    used = {manifest.label.signal}
    for term in manifest.terms:
        used |= set(term.definition.signals) if term.definition else {term.signal}
    for (_, signals), examples in found.items():
        # Beside a champion, whose drives have no faults, half of them are enough.
        if used.isdisjoint(signals) or 2 * len(examples) + (made is not None) <= looked_at:
            continue
        raise RefusedError(
            f"{manifest.name} was not published: {len(examples)} of {looked_at} inspected drives "
            f"contradict the motion of any car: {examples[0]} Correct the mapping and run: "
            "fleet-slip ingest LOGS --mapping M --replace. To publish it anyway: --force"
        )


def _look(
    warehouse: Warehouse, manifest: Manifest, made: TrainedDrives | None
) -> tuple[dict[tuple[str, tuple[str, ...]], list[Fault]], int, int]:
    """Return what looks wrong in some long drives, how many these are, and of how many."""
    signals = warehouse.catalog.signals
    found: dict[tuple[str, tuple[str, ...]], list[Fault]] = {}
    predicate = parse_predicate(signals, manifest.trained_on.cohort)
    query = _LONGEST.format(predicate=predicate.sql)
    with (
        connect_tables(warehouse, query + "log_counts") as database,
        guarded_query(database, predicate),
    ):
        drives = database.execute(query, {"source": MEASURED}).fetchall()
        measured = len(drives)
        if made is not None:
            numbers = hash_names(pa.array([drive for drive, _ in drives], pa.string()))
            seen = made.among(numbers).tolist()
            drives = [drive for drive, known in zip(drives, seen, strict=True) if not known]
        chosen = drives[:DRIVES]
        for drive, day in chosen:
            columns = database.execute(
                "SELECT * FROM log_counts WHERE day = $day AND drive_id = $drive ORDER BY tick "
                f"LIMIT {MOST_TICKS}",
                {"day": day, "drive": drive},
            ).fetchnumpy()
            for one in check_plausibility(signals, _signals(signals, columns)):
                if one.does_harm:
                    found.setdefault((one.kind, one.signals), []).append(one)
    return found, len(chosen), measured


def _signals(signals: SignalCatalog, columns: Mapping[str, Any]) -> Signals:
    """Return the signals of a drive that has values of them."""
    counts = {
        name: np.ma.filled(np.ma.asarray(columns[name], dtype=np.float64), np.nan)
        for name in signals.signals
        if name in columns
    }
    some = {name: values for name, values in counts.items() if np.isfinite(values).any()}
    return to_regular_grid(signals, np.asarray(columns["tick"], dtype=np.int32), some)


# A course that is late looks like a side-slip angle, in all figures, and so does a heading.

MOST_S, SURE_S = 0.01, 0.005
"""Delay that may be left, and its standard error: 20 ms cost 0.4 deg on a real car."""
NAMED, SHOWN = 5, 3


def require_in_time(warehouse: Warehouse, manifest: Manifest) -> dict[str, float]:
    """Return how late courses still are, in s, in the Gram rows of the cars that taught a model.

    Raises `RefusedError` unless all are known and corrected for, `DataError` without Gram rows.
    """
    signals = warehouse.catalog.signals
    predicate = parse_cohort(signals, manifest.trained_on.cohort)
    with open_grams(warehouse, DELAY, predicate) as opened:
        told = opened.batches(parse_predicate(signals, ALL_DRIVES))
        delays = receiver_delays(told).cars
    feature_set = warehouse.catalog.name_of(manifest.trained_on.feature_set)
    with open_grams(warehouse, feature_set, predicate) as opened:
        cars = dict(opened.course_delays(predicate))
    left = {
        car: max((delays[car].value - GRAIN_S * parts for parts in corrected), key=abs)
        for car, corrected in cars.items()
        if car in delays
    }
    unsure = [car for car in left if (delays[car].uncertainty or math.inf) > SURE_S]
    late = [car for car, delay_s in left.items() if abs(delay_s) > MOST_S]
    problems = []
    if unsure:
        problems.append(
            f"delays are not estimated to {1000 * SURE_S:g} ms ({_named(delays, unsure)})"
        )
    if unknown := len(cars) - len(left):
        cars_text = pluralize(unknown, "car")
        problems.append(f"that of {cars_text} cannot be estimated from their drives")
    if late:
        problems.append(
            "the Gram rows of some cars are corrected by an outdated delay "
            f"({_named(delays, late)}): run fleet-slip gram --features course, and send the new "
            "delay to cars that count on board"
        )
    if problems:
        raise RefusedError(
            f"{manifest.name} was not published: a late course looks like side-slip, and "
            f"{'; '.join(problems)}. fleet-slip calibrate --car NAME says it. Choose "
            "other cars, add drives, or set the receiver type (receiver in the mapping). "
            f"To publish it anyway: fleet-slip publish {manifest.name} --label "
            "course --force"
        )
    return left


def _named(delays: Mapping[str, ReceiverDelay], cars: Sequence[str]) -> str:
    shown = ", ".join(f"{car}: {delays[car]}" for car in cars[:NAMED])
    return f"{shown}, and {len(cars) - NAMED} more" if len(cars) > NAMED else shown


def require_sound_course(
    warehouse: Warehouse, manifest: Manifest, delays_s: Mapping[str, float]
) -> None:
    """Raise `RefusedError` unless all courses, `delays_s` late in Gram rows, are those of a car."""
    predicate = parse_cohort(warehouse.catalog.signals, manifest.trained_on.cohort)
    with GramReader(warehouse) as reader:
        cars = course_moments(reader, predicate)
    faults: dict[str, Fault] = {}
    for car, drives in sorted(cars.items()):
        relation = relate(np.sum(list(drives.values()), axis=0), delays_s.get(car, 0.0))
        if relation and (fault := relation.fault or relation.misplaced):
            faults[car] = fault
    if not faults:
        return
    first = next(iter(faults.values()))
    named = "; ".join(f"{car}: {one.figure}" for car, one in list(faults.items())[:SHOWN])
    more = f", and {len(faults) - SHOWN} more" if len(faults) > SHOWN else ""
    raise RefusedError(
        f"{manifest.name} was not published: the course of {len(faults)} of "
        f"{pluralize(len(cars), 'car')} is implausible ({named}{more}). {first.remedy} Then "
        "ingest again, or choose other cars; fleet-slip quality lists the drives. To publish it "
        f"anyway: fleet-slip publish {manifest.name} --label course --force"
    )
