"""What a car's own numbers are worth, in a fleet car by car."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fleet_slip.base import FloatArray
from fleet_slip.catalogue.facts import TRAINING_DRIVES
from fleet_slip.catalogue.features import features, input_scales
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import DataError
from fleet_slip.grams.cohort import Cohort, load_cohort
from fleet_slip.grams.folding import assign_folds
from fleet_slip.regression.figures import ErrorSums
from fleet_slip.regression.folds import held_out_errors
from fleet_slip.regression.least_squares import fit
from fleet_slip.views import connect
from fleet_slip.warehouse.database import sql_text
from fleet_slip.warehouse.tables import Warehouse

SET = "fleet"
"""The feature set with the numbers that a car's own drives tell."""

FEWEST_CARS = 20
FOLDS = 10


@dataclass(frozen=True)
class Cars:
    """Errors in cars that the model was not fitted on, RMSE in degrees.

    Attributes:
        campaign: whose cars they are.
        before_deg, after_deg: of each car, without and with its own numbers, shape (cars,).
        all_before_deg, all_after_deg: of all rows together.
        inputs_before, inputs_after: number of inputs.
    """

    campaign: str
    before_deg: FloatArray
    after_deg: FloatArray
    all_before_deg: float
    all_after_deg: float
    inputs_before: int
    inputs_after: int


def weigh_cars(warehouse: Warehouse) -> Cars | None:
    """Weigh the numbers of the campaign with most cars; None without a fleet's Gram rows."""
    campaign = largest_fleet(warehouse)
    if campaign is None:
        return None
    one = features().feature_set(SET)
    try:
        cohort = load_cohort(
            warehouse, f"{TRAINING_DRIVES} AND campaign = {sql_text(campaign)}", SET
        )
        known = [name for name in one.inputs if name in cohort.inputs]
        before = [name for name in known if name not in {*one.calibrated, *features().factors}]
        own = [name for name in one.calibrated if name in known]
        if not own:  # no Gram rows of the set that numbers come from
            return None
        without, of_all = errors_by_car(cohort, before)
        with_own, of_all_with = errors_by_car(cohort, [*before, *own])
    except DataError:  # no Gram rows of the set, or cars that lack what it needs
        return None
    cars = sorted(set(without) & set(with_own), key=lambda car: without[car])
    return Cars(
        campaign=campaign,
        before_deg=np.array([without[car] for car in cars]),
        after_deg=np.array([with_own[car] for car in cars]),
        all_before_deg=of_all,
        all_after_deg=of_all_with,
        inputs_before=len(before),
        inputs_after=len(before) + len(own),
    )


def largest_fleet(warehouse: Warehouse) -> str | None:
    """Return the campaign with most cars, if they are enough for folds of cars."""
    with connect(warehouse.root) as database:
        found = database.execute(
            "SELECT campaign FROM drives WHERE campaign IS NOT NULL GROUP BY campaign "
            "HAVING count(DISTINCT vehicle_id) >= $fewest "
            "ORDER BY count(DISTINCT vehicle_id) DESC, campaign LIMIT 1",
            {"fewest": FEWEST_CARS},
        ).fetchone()
    return None if found is None else str(found[0])


def errors_by_car(cohort: Cohort, inputs: Sequence[str]) -> tuple[dict[str, float], float]:
    """Return the RMSE in deg of each car and of all, by models of others. Raises `DataError`."""
    label = catalogue().label
    served = cohort.serving(inputs)
    vehicles = served.drives["vehicle_id"].to_pylist()
    cars, number = np.unique(vehicles, return_inverse=True)
    folds = assign_folds(cars.tolist(), "vehicle", FOLDS)
    of_car = served.table.totals(number, len(cars))
    total = served.table.total()
    errors: dict[str, ErrorSums] = {}
    for fold in range(len(folds.names)):
        held_out = np.flatnonzero(folds.fold == fold)
        training = total - sum((of_car[i] for i in held_out[1:]), of_car[held_out[0]])
        model = fit(training, inputs, label).model
        errors |= {str(cars[i]): held_out_errors(model, training, of_car[i]) for i in held_out}
    unit = input_scales()[label]
    first, *others = errors.values()
    return (
        {car: one.figures(unit).rmse_deg for car, one in errors.items()},
        sum(others, first).figures(unit).rmse_deg,
    )
