"""Whether a course that taught a model is one of cars: no heading, and of the right place."""

from collections.abc import Mapping

import numpy as np

from fleet_slip.catalogue.course_relation import CourseFault, relate
from fleet_slip.errors import RefusedError
from fleet_slip.grams.calibration.course_drives import course_moments
from fleet_slip.grams.cohorts.reader import GramReader
from fleet_slip.models.manifest import Manifest
from fleet_slip.warehouse.condition import parse_cohort
from fleet_slip.warehouse.minimum_cohort import tells_single_cars
from fleet_slip.warehouse.tables import Warehouse
from fleet_slip.words import number_of

NAMED = 3


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
    named = "; ".join(f"{car}: {fault.figure}" for car, fault in list(faults.items())[:NAMED])
    more = f", and {len(faults) - NAMED} more" if len(faults) > NAMED else ""
    raise RefusedError(
        f"{manifest.name} was not published: the course of {len(faults)} of "
        f"{number_of(len(cars), 'car')} is not that of a car "
        f"({named + more if tells_single_cars() else first.figure}). {first.remedy} Then ingest "
        "again, or choose other cars; fleet-slip quality names the drives. To publish all the "
        f"same: fleet-slip publish {manifest.name} --label course --force"
    )
