"""Whether the course that a model learned from moves as cars do, and came in time.

A late one looks like a side-slip angle, in all figures, and so does a heading.
"""

from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from fleet_slip.catalogue.car_numbers import DELAY
from fleet_slip.catalogue.course_relation import CourseFault, relate
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.sources import ALL_DRIVES
from fleet_slip.errors import RefusedError
from fleet_slip.grams.calibration.course_drives import course_moments
from fleet_slip.grams.cohorts.gram_reader import GramReader, open_grams
from fleet_slip.grams.rows.course_delays import GRAIN_S
from fleet_slip.grams.rows.receiver_delay import ReceiverDelay, receiver_delays
from fleet_slip.models.manifest import Manifest
from fleet_slip.warehouse.condition import parse_cohort, parse_condition
from fleet_slip.warehouse.tables import Warehouse
from fleet_slip.words import number_of

MOST_S, SURE_S = 0.01, 0.005
"""Delay that may be left, and its standard error: 20 ms cost 0.4 deg on a real car."""
NAMED, SHOWN = 5, 3


def require_in_time(warehouse: Warehouse, manifest: Manifest) -> dict[str, float]:
    """Return how late courses still are, in s, in the Gram rows of the cars that taught a model.

    Raises `RefusedError` unless all are known and corrected for, `DataError` without Gram rows.
    """
    condition = parse_cohort(manifest.trained_on.cohort)
    with open_grams(warehouse, DELAY, condition) as opened:
        told = opened.batches(parse_condition(ALL_DRIVES))
        delays = receiver_delays(told).cars
    feature_set = features().name_of(manifest.trained_on.feature_set)
    with open_grams(warehouse, feature_set, condition) as opened:
        cars = dict(opened.course_delays(condition))
    problems = [*_unsure(delays, cars), *_not_corrected(delays, cars)]
    if problems:
        raise RefusedError(
            f"{manifest.name} was not published: a course that is late looks like a side-slip "
            f"angle, and {'; '.join(problems)}. The view calibration has the number receiver_delay "
            "of each car. Choose other cars, more drives of them, or tell the type of their "
            "receivers: receiver in a mapping or its table of cars. To publish all the same: "
            f"fleet-slip publish {manifest.name} --label course --force"
        )
    return {car: max(_left(delays[car], corrected), key=abs) for car, corrected in cars.items()}


def _unsure(delays: Mapping[str, ReceiverDelay], cars: Iterable[str]) -> Iterator[str]:
    unsure = {car: delays[car] for car in cars if car in delays and not _sure(delays[car])}
    if unsure:
        yield f"delays are not known to {1000 * SURE_S:g} ms ({_named(unsure)})"
    if untold := sum(car not in delays for car in cars):
        yield f"that of {number_of(untold, 'car')} is not known at all: their drives do not tell it"


def _not_corrected(
    delays: Mapping[str, ReceiverDelay], cars: Mapping[str, tuple[int, int]]
) -> Iterator[str]:
    late = {
        car: delays[car]
        for car, corrected in cars.items()
        if car in delays and max(map(abs, _left(delays[car], corrected))) > MOST_S
    }
    if late:
        yield (
            f"the Gram rows of some cars are corrected by another delay than they have "
            f"({_named(late)}): run fleet-slip gram --features course, and tell cars that count "
            "on board their delay"
        )


def _left(one: ReceiverDelay, corrected: tuple[int, int]) -> list[float]:
    return [one.value - GRAIN_S * parts for parts in corrected]


def _named(delays: Mapping[str, ReceiverDelay]) -> str:
    shown = ", ".join(f"{car}: {_said(one)}" for car, one in list(delays.items())[:NAMED])
    return f"{shown}, and {len(delays) - NAMED} more" if len(delays) > NAMED else shown


def _sure(one: ReceiverDelay) -> bool:
    return one.uncertainty is not None and one.uncertainty <= SURE_S


def _said(one: ReceiverDelay) -> str:
    if one.uncertainty is None:
        return f"{1000 * one.value:.0f} ms, of too few drives to be sure"
    return f"{1000 * one.value:.0f} +- {1000 * one.uncertainty:.0f} ms"


def require_sound_course(
    warehouse: Warehouse, manifest: Manifest, delays_s: Mapping[str, float]
) -> None:
    """Raise `RefusedError` unless all courses, `delays_s` late in Gram rows, are those of a car."""
    condition = parse_cohort(manifest.trained_on.cohort)
    with GramReader(warehouse) as reader:
        cars = course_moments(reader, condition)
    faults: dict[str, CourseFault] = {}
    for car, drives in sorted(cars.items()):
        relation = relate(np.sum(list(drives.values()), axis=0), delays_s.get(car, 0.0))
        if relation and (fault := relation.fault or relation.misplaced):
            faults[car] = fault
    if not faults:
        return
    first = next(iter(faults.values()))
    named = "; ".join(f"{car}: {fault.figure}" for car, fault in list(faults.items())[:SHOWN])
    more = f", and {len(faults) - SHOWN} more" if len(faults) > SHOWN else ""
    raise RefusedError(
        f"{manifest.name} was not published: the course of {len(faults)} of "
        f"{number_of(len(cars), 'car')} is not that of a car "
        f"({named}{more}). {first.remedy} Then ingest "
        "again, or choose other cars; fleet-slip quality names the drives. To publish all the "
        f"same: fleet-slip publish {manifest.name} --label course --force"
    )
