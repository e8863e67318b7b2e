"""Estimators that compete: models of Table I, published models, and Kalman filters.

All filters use the stated noise of the sensors and the file of the vehicle's class, and assume a
dry road and the usual load. `ekf_informed` uses the true vehicle and road. Tuned filters have the
parameters with the smallest error on drives that the regression was trained on.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.base import pluralize, sha256_of
from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.columns.drive_columns import as_counts
from fleet_slip.config import Config
from fleet_slip.errors import ConfigError, DataError
from fleet_slip.evaluation import ekf, kalman
from fleet_slip.evaluation.evaluated_drives import LabelledDrive, TestDrive, read_drives
from fleet_slip.evaluation.evaluator import Estimator
from fleet_slip.evaluation.identify import IdentifiedVehicle, TuningResult, identify, tune
from fleet_slip.evaluation.kalman import measured_speed_mps
from fleet_slip.grams.cohort import Cohort, load_cohort
from fleet_slip.models.predict import Predictor
from fleet_slip.models.registry import ModelVersion
from fleet_slip.models.request import load_model_list
from fleet_slip.models.select import select
from fleet_slip.models.summary import Selection
from fleet_slip.resources import Configs
from fleet_slip.simulation.sensors import SAMPLE_RATE_HZ
from fleet_slip.storage.documents import DocumentFolder
from fleet_slip.storage.runs import LOGGER
from fleet_slip.vehicle.parameters import VehicleMeasures, VehicleParameters, load_vehicle
from fleet_slip.warehouse.warehouse import Warehouse

TABLE_ONE = "table1"
"""The model list with the paper's five sets of signals."""

EstimatorBank = dict[str, tuple[Estimator[TestDrive], dict[str, Any]]]
"""Estimators by name, each with its description in a document."""


def linear_estimate(
    intercept: float, coefficients: Mapping[str, float], drive: TestDrive
) -> FloatArray:
    """Return intercept in rad + sum of coefficient times SI column; NaN where one is null."""
    terms = [weight * drive.columns[column] for column, weight in coefficients.items()]
    total: FloatArray = np.sum(terms, axis=0) + intercept
    return total


def published_estimate(
    signals: SignalCatalog, predictor: Predictor, drive: TestDrive
) -> FloatArray:
    """Return the estimate of a model on counts: the integers that its Gram rows are made of."""
    names = predictor.plan.signals
    return predictor(as_counts(signals, drive.columns, names, drive.vehicle_attributes))


@dataclass(frozen=True)
class TrainedModels:
    """A published model, and the five models of Table I on the cohort that it was trained on."""

    version: ModelVersion
    selection: Selection

    @property
    def table_one(self) -> dict[str, str]:
        """Estimator names of the models of Table I whose signals the cohort has."""
        return {row.name: f"{self.version.reference}/{row.name}" for row in self.selection.models}

    def bank(self) -> EstimatorBank:
        """Return the models of Table I, then the published one."""
        version, manifest, cohort = self.version, self.version.manifest, self.selection.cohort
        common = {
            "kind": "regression",
            "group": version.reference,
            "cohort": cohort.predicate.text,
            "drives": cohort.drives.num_rows,
            "rows": cohort.rows,
        }
        signals = version.catalog.signals
        bank: EstimatorBank = {}
        for name, model in zip(self.table_one.values(), self.selection.models, strict=True):
            offset, weights = model.model.offset, model.model.weights
            coefficients = {signals[signal].column: weight for signal, weight in weights.items()}
            bank[name] = (
                partial(linear_estimate, offset, coefficients),
                {
                    **common,
                    "table_one": model.name,
                    "signals": list(model.signals),
                    "cross_validated": model.pooled.as_dict(),
                    "intercept": offset,
                    "coefficients": coefficients,
                },
            )
        bank[version.reference] = (
            partial(published_estimate, signals, Predictor.from_manifest(signals, manifest)),
            {
                **common,
                "published": version.reference,
                "sha256": version.sha256,
                "signals": list(manifest.signals),
                "cross_validated": manifest.cross_validation.model_dump(mode="json"),
                "intercept": manifest.intercept,
                "coefficients": {term.column: term.coefficient for term in manifest.terms},
                "columns": {
                    term.signal: term.definition.model_dump(mode="json")
                    if term.definition
                    else term.sql
                    for term in manifest.terms
                    if not term.logged
                },
            },
        )
        return bank


def train_models(warehouse: Warehouse, version: ModelVersion) -> TrainedModels:
    """Fit Table I on a published model's cohort as it is now. Raises `DataError` if it is empty."""
    cohort = load_cohort(warehouse, version.manifest.trained_on.cohort)
    models = load_model_list(warehouse.catalog, TABLE_ONE)
    return TrainedModels(version, select(cohort, models))


GROUP = "filters and observers"


