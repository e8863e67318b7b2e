"""The Kalman filters as rivals of the regression, as they are and tuned.

All know the sensors' stated noise, and the class of the car that they are in, by its file; they
take the road for dry and the load for the usual one. `ekf_told` knows the very car and the road.
The tuned ones have the parameters that suit drives which the regression was trained on best.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.base import number_of
from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.columns.drive_columns import as_counts
from fleet_slip.config import Config
from fleet_slip.errors import ConfigError, DataError
from fleet_slip.evaluation import ekf, kalman
from fleet_slip.evaluation.drives import EvaluatedDrive
from fleet_slip.evaluation.identify import (
    Identified,
    Measured,
    Tuned,
    checksum_of_sources,
    identify,
    tune,
)
from fleet_slip.evaluation.judge import Estimate, Signals
from fleet_slip.evaluation.single_track import (
    DriveSignals,
    LabelledDrive,
    measured_speed_mps,
    read_drive,
)
from fleet_slip.grams.cohort import Cohort, load_cohort
from fleet_slip.models.predict import Predictor
from fleet_slip.models.registry import ModelVersion
from fleet_slip.models.request import load_model_list
from fleet_slip.models.select import Selection, select
from fleet_slip.resources import Configs
from fleet_slip.simulation.sensors import SAMPLE_RATE_HZ
from fleet_slip.storage.documents import DocumentFolder
from fleet_slip.storage.runs import LOGGER
from fleet_slip.vehicle.parameters import VehicleParameters, load_vehicle
from fleet_slip.views import open_views
from fleet_slip.warehouse.tables import Warehouse

TABLE_ONE = "table1"
"""The model list with the paper's five sets of signals."""

Bank = dict[str, tuple[Estimate, dict[str, Any]]]
"""Estimators by name, and what a document says of each."""


@dataclass(frozen=True)
class LinearEstimate:
    """An intercept in rad and a coefficient for each SI column; a null leaves no estimate."""

    intercept: float
    coefficients: Mapping[str, float]

    def __call__(self, signals: Signals) -> FloatArray:
        """Return intercept + sum of coefficient times signal."""
        terms = [weight * signals[column] for column, weight in self.coefficients.items()]
        total: FloatArray = np.sum(terms, axis=0) + self.intercept
        return total


@dataclass(frozen=True)
class PublishedEstimate:
    """A published model, sample by sample as a car drives.

    It sees counts, as an ECU does: the columns are the integers that its Gram rows are made of.
    `facts` are what the car knows of itself; `signal_catalog` has the scales of the counts.
    """

    signal_catalog: SignalCatalog
    predictor: Predictor
    facts: Mapping[str, Any] = field(default_factory=dict)

    def in_drive(self, drive: EvaluatedDrive) -> "PublishedEstimate":
        """Return the estimator in the car of a drive, which knows its facts."""
        return replace(self, facts=drive.facts)

    def __call__(self, signals: Signals) -> FloatArray:
        """Return the estimate at each tick; there is one row for every tick."""
        names = self.predictor.plan.signals
        return self.predictor(as_counts(self.signal_catalog, signals, names, self.facts))


