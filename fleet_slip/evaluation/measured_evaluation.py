"""Evaluation on measured drives with a label, held out in turn.

Segments are whole drives, or quarters of each drive's time where there are few, and kinds of
driving. Without the held-out segments, columns are chosen by each model's own recipe and fitted,
filters are tuned and a car is identified: neither a fit nor a choice saw the rows that an error is
taken on.

The weights of a combination of line and filter are cross-validated in inner groups of drives. In
every group the car is identified, and the line chosen and fitted, without the group.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from importlib.metadata import version as package_version
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.columns.drive_columns import ColumnPlan
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.evaluation.evaluated_drives import (
    QUARTERS,
    STEP_S,
    LabelledDrive,
    Segments,
    TestDrive,
    hold_last,
    predict_drive,
    read_drives,
)
from fleet_slip.evaluation.evaluator import (
    Estimator,
    MissingSignalError,
    evaluate,
    on_common_rows,
    pooled_statistics,
    variation_between_drives,
)
from fleet_slip.evaluation.filters import (
    FILTERS,
    TABLE_ONE,
    TUNING_DRIVES,
    TUNING_S,
    FilterEstimate,
    choose_evenly,
    class_car,
)
from fleet_slip.evaluation.identify import IDENTIFIED, IdentifiedVehicle, identify, vehicle_with_fit
from fleet_slip.evaluation.kalman import YawRateNoise, estimate_yaw_rate, follow, measured_speed_mps
from fleet_slip.grams.calibrated_columns import CarCounts
from fleet_slip.grams.cohort import Cohort, load_cohort, with_gram_rows
from fleet_slip.grams.compute import counts_of, drive_sums, gram_rows
from fleet_slip.ingest.mapping import NO_WHEEL_SPEEDS, ONE_SPEED
from fleet_slip.models.predict import Predictor
from fleet_slip.models.prior import simulate_prior
from fleet_slip.models.publish import (
    assumptions_of_cohort,
    manifest_of,
    training_options,
    with_straight_intercept,
)
from fleet_slip.models.registry import ModelVersion, Registry
from fleet_slip.models.request import SelectionPlan, SelectionRequest, load_model_list
from fleet_slip.models.score import calibrated_cars, find_training_overlap
from fleet_slip.models.select import MIN_DRIVES, deal_trips, select_without
from fleet_slip.models.summary import Selection, group_reasons
from fleet_slip.regression.combination import (
    CombinationChoice,
    EstimateCombination,
    PairedEstimates,
    choose_combination,
)
from fleet_slip.simulation.campaign import Campaign, load_campaign
from fleet_slip.simulation.sensors import SAMPLE_RATE_HZ
from fleet_slip.storage.runs import LOGGER
from fleet_slip.vehicle.parameters import VehicleMeasures, VehicleParameters
from fleet_slip.warehouse.warehouse import Warehouse

# Measured drives, and the segments that are held out together.

MAX_DRIVES = 96
"""Drives to evaluate of a larger cohort, evenly chosen."""


def read_measured_drives(warehouse: Warehouse, cohort: Cohort) -> list[LabelledDrive]:
    """Read drives of a cohort, at most `MAX_DRIVES`. Raises `DataError` if none has a label."""
    trips = {row["drive_id"]: row["trip"] for row in cohort.drives.to_pylist()}
    drives = [
        replace(drive, trip=trips[drive.name])
        for drive in read_drives(warehouse, choose_evenly(sorted(trips), MAX_DRIVES))
        if drive.evaluated.any()
    ]
    if not drives:
        raise DataError(
            "no drive of the cohort has the side-slip angle, the reference of every RMSE. Choose "
            "drives with that label."
        )
    return drives


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


def segments_of(
    drives: Iterable[LabelledDrive], quarters: Iterable[int] = range(QUARTERS)
) -> Segments:
    """Return quarters of drives, by default whole drives."""
    return frozenset((drive.name, quarter) for drive in drives for quarter in quarters)


def folds_of(drives: Sequence[LabelledDrive]) -> list[Segments]:
    """Return the folds: whole drives, together with all of their trip, or quarters."""
    trips = [drive.trip for drive in drives]
    if len(set(trips)) < MIN_DRIVES:
        return [segments_of(drives, [quarter]) for quarter in range(QUARTERS)]
    groups = deal_trips(trips)
    return [
        segments_of(drive for drive, group in zip(drives, groups, strict=True) if group == fold)
        for fold in range(max(groups) + 1)
    ]


def folds_by_kind(drives: Sequence[LabelledDrive]) -> dict[str, Segments]:
    """Return the drives of each kind of driving; empty if all are of one kind."""
    kinds = sorted({drive.kind for drive in drives})
    if len(kinds) < 2:
        return {}
    return {kind: segments_of(drive for drive in drives if drive.kind == kind) for kind in kinds}


def training_drives(drives: Sequence[LabelledDrive], held_out: Segments) -> list[LabelledDrive]:
    """Return the labelled drives without held-out segments; of many, the beginnings of some."""
    training = [drive.without(held_out) for drive in drives]
    training = [drive for drive in training if drive.evaluated.any()]
    rows = TUNING_S * SAMPLE_RATE_HZ
    if sum(len(drive.signals) for drive in training) > TUNING_DRIVES * rows:
        training = [drive.beginning(rows) for drive in choose_evenly(training, TUNING_DRIVES)]
    return training


# Regressions: chosen and fitted on the Gram rows of the training segments.


@dataclass(frozen=True)
class Learner:
    """A model that is trained again without held-out segments, by its own recipe.

    Attributes
    ----------
    plan
        Recipe of the model.
    cohort
        Gram rows of all drives.
    drives
        Their rows as logged, with the label.
    warehouse
        Data from which a label-free model takes its intercept.
    """

    plan: SelectionPlan
    cohort: Cohort
    drives: Sequence[LabelledDrive]
    warehouse: Warehouse

    @classmethod
    def prepare(
        cls,
        warehouse: Warehouse,
        request: SelectionRequest,
        predicate: str,
        drives: Sequence[LabelledDrive],
    ) -> "Learner":
        """Prepare a model's recipe for the drives of a cohort. Raises as `load_cohort`."""
        plan = SelectionPlan.from_request(warehouse.catalog, request)
        cohort = load_cohort(warehouse, predicate, plan.feature_set)
        return cls(plan, cohort, drives, warehouse)

    @cached_property
    def cars(self) -> CarCounts:
        """Calibration parameters of each car, for calibrated columns."""
        feature_set = self.warehouse.catalog.feature_set(self.plan.feature_set)
        return calibrated_cars(self.warehouse) if feature_set.calibrated else {}

    @cached_property
    def quarters(self) -> Cohort:
        """Gram rows of each quarter of each drive, by the column `quarter`.

        They are of the quarter's labelled rows; columns look back beyond it.
        """
        catalog, name = self.warehouse.catalog, self.plan.feature_set
        feature_set, label = catalog.feature_set(name), catalog.signals.label
        if feature_set.change_ticks:
            raise DataError("a label-free model needs three drives or more: add some.")
        plan = ColumnPlan.of_set(catalog, name)
        attributes = {row["drive_id"]: row for row in self.cohort.drives.to_pylist()}
        rows: list[dict[str, Any]] = []
        for drive in self.drives:
            counts = counts_of(drive.rows, plan, attributes[drive.name])
            labelled = counts.present.get(label, np.ones(len(drive.rows), dtype=np.bool_))
            for quarter in range(QUARTERS):
                present = {**counts.present, label: labelled & (drive.quarter == quarter)}
                sums = drive_sums(plan, feature_set, replace(counts, present=present))
                metadata = {**attributes[drive.name], "quarter": quarter}
                rows += gram_rows(sums, feature_set, metadata)
        rows = [row for row in rows if label in row["signals"].split(",")]
        sums_type = pa.list_(pa.int64())
        of_quarter = [("quarter", pa.int64()), ("sums", sums_type), ("products", sums_type)]
        schema = pa.schema([*self.cohort.drives.schema, *of_quarter])
        return with_gram_rows(self.cohort, pa.Table.from_pylist(rows, schema=schema))

    def choose(self, held_out: Segments, prior: Cohort | None = None) -> Selection:
        """Choose a model as `publish` does on the segments that are not held out.

        The folds are trips where the key of the recipe has one value, and quarters of a single
        trip, on which `publish` refuses. Quarters never count as drives.
        """
        training = segments_of(self.drives) - held_out
        names = {name for name, _ in training}
        trips = {drive.trip for drive in self.drives if drive.name in names}
        is_whole = len(training) == QUARTERS * len(names) and len(trips) > 1
        cohort = self.cohort if is_whole else self.quarters
        rows = cohort.drives.to_pylist()
        left_out = [(row["drive_id"], row.get("quarter", 0)) not in training for row in rows]
        if len(trips) == 1:  # each quarter of the time is a trip, hence a fold
            quarters = pa.array([f"quarter {row['quarter'] + 1}" for row in rows])
            column = cohort.drives.schema.get_field_index("trip")
            cohort = replace(cohort, drives=cohort.drives.set_column(column, "trip", quarters))
        return select_without(replace(cohort, prior=prior), self.plan, np.array(left_out))

    def train(
        self, held_out: Segments, prior: Cohort | None = None
    ) -> tuple[list[str], Estimator[LabelledDrive]]:
        """Train without held-out segments; return the chosen columns and the model."""
        selection = self.choose(held_out, prior)
        manifest = with_straight_intercept(self.warehouse, manifest_of(selection, "left_out"))
        model = Predictor.from_manifest(self.warehouse.catalog.signals, manifest)
        return [*selection.winner.model.signals], partial(predict_drive, model, self.cars)


