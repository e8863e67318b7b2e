"""All estimators on measured drives with a label, each part of them left out in turn.

On what is left in, columns are chosen by each model's own recipe and fitted, filters tuned and a
car identified: whatever is estimated was seen by none of it, neither by a fit nor by a choice.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from importlib.metadata import version as package_version
from typing import Any

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.config import Config
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.evaluation.belief import YawRateNoise
from fleet_slip.evaluation.belief import estimate as estimate_yaw_rate
from fleet_slip.evaluation.filters import (
    FILTERS,
    TABLE_ONE,
    TUNING_DRIVES,
    TUNING_S,
    Filter,
    choose_evenly,
    class_car,
)
from fleet_slip.evaluation.identify import IDENTIFIED, Fitted, Identified, Measured, identify
from fleet_slip.evaluation.judge import JudgedDrive, judge, spread_over
from fleet_slip.evaluation.left_out import (
    QUARTERS,
    HeldOutDrive,
    Learner,
    LeftOut,
    kinds_to_leave_out,
    parts_to_leave_out,
    predict_drive,
    read_measured_drives,
)
from fleet_slip.evaluation.single_track import (
    STEP_S,
    DriveSignals,
    LabelledDrive,
    follow,
    measured_speed_mps,
    without_rest,
)
from fleet_slip.grams.cohort import Cohort, load_cohort
from fleet_slip.grams.expansion import CarCounts
from fleet_slip.models.predict import Predictor
from fleet_slip.models.prior import simulate_prior
from fleet_slip.models.publish import recipe_of
from fleet_slip.models.registry import ModelVersion, Registry
from fleet_slip.models.request import SelectionRequest, load_model_list
from fleet_slip.models.score import calibrated_cars, find_seen
from fleet_slip.simulation.campaign import Campaign, load_campaign
from fleet_slip.simulation.sensors import SAMPLE_RATE_HZ
from fleet_slip.storage.runs import LOGGER
from fleet_slip.vehicle.parameters import VehicleParameters
from fleet_slip.warehouse.tables import Warehouse

FITTED = "fitted without what is judged"
CHOSEN = "chosen and fitted without what is judged"


def evaluate_measured(
    warehouse: Warehouse,
    versions: Sequence[ModelVersion],
    condition: str,
    car: VehicleParameters | Measured | None,
    executor: Executor,
) -> dict[str, Any]:
    """Evaluate models, those of Table I and, in a car, filters on measured drives.

    A model that was trained on labels of these drives is chosen and fitted anew; another is judged
    as it is. Without a `car` it is that of the drives' class where one ships. Returns the
    evaluation's document, the best first. Raises `DataError` without drives that have a label,
    and as `load_cohort`.
    """
    cohort = load_cohort(warehouse, condition)
    drives = read_measured_drives(warehouse, cohort)
    car = car or class_car(cohort.drives["vehicle_model"][0].as_py(), None, warehouse.configs)
    car = car or next(filter(None, map(identified_prior, map(prior_of, versions))), None)
    competition = Competition.of(warehouse, versions, condition, drives, car, executor)
    parts, kinds = parts_to_leave_out(drives), kinds_to_leave_out(drives)
    whole = len({quarter for _, quarter in parts[0]}) > 1
    judged = competition.judge_without(parts)
    of_kinds = judge(competition.judge_without([*kinds.values()])) if kinds else {}
    figures = {name: one for name, one in judge(judged).items() if one.rmse_deg is not None}
    order = sorted(figures, key=lambda name: figures[name].rmse_deg or 0.0)
    units = judged
    if not whole:
        units = [
            replace(one, name=f"{one.name}, quarter {part + 1}", evaluated=one.evaluated & here)
            for one, drive in zip(judged, drives, strict=True)
            for part in range(QUARTERS)
            for here in [drive.quarter == part]
        ]
    return {
        "format": 2,
        "package_version": package_version("fleet-slip"),
        "model": versions[0].reference,
        "cohort": condition,
        "vehicle": car.name if car else None,
        "parts_of": "drives" if whole else "time",
        "parts": len(parts),
        "kinds": [
            {"name": kind, "drives": sorted({drives[i].drive.drive_id for i, _ in left_out})}
            for kind, left_out in kinds.items()
        ],
        "estimators": {
            name: {
                "told": competition.told[name],
                **asdict(figures[name]),
                **spread_over(units, name),
                "kinds_left_out": asdict(of_kinds[name]) if name in of_kinds else None,
                "found": [competition.without(one).get(name, (None,))[0] for one in parts],
            }
            for name in order
        },
        "drives": [
            {
                "name": one.name,
                "kind": drive.kind,
                "sideslip_std_deg": one.sideslip_std_deg,
                "results": {name: asdict(found[name]) for name in order},
            }
            for drive, one, found in (
                (drive, one, judge([one])) for drive, one in zip(drives, judged, strict=True)
            )
        ],
    }


Known = tuple[str, Callable[[DriveSignals], FloatArray], Any]
"""What an estimator knows, in words, what it makes of a drive, and what was found for it."""


Estimates = dict[str, tuple[Any, list[FloatArray]]]
"""By estimator: what was found on what is left in, and the angle in rad by drive and row."""


@dataclass(frozen=True)
class Competition:
    """Those who compete on some drives, and what each made of what was left out.

    Attributes:
        published: models that are judged as they are.
        learners: models that are chosen and fitted anew.
        vehicle: the car of a file, for filters.
        measured: what scales and a tape measure say, to identify the car by.
        cars: numbers of each car, for calibrated columns.
        told: what each estimator knows, in words.
    """

    catalog: Catalog
    drives: Sequence[HeldOutDrive]
    published: Mapping[str, Predictor]
    learners: Mapping[str, Learner]
    vehicle: VehicleParameters | None
    measured: Measured | None
    cars: CarCounts
    executor: Executor
    told: dict[str, str]
    _identified: dict[LeftOut, Identified] = field(default_factory=dict)
    _priors: dict[tuple[str, str], Cohort] = field(default_factory=dict)
    _without: dict[LeftOut, Estimates] = field(default_factory=dict)
    _failed: set[str] = field(default_factory=set)

    @classmethod
    def of(
        cls,
        warehouse: Warehouse,
        versions: Sequence[ModelVersion],
        condition: str,
        drives: Sequence[HeldOutDrive],
        car: VehicleParameters | Measured | None,
        executor: Executor,
    ) -> "Competition":
        """Return who competes: Table I, versions, and filters in a car if there is one."""
        catalog, registry = warehouse.catalog, Registry.of(warehouse)
        recipes = {
            f"table1/{one.name}": SelectionRequest(model=",".join(one.signals))
            for one in load_model_list(catalog, TABLE_ONE).model
        }
        told = dict.fromkeys(recipes, FITTED)
        published: dict[str, Predictor] = {}
        for version in versions:
            manifest, name = version.manifest, version.reference
            of_course = manifest.learned_from is not None
            if of_course or find_seen(warehouse, registry, manifest, condition).trained == 0:
                published[name] = Predictor.of(catalog.signals, manifest)
                told[name] = "as published"
            else:
                recipes[name], told[name] = recipe_of(version)[0], CHOSEN
        learners = {
            name: Learner.of(warehouse, request, condition, drives)
            for name, request in recipes.items()
        }
        numbered = any(one.plan.numbers for one in published.values()) or any(
            catalog.feature_set(one.plan.feature_set).calibrated for one in learners.values()
        )
        vehicle = car if isinstance(car, VehicleParameters) else None
        measured = Measured.of(car) if isinstance(car, VehicleParameters) else car
        cars = calibrated_cars(warehouse) if numbered else {}
        if measured is not None:
            drives = [
                replace(one, drive=_judged(accelerated(one.drive, measured), measured))
                for one in drives
            ]
        return cls(catalog, drives, published, learners, vehicle, measured, cars, executor, told)

    def judge_without(self, parts: Sequence[LeftOut]) -> list[JudgedDrive]:
        """Return the drives with what everybody makes of each part without having seen it."""
        blank = [np.full(len(one.rows), np.nan) for one in self.drives]
        found: dict[str, list[FloatArray]] = {}
        for left_out in parts:
            here = [
                np.isin(one.quarter, [quarter for i, quarter in left_out if i == number])
                for number, one in enumerate(self.drives)
            ]
            for name, (_, estimates) in self.without(left_out).items():
                before = found.get(name, blank)
                found[name] = list(map(np.where, here, estimates, before))
        return [
            JudgedDrive(
                one.drive.drive_id,
                one.drive.sideslip_rad,
                np.isfinite(one.drive.sideslip_rad),
                {name: estimates[number] for name, estimates in found.items()},
            )
            for number, one in enumerate(self.drives)
        ]

    def without(self, left_out: LeftOut) -> Estimates:
        """Return what everybody estimates who learned from what is left in."""
        if left_out not in self._without:
            self._without[left_out] = {
                **{
                    name: (None, [predict_drive(model, one, self.cars) for one in self.drives])
                    for name, model in self.published.items()
                },
                **self._learned(left_out),
                **self._filtered(left_out),
            }
        return self._without[left_out]

    def _learned(self, left_out: LeftOut) -> Estimates:
        found: Estimates = {}
        for name, learner in self.learners.items():
            try:
                found[name] = learner.estimate(left_out, self.cars, self._prior(learner, left_out))
            except (DataError, QuestionError) as error:
                if name not in self._failed:
                    LOGGER.warning("%s is missing in some folds: %s", name, error)
                self._failed.add(name)
        return found

    def _prior(self, learner: Learner, left_out: LeftOut) -> Cohort | None:
        """Return a learner's prior, in a car identified on what is left in if it was identified."""
        name, feature_set = learner.plan.request.prior, learner.plan.feature_set
        if name is None:
            return None
        campaign = load_campaign(name, self.catalog.configs)
        if (measured := self.measured) and identified_prior(campaign):
            vehicles = (self.identified(measured, left_out).car,)
            plan = campaign.plan.model_copy(update={"vehicles": vehicles})
            campaign = campaign.model_copy(update={"plan": plan})
        key = campaign.digest, feature_set
        if key not in self._priors:
            self._priors[key] = simulate_prior(self.catalog, campaign, feature_set, self.executor)
        return self._priors[key]

    def identified(self, measured: Measured, left_out: LeftOut) -> Identified:
        """Return the car that is identified on what is left in. Raises as `identify`."""
        if left_out not in self._identified:
            left_in = self._left_in(left_out)
            self._identified[left_out] = identify(measured, left_in, self.executor)
        return self._identified[left_out]

    def _left_in(self, left_out: LeftOut) -> list[LabelledDrive]:
        others = [
            one.without([quarter for i, quarter in left_out if i == number])
            for number, one in enumerate(self.drives)
        ]
        others = [one for one in others if np.isfinite(one.sideslip_rad).any()]
        if sum(len(one.signals) for one in others) > TUNING_DRIVES * TUNING_S * SAMPLE_RATE_HZ:
            begin = TUNING_S * SAMPLE_RATE_HZ
            others = [one.beginning(begin) for one in choose_evenly(others, TUNING_DRIVES)]
        return others

    def _filtered(self, left_out: LeftOut) -> Estimates:
        """Estimate by filters that are tuned, in cars identified, on what is left in."""
        if self.measured is None:
            return {}
        found: Estimates = {}
        for name, (knows, estimate, about) in self._tuned(self.measured, left_out).items():
            self.told[name] = knows
            found[name] = about, [np.full(len(one.rows), np.nan) for one in self.drives]
            for i in {i for i, _ in left_out}:
                with suppress(DataError):  # this drive lacks a sensor: no estimate
                    found[name][1][i] = estimate(self.drives[i].drive.signals)
        return found

    def _tuned(self, measured: Measured, left_out: LeftOut) -> dict[str, Known]:
        """Return each filter by name, tuned on drives in the car of the file and the identified."""
        others = self._left_in(left_out)
        ready: dict[str, Known] = {
            "kinematic": ("geometry", partial(_rolling, measured.car(Fitted())), None)
        }
        cars: dict[str, tuple[str, VehicleParameters]] = {}
        if self.vehicle is not None and self.vehicle.description != IDENTIFIED:
            cars["tuned"] = ("the vehicle's file", self.vehicle)
        try:
            identified = self.identified(measured, left_out)
        except DataError as error:
            LOGGER.warning("no car identified: %s", error)
            if self.vehicle is not None:
                cars["tuned"] = ("the vehicle's file", self.vehicle)
        else:
            cars["identified"] = ("the identified car", identified.car)
            knows = "geometry, and a car identified from the other parts"
            ready["ekf_identified"] = (knows, identified.estimate, identified.as_dict()["found"])
        navigated = any(np.isfinite(one.signals.gps_vx_mps).any() for one in others)
        for one in FILTERS:
            for how, (knows, car) in cars.items():
                name = f"{one.module}_{how}"
                if one.informed or name in ready or (one.gps and not navigated):
                    continue
                try:
                    tuned = one.tune(others, car, self.executor).parameters
                except DataError as error:
                    LOGGER.warning("%s left out: %s", name, error)
                else:
                    estimate = partial(_estimate, one, car, tuned)
                    about = tuned.model_dump(mode="json")
                    ready[name] = (f"{knows}, and labels to be tuned by", estimate, about)
        return ready