class Filter(NamedTuple):
    """A filter: its name among the estimators, and its module.

    Filters of one module share tuned parameters. A module has the function `estimate`, parameters
    to begin a search with, `STARTS`, of which the first are the default, and those to search,
    `TUNABLE`.
    """

    name: str
    module: Any
    gps: bool = False
    """True if it needs satellite navigation."""
    informed: bool = False
    """True if it uses the scenario's own load, tyres and road."""

    @property
    def module_name(self) -> str:
        """Name of its module."""
        return str(self.module.__name__).rpartition(".")[2]

    @property
    def default(self) -> Config:
        """Default parameters."""
        default: Config = self.module.STARTS[0]
        return default

    def tune(
        self, drives: Sequence[LabelledDrive], car: VehicleParameters, executor: Executor
    ) -> TuningResult[Config]:
        """Return the best parameters over all starts."""
        estimate, names = self.module.estimate, self.module.TUNABLE
        starts = self.module.STARTS
        results = [tune(estimate, start, names, drives, car, executor) for start in starts]
        return min(results, key=lambda result: result.rmse_rad)


FILTERS = (
    Filter("kalman", kalman, gps=True),
    Filter("ekf_class", ekf),
    Filter("ekf_informed", ekf, informed=True),
)


@dataclass(frozen=True)
class FilterEstimate:
    """A filter with its parameters, in the car of each drive."""

    filter: Filter
    parameters: Config
    with_mass: bool = False
    """True to use the stated mass of a car, as the model under comparison does."""

    def car(self, drive: TestDrive) -> VehicleParameters:
        """Return the car of a drive, as the filter assumes it."""
        scenario = drive.scenario
        if self.filter.informed:
            return scenario.car
        if self.with_mass:
            return scenario.vehicle.with_sprung_mass(scenario.car.body.sprung_mass_kg)
        return scenario.vehicle

    def __call__(self, drive: TestDrive) -> FloatArray:
        """Return the estimate at each tick, at the reference point of the car."""
        car, parameters = self.car(drive), self.parameters
        if self.filter.informed:
            parameters = parameters.model_copy(update={"adhesion": drive.scenario.adhesion})
        angle_rad: FloatArray = self.filter.module.estimate(drive.signals, car, parameters)
        if not (reference_m := car.body.reference_m):
            return angle_rad
        speed_mps = np.maximum(measured_speed_mps(drive.signals, car), 1.0)
        return angle_rad + reference_m * drive.signals.yaw_rate_rad_s / speed_mps

    def on_labelled(self, default_car: VehicleParameters, drive: LabelledDrive) -> FloatArray:
        """Return the estimate of a drive of the logs, at each row."""
        car = drive.car or default_car
        angle_rad: FloatArray = self.filter.module.estimate(drive.signals, car, self.parameters)
        return angle_rad

    def description(self) -> dict[str, Any]:
        """Return its description in a document."""
        return {
            "kind": "filter",
            "group": GROUP,
            "gps": self.filter.gps,
            "told": "everything" if self.filter.informed else "class",
            "weighed": self.with_mass,
            "parameters": self.parameters.model_dump(mode="json"),
        }


def restore_filter(name: str, about: Mapping[str, Any]) -> FilterEstimate:
    """Restore a filter from its name among the estimators and its description in a document."""
    (kind,) = (kind for kind in FILTERS if kind.name == name.removesuffix("_tuned"))
    parameters = type(kind.default).model_validate(about["parameters"])
    return FilterEstimate(kind, parameters, about.get("weighed", False))


def filter_bank(
    stored: Mapping[str, Any], drives: Sequence[LabelledDrive], *, with_mass: bool
) -> EstimatorBank:
    """Return each filter with default and with tuned parameters, and one in an identified car.

    `stored` is of `load_or_tune`. A filter for which the drives lack a signal is not tuned, and a
    warning names it.
    """
    for failure in stored["failing"]:
        LOGGER.warning("%s", failure)
    bank: EstimatorBank = {}
    if stored["cars"]:
        cars = {name: IdentifiedVehicle.load(content) for name, content in stored["cars"].items()}
        about = {"kind": "filter", "group": GROUP, "gps": False, "told": "labelled drives"}
        about |= {"parameters": stored["cars"]}
        bank[IDENTIFIED_NAME] = partial(identified_estimate, cars), about
    for kind in FILTERS:
        default = tuned = FilterEstimate(kind, kind.default, with_mass)
        bank[kind.name], names = (default, default.description()), []
        if best := stored["parameters"].get(kind.module_name):
            names = [drive.name for drive in drives]
            tuned = replace(default, parameters=type(kind.default).model_validate(best))
        bank[f"{kind.name}_tuned"] = tuned, {**tuned.description(), "tuned_on": names}
    return bank