# Combinations of a line and a filter.

MAX_GROUPS = 4
"""Inner groups of drives, each held out in turn."""

LATERAL_ROWS = 32
"""Rows of the mean of the lateral acceleration that shares depend on."""


def lateral_mps2(ay_mps2: FloatArray) -> FloatArray:
    """Return the size of the lateral acceleration, a mean of the last `LATERAL_ROWS` rows."""
    sums = np.cumsum(hold_last(ay_mps2, "ay"))
    before = np.concatenate([np.zeros(LATERAL_ROWS), sums])[: len(sums)]
    size: FloatArray = np.abs(sums - before) / np.minimum(np.arange(len(sums)) + 1, LATERAL_ROWS)
    return size


def combined_estimate(
    combination: EstimateCombination,
    line: Estimator[Any],
    filtered: Estimator[Any],
    drive: LabelledDrive | TestDrive,
) -> FloatArray:
    """Combine the estimates of a line and a filter; the line's where the filter has none."""
    line_rad, filter_rad = line(drive), filtered(drive)
    combined = combination(line_rad, filter_rad, lateral_mps2(drive.ay_mps2))
    return np.where(np.isnan(filter_rad), line_rad, combined)


def pair_estimates(
    drive: LabelledDrive,
    line: Estimator[LabelledDrive],
    filtered: Estimator[LabelledDrive],
    rows: BoolArray,
    group: int,
) -> PairedEstimates:
    """Return both estimates of the rows of a mask that have them and a label."""
    estimates, label = (line(drive), filtered(drive)), drive.sideslip_rad
    groups = np.full(len(label), float(group))
    pairs = PairedEstimates(*estimates, label, lateral_mps2(drive.ay_mps2), groups)
    return pairs.where(rows & np.isfinite(estimates[0] + estimates[1] + label))


