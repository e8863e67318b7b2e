"""The Kalman filters as rivals of the regression, as they are and tuned.

All know the sensors' stated noise, and the class of the car that they are in, by its file; they
take the road for dry and the load for the usual one. `ekf_told` is told the very car and the road.
The tuned ones have the parameters that suit drives which the regression was trained on best.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.base import number_of
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.columns.drive_columns import as_counts
from fleet_slip.config import Config
from fleet_slip.errors import ConfigError, DataError
from fleet_slip.evaluation import ekf, kalman
from fleet_slip.evaluation.drives import EvaluatedDrive
from fleet_slip.evaluation.identify import Tuned, checksum_of_sources, tune
from fleet_slip.evaluation.single_track import DriveSignals, LabelledDrive, read_drive
from fleet_slip.grams.cohort import Cohort, load_cohort
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.predict import Predictor
from fleet_slip.models.registry import ModelVersion
from fleet_slip.models.request import load_model_list
from fleet_slip.models.select import Selection, select
from fleet_slip.regression.least_squares import LinearModel
from fleet_slip.simulation.sensors import SAMPLE_RATE_HZ
from fleet_slip.storage.documents import DocumentFolder
from fleet_slip.storage.runs import LOGGER
from fleet_slip.vehicle.parameters import VehicleParameters, load_vehicle
from fleet_slip.views import connect
from fleet_slip.warehouse.tables import Warehouse

# What is evaluated: anything that turns a drive's signals into side-slip angles.

Signals = Mapping[str, FloatArray]
"""One drive at 100 Hz: an array of shape (ticks,) for each SI column; NaN where null."""

Estimate = Callable[[Signals], FloatArray]
"""Side-slip angle in rad at every tick, shape (ticks,); NaN where there is no estimate."""

TABLE_ONE = "table1"
"""The model list with the paper's five sets of signals."""


@dataclass(frozen=True)
class LinearEstimate:
    """An intercept in rad and a coefficient for each SI column; a null leaves no estimate."""

    intercept: float
    coefficients: Mapping[str, float]

    @classmethod
    def of(cls, model: LinearModel) -> "LinearEstimate":
        """Return the estimator of a model of physical values."""
        weights = model.weights
        return cls(model.offset, {catalogue()[name].column: weights[name] for name in weights})

    @classmethod
    def published(cls, manifest: Manifest) -> "LinearEstimate":
        """Return the estimator that a manifest of logged signals publishes."""
        return cls(manifest.intercept, {term.column: term.coefficient for term in manifest.terms})

    def __call__(self, signals: Signals) -> FloatArray:
        """Return intercept + sum of coefficient times signal."""
        terms = [weight * signals[column] for column, weight in self.coefficients.items()]
        total: FloatArray = np.sum(terms, axis=0) + self.intercept
        return total

    def as_dict(self) -> dict[str, Any]:
        """Return what a JSON document needs to compute the same estimates."""
        return {"intercept": self.intercept, "coefficients": dict(self.coefficients)}


@dataclass(frozen=True)
class ColumnEstimate:
    """A published model with features or columns over time, sample by sample as a car drives.

    It sees counts, as an ECU does: the columns are the integers that its Gram rows are made of.

    Attributes:
        manifest: what was published.
        predictor: what computes it.
        facts: what the car knows of itself.
    """

    manifest: Manifest
    predictor: Predictor
    facts: Mapping[str, Any] = field(default_factory=dict)

    def in_drive(self, drive: EvaluatedDrive) -> "ColumnEstimate":
        """Return the estimator in the car of a drive, which knows its facts."""
        return replace(self, facts=drive.facts)

    def __call__(self, signals: Signals) -> FloatArray:
        """Return the estimate at each tick; there is one row for every tick."""
        return self.predictor(as_counts(signals, self.predictor.plan.signals, self.facts))

    def as_dict(self) -> dict[str, Any]:
        """Return what a JSON document needs to compute the same estimates."""
        return {
            "intercept": self.manifest.intercept,
            "coefficients": {term.column: term.coefficient for term in self.manifest.terms},
            "columns": {
                term.signal: term.definition.model_dump(mode="json")
                if term.definition
                else term.sql
                for term in self.manifest.terms
                if not term.logged
            },
        }


def published_estimate(manifest: Manifest) -> LinearEstimate | ColumnEstimate:
    """Return the estimator that a manifest publishes. Raises `RefusedError` if counts changed."""
    if all(term.logged for term in manifest.terms):
        return LinearEstimate.published(manifest)
    return ColumnEstimate(manifest, Predictor.of(manifest))


