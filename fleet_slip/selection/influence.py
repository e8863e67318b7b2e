"""The cars of a cohort whose influence no honest car has, by name, and a cohort without them."""

from collections.abc import Collection

import numpy as np

from fleet_slip.grams.cohorts.gram_cohort import Served
from fleet_slip.regression.inference.drive_moments import DriveMoments
from fleet_slip.regression.inference.influential import Influential, find_influential
from fleet_slip.warehouse.condition import Condition, parse_condition
from fleet_slip.warehouse.database import sql_text


def influential_cars(served: Served, moments: DriveMoments) -> dict[str, Influential]:
    """Return cars of unusual influence by name, most unusual first. Raises `DataError` for few."""
    owners = np.array([name or "" for name in served.drives["vehicle_id"].to_pylist()])
    names, cars = np.unique(owners, return_inverse=True)
    found = find_influential(moments, cars.astype(np.int64))
    return {str(names[one.car]): one for one in found if names[one.car]}


def without_vehicles(condition: Condition, vehicles: Collection[str]) -> Condition:
    """Return a condition without some cars."""
    if not vehicles:
        return condition
    quoted = ", ".join(map(sql_text, sorted(vehicles)))
    others = f"(vehicle_id IS NULL OR vehicle_id NOT IN ({quoted}))"
    return parse_condition(f"{condition.sql} AND {others}")