def cross_validate_combination(
    learner: Learner,
    measures: VehicleMeasures,
    identified: IdentifiedVehicle,
    held_out: Segments,
    executor: Executor,
    prior: Cohort | None = None,
) -> CombinationChoice:
    """Choose a combination without held-out segments; `identified` is the car without them.

    Raises `DataError` without labels, or without a signal that the filter needs, and as
    `Learner.train`.
    """
    drives = learner.drives
    groups, kinds = inner_groups(drives, held_out)
    pairs: list[PairedEstimates] = []
    pairs_of_kinds: list[PairedEstimates] = []
    for number, group in enumerate([*groups, *kinds]):
        without = held_out | group
        vehicle = identify(measures, training_drives(drives, without), executor, start=identified)
        _, line = learner.train(without, prior)
        for drive in drives:
            rows = drive.rows_in(group) & drive.evaluated
            if rows.any():
                pair = pair_estimates(drive, line, vehicle.estimate_drive, rows, number)
                (pairs if number < len(groups) else pairs_of_kinds).append(pair)
    if not pairs:
        raise DataError("no inner group has rows with a label and both estimates.")
    return choose_combination(
        PairedEstimates.concatenate(pairs),
        PairedEstimates.concatenate(pairs_of_kinds) if pairs_of_kinds else None,
    )