@dataclass(frozen=True)
class TrainedModels:
    """A published model, and the five models of Table I on the cohort that it was trained on."""

    version: ModelVersion
    selection: Selection

    @property
    def table_one(self) -> dict[str, str]:
        """Return the estimator's name of each model of Table I that the cohort can serve."""
        return {one.name: f"{self.version.reference}/{one.name}" for one in self.selection.models}

    def linear_estimators(self) -> dict[str, LinearEstimate]:
        """Return the models of Table I by name."""
        models = zip(self.table_one.values(), self.selection.models, strict=True)
        return {name: LinearEstimate.of(one.model) for name, one in models}

    def estimators(self) -> dict[str, LinearEstimate | ColumnEstimate]:
        """Return the models of Table I, then the published one, by name."""
        published = published_estimate(self.version.manifest)
        return {**self.linear_estimators(), self.version.reference: published}

    def descriptions(self) -> dict[str, dict[str, Any]]:
        """Return what a JSON document says of each estimator."""
        estimators = self.estimators()
        trained = {
            "kind": "regression",
            "group": self.version.reference,
            "cohort": self.selection.cohort.condition.text,
            "drives": self.selection.cohort.drives.num_rows,
            "rows": self.selection.cohort.rows,
        }
        fitted = {
            self.table_one[model.name]: {
                **trained,
                "table_one": model.name,
                "signals": list(model.signals),
                "cross_validated": model.pooled.as_dict(),
                **estimators[self.table_one[model.name]].as_dict(),
            }
            for model in self.selection.models
        }
        manifest, reference = self.version.manifest, self.version.reference
        published = {
            **trained,
            "published": reference,
            "sha256": self.version.sha256,
            "signals": list(manifest.signals),
            "cross_validated": manifest.cross_validation.model_dump(mode="json"),
            **estimators[reference].as_dict(),
        }
        return {**fitted, reference: published}


def train_models(warehouse: Warehouse, version: ModelVersion) -> TrainedModels:
    """Fit Table I on a published model's cohort as it is now. Raises `DataError` if it is empty."""
    cohort = load_cohort(warehouse, version.manifest.trained_on.cohort)
    models = load_model_list(TABLE_ONE)
    return TrainedModels(version, select(cohort, models.model, models.folds))


GROUP = "filters and observers"


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
        "ekf_told", "ekf", ekf.estimate, ekf.EkfNoise(), ekf.TUNABLE, told=True,
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
        """Return the filter as it is told of the car, and of the road if it is told everything."""
        scenario = drive.scenario
        if not self.filter.told:
            mass_kg = drive.facts["mass_kg"] if self.weighed else None
            car = scenario.vehicle
            return replace(self, car=car if mass_kg is None else car.with_sprung_mass(mass_kg))
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
    warehouse: Warehouse,
    drives: "TuningDrives",
    car: VehicleParameters,
    executor: Executor,
    *,
    weighed: bool = False,
) -> tuple[dict[str, FilterEstimate], dict[str, dict[str, list[str]]]]:
    """Return each filter as it is and tuned on drives, each in the car that made it.

    Beside them stands what each tuned one was `tuned_on`.

    A filter that the drives lack something for is tuned on none, and a remark says so. Tuned
    parameters are kept below `tuned/` in the data root, and sought again only for other
    drives, another car or another program. The best that any start leads to is taken.
    """
    bank: dict[str, FilterEstimate] = {}
    tuned_on: dict[str, dict[str, list[str]]] = {}
    before: dict[str, Config] = {}
    for one in FILTERS:
        key = _key(one, drives, car)
        kept = DocumentFolder(warehouse.root / "tuned" / one.module)
        found = find_kept(kept, key)
        if found is None:
            LOGGER.info("tuning %s on %s, once", one.name, number_of(len(drives.names), "drive"))
            try:
                best = one.tune(drives.read(), car, executor)
                found = {
                    "key": key,
                    "parameters": best.parameters.model_dump(mode="json"),
                    "rmse_deg": float(np.degrees(best.rmse_rad)),
                    "evaluations": best.evaluations,
                }
                kept.append(found)
            except DataError as error:  # its drives have no fix, no wheel speeds, no steering
                LOGGER.warning("%s competes as it is, for it cannot be tuned: %s", one.name, error)
        if found:
            before[one.module] = type(one.parameters).model_validate(found["parameters"])
        tuned = before.get(one.module, one.parameters)
        bank[one.name] = FilterEstimate(one, one.parameters, car, weighed)
        bank[f"{one.name}_tuned"] = FilterEstimate(one, tuned, car, weighed)
        tuned_on[f"{one.name}_tuned"] = {"tuned_on": drives.names if found else []}
    return bank, tuned_on


def _key(one: Filter, drives: "TuningDrives", car: VehicleParameters) -> dict[str, Any]:
    """Return what tuned parameters depend on."""
    return {
        "for_lowest": "rmse_deg",
        "starts": [start.model_dump(mode="json") for start in (one.parameters, *one.other_starts)],
        "tunable": list(one.tunable),
        "drives": drives.key(),
        "car": car.model_dump(mode="json"),
        "program": checksum_of_sources(),
    }


def find_kept(kept: DocumentFolder, key: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the newest document about what was asked; None if there is none."""
    documents = (kept.read(number).content for number in reversed(kept.numbers()))
    return next((content for content in documents if content["key"] == key), None)


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

    def key(self) -> list[Any]:
        """Return what tells these from others, for a JSON document."""
        return [TUNING_S, *(list(known) for known in self.known)]

    def read(self) -> Sequence[LabelledDrive]:
        """Return the beginning of each drive, as filters meet it: they know no bias yet."""
        if not self._read:
            with connect(self.warehouse.root, query="SELECT 1 FROM log") as database:
                for name, model, mass_kg in self.known:
                    drive = read_drive(database, name).beginning(TUNING_S * SAMPLE_RATE_HZ)
                    self._read.append(replace(drive, car=class_car(model, mass_kg)))
        return self._read


def class_car(model: str, mass_kg: float | None) -> VehicleParameters | None:
    """Return what a fleet knows of a car: its class's file, and its mass; None without a file."""
    try:
        car = load_vehicle(model)
    except ConfigError:
        return None
    return car if mass_kg is None else car.with_sprung_mass(mass_kg)
