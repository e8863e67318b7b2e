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
from fleet_slip.comparison.evaluation.estimators import Signals
from fleet_slip.comparison.evaluation.evaluated_drives import EvaluatedDrive
from fleet_slip.comparison.observers import ekf, kalman
from fleet_slip.comparison.observers.drive_signals import DriveSignals, LabelledDrive, read_drive
from fleet_slip.comparison.observers.tuning import Tuned, checksum_of_sources, tune
from fleet_slip.config import Config
from fleet_slip.errors import ConfigError, DataError
from fleet_slip.files.documents import DocumentFolder
from fleet_slip.grams.cohorts.gram_cohort import Cohort
from fleet_slip.runs.log import LOGGER
from fleet_slip.simulation.sensing.sensors import SAMPLE_RATE_HZ
from fleet_slip.vehicle.parameters import VehicleParameters, load_vehicle
from fleet_slip.views import connect
from fleet_slip.warehouse.tables import Warehouse
from fleet_slip.words import number_of

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


@dataclass(frozen=True)
class Bank:
    """All filters with the parameters that they have, by name, and the drives they are tuned on."""

    drives: "TuningDrives"
    estimators: dict[str, FilterEstimate]
    descriptions: dict[str, dict[str, Any]]


def filter_bank(
    warehouse: Warehouse,
    cohort: Cohort,
    car: VehicleParameters,
    executor: Executor,
    *,
    weighed: bool = False,
) -> Bank:
    """Return each filter as it is and tuned on drives of a cohort, each in the car that made it.

    A filter that the drives lack something for is tuned on none, and a remark says so. Tuned
    parameters are kept below `tuned/` in the data root, and sought again only for other
    drives, another car or another program. The best that any start leads to is taken.
    """
    drives = TuningDrives.of(warehouse, cohort, weighed=weighed)
    bank = Bank(drives, {}, {})
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
        on = drives.names if found else []
        if found:
            before[one.module] = type(one.parameters).model_validate(found["parameters"])
        tuned = before.get(one.module, one.parameters)
        both = {one.name: one.parameters, f"{one.name}_tuned": tuned}
        for name, parameters in both.items():
            bank.estimators[name] = FilterEstimate(one, parameters, car, weighed)
            bank.descriptions[name] = bank.estimators[name].description()
        bank.descriptions[f"{one.name}_tuned"]["tuned_on"] = on
    return bank


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
