"""Estimators that compete: models of Table I, published models, and Kalman filters.

All filters use the stated noise of the sensors and the file of the vehicle's class, and assume a
dry road and the usual load. `ekf_informed` uses the true vehicle and road. Tuned filters have the
parameters with the smallest error on drives that the regression was trained on.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
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
from fleet_slip.evaluation.evaluator import Estimator
from fleet_slip.evaluation.identify import IdentifiedVehicle, TuningResult, identify, tune
from fleet_slip.evaluation.labelled_drives import DriveSignals, LabelledDrive, read_drives
from fleet_slip.evaluation.single_track import measured_speed_mps
from fleet_slip.evaluation.test_drives import TestDrive
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
    terms = [weight * drive.signals[column] for column, weight in coefficients.items()]
    total: FloatArray = np.sum(terms, axis=0) + intercept
    return total


def published_estimate(
    signals: SignalCatalog, predictor: Predictor, drive: TestDrive
) -> FloatArray:
    """Return the estimate of a model on counts: the integers that its Gram rows are made of."""
    names = predictor.plan.signals
    return predictor(as_counts(signals, drive.signals, names, drive.vehicle_attributes))


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
        version, manifest = self.version, self.version.manifest
        common = {
            "kind": "regression",
            "group": version.reference,
            "cohort": self.selection.cohort.predicate.text,
            "drives": self.selection.cohort.drives.num_rows,
            "rows": self.selection.cohort.rows,
        }
        signals = version.catalog.signals
        bank: EstimatorBank = {}
        for name, model in zip(self.table_one.values(), self.selection.models, strict=True):
            weights = {
                signals[signal].column: weight for signal, weight in model.model.weights.items()
            }
            about = {
                **common,
                "table_one": model.name,
                "signals": list(model.signals),
                "cross_validated": model.pooled.as_dict(),
                "intercept": model.model.offset,
                "coefficients": weights,
            }
            bank[name] = partial(linear_estimate, model.model.offset, weights), about
        about = {
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
        }
        predictor = Predictor.from_manifest(signals, manifest)
        bank[version.reference] = partial(published_estimate, signals, predictor), about
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
        module = self.module
        return min(
            (
                tune(module.estimate, start, module.TUNABLE, drives, car, executor)
                for start in module.STARTS
            ),
            key=lambda tuned: tuned.rmse_rad,
        )


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
        signals, car, parameters = drive_signals(drive), self.car(drive), self.parameters
        if self.filter.informed:
            parameters = parameters.model_copy(update={"adhesion": drive.scenario.adhesion})
        angle_rad: FloatArray = self.filter.module.estimate(signals, car, parameters)
        if not (reference_m := car.body.reference_m):
            return angle_rad
        speed_mps = np.maximum(measured_speed_mps(signals, car), 1.0)
        return angle_rad + reference_m * signals.yaw_rate_rad_s / speed_mps

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


def drive_signals(drive: TestDrive) -> DriveSignals:
    """Return the signals of a drive that filters read."""
    names = (column.name for column in fields(DriveSignals))
    return DriveSignals(**{name: drive.signals[name] for name in names})


def restore_filter(name: str, about: Mapping[str, Any]) -> FilterEstimate:
    """Restore a filter from its name among the estimators and its description in a document."""
    (kind,) = (kind for kind in FILTERS if kind.name == name.removesuffix("_tuned"))
    parameters = type(kind.default).model_validate(about["parameters"])
    return FilterEstimate(kind, parameters, about.get("weighed", False))


def filter_bank(
    drives: "TuningDrives", car: VehicleParameters, executor: Executor
) -> EstimatorBank:
    """Return each filter with default and with tuned parameters, and one in an identified car.

    A filter for which the drives lack a signal is not tuned, and a warning names it.
    """
    stored = drives.load_or_tune(car, executor)
    for failure in stored["failing"]:
        LOGGER.warning("%s", failure)
    bank: EstimatorBank = {}
    if stored["cars"]:
        cars = {name: IdentifiedVehicle.load(content) for name, content in stored["cars"].items()}
        about = {"kind": "filter", "group": GROUP, "gps": False, "told": "labelled drives"}
        about |= {"parameters": {name: car.dump() for name, car in cars.items()}}
        bank[IDENTIFIED_NAME] = partial(identified_estimate, cars), about
    for kind in FILTERS:
        default = FilterEstimate(kind, kind.default, drives.with_mass)
        best = stored["parameters"].get(kind.module_name)
        parameters = type(kind.default).model_validate(best) if best else kind.default
        tuned = replace(default, parameters=parameters)
        tuned_on = {"tuned_on": drives.names if best else []}
        bank[kind.name] = default, default.description()
        bank[f"{kind.name}_tuned"] = tuned, {**tuned.description(), **tuned_on}
    return bank


# The extended Kalman filter in a car that was identified from the training drives of a model, with
# scales, a tape measure and labelled drives.

IDENTIFIED_NAME = "ekf_identified"

DRIVES_OF_A_CLASS = 12
"""Drives of each class of cars; a dozen give as good a car in half the time."""


def identified_estimate(cars: Mapping[str, IdentifiedVehicle], drive: TestDrive) -> FloatArray:
    """Return the filter's estimate in the identified car of a drive's class, or in the first."""
    default = next(iter(cars.values()))
    return cars.get(drive.scenario.vehicle.name, default).estimate(drive_signals(drive))


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


@dataclass(frozen=True)
class TuningDrives:
    """Drives of a cohort to tune filters on: name, vehicle model, and mass if filters use it."""

    warehouse: Warehouse
    keys: tuple[tuple[str, str, float | None], ...]
    with_mass: bool

    @classmethod
    def choose(cls, warehouse: Warehouse, cohort: Cohort, *, with_mass: bool) -> "TuningDrives":
        """Choose drives evenly, by name."""
        columns = cohort.drives.select(["drive_id", "vehicle_model", "mass_kg"])
        rows = {row["drive_id"]: row for row in columns.to_pylist()}
        keys = (
            (name, rows[name]["vehicle_model"], rows[name]["mass_kg"] if with_mass else None)
            for name in choose_evenly(sorted(rows), TUNING_DRIVES)
        )
        return cls(warehouse, tuple(keys), with_mass)

    @property
    def names(self) -> list[str]:
        """The drives' names."""
        return [name for name, _, _ in self.keys]

    @cached_property
    def drives(self) -> tuple[LabelledDrive, ...]:
        """The beginning of each drive, as filters meet it: with unknown biases."""
        drives = read_drives(self.warehouse, self.names)
        return tuple(
            replace(
                drive.beginning(TUNING_S * SAMPLE_RATE_HZ),
                car=class_car(model, mass_kg, self.warehouse.configs),
            )
            for drive, (_, model, mass_kg) in zip(drives, self.keys, strict=True)
        )

    def load_or_tune(self, car: VehicleParameters, executor: Executor) -> Mapping[str, Any]:
        """Return the parameters stored below `tuned/`, or tune and store them.

        The document has `parameters` by module, the identified `cars` by vehicle model, and a
        message for each failure: a fix, wheel speeds, steering or a label is missing (`failing`).
        """
        key = {
            "drives": [TUNING_S, *map(list, self.keys)],
            "car": car.model_dump(mode="json"),
            "program": checksum_of_sources(),
        }
        folder = DocumentFolder(self.warehouse.root, "tuned")
        documents = (folder.read(number).content for number in reversed(folder.numbers()))
        stored = next((content for content in documents if content["key"] == key), None)
        return stored or folder.append({"key": key, **self._tuned(car, executor)}).content

    def _tuned(self, car: VehicleParameters, executor: Executor) -> dict[str, Any]:
        drives = pluralize(len(self.names), "drive")
        LOGGER.info("tuning filters and identifying the car on %s, once", drives)
        cars: dict[str, Any] = {}
        parameters: dict[str, Any] = {}
        failures: list[str] = []
        try:
            cars = self._identified(executor)
        except DataError as error:
            failures.append(f"no car can be identified: {error}")
        for kind in {kind.module_name: kind for kind in reversed(FILTERS)}.values():
            try:
                best = kind.tune(self.drives, car, executor)
                parameters[kind.module_name] = best.parameters.model_dump(mode="json")
            except DataError as error:
                failures.append(f"{kind.name} left untuned: {error}")
        return {"cars": cars, "parameters": parameters, "failing": failures}

    def _identified(self, executor: Executor) -> dict[str, Any]:
        """Identify each class of cars that has a file. Raises `DataError` as `identify`."""
        cars = {}
        for model in sorted({model for _, model, _ in self.keys if model}):
            drives = [
                replace(drive, car=None)
                for (_, drive_model, _), drive in zip(self.keys, self.drives, strict=True)
                if drive_model == model and drive.car is not None
            ]
            if drives:
                car = VehicleMeasures.of_vehicle(load_vehicle(model, self.warehouse.configs))
                chosen = choose_evenly(drives, DRIVES_OF_A_CLASS)
                cars[model] = identify(car, chosen, executor).dump()
        return cars


def class_car(model: str, mass_kg: float | None, configs: Configs) -> VehicleParameters | None:
    """Return the car of a class's file, with its stated mass; None without a file."""
    try:
        car = load_vehicle(model, configs)
    except ConfigError:
        return None
    return car if mass_kg is None else car.with_sprung_mass(mass_kg)