def prior_of(version: ModelVersion) -> Campaign | None:
    """Return the campaign of a version's prior, if it has one. Raises `ConfigError`."""
    name = recipe_of(version)[0].prior if version.manifest.prior else None
    return load_campaign(name, version.catalog.configs) if name else None


def identified_prior(campaign: Campaign | None) -> VehicleParameters | None:
    """Return the car of a prior that was identified from drives; None of another."""
    cars = campaign.plan.vehicles if campaign else ()
    return cars[0] if len(cars) == 1 and cars[0].description == IDENTIFIED else None


def _estimate(
    one: Filter, car: VehicleParameters, parameters: Config, signals: DriveSignals
) -> FloatArray:
    return one.estimate(signals, car, parameters)


WHEELS_LAG = 0.1
"""Of the change of wheel speeds in a step, what an acceleration made of them follows."""


def accelerated(drive: LabelledDrive, car: Measured) -> LabelledDrive:
    """Return the drive with ax from its wheels where none is logged, as many a car has it."""
    signals = drive.signals
    if np.isfinite(signals.ax_mps2).any():
        return drive
    try:
        speed = measured_speed_mps(signals, car.car(Fitted()))
    except DataError:
        return drive
    ax_mps2 = follow(np.diff(speed, prepend=speed[:1]) / STEP_S, WHEELS_LAG)
    return replace(drive, signals=replace(signals, ax_mps2=ax_mps2))


def _judged(drive: LabelledDrive, car: Measured) -> LabelledDrive:
    """Return the drive with the labels that are judged: where its wheels tell that it moves."""
    with suppress(DataError):
        return without_rest(drive, car.car(Fitted()))
    return drive


def _rolling(vehicle: VehicleParameters, signals: DriveSignals) -> FloatArray:
    """Return side-slip in rad where the rear wheels roll without slip, arctan(b r / vx)."""
    turning: FloatArray = estimate_yaw_rate(signals, vehicle, YawRateNoise())[0]
    return np.arctan2(vehicle.body.rear_axle_m * turning, measured_speed_mps(signals, vehicle))
