"""Evaluation on measured drives with a label, held out in turn.

Without the held-out segments, columns are chosen by each model's own recipe and fitted, filters are
tuned and a car is identified: neither a fit nor a choice saw the rows that an error is taken on.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from importlib.metadata import version as package_version
from typing import Any, NamedTuple, TypeVar

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.evaluation.evaluator import (
    Estimator,
    MissingSignalError,
    evaluate,
    on_common_rows,
    pooled_statistics,
    variation_between_drives,
)
from fleet_slip.evaluation.filters import FILTERS, TABLE_ONE, FilterEstimate, class_car
from fleet_slip.evaluation.held_out import (
    Learner,
    combine,
    folds_by_kind,
    folds_of,
    read_measured_drives,
    training_drives,
)
from fleet_slip.evaluation.identify import IDENTIFIED, IdentifiedVehicle, identify, vehicle_with_fit
from fleet_slip.evaluation.kalman import YawRateNoise, estimate_yaw_rate
from fleet_slip.evaluation.labelled_drives import (
    QUARTERS,
    STEP_S,
    LabelledDrive,
    Segments,
    predict_drive,
)
from fleet_slip.evaluation.single_track import follow, measured_speed_mps
from fleet_slip.grams.calibrated_columns import CarCounts
from fleet_slip.grams.cohort import Cohort, load_cohort
from fleet_slip.ingest.mapping import NO_WHEEL_SPEEDS, ONE_SPEED
from fleet_slip.models.predict import Predictor
from fleet_slip.models.prior import simulate_prior
from fleet_slip.models.publish import assumptions_of_cohort, recipe_of
from fleet_slip.models.registry import ModelVersion, Registry
from fleet_slip.models.request import SelectionRequest, load_model_list
from fleet_slip.models.score import calibrated_cars, find_training_overlap
from fleet_slip.models.summary import group_reasons
from fleet_slip.simulation.campaign import Campaign, load_campaign
from fleet_slip.storage.runs import LOGGER
from fleet_slip.vehicle.measures import VehicleMeasures
from fleet_slip.vehicle.parameters import VehicleParameters
from fleet_slip.warehouse.warehouse import Warehouse

T = TypeVar("T")

FITTED = "fitted without held-out rows"
CHOSEN = "chosen and fitted without held-out rows"


def evaluate_measured(
    warehouse: Warehouse,
    versions: Sequence[ModelVersion],
    predicate: str,
    car: VehicleParameters | VehicleMeasures | None,
    executor: Executor,
) -> dict[str, Any]:
    """Evaluate models, those of Table I and, in a car, filters; return the document.

    A model that was trained on labels of these drives is chosen and fitted anew; another is
    evaluated as published. The default car is that of the drives' class, if a file ships. Raises
    `DataError` without drives that have a label, and as `load_cohort`.
    """
    cohort = load_cohort(warehouse, predicate)
    drives = read_measured_drives(warehouse, cohort)
    car = car or class_car(cohort.drives["vehicle_model"][0].as_py(), None, warehouse.configs)
    car = car or next(filter(None, map(identified_prior, map(prior_of, versions))), None)
    combinations = (version.manifest.combination for version in versions)
    car = car or next((filtered.measures for filtered in combinations if filtered), None)
    competition = Competition.collect(warehouse, versions, predicate, drives, car, executor)
    folds, kinds = folds_of(drives), folds_by_kind(drives)
    fitted = {
        held_out: competition.fit(held_out) for held_out in dict.fromkeys([*folds, *kinds.values()])
    }
    all_rows = evaluate(competition.drives, cross_fitted({fold: fitted[fold] for fold in folds}))
    runs, excluded = on_common_rows(all_rows)
    coverage = {name: row.coverage for name, row in pooled_statistics(all_rows).items()}
    errors = pooled_statistics(runs)
    _warn_of_missing({**excluded, **competition.failures}, errors)
    by_kind = cross_fitted({fold: fitted[fold] for fold in kinds.values()})
    of_kinds = pooled_statistics(on_common_rows(evaluate(competition.drives, by_kind))[0])
    order = sorted(errors, key=lambda name: errors[name].rmse_deg or 0.0)
    whole_drives = len({quarter for _, quarter in folds[0]}) > 1
    units = runs
    if not whole_drives:
        units = tuple(
            run.within(run.drive.quarter == quarter, f"{run.name}, quarter {quarter + 1}")
            for run in runs
            for quarter in range(QUARTERS)
        )
    sources = {
        name: estimator.source for fold in fitted.values() for name, estimator in fold.items()
    }
    assumed = assumptions_of_cohort(warehouse, cohort)
    speeds = [text for text in assumed if text in {NO_WHEEL_SPEEDS, ONE_SPEED}]
    return {
        "format": 2,
        "package_version": package_version("fleet-slip"),
        "model": versions[0].reference,
        "cohort": predicate,
        **({"assumed": speeds} if speeds else {}),
        "vehicle": car.name if car else None,
        "parts_of": "drives" if whole_drives else "time",
        "parts": len(folds),
        "kinds": [
            {"name": kind, "drives": sorted({name for name, _ in held_out})}
            for kind, held_out in kinds.items()
        ],
        "estimators": {
            name: {
                "told": sources[name],
                **asdict(errors[name]),
                "coverage": coverage[name],
                **variation_between_drives(units, name),
                "kinds_left_out": asdict(of_kinds[name]) if name in of_kinds else None,
                "found": [
                    fitted[fold][name].parameters if name in fitted[fold] else None
                    for fold in folds
                ],
            }
            for name in order
        },
        "drives": [
            {
                "name": run.name,
                "kind": run.drive.kind,
                "sideslip_std_deg": run.sideslip_std_deg,
                "results": {name: asdict(run.statistics[name]) for name in order},
            }
            for run in runs
        ],
    }


def _warn_of_missing(reasons: Mapping[str, str], evaluated: Mapping[str, object]) -> None:
    """Warn of models without a fit for some segments, and of estimators without figures.

    Estimators with the same reason share a line.
    """
    partial_fits = {name: reason for name, reason in reasons.items() if name in evaluated}
    failed = {name: reason for name, reason in reasons.items() if name not in evaluated}
    for extent, group in (("segments without a fit", partial_fits), ("not evaluated", failed)):
        for names, reason in group_reasons(group):
            LOGGER.warning("%s: %s: %s.", ", ".join(names), extent, reason.rstrip("."))


class FittedEstimator(NamedTuple):
    """An estimator that was fitted without held-out segments.

    It has its source of knowledge in words, and the fitted columns or parameters.
    """

    source: str
    estimate: Estimator[LabelledDrive]
    parameters: Any = None


FittedFold = Mapping[str, FittedEstimator]


def cross_fitted(fitted: Mapping[Segments, FittedFold]) -> dict[str, Estimator[LabelledDrive]]:
    """Combine the folds: each estimates the segments that it was not fitted on."""

    def estimate(name: str, drive: LabelledDrive) -> FloatArray:
        combined = np.full(len(drive.sideslip_rad), np.nan)
        for held_out, fold in fitted.items():
            rows = drive.rows_in(held_out)
            if name in fold and rows.any():
                combined[rows] = fold[name].estimate(drive)[rows]
        return combined

    names = dict.fromkeys(name for fold in fitted.values() for name in fold)
    return {name: partial(estimate, name) for name in names}


@dataclass(frozen=True)
class Competition:
    """Estimators that compete on measured drives, to be fitted without held-out segments.

    Attributes
    ----------
    drives
        Drives to evaluate, with labels where the car moves.
    published
        Models that are evaluated as published.
    learners
        Models that are trained again; with their sources of knowledge in words.
    combined
        Learners that are combined with a filter.
    vehicle
        The car of a file, for filters.
    measures
        Measures of the car, to identify it by.
    cars
        Calibration parameters of each car, for calibrated columns.
    priors
        Simulated priors, by campaign and feature set.
    failures
        Reasons of estimators that could not be fitted.
    """

    warehouse: Warehouse
    drives: Sequence[LabelledDrive]
    published: Mapping[str, Predictor]
    learners: Mapping[str, tuple[str, Learner]]
    combined: frozenset[str]
    vehicle: VehicleParameters | None
    measures: VehicleMeasures | None
    cars: CarCounts
    executor: Executor
    priors: dict[tuple[str, str], Cohort] = field(default_factory=dict)
    failures: dict[str, str] = field(default_factory=dict)

    @classmethod
    def collect(
        cls,
        warehouse: Warehouse,
        versions: Sequence[ModelVersion],
        predicate: str,
        drives: Sequence[LabelledDrive],
        car: VehicleParameters | VehicleMeasures | None,
        executor: Executor,
    ) -> "Competition":
        """Collect Table I, the versions, and filters in the car if there is one."""
        catalog, registry = warehouse.catalog, Registry.open(warehouse)
        vehicle = car if isinstance(car, VehicleParameters) else None
        measures = VehicleMeasures.of_vehicle(car) if isinstance(car, VehicleParameters) else car
        if measures is not None:
            drives = [prepare_drive(drive, vehicle_with_fit(measures)) for drive in drives]
        recipes = {
            f"table1/{row.name}": (FITTED, SelectionRequest(model=",".join(row.signals)))
            for row in load_model_list(catalog, TABLE_ONE).model
        }
        published: dict[str, Predictor] = {}
        for version in versions:
            manifest, name = version.manifest, version.reference
            is_label_free = manifest.learned_from is not None
            if (
                is_label_free
                or not find_training_overlap(warehouse, registry, manifest, predicate).trained
            ):
                published[name] = Predictor.from_manifest(catalog.signals, manifest)
            else:
                recipes[name] = CHOSEN, recipe_of(version)[0]
        learners = {
            name: (source, Learner.prepare(warehouse, request, predicate, drives))
            for name, (source, request) in recipes.items()
        }
        is_calibrated = any(model.plan.numbers for model in published.values()) or any(
            catalog.feature_set(learner.plan.feature_set).calibrated
            for _, learner in learners.values()
        )
        cars = calibrated_cars(warehouse) if is_calibrated else {}
        combined = frozenset(v.reference for v in versions if v.manifest.combination)
        return cls(
            warehouse, drives, published, learners, combined, vehicle, measures, cars, executor
        )

    def fit(self, held_out: Segments) -> FittedFold:
        """Fit, tune and identify without the held-out segments."""
        drives = training_drives(self.drives, held_out)
        fitted = {
            name: FittedEstimator("as published", partial(predict_drive, model, self.cars))
            for name, model in self.published.items()
        }
        identified = None
        if measures := self.measures:
            name = "ekf_identified"
            identified = self._attempt(name, lambda: identify(measures, drives, self.executor))
        for name, (source, learner) in self.learners.items():
            fitted |= self._learn(name, source, learner, held_out, identified)
        return {**fitted, **self._tune(drives, identified)}

    def _attempt(self, name: str, fit: Callable[[], T]) -> T | None:
        """Return what a function fits; None if it cannot, with the reason in `failures`."""
        try:
            return fit()
        except (DataError, QuestionError) as error:
            self.failures[name] = str(error)
            return None

    def _learn(
        self,
        name: str,
        source: str,
        learner: Learner,
        held_out: Segments,
        identified: IdentifiedVehicle | None,
    ) -> dict[str, FittedEstimator]:
        """Train a learner, and combine it with a filter if its version is."""
        trained = self._attempt(
            name, lambda: learner.train(held_out, self._prior(learner, identified))
        )
        if trained is None:
            return {}
        columns, model = trained
        line = FittedEstimator(source, partial(predict_drive, model, self.cars), columns)
        measures = self.measures
        if name not in self.combined or measures is None or identified is None:
            return {name: line}
        combined = self._attempt(
            name,
            lambda: combine(
                learner,
                measures,
                held_out,
                self.executor,
                cars=self.cars,
                identified=identified,
                prior=self._prior(learner, identified),
            ),
        )
        if combined is None:
            return {name: line}
        source, choice = f"{source}, with a filter", asdict(combined.choice)
        return {
            f"{name} line": line,
            name: FittedEstimator(source, combined.estimate, choice),
        }

    def _prior(self, learner: Learner, identified: IdentifiedVehicle | None) -> Cohort | None:
        """Simulate a learner's prior, in the car of this fold if its car was identified."""
        name, feature_set = learner.plan.request.prior, learner.plan.feature_set
        if name is None:
            return None
        campaign = load_campaign(name, self.warehouse.configs)
        if self.measures and identified_prior(campaign):
            if identified is None:
                raise DataError("the car of the prior cannot be identified without these drives.")
            plan = campaign.plan.model_copy(update={"vehicles": (identified.car,)})
            campaign = campaign.model_copy(update={"plan": plan})
        key, catalog = (campaign.digest, feature_set), self.warehouse.catalog
        if key not in self.priors:
            self.priors[key] = simulate_prior(catalog, campaign, feature_set, self.executor)
        return self.priors[key]

    def _tune(
        self, drives: Sequence[LabelledDrive], identified: IdentifiedVehicle | None
    ) -> dict[str, FittedEstimator]:
        """Tune filters in the car of the file and in the identified car."""
        if self.measures is None:
            return {}
        rolling = partial(rolling_sideslip, vehicle_with_fit(self.measures))
        fitted = {"kinematic": FittedEstimator("geometry", rolling)}
        cars: dict[str, tuple[str, VehicleParameters]] = {}
        if self.vehicle and (identified is None or self.vehicle.description != IDENTIFIED):
            cars["tuned"] = ("the vehicle's file", self.vehicle)
        if identified is not None:
            cars["identified"] = ("the identified car", identified.car)
            fitted["ekf_identified"] = FittedEstimator(
                "geometry, and a car identified from the other folds",
                identified.estimate_drive,
                identified.as_dict()["found"],
            )
        has_gps = any(np.isfinite(drive.signals.gps_vx_mps).any() for drive in drives)
        for kind in FILTERS:
            for suffix, (source, car) in cars.items():
                name = f"{kind.module_name}_{suffix}"
                if name not in fitted and not kind.informed and (has_gps or not kind.gps):
                    tune = partial(kind.tune, drives, car, self.executor)
                    if tuned := self._attempt(name, tune):
                        estimate = partial(FilterEstimate(kind, tuned.parameters).on_labelled, car)
                        content = tuned.parameters.model_dump(mode="json")
                        origin = f"{source}, tuned on labels"
                        fitted[name] = FittedEstimator(origin, estimate, content)
        return fitted


