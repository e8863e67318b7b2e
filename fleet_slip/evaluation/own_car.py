"""All estimators on measured drives with a label, each part of them held out in turn.

Models are fitted, filters tuned and a car identified on the other parts; whatever is estimated was
not seen. A part is a quarter of the drives, or of each drive's time where there are few.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version as package_version
from typing import Any

import numpy as np

from fleet_slip.arrays import BoolArray, FloatArray, IntArray
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.columns.drive_columns import DriveColumns
from fleet_slip.columns.plan import ColumnPlan
from fleet_slip.errors import DataError
from fleet_slip.evaluation import ekf
from fleet_slip.evaluation.belief import YawRateNoise
from fleet_slip.evaluation.belief import estimate as estimate_yaw_rate
from fleet_slip.evaluation.drives import SLOWEST_MPS, EvaluatedDrive
from fleet_slip.evaluation.filters import (
    FILTERS,
    GROUP,
    TABLE_ONE,
    TUNING_DRIVES,
    TUNING_S,
    Filter,
    Signals,
    TuningDrives,
    choose_evenly,
    class_car,
    find_kept,
    seen,
)
from fleet_slip.evaluation.identify import (
    FOLDS,
    IDENTIFIED,
    Identified,
    Measured,
    checksum_of_sources,
    identify,
)
from fleet_slip.evaluation.scenarios import ErrorFigures, error_figures, judge_together
from fleet_slip.evaluation.single_track import (
    STEP_S,
    DriveSignals,
    LabelledDrive,
    follow,
    measured_speed_mps,
    read_drive,
)
from fleet_slip.grams.cohort import load_cohort
from fleet_slip.grams.compute import counts_of
from fleet_slip.grams.expansion import CarCounts
from fleet_slip.models.diff import find_seen
from fleet_slip.models.predict import Predictor
from fleet_slip.models.registry import ModelVersion, Registry
from fleet_slip.models.request import load_model_list
from fleet_slip.models.score import calibrated_cars
from fleet_slip.simulation.sensors import SAMPLE_RATE_HZ
from fleet_slip.storage.documents import DocumentFolder
from fleet_slip.storage.runs import LOGGER
from fleet_slip.vehicle.parameters import VehicleParameters, load_vehicle
from fleet_slip.views import connect
from fleet_slip.warehouse.tables import Warehouse


@dataclass(frozen=True)
class Design:
    """The columns of a model, to be fitted anew; `published`, a version as it is, needs no fit."""

    plan: ColumnPlan
    scales: tuple[float, ...]
    intercept: bool = True
    published: Predictor | None = None


@dataclass(frozen=True)
class OwnDrive:
    """A drive: its signals and label, each design's columns (rows, n), and the part of each row."""

    drive: LabelledDrive
    columns: Mapping[str, FloatArray]
    part: IntArray

    def without(self, part: int) -> LabelledDrive:
        """Return the drive without the labels of a part."""
        label = np.where(self.part == part, np.nan, self.drive.sideslip_rad)
        return replace(self.drive, sideslip_rad=label)


def designs_of(
    warehouse: Warehouse, versions: Sequence[ModelVersion], condition: str
) -> dict[str, Design]:
    """Return the models of Table I and versions; who saw none of the labels stays as it is."""
    designs = {
        f"table1/{one.name}": Design(
            ColumnPlan.of(one.signals, {}, {}),
            tuple(float(catalogue()[signal].scale) for signal in one.signals),
        )
        for one in load_model_list(TABLE_ONE).model
    }
    registry = Registry.of(warehouse)
    for version in versions:
        manifest, model = version.manifest, Predictor.of(version.manifest)
        from_course = manifest.learned_from is not None and manifest.learned_from.weight is None
        made = from_course or find_seen(warehouse, registry, manifest, condition).trained == 0
        designs[version.reference] = Design(
            model.plan, model.scales, not manifest.through_origin, model if made else None
        )
    return designs