def inner_groups(
    drives: Sequence[LabelledDrive], held_out: Segments
) -> tuple[list[Segments], list[Segments]]:
    """Divide the training segments into groups of trips, and into kinds of driving.

    A single trip is divided into quarters of time. A kind that is a group of trips is left out.
    """
    training = segments_of(drives) - held_out
    trips = {drive.name: drive.trip for drive in drives}
    names = list(dict.fromkeys(trips[name] for name in trips if (name, 0) in training))
    has_whole_drives = len(training) == QUARTERS * len({name for name, _ in training})
    group_of = {part: part[1] for part in training}
    if has_whole_drives and len(names) > 1:
        count = min(len(names), MAX_GROUPS)
        group_of = {part: names.index(trips[part[0]]) % count for part in training}
    groups = [
        frozenset(part for part in training if group_of[part] == group)
        for group in sorted({*group_of.values()})
    ]
    kinds = folds_by_kind([drive for drive in drives if (drive.name, 0) in training])
    return groups, [kind for kind in kinds.values() if has_whole_drives and kind not in groups]


# Estimators that compete on measured drives, fitted without held-out segments.

FITTED = "fitted without held-out rows"
CHOSEN = "chosen and fitted without held-out rows"


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
    car
        The car for filters, if there is one, and its measures.
    priors
        Simulated priors, by campaign and feature set.
    failures
        Reasons of estimators that could not be fitted.
    """

    warehouse: Warehouse
    drives: Sequence[LabelledDrive]
    published: FittedFold
    learners: Mapping[str, tuple[str, Learner]]
    combined: frozenset[str]
    car: VehicleParameters | VehicleMeasures | None
    measures: VehicleMeasures | None
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
        measures = VehicleMeasures.of_vehicle(car) if isinstance(car, VehicleParameters) else car
        if measures is not None:
            drives = [prepare_drive(drive, vehicle_with_fit(measures)) for drive in drives]
        recipes = {
            f"table1/{row.name}": (FITTED, SelectionRequest(model=",".join(row.signals)))
            for row in load_model_list(catalog, TABLE_ONE).model
        }
        published: dict[str, FittedEstimator] = {}
        for version in versions:
            manifest, name = version.manifest, version.reference
            overlap = find_training_overlap(warehouse, registry, manifest, predicate)
            if manifest.learned_from is not None or not overlap.trained:
                model = Predictor.from_manifest(catalog.signals, manifest)
                cars = calibrated_cars(warehouse) if model.plan.numbers else {}
                estimate = partial(predict_drive, model, cars)
                published[name] = FittedEstimator("as published", estimate)
            else:
                recipes[name] = CHOSEN, training_options(version)[0]
        learners = {
            name: (source, Learner.prepare(warehouse, request, predicate, drives))
            for name, (source, request) in recipes.items()
        }
        combined = frozenset(v.reference for v in versions if v.manifest.combination)
        return cls(warehouse, drives, published, learners, combined, car, measures, executor)

    @contextmanager
    def _noting_failure(self, name: str) -> Iterator[None]:
        """Note the reason for which an estimator cannot be fitted."""
        try:
            yield
        except (DataError, QuestionError) as error:
            self.failures[name] = str(error)

    def fit(self, held_out: Segments) -> FittedFold:
        """Fit, tune and identify without the held-out segments."""
        drives = training_drives(self.drives, held_out)
        fitted, identified = dict(self.published), None
        if self.measures:
            with self._noting_failure("ekf_identified"):
                identified = identify(self.measures, drives, self.executor)
        for name, (source, learner) in self.learners.items():
            with self._noting_failure(name):
                prior = self._prior(learner, identified)
                columns, line = learner.train(held_out, prior)
                fitted[name] = FittedEstimator(source, line, columns)
                if name not in self.combined or self.measures is None or identified is None:
                    continue
                choice = cross_validate_combination(
                    learner, self.measures, identified, held_out, self.executor, prior
                )
                filtered = identified.estimate_drive
                both = partial(combined_estimate, choice.combination, line, filtered)
                fitted[f"{name} line"] = fitted[name]
                fitted[name] = FittedEstimator(f"{source}, with a filter", both, asdict(choice))
        return {**fitted, **self._filters(drives, identified)}

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

    def _filters(
        self, drives: Sequence[LabelledDrive], identified: IdentifiedVehicle | None
    ) -> FittedFold:
        """Tune filters in the car of the file and in the identified car."""
        if self.measures is None:
            return {}
        rolling = partial(rolling_sideslip, vehicle_with_fit(self.measures))
        fitted = {"kinematic": FittedEstimator("geometry", rolling)}
        cars: dict[str, tuple[str, VehicleParameters]] = {}
        file = self.car if isinstance(self.car, VehicleParameters) else None
        if file and (identified is None or file.description != IDENTIFIED):
            cars["tuned"] = ("the vehicle's file", file)
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
                if name in fitted or kind.informed or (kind.gps and not has_gps):
                    continue
                with self._noting_failure(name):
                    tuned = kind.tune(drives, car, self.executor).parameters
                    estimate = partial(FilterEstimate(kind, tuned).on_labelled, car)
                    origin = f"{source}, tuned on labels"
                    fitted[name] = FittedEstimator(origin, estimate, tuned.model_dump(mode="json"))
        return fitted


def prior_of(version: ModelVersion) -> Campaign | None:
    """Return the campaign of a version's prior, if it has one. Raises `ConfigError`."""
    name = training_options(version)[0].prior if version.manifest.prior else None
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


