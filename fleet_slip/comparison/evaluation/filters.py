"""The Kalman filter and the observers as rivals of the regression, as they are and tuned.

All know the sensors' stated noise, and the class of the car that they are in, by its file; they
take the road for dry and the load for the usual one. `ekf_told` is told the very car and the road.
The tuned ones have the parameters that suit drives which the regression was trained on best.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, fields, replace
from importlib.metadata import version as package_version
from typing import Any

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.comparison.evaluation.estimators import Signals
from fleet_slip.comparison.evaluation.evaluated_drives import EvaluatedDrive
from fleet_slip.comparison.observers import ekf, kalman, luenberger, sliding_mode
from fleet_slip.comparison.observers.drive_signals import DriveSignals, LabelledDrive, read_drive
from fleet_slip.comparison.observers.tuning import tune
from fleet_slip.config import Config
from fleet_slip.errors import DataError
from fleet_slip.files.documents import DocumentFolder
from fleet_slip.grams.cohorts.gram_cohort import Cohort
from fleet_slip.runs.log import LOGGER
from fleet_slip.vehicle.parameters import VehicleParameters
from fleet_slip.views import connect
from fleet_slip.warehouse.tables import Warehouse

GROUP = "filters and observers"
TUNING_DRIVES = 4
"""Drives of the cohort that parameters are tuned on, evenly chosen."""


@dataclass(frozen=True)
class Filter:
    """One estimator of `comparison.observers`, its parameters as they are, and which to tune.

    Attributes:
        name: among the estimators.
        module: whose it is; filters of one module share what is tuned.
        gps: whether it needs satellite navigation.
        told: whether it knows the scenario's own load, tyres and road.
    """

    name: str
    module: str
    estimate: Callable[[DriveSignals, VehicleParameters, Any], FloatArray]
    parameters: Config
    tunable: tuple[str, ...]
    gps: bool = False
    told: bool = False


FILTERS = (
    Filter("kalman", "kalman", kalman.estimate, kalman.FilterNoise(), kalman.TUNABLE, gps=True),
    Filter("ekf_class", "ekf", ekf.estimate, ekf.EkfNoise(), ekf.TUNABLE),
    Filter("ekf_told", "ekf", ekf.estimate, ekf.EkfNoise(), ekf.TUNABLE, told=True),
    Filter(
        "luenberger", "luenberger", luenberger.estimate, luenberger.ObserverPoles(),
        luenberger.TUNABLE,
    ),
    Filter(
        "sliding_mode", "sliding_mode", sliding_mode.estimate, sliding_mode.SlidingGains(),
        sliding_mode.TUNABLE,
    ),
)  # fmt: skip


@dataclass(frozen=True)
class FilterEstimate:
    """A filter with its parameters, in a car, as an estimator of a drive's signals."""

    filter: Filter
    parameters: Config
    car: VehicleParameters

    def in_drive(self, drive: EvaluatedDrive) -> "FilterEstimate":
        """Return the filter as it is told of the car, and of the road if it is told everything."""
        scenario = drive.scenario
        if not self.filter.told:
            return replace(self, car=scenario.vehicle)
        told = self.parameters.model_copy(update={"adhesion": scenario.adhesion})
        return replace(self, car=scenario.car, parameters=told)

    def __call__(self, signals: Signals) -> FloatArray:
        """Return the estimate at each tick."""
        return self.filter.estimate(seen(signals), self.car, self.parameters)

    def description(self) -> dict[str, Any]:
        """Return what a JSON document says of it."""
        return {
            "kind": "filter",
            "group": GROUP,
            "gps": self.filter.gps,
            "told": "everything" if self.filter.told else "class",
            "parameters": self.parameters.model_dump(mode="json"),
        }


def seen(signals: Signals) -> DriveSignals:
    """Return what filters see of a drive's signals."""
    return DriveSignals(**{field.name: signals[field.name] for field in fields(DriveSignals)})


def rebuild(name: str, about: Mapping[str, Any], car: VehicleParameters) -> FilterEstimate:
    """Return a filter from its name among the estimators and what a document says of it."""
    (one,) = (one for one in FILTERS if one.name == name.removesuffix("_tuned"))
    return FilterEstimate(one, type(one.parameters).model_validate(about["parameters"]), car)


@dataclass(frozen=True)
class Bank:
    """All filters with the parameters that they have, by name, and the drives they are tuned on."""

    tuned_on: tuple[str, ...]
    estimators: dict[str, FilterEstimate]
    descriptions: dict[str, dict[str, Any]]


def filter_bank(
    warehouse: Warehouse, cohort: Cohort, car: VehicleParameters, executor: Executor
) -> Bank:
    """Return each filter as it is and tuned on drives of a cohort that the car made.

    A filter that the drives lack something for is tuned on none, and a remark says so. Tuned
    parameters are kept below `tuned/` in the data root, and sought again only for other
    drives, another car or another program.
    """
    chosen = tuning_drives(cohort, car)
    drives: list[LabelledDrive] = []
    bank = Bank(chosen, {}, {})
    for one in FILTERS:
        key = _key(one, chosen, car)
        kept = DocumentFolder(warehouse.root / "tuned" / one.module)
        documents = (kept.read(number).content for number in reversed(kept.numbers()))
        found = next((content for content in documents if content["key"] == key), None)
        if found is None:
            drives = drives or read_labelled(warehouse, chosen)
            try:
                best = tune(one.estimate, one.parameters, one.tunable, drives, car, executor)
                found = {
                    "key": key,
                    "parameters": best.parameters.model_dump(mode="json"),
                    "rmse_deg": float(np.degrees(best.rmse_rad)),
                    "evaluations": best.evaluations,
                }
                kept.append(found)
            except DataError as error:  # its drives have no fix, no wheel speeds, no steering
                LOGGER.warning("%s competes as it is, for it cannot be tuned: %s", one.name, error)
        on = list(chosen) if found else []
        tuned = type(one.parameters).model_validate(found["parameters"]) if found else None
        both = {one.name: one.parameters, f"{one.name}_tuned": tuned or one.parameters}
        for name, parameters in both.items():
            bank.estimators[name] = FilterEstimate(one, parameters, car)
            bank.descriptions[name] = bank.estimators[name].description()
        bank.descriptions[f"{one.name}_tuned"]["tuned_on"] = on
    return bank


def tuning_drives(cohort: Cohort, car: VehicleParameters) -> tuple[str, ...]:
    """Return the drives of a cohort to tune filters on: of that car's model if there are any."""
    drives = cohort.drives.select(["drive_id", "vehicle_model"]).to_pylist()
    of_car = {row["drive_id"] for row in drives if row["vehicle_model"] == car.name}
    names = sorted(of_car or {row["drive_id"] for row in drives})
    count = min(TUNING_DRIVES, len(names))
    places = np.linspace(0, len(names) - 1, count).round().astype(int)
    return tuple(names[place] for place in places)


def _key(one: Filter, drives: Sequence[str], car: VehicleParameters) -> dict[str, Any]:
    """Return what tuned parameters depend on."""
    return {
        "for_lowest": "rmse_deg",
        "start": one.parameters.model_dump(mode="json"),
        "tunable": list(one.tunable),
        "drives": list(drives),
        "car": car.model_dump(mode="json"),
        "package_version": package_version("fleet-slip"),
    }


def read_labelled(warehouse: Warehouse, names: Sequence[str]) -> list[LabelledDrive]:
    """Return drives with their labels, to train with."""
    with connect(warehouse.root) as database:
        return [read_drive(database, name) for name in names]