def read_own_drives(
    warehouse: Warehouse, names: Sequence[str], designs: Mapping[str, Design]
) -> list[OwnDrive]:
    """Read drives with their designs' columns. Raises `DataError` where none has a label."""
    drives: list[OwnDrive] = []
    cars: CarCounts = {}
    if any(design.plan.numbers for design in designs.values()):
        cars = calibrated_cars(warehouse)
    needed = [
        *(name for design in designs.values() for name in design.plan.signals),
        *(name for design in designs.values() for name in design.plan.facts),
    ]
    wanted = ", ".join(dict.fromkeys(("tick", "vehicle_id", *needed)))
    query = f"SELECT {wanted} FROM log_counts WHERE drive_id = $drive ORDER BY tick"
    with connect(warehouse.root, query="SELECT 1 FROM log, log_counts") as database:
        for name in names:
            drive = read_drive(database, name)
            if not np.isfinite(drive.sideslip_rad).any():
                continue
            rows = database.sql(query, params={"drive": name}).to_arrow_table()
            numbers = cars.get(rows["vehicle_id"][0].as_py())
            columns = {}
            for model, one in designs.items():
                counts = counts_of(rows, one.plan, None, numbers)
                if one.published is not None:
                    columns[model] = one.published(counts)[:, None]
                else:
                    scales = np.array(one.scales)[:, None]
                    columns[model] = (DriveColumns(one.plan, counts).compute() * scales).T
            drives.append(OwnDrive(drive, columns, np.full(len(rows), len(drives) % FOLDS)))
    if not drives:
        raise DataError(
            "no drive of the cohort has side-slip, by which estimators are judged. Choose drives "
            "with that label."
        )
    if len(drives) >= FOLDS:
        return drives
    return [replace(one, part=np.arange(len(one.part)) * FOLDS // len(one.part)) for one in drives]


DRIVES_AT_MOST = 96
"""Of a larger cohort so many are estimated, evenly chosen."""


@dataclass(frozen=True)
class OwnCarEvaluation:
    """Figures of every estimator on drives that it was not fitted to.

    Attributes:
        model, cohort, vehicle: what was asked for; no vehicle, no filter.
        parts_of: what was left out: parts of the "drives", or of the "time" of each.
        figures: by estimator, over all drives.
        told: what each knows, by estimator.
        by_drive: RMSE in degrees by drive and estimator; None without an estimate.
    """

    model: str
    cohort: str
    vehicle: str | None
    parts_of: str
    figures: Mapping[str, ErrorFigures]
    told: Mapping[str, str]
    by_drive: Mapping[str, Mapping[str, float | None]] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Return the evaluation's document."""
        return {
            "format": 1,
            "package_version": package_version("fleet-slip"),
            **{name: getattr(self, name) for name in ("model", "cohort", "vehicle", "parts_of")},
            "estimators": {
                name: {"told": self.told[name], **asdict(one)} for name, one in self.figures.items()
            },
            "drives": {name: dict(found) for name, found in self.by_drive.items()},
        }


def own_car_evaluations(warehouse: Warehouse) -> DocumentFolder:
    """Return where a data root keeps evaluations on measured drives."""
    return DocumentFolder(warehouse.root / "evaluations" / "measured")


def evaluate_own_car(
    warehouse: Warehouse,
    versions: Sequence[ModelVersion],
    condition: str,
    file: str | None,
    executor: Executor,
) -> OwnCarEvaluation:
    """Evaluate models, those of Table I and, in a car, filters on measured drives.

    A model that was trained on labels of these drives is fitted anew; another is judged as it is.
    The car is that of a vehicle `file`, or of the drives' class where one ships. Raises `DataError`
    without drives that have a label, `ConfigError` for an unknown car, and as `load_cohort`.
    """
    found = load_cohort(warehouse, condition).drives
    names = sorted({*found["drive_id"].to_pylist()})
    vehicle = load_vehicle(file) if file else class_car(found["vehicle_model"][0].as_py(), None)
    designs = designs_of(warehouse, versions, condition)
    drives = read_own_drives(warehouse, choose_evenly(names, DRIVES_AT_MOST), designs)
    estimates: dict[str, list[FloatArray]] = {}
    for name, design in designs.items():
        estimates[name] = fit_left_out(drives, name, design)
    told = {
        name: "as published" if design.published else "fitted to labels of the other parts"
        for name, design in designs.items()
    }
    if vehicle is not None:
        for name, (knows, found) in _filtered(drives, vehicle, executor).items():
            estimates[name], told[name] = found, knows
    among = [_judged(one, vehicle) for one in drives]
    truth = [one.drive.sideslip_rad for one in drives]
    together = judge_together(estimates, truth, among)
    kept = {name: one for name, one in together.items() if one.rmse_deg is not None}
    return OwnCarEvaluation(
        model=versions[0].reference,
        cohort=condition,
        vehicle=vehicle.name if vehicle else None,
        parts_of="time" if len(drives) < FOLDS else "drives",
        figures=dict(sorted(kept.items(), key=lambda one: one[1].rmse_deg or 0.0)),
        told={name: told[name] for name in kept},
        by_drive={
            one.drive.drive_id: {
                name: error_figures(estimates[name][place], truth[place], among[place]).rmse_deg
                for name in kept
            }
            for place, one in enumerate(drives)
        },
    )


def _judged(one: OwnDrive, vehicle: VehicleParameters | None) -> BoolArray:
    """Return the rows with a label where the car moves, as far as wheels tell."""
    labelled: BoolArray = np.isfinite(one.drive.sideslip_rad)
    if vehicle is None:
        return labelled
    try:
        return labelled & (measured_speed_mps(one.drive.signals, vehicle) > SLOWEST_MPS)
    except DataError:
        return labelled


def fit_left_out(drives: Sequence[OwnDrive], name: str, design: Design) -> list[FloatArray]:
    """Estimate each part by least squares on the rows of the others."""
    if design.published is not None:
        return [one.columns[name][:, 0] for one in drives]
    rows = np.concatenate([one.columns[name] for one in drives])
    label = np.concatenate([one.drive.sideslip_rad for one in drives])
    part = np.concatenate([one.part for one in drives])
    complete = np.isfinite(rows).all(axis=1)
    estimate = np.full(len(rows), np.nan)
    if complete.any():
        rows = rows / np.maximum(np.abs(rows[complete]).max(axis=0), np.finfo(float).tiny)
        if design.intercept:
            rows = np.column_stack([rows, np.ones(len(rows))])
        for left in range(FOLDS):
            others = complete & np.isfinite(label) & (part != left)
            if others.any():
                weights = np.linalg.lstsq(rows[others], label[others], rcond=None)[0]
                here = complete & (part == left)
                estimate[here] = rows[here] @ weights
    return np.split(estimate, np.cumsum([len(one.part) for one in drives])[:-1])


Known = tuple[str, Callable[[DriveSignals], FloatArray]]
"""What an estimator knows, in words, and what it makes of a drive."""


def _filtered(
    drives: Sequence[OwnDrive], vehicle: VehicleParameters, executor: Executor
) -> dict[str, tuple[str, list[FloatArray]]]:
    """Estimate each part by filters that are tuned, in cars identified, on the others."""
    found: dict[str, tuple[str, list[FloatArray]]] = {}
    drives = [replace(one, drive=accelerated(one.drive, vehicle)) for one in drives]
    for left in range(FOLDS):
        others = [one.without(left) for one in drives]
        others = [one for one in others if np.isfinite(one.sideslip_rad).any()]
        if len(drives) >= FOLDS:
            begin = TUNING_S * SAMPLE_RATE_HZ
            others = [one.beginning(begin) for one in choose_evenly(others, TUNING_DRIVES)]
        ready = _tuned(vehicle, others, executor)
        for name, (knows, estimate) in ready.items():
            _, estimates = found.setdefault(
                name, (knows, [np.full(len(one.part), np.nan) for one in drives])
            )
            for one, into in zip(drives, estimates, strict=True):
                here = one.part == left
                if here.any():
                    with suppress(DataError):  # this drive lacks a sensor: no estimate
                        into[here] = estimate(one.drive.signals)[here]
    return found


def _tuned(
    vehicle: VehicleParameters, others: Sequence[LabelledDrive], executor: Executor
) -> dict[str, Known]:
    """Return each filter by name, tuned on drives in the car of the file and in that identified."""
    ready: dict[str, Known] = {
        "kinematic": ("geometry", lambda signals: _rolling(signals, vehicle))
    }
    cars = {} if vehicle.description == IDENTIFIED else {"tuned": vehicle}
    try:
        identified = identify(Measured.of(vehicle), others, executor)
    except DataError as error:
        LOGGER.warning("no car is identified: %s", error)
        cars["tuned"] = vehicle
    else:
        cars["identified"] = identified.car
        ready["ekf_identified"] = (
            "geometry, and a car identified from the other parts",
            lambda signals: ekf.estimate(signals, identified.car, identified.noise),
        )
    navigated = any(np.isfinite(one.signals.gps_vx_mps).any() for one in others)
    for one in FILTERS:
        for how, car in cars.items():
            name = f"{one.module}_{how}"
            if one.told or name in ready or (one.gps and not navigated):
                continue
            try:
                ready[name] = (_knows(how), _in_car(one, car, others, executor))
            except DataError as error:
                LOGGER.warning("%s does not compete: %s", name, error)
    return ready


def _knows(how: str) -> str:
    if how == "identified":
        return "the identified car, and labels to be tuned by"
    return "the vehicle's file, and labels to be tuned by"


def _in_car(
    one: Filter,
    car: VehicleParameters,
    others: Sequence[LabelledDrive],
    executor: Executor,
) -> Callable[[DriveSignals], FloatArray]:
    parameters = one.tune(others, car, executor).parameters
    return lambda signals: one.estimate(signals, car, parameters)


WHEELS_LAG = 0.1
"""Of the change of wheel speeds in a step, what an acceleration made of them follows."""


def accelerated(drive: LabelledDrive, vehicle: VehicleParameters) -> LabelledDrive:
    """Return the drive with ax from its wheels where none is logged, as many a car has it."""
    signals = drive.signals
    if np.isfinite(signals.ax_mps2).any():
        return drive
    try:
        speed = measured_speed_mps(signals, vehicle)
    except DataError:
        return drive
    ax_mps2 = follow(np.diff(speed, prepend=speed[:1]) / STEP_S, WHEELS_LAG)
    return replace(drive, signals=replace(signals, ax_mps2=ax_mps2))


def _rolling(signals: DriveSignals, vehicle: VehicleParameters) -> FloatArray:
    """Return side-slip in rad where the rear wheels roll without slip, arctan(b r / vx)."""
    turning = estimate_yaw_rate(signals, vehicle, YawRateNoise()).yaw_rate_rad_s
    return np.arctan2(vehicle.body.rear_axle_m * turning, measured_speed_mps(signals, vehicle))


# The extended Kalman filter in a car that was identified from the drives a model learned from, as a
# department would build it that has scales, a tape measure and labelled drives.

NAME = "ekf_identified"

DRIVES_OF_A_CLASS = 12
"""Of each class of cars a dozen tell as much, in half the time."""


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
        car = self.cars[self.driven]
        return ekf.estimate(seen(signals), car.car, car.noise)

    def description(self) -> dict[str, Any]:
        """Return what a JSON document says of it."""
        return {
            "kind": "filter",
            "group": GROUP,
            "gps": False,
            "told": "labelled drives",
            "parameters": {name: _dumped(one) for name, one in self.cars.items()},
        }


def identified_estimate(
    warehouse: Warehouse, drives: TuningDrives, executor: Executor
) -> IdentifiedEstimate | None:
    """Identify each class of cars among drives; None where the drives do not allow it.

    What was found is kept below `tuned/` in the data root, and sought again only for other drives
    or another program.
    """
    key = {"drives": drives.key(), "program": checksum_of_sources()}
    kept = DocumentFolder(warehouse.root / "tuned" / "identified")
    found = find_kept(kept, key)
    if found is None:
        LOGGER.info("identifying the car, once")
        try:
            cars = {model: _dumped(one) for model, one in _identify(drives, executor).items()}
        except DataError as error:
            LOGGER.warning("no car can be identified from these drives: %s", error)
            return None
        found = {"key": key, "cars": cars}
        kept.append(found)
    identified = {model: _loaded(one) for model, one in found["cars"].items()}
    return IdentifiedEstimate(identified, next(iter(identified))) if identified else None


def _identify(drives: TuningDrives, executor: Executor) -> dict[str, Identified]:
    of_class: dict[str, list[LabelledDrive]] = {}
    for (_, model, _), drive in zip(drives.known, drives.read(), strict=True):
        if drive.car is not None:
            of_class.setdefault(model, []).append(replace(drive, car=None))
    return {
        model: identify(
            Measured.of(load_vehicle(model)),
            choose_evenly(own, DRIVES_OF_A_CLASS),
            executor,
        )
        for model, own in sorted(of_class.items())
    }


def _dumped(one: Identified) -> dict[str, Any]:
    return {
        "car": one.car.model_dump(mode="json"),
        "noise": one.noise.model_dump(mode="json"),
        "fit_rad": one.fit_rad,
    }


def _loaded(content: Mapping[str, Any]) -> Identified:
    return Identified(
        car=VehicleParameters.model_validate(content["car"]),
        noise=ekf.EkfNoise.model_validate(content["noise"]),
        fit_rad=content["fit_rad"],
    )