def prior_of(version: ModelVersion) -> Campaign | None:
    """Return the campaign of a version's prior, if it has one. Raises `ConfigError`."""
    name = recipe_of(version)[0].prior if version.manifest.prior else None
    return load_campaign(name, version.catalog.configs) if name else None


def identified_prior(campaign: Campaign | None) -> VehicleParameters | None:
    """Return the car of a prior that was identified from drives; None for another prior."""
    cars = campaign.plan.vehicles if campaign else ()
    return cars[0] if len(cars) == 1 and cars[0].description == IDENTIFIED else None


def rolling_sideslip(vehicle: VehicleParameters, drive: LabelledDrive) -> FloatArray:
    """Return side-slip in rad of rear wheels that roll without slip, arctan(b r / vx)."""
    yaw_rate_rad_s, _ = estimate_yaw_rate(drive.signals, vehicle, YawRateNoise())
    lateral_mps = vehicle.body.rear_axle_m * yaw_rate_rad_s
    angle_rad: FloatArray = np.arctan2(lateral_mps, measured_speed_mps(drive.signals, vehicle))
    return angle_rad


WHEELS_LAG = 0.1
"""Share of a new sample in the acceleration from wheel speeds."""


def prepare_drive(drive: LabelledDrive, car: VehicleParameters) -> LabelledDrive:
    """Derive ax from wheel speeds where it is not logged."""
    if np.isfinite(drive.signals.ax_mps2).any():
        return drive
    try:
        speed_mps = measured_speed_mps(drive.signals, car)
    except MissingSignalError:
        return drive
    ax_mps2 = follow(np.diff(speed_mps, prepend=speed_mps[:1]) / STEP_S, WHEELS_LAG)
    return replace(drive, signals=replace(drive.signals, ax_mps2=ax_mps2))