IDENTIFIED_NAME = "ekf_identified"
"""The extended Kalman filter in a car that was identified from the training drives of a model, with
scales, a tape measure and labelled drives."""

DRIVES_OF_A_CLASS = 12
"""Drives of each class of cars; a dozen give as good a car in half the time."""


def identified_estimate(cars: Mapping[str, IdentifiedVehicle], drive: TestDrive) -> FloatArray:
    """Return the filter's estimate in the identified car of a drive's class, or in the first."""
    default = next(iter(cars.values()))
    return cars.get(drive.scenario.vehicle.name, default).estimate_drive(drive)


def checksum_of_sources(folder: Path = Path(__file__).parent) -> str:
    """Return the SHA-256 of the modules of a folder, by default of all that tuning depends on."""
    modules = sorted(folder.glob("*.py"))
    return sha256_of("\0".join(module.read_text(encoding="utf-8") for module in modules))


T = TypeVar("T")


def choose_evenly(items: Sequence[T], count: int) -> list[T]:
    """Choose `count` items in their order, evenly apart, or all if there are fewer."""
    places = np.linspace(0, len(items) - 1, min(count, len(items))).round()
    return [items[int(place)] for place in places]


TUNING_DRIVES = 24
"""Drives of the cohort that parameters are tuned on, evenly chosen."""

TUNING_S = 120
"""Length of the beginning of each tuning drive."""


def read_tuning_drives(
    warehouse: Warehouse, cohort: Cohort, *, with_mass: bool = False
) -> list[LabelledDrive]:
    """Read the beginnings of drives of a cohort, evenly chosen, in the cars of their classes.

    `with_mass`: with the stated mass of each car. Biases of the sensors are unknown.
    """
    names = sorted(set(cohort.drives["drive_id"].to_pylist()))
    drives = []
    for drive in read_drives(warehouse, choose_evenly(names, TUNING_DRIVES)):
        model, mass_kg = _class_of(drive, with_mass)
        car = class_car(model, mass_kg, warehouse.configs)
        drives.append(replace(drive.beginning(TUNING_S * SAMPLE_RATE_HZ), car=car))
    return drives


def _class_of(drive: LabelledDrive, with_mass: bool) -> tuple[str, float | None]:
    """Return the vehicle model of a drive, and its mass if filters use it."""
    mass_kg = drive.rows["mass_kg"][0].as_py() if with_mass else None
    return drive.rows["vehicle_model"][0].as_py(), mass_kg


def load_or_tune(
    warehouse: Warehouse,
    drives: Sequence[LabelledDrive],
    car: VehicleParameters,
    executor: Executor,
    *,
    with_mass: bool,
) -> Mapping[str, Any]:
    """Return the parameters stored below `tuned/`, or tune and store them.

    The document has `parameters` by module, the identified `cars` by vehicle model, and a message
    for each failure: a fix, wheel speeds, steering or a label is missing (`failing`).
    """
    keys = [[drive.name, *_class_of(drive, with_mass)] for drive in drives]
    key = {
        "drives": [TUNING_S, *keys],
        "car": car.model_dump(mode="json"),
        "program": checksum_of_sources(),
    }
    folder = DocumentFolder(warehouse.root, "tuned")
    for number in reversed(folder.numbers()):
        stored = folder.read(number).content
        if stored["key"] == key:
            return stored
    LOGGER.info(
        "tuning filters and identifying the car on %s, once", pluralize(len(drives), "drive")
    )
    cars: dict[str, Any] = {}
    parameters: dict[str, Any] = {}
    failures: list[str] = []
    try:
        models = [_class_of(drive, with_mass)[0] for drive in drives if drive.car]
        for model in sorted(set(models)):
            measures = VehicleMeasures.of_vehicle(load_vehicle(model, warehouse.configs))
            of_class = [drive for drive in drives if _class_of(drive, with_mass)[0] == model]
            chosen = choose_evenly(of_class, DRIVES_OF_A_CLASS)
            cars[model] = identify(measures, chosen, executor).dump()
    except DataError as error:
        failures.append(f"no car can be identified: {error}")
    for kind in {kind.module_name: kind for kind in reversed(FILTERS)}.values():
        try:
            best = kind.tune(drives, car, executor)
            parameters[kind.module_name] = best.parameters.model_dump(mode="json")
        except DataError as error:
            failures.append(f"{kind.name} left untuned: {error}")
    content = {"key": key, "cars": cars, "parameters": parameters, "failing": failures}
    return folder.append(content).content


def class_car(model: str, mass_kg: float | None, configs: Configs) -> VehicleParameters | None:
    """Return the car of a class's file, with its stated mass; None without a file."""
    try:
        car = load_vehicle(model, configs)
    except ConfigError:
        return None
    return car if mass_kg is None else car.with_sprung_mass(mass_kg)