# The evaluation.


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
    by_kind = cross_fitted({fold: fitted[fold] for fold in kinds.values()})
    of_kinds = pooled_statistics(on_common_rows(evaluate(competition.drives, by_kind))[0])
    _warn_of_missing({**excluded, **competition.failures}, errors)
    order = sorted(errors, key=lambda name: errors[name].rmse_deg or 0.0)
    whole_drives = len({quarter for _, quarter in folds[0]}) > 1
    units = runs
    if not whole_drives:
        units = tuple(
            run.within(run.drive.quarter == quarter, f"{run.name}, quarter {quarter + 1}")
            for run in runs
            for quarter in range(QUARTERS)
        )
    assumed = assumptions_of_cohort(warehouse, cohort)
    speeds = [text for text in assumed if text in {NO_WHEEL_SPEEDS, ONE_SPEED}]
    estimators: dict[str, Any] = {}
    for name in order:
        fits = [fold.get(name) for fold in fitted.values()]
        estimators[name] = {
            "told": [fit.source for fit in fits if fit][-1],
            **asdict(errors[name]),
            "coverage": coverage[name],
            **variation_between_drives(units, name),
            "kinds_left_out": asdict(of_kinds[name]) if name in of_kinds else None,
            "found": [fit and fit.parameters for fit in fits[: len(folds)]],
        }
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
        "estimators": estimators,
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
    for extent, has_figures in (("segments without a fit", True), ("not evaluated", False)):
        group = {name: why for name, why in reasons.items() if (name in evaluated) == has_figures}
        for names, reason in group_reasons(group):
            LOGGER.warning("%s: %s: %s.", ", ".join(names), extent, reason.rstrip("."))
