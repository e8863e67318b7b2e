"""The Kalman filter and the observers as rivals of the regression, as they are and tuned.

They know the car of the nominal scenario, on a dry road, and the sensors' stated noise. The tuned
ones have the parameters that suit drives which the regression was trained on best.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, fields
from functools import partial
from importlib.metadata import version as package_version
from typing import Any

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.config import Config
from fleet_slip.evaluation.estimators import Estimate, Signals
from fleet_slip.files.documents import DocumentFolder
from fleet_slip.grams.cohort import Cohort
from fleet_slip.observers import ekf, kalman, luenberger, sliding_mode
from fleet_slip.observers.signals import DriveSignals, LabelledDrive, read_drive
from fleet_slip.observers.tuning import tune
from fleet_slip.vehicle.parameters import VehicleParameters
from fleet_slip.views import connect
from fleet_slip.warehouse.tables import Warehouse

GROUP = "filters and observers"
TUNING_DRIVES = 4
"""Drives of the cohort that parameters are tuned on, evenly chosen."""


@dataclass(frozen=True)
class Filter:
    """One estimator of `fleet_slip.observers`, its parameters as they are, and which to tune."""

    name: str
    estimate: Callable[[DriveSignals, VehicleParameters, Any], FloatArray]
    parameters: Config
    tunable: tuple[str, ...]


FILTERS = (
    Filter("kalman", kalman.estimate, kalman.FilterNoise(), kalman.TUNABLE),
    Filter("ekf", ekf.estimate, ekf.EkfNoise(), ekf.TUNABLE),
    Filter("luenberger", luenberger.estimate, luenberger.ObserverPoles(), luenberger.TUNABLE),
    Filter(
        "sliding_mode", sliding_mode.estimate, sliding_mode.SlidingGains(), sliding_mode.TUNABLE
    ),
)


def bound(one: Filter, parameters: Config, car: VehicleParameters) -> Estimate:
    """Return a filter as an estimator of a drive's signals."""
    return partial(_estimate, one, parameters, car)


def _estimate(
    one: Filter, parameters: Config, car: VehicleParameters, signals: Signals
) -> FloatArray:
    seen = DriveSignals(**{field.name: signals[field.name] for field in fields(DriveSignals)})
    return one.estimate(seen, car, parameters)


@dataclass(frozen=True)
class Bank:
    """All filters with the parameters that they have, by name."""

    estimators: dict[str, Estimate]
    descriptions: dict[str, dict[str, Any]]


def filter_bank(
    warehouse: Warehouse, cohort: Cohort, car: VehicleParameters, executor: Executor
) -> Bank:
    """Return each filter as it is and tuned on drives of a cohort.

    Tuned parameters are kept below `tuned/` in the data root, and sought again only for other
    drives, another car or another program.
    """
    chosen = tuning_drives(cohort)
    drives: list[LabelledDrive] = []
    bank = Bank({}, {})
    for one in FILTERS:
        key = _key(one, chosen, car)
        found = _kept(warehouse, one, key)
        if found is None:
            drives = drives or _read(warehouse, chosen)
            found = _tune(warehouse, one, key, drives, car, executor)
        tuned = type(one.parameters).model_validate(found["parameters"])
        for name, parameters in ((one.name, one.parameters), (f"{one.name}_tuned", tuned)):
            bank.estimators[name] = bound(one, parameters, car)
            bank.descriptions[name] = {
                "kind": "filter",
                "group": GROUP,
                "car": car.name,
                "parameters": parameters.model_dump(mode="json"),
            }
        bank.descriptions[f"{one.name}_tuned"]["tuned_on"] = list(chosen)
    return bank


def tuning_drives(cohort: Cohort) -> tuple[str, ...]:
    """Return the names of the drives of a cohort that filters are tuned on."""
    names = sorted(set(cohort.drives["drive_id"].to_pylist()))
    count = min(TUNING_DRIVES, len(names))
    places = np.linspace(0, len(names) - 1, count).round().astype(int)
    return tuple(names[place] for place in places)


def _key(one: Filter, drives: Sequence[str], car: VehicleParameters) -> dict[str, Any]:
    """Return what tuned parameters depend on."""
    return {
        "start": one.parameters.model_dump(mode="json"),
        "tunable": list(one.tunable),
        "drives": list(drives),
        "car": car.model_dump(mode="json"),
        "package_version": package_version("fleet-slip"),
    }


def _folder(warehouse: Warehouse, one: Filter) -> DocumentFolder:
    return DocumentFolder(warehouse.root / "tuned" / one.name)


def _kept(warehouse: Warehouse, one: Filter, key: dict[str, Any]) -> dict[str, Any] | None:
    folder = _folder(warehouse, one)
    for number in reversed(folder.numbers()):
        content = dict(folder.read(number).content)
        if content["key"] == key:
            return content
    return None


def _tune(
    warehouse: Warehouse,
    one: Filter,
    key: dict[str, Any],
    drives: Sequence[LabelledDrive],
    car: VehicleParameters,
    executor: Executor,
) -> dict[str, Any]:
    found = tune(one.estimate, one.parameters, one.tunable, drives, car, executor)
    content = {
        "key": key,
        "parameters": found.parameters.model_dump(mode="json"),
        "error_std_deg": float(np.degrees(found.error_std_rad)),
        "evaluations": found.evaluations,
    }
    _folder(warehouse, one).append(content)
    return content


def _read(warehouse: Warehouse, names: Sequence[str]) -> list[LabelledDrive]:
    with connect(warehouse.root) as database:
        return [read_drive(database, name) for name in names]
