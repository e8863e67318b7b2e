"""Checks of the training data before a model is published: drives and courses that a car can have.

A fault of all drives, such as a reversed label, shows in no comparison of drives.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import FloatArray
from fleet_slip.base import pluralize
from fleet_slip.calibration.course_label import course_moments
from fleet_slip.calibration.receiver_delay import GRAIN_S, ReceiverDelay, receiver_delays
from fleet_slip.catalog.course import YAW_RATE
from fleet_slip.catalog.definitions import DELAY
from fleet_slip.catalog.signals import ALL_DRIVES
from fleet_slip.errors import RefusedError
from fleet_slip.grams.cohort import hash_names
from fleet_slip.models.acceptance import load_thresholds, missing_evidence
from fleet_slip.models.manifest import Manifest, TrainedDrives
from fleet_slip.quality.checks import Fault
from fleet_slip.quality.course_relation import COLUMNS, relate
from fleet_slip.quality.plausibility import inspect_drives
from fleet_slip.warehouse.gram_reader import GramReader, open_grams
from fleet_slip.warehouse.predicate import parse_cohort, parse_predicate
from fleet_slip.warehouse.warehouse import Warehouse

MAX_DRIVES = 5
"""Drives to inspect, each of a different vehicle where possible."""
WRONG_MAPPING = ("late", "magnitude", "reversed", "scaled", "swapped")
"""Kinds of faults of the mapping. If most drives of a first champion have one, no drive shows the
correct value, and later models may use the signal."""
MIN_NEW_DRIVES = 3
"""Fewest new drives to judge beside a champion: one alone may be odd."""


def require_sound_drives(
    warehouse: Warehouse,
    manifest: Manifest,
    champion_drives: TrainedDrives | None = None,
    champion_columns: int = 0,
) -> None:
    """Raise `RefusedError` if most of the inspected measured drives contradict the motion of cars.

    Faults of the label and of signals in columns of the model count. For a first champion wrong
    mappings of all other signals do, too. Beside a champion only drives that it was not trained on
    are inspected; a model of more columns than the champion needs as much data as a first one.
    """

    def select_new(drives: Sequence[str]) -> Sequence[bool]:
        if champion_drives is None:
            return [True] * len(drives)
        names = hash_names(pa.array(drives, pa.string()))
        return [not is_trained for is_trained in champion_drives.among(names).tolist()]

    predicate = parse_predicate(warehouse.catalog.signals, manifest.trained_on.cohort)
    inspection = inspect_drives(warehouse, predicate, MAX_DRIVES, select_new)
    missing = missing_evidence(load_thresholds(warehouse.configs), manifest)
    if inspection.measured and len(manifest.terms) > champion_columns and missing:
        raise RefusedError(
            f"{manifest.name} was not published: {'; '.join(missing)}. Ingest more drives or "
            "choose fewer columns. To publish it anyway: --force"
        )
    inspected, has_champion = len(inspection.drives), champion_drives is not None
    if has_champion and inspected < MIN_NEW_DRIVES:
        return
    used = {manifest.label.signal}
    for term in manifest.terms:
        used |= set(term.definition.signals) if term.definition else {term.signal}
    for (kind, signals), faults in inspection.by_fault().items():
        counts = not used.isdisjoint(signals) or (kind in WRONG_MAPPING and not has_champion)
        # Drives of a champion have no faults, so that half of the new ones are enough beside it.
        if not counts or 2 * len(faults) + has_champion <= inspected:
            continue
        raise RefusedError(
            f"{manifest.name} was not published: {len(faults)} of {inspected} inspected drives "
            f"contradict the motion of any car: {faults[0]} Correct the mapping and run: "
            "fleet-slip ingest LOGS --mapping M --replace. To publish it anyway: --force"
        )


# A late course looks like a side-slip angle in all figures, and so does a heading.

MAX_ANGLE_ERROR_DEG = 0.15
"""Error of the label that an unknown or remaining delay may cause: as much as the intercept has
from the mounting of reference sensors (`calibration.course_label`)."""
USUAL_YAW_RATE_RAD_S = 0.25
"""Standard deviation of the yaw rate of cars without moments of the course."""
MAX_CARS = 5
"""Maximum number of cars in a message."""


def require_sound_course(warehouse: Warehouse, manifest: Manifest) -> None:
    """Raise `RefusedError` for a course that is late, or implausible for a car.

    A course that is late by d shifts the label by d times the yaw rate.
    """
    predicate = parse_cohort(warehouse.catalog.signals, manifest.trained_on.cohort)
    with GramReader(warehouse) as reader:
        drives = course_moments(reader, predicate)
    moments = {car: np.sum(list(of_car.values()), axis=0) for car, of_car in drives.items()}
    yaw_rates = {car: _yaw_rate_rad_s(of_car) for car, of_car in moments.items()}
    delays_s = _require_in_time(warehouse, manifest, yaw_rates)
    _require_course_of_cars(manifest, moments, delays_s)


def _yaw_rate_rad_s(moments: FloatArray) -> float:
    """Return the standard deviation of the yaw rate: that of its changes over the root of two."""
    at = 1 + COLUMNS.index(YAW_RATE)
    changes, total, square = moments[0, 0], moments[0, at], moments[at, at]
    return math.sqrt(max(square / changes - (total / changes) ** 2, 0.0) / 2)


def _require_in_time(
    warehouse: Warehouse, manifest: Manifest, yaw_rates: Mapping[str, float]
) -> dict[str, float]:
    """Return the remaining delays of courses in Gram rows, in s, by car of the training drives.

    Raises `RefusedError` unless all are estimated and corrected, `DataError` without Gram rows.
    """
    signals = warehouse.catalog.signals
    predicate = parse_cohort(signals, manifest.trained_on.cohort)
    with open_grams(warehouse, DELAY, predicate) as opened:
        batches = opened.batches(parse_predicate(signals, ALL_DRIVES))
        delays = receiver_delays(batches).cars
    feature_set = warehouse.catalog.name_of(manifest.trained_on.feature_set)
    with open_grams(warehouse, feature_set, predicate) as opened:
        cars = dict(opened.course_delays(predicate))
    remaining = {
        car: max((delays[car].value - GRAIN_S * parts for parts in corrected), key=abs)
        for car, corrected in cars.items()
        if car in delays
    }

    def is_large(car: str, delay_s: float | None) -> bool:
        yaw_rate = yaw_rates.get(car, USUAL_YAW_RATE_RAD_S)
        return delay_s is None or math.degrees(abs(delay_s) * yaw_rate) > MAX_ANGLE_ERROR_DEG

    unsure = [car for car in remaining if is_large(car, delays[car].uncertainty)]
    late = [car for car, delay_s in remaining.items() if is_large(car, delay_s)]
    problems = []
    if unsure:
        problems.append(
            f"delays are too uncertain ({_named(delays, unsure)}; they may cause more than "
            f"{MAX_ANGLE_ERROR_DEG:g} deg)"
        )
    if unknown := len(cars) - len(remaining):
        problems.append(f"that of {pluralize(unknown, 'car')} cannot be estimated")
    if late:
        problems.append(
            f"Gram rows are corrected by an outdated delay ({_named(delays, late)}): run "
            "fleet-slip gram --features course, and send the new delay to cars that count on board"
        )
    if problems:
        raise RefusedError(
            f"{manifest.name} was not published: a late course looks like side-slip, and "
            f"{'; '.join(problems)}. See: fleet-slip calibrate --car NAME. Choose other cars, add "
            "drives, or set the receiver type (receiver in the mapping). To publish it anyway: "
            f"fleet-slip publish {manifest.name} --label course --force"
        )
    return remaining


def _named(delays: Mapping[str, ReceiverDelay], cars: Sequence[str]) -> str:
    shown = ", ".join(f"{car}: {delays[car]}" for car in cars[:MAX_CARS])
    return f"{shown}, and {len(cars) - MAX_CARS} more" if len(cars) > MAX_CARS else shown


def _require_course_of_cars(
    manifest: Manifest, moments: Mapping[str, FloatArray], delays_s: Mapping[str, float]
) -> None:
    """Raise `RefusedError` if a course, `delays_s` late in Gram rows, is not that of a car."""
    faults: dict[str, Fault] = {}
    for car, of_car in sorted(moments.items()):
        relation = relate(of_car, delays_s.get(car, 0.0))
        if relation and (fault := relation.fault or relation.misplaced):
            faults[car] = fault
    if not faults:
        return
    (car, fault), *remaining = faults.items()
    more = f", and {pluralize(len(remaining), 'other car')}" if remaining else ""
    raise RefusedError(
        f"{manifest.name} was not published: the course of {len(faults)} of "
        f"{pluralize(len(moments), 'car')} is implausible ({car}: {fault.figure}{more}). "
        f"{fault.remedy} Then ingest again, or choose other cars; fleet-slip quality lists the "
        f"drives. To publish it anyway: fleet-slip publish {manifest.name} --label course --force"
    )