@dataclass(frozen=True)
class TrainedModels:
    """A published model, and the five models of Table I on the cohort that it was trained on."""

    version: ModelVersion
    selection: Selection

    @property
    def table_one(self) -> dict[str, str]:
        """Return the estimator's name of each model of Table I that the cohort can serve."""
        return {one.name: f"{self.version.reference}/{one.name}" for one in self.selection.models}

    def bank(self) -> Bank:
        """Return the models of Table I, then the published one."""
        version, manifest = self.version, self.version.manifest
        trained = {
            "kind": "regression",
            "group": version.reference,
            "cohort": self.selection.cohort.condition.text,
            "drives": self.selection.cohort.drives.num_rows,
            "rows": self.selection.cohort.rows,
        }
        signals = version.catalog.signals
        bank: Bank = {}
        for name, model in zip(self.table_one.values(), self.selection.models, strict=True):
            weights = {signals[name].column: one for name, one in model.model.weights.items()}
            fitted = LinearEstimate(model.model.offset, weights)
            about = {
                **trained,
                "table_one": model.name,
                "signals": list(model.signals),
                "cross_validated": model.pooled.as_dict(),
                "intercept": fitted.intercept,
                "coefficients": dict(fitted.coefficients),
            }
            bank[name] = fitted, about
        about = {
            **trained,
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
        published = PublishedEstimate(signals, Predictor.of(signals, manifest))
        bank[version.reference] = published, about
        return bank


def train_models(warehouse: Warehouse, version: ModelVersion) -> TrainedModels:
    """Fit Table I on a published model's cohort as it is now. Raises `DataError` if it is empty."""
    cohort = load_cohort(warehouse, version.manifest.trained_on.cohort)
    models = load_model_list(warehouse.catalog, TABLE_ONE)
    return TrainedModels(version, select(cohort, models.model, models.folds))


GROUP = "filters and observers"


@dataclass(frozen=True)
class Filter:
    """One estimator of `comparison.observers`, its parameters as they are, and which to tune.

    Attributes:
        name: among the estimators.
        module: whose it is; filters of one module share what is tuned.
        gps: whether it needs satellite navigation.
        informed: whether it knows the scenario's own load, tyres and road.
    """

    name: str
    module: str
    estimate: Callable[[DriveSignals, VehicleParameters, Any], FloatArray]
    parameters: Config
    tunable: tuple[str, ...]
    gps: bool = False
    informed: bool = False
    other_starts: tuple[Config, ...] = ()
    """Where the search for parameters begins besides."""

    def tune(
        self, drives: Sequence[LabelledDrive], car: VehicleParameters, executor: Executor
    ) -> Tuned[Config]:
        """Return the best that any start leads to."""
        return min(
            (
                tune(self.estimate, start, self.tunable, drives, car, executor)
                for start in (self.parameters, *self.other_starts)
            ),
            key=lambda one: one.rmse_rad,
        )


LOOSE_EKF = ekf.EkfNoise(
    lateral_model_std_mps2=2.0, yaw_model_std_rad_s2=2.0, ay_bias_std_mps2=0.01
)
"""Believes in no bias and little in its model, as suits cars that are not as their class."""

FILTERS = (
    Filter("kalman", "kalman", kalman.estimate, kalman.FilterNoise(), kalman.TUNABLE, gps=True),
    Filter(
        "ekf_class", "ekf", ekf.estimate, ekf.EkfNoise(), ekf.TUNABLE, other_starts=(LOOSE_EKF,)
    ),
    Filter(
        "ekf_told", "ekf", ekf.estimate, ekf.EkfNoise(), ekf.TUNABLE, informed=True,
        other_starts=(LOOSE_EKF,),
    ),
)  # fmt: skip


@dataclass(frozen=True)
class FilterEstimate:
    """A filter with its parameters, in a car, as an estimator of a drive's signals."""

    filter: Filter
    parameters: Config
    car: VehicleParameters
    weighed: bool = False
    """Whether it knows a car's mass, as the model that it competes with does."""

    def in_drive(self, drive: EvaluatedDrive) -> "FilterEstimate":
        """Return the filter with what it knows of the car, and of the road if it is informed."""
        scenario = drive.scenario
        if self.filter.informed:
            parameters = self.parameters.model_copy(update={"adhesion": scenario.adhesion})
            return replace(self, car=scenario.car, parameters=parameters)
        car = scenario.vehicle
        if self.weighed:
            car = car.with_sprung_mass(scenario.car.body.sprung_mass_kg)
        return replace(self, car=car)

    def __call__(self, signals: Signals) -> FloatArray:
        """Return the estimate at each tick, where the car's angle is meant."""
        drive = seen(signals)
        angle_rad = self.filter.estimate(drive, self.car, self.parameters)
        if not (reference_m := self.car.body.reference_m):
            return angle_rad
        return angle_rad + reference_m * drive.yaw_rate_rad_s / np.maximum(
            measured_speed_mps(drive, self.car), 1.0
        )

    def description(self) -> dict[str, Any]:
        """Return what a JSON document says of it."""
        return {
            "kind": "filter",
            "group": GROUP,
            "gps": self.filter.gps,
            "told": "everything" if self.filter.informed else "class",
            "weighed": self.weighed,
            "parameters": self.parameters.model_dump(mode="json"),
        }


def seen(signals: Signals) -> DriveSignals:
    """Return what filters see of a drive's signals."""
    return DriveSignals(**{one.name: signals[one.name] for one in fields(DriveSignals)})


def rebuild(name: str, about: Mapping[str, Any], car: VehicleParameters) -> FilterEstimate:
    """Return a filter from its name among the estimators and what a document says of it."""
    (one,) = (one for one in FILTERS if one.name == name.removesuffix("_tuned"))
    parameters = type(one.parameters).model_validate(about["parameters"])
    return FilterEstimate(one, parameters, car, about.get("weighed", False))


def filter_bank(
    drives: "TuningDrives", car: VehicleParameters, executor: Executor, *, weighed: bool = False
) -> Bank:
    """Return each filter as it is and tuned on drives, and the one in a car identified from them.

    A filter that the drives lack something for is not tuned, and a remark says so.
    """
    found = drives.kept_or_tuned(car, executor)
    for failing in found["failing"]:
        LOGGER.warning("%s", failing)
    cars = {model: Identified.load(one) for model, one in found["cars"].items()}
    bank: Bank = {}
    if cars:
        identified = IdentifiedEstimate(cars, next(iter(cars)))
        bank[IDENTIFIED_NAME] = identified, identified.description()
    for one in FILTERS:
        plain = FilterEstimate(one, one.parameters, car, weighed)
        best = found["parameters"].get(one.module)
        parameters = type(one.parameters).model_validate(best) if best else one.parameters
        tuned = replace(plain, parameters=parameters)
        tuned_on = {"tuned_on": drives.names if best else []}
        bank[one.name] = plain, plain.description()
        bank[f"{one.name}_tuned"] = tuned, {**tuned.description(), **tuned_on}
    return bank


# The extended Kalman filter in a car that was identified from the drives a model learned from, as a
# department would build it that has scales, a tape measure and labelled drives.

IDENTIFIED_NAME = "ekf_identified"

DRIVES_OF_A_CLASS = 12
"""Of each class of cars; a dozen give as good a car in half the time."""


@dataclass(frozen=True)
class IdentifiedEstimate:
    """The filter in the identified car of a class; in the first of another class that it knows."""

    cars: Mapping[str, Identified]
    driven: str

    def in_drive(self, drive: EvaluatedDrive) -> "IdentifiedEstimate":
        """Return the filter in the car of a drive."""
        known = drive.scenario.vehicle.name
        return replace(self, driven=known) if known in self.cars else self

    def __call__(self, signals: Signals) -> FloatArray:
        """Return the estimate at each tick."""
        return self.cars[self.driven].estimate(seen(signals))

    def description(self) -> dict[str, Any]:
        """Return what a JSON document says of it."""
        return {
            "kind": "filter",
            "group": GROUP,
            "gps": False,
            "told": "labelled drives",
            "parameters": {name: one.dump() for name, one in self.cars.items()},
        }


T = TypeVar("T")


def choose_evenly(some: Sequence[T], at_most: int) -> list[T]:
    """Return so many of some in their order, evenly apart, or all if they are fewer."""
    places = np.linspace(0, len(some) - 1, min(at_most, len(some))).round()
    return [some[int(place)] for place in places]


TUNING_DRIVES = 24
"""Drives of the cohort that parameters are tuned on, evenly chosen."""

TUNING_S = 120
"""How much of each is taken."""


@dataclass(frozen=True)
class TuningDrives:
    """Drives of a cohort to tune filters on: name, vehicle model, and mass if filters know it."""

    warehouse: Warehouse
    known: tuple[tuple[str, str, float | None], ...]
    _read: list[LabelledDrive] = field(default_factory=list, repr=False, compare=False)

    @classmethod
    def of(cls, warehouse: Warehouse, cohort: Cohort, *, weighed: bool) -> "TuningDrives":
        """Choose drives evenly, by name."""
        rows = cohort.drives.select(["drive_id", "vehicle_model", "mass_kg"]).to_pylist()
        one_each = {row["drive_id"]: row for row in rows}
        chosen = [one_each[name] for name in choose_evenly(sorted(one_each), TUNING_DRIVES)]
        return cls(
            warehouse,
            tuple(
                (row["drive_id"], row["vehicle_model"], row["mass_kg"] if weighed else None)
                for row in chosen
            ),
        )

    @property
    def names(self) -> list[str]:
        """The drives' names."""
        return [name for name, _, _ in self.known]

    def kept_or_tuned(self, car: VehicleParameters, executor: Executor) -> Mapping[str, Any]:
        """Return what suits the drives best, as it was kept below `tuned/`, else found now.

        That is `parameters` by module, the identified `cars` by vehicle model, and what was not
        found for want of a fix, wheel speeds, steering or a label, in words (`failing`).
        """
        key = {
            "drives": [TUNING_S, *(list(known) for known in self.known)],
            "car": car.model_dump(mode="json"),
            "program": checksum_of_sources(),
        }
        folder = DocumentFolder(self.warehouse.root, "tuned")
        documents = (folder.read(number).content for number in reversed(folder.numbers()))
        found = next((content for content in documents if content["key"] == key), None)
        return found or folder.append({"key": key, **self._tuned(car, executor)}).content

    def _tuned(self, car: VehicleParameters, executor: Executor) -> dict[str, Any]:
        many = number_of(len(self.names), "drive")
        LOGGER.info("tuning filters and identifying the car on %s, once", many)
        cars: dict[str, Any] = {}
        parameters: dict[str, Any] = {}
        failing: list[str] = []
        try:
            cars = {model: one.dump() for model, one in self._identified(executor)}
        except DataError as error:
            failing.append(f"no car can be identified: {error}")
        for one in {one.module: one for one in reversed(FILTERS)}.values():
            try:
                best = one.tune(self.read(), car, executor)
                parameters[one.module] = best.parameters.model_dump(mode="json")
            except DataError as error:
                failing.append(f"{one.name} left untuned: {error}")
        return {"cars": cars, "parameters": parameters, "failing": failing}

    def _identified(self, executor: Executor) -> Iterator[tuple[str, Identified]]:
        """Identify each class of cars that has a file. Raises `DataError` as `identify`."""
        of_class: dict[str, list[LabelledDrive]] = {}
        for (_, model, _), drive in zip(self.known, self.read(), strict=True):
            if drive.car is not None:
                of_class.setdefault(model, []).append(replace(drive, car=None))
        for model, own in sorted(of_class.items()):
            some = choose_evenly(own, DRIVES_OF_A_CLASS)
            car = load_vehicle(model, self.warehouse.configs)
            yield model, identify(Measured.of(car), some, executor)

    def read(self) -> Sequence[LabelledDrive]:
        """Return the beginning of each drive, as filters meet it: they know no bias yet."""
        if not self._read:
            signals, configs = self.warehouse.catalog.signals, self.warehouse.configs
            with open_views(self.warehouse, "SELECT 1 FROM log") as database:
                for name, model, mass_kg in self.known:
                    drive = read_drive(signals, database, name)
                    drive = drive.beginning(TUNING_S * SAMPLE_RATE_HZ)
                    self._read.append(replace(drive, car=class_car(model, mass_kg, configs)))
        return self._read


def class_car(model: str, mass_kg: float | None, configs: Configs) -> VehicleParameters | None:
    """Return what a fleet knows of a car: its class's file, and its mass; None without a file."""
    try:
        car = load_vehicle(model, configs)
    except ConfigError:
        return None
    return car if mass_kg is None else car.with_sprung_mass(mass_kg)
