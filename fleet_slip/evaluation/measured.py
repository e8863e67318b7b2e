"""All estimators on measured drives with a label, each part of them held out in turn.

Models are fitted, filters tuned and a car identified on the other parts; whatever is estimated was
not seen. A part is a quarter of the drives, or of each drive's time where there are few.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib.metadata import version as package_version
from typing import Any

import numpy as np

from fleet_slip.arrays import BoolArray, FloatArray, IntArray
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.columns.drive_columns import DriveColumns
from fleet_slip.columns.plan import ColumnPlan
from fleet_slip.config import Config
from fleet_slip.errors import DataError
from fleet_slip.evaluation.belief import YawRateNoise
from fleet_slip.evaluation.belief import estimate as estimate_yaw_rate
from fleet_slip.evaluation.drives import SLOWEST_MPS
from fleet_slip.evaluation.filters import (
    FILTERS,
    TABLE_ONE,
    TUNING_DRIVES,
    TUNING_S,
    Filter,
    choose_evenly,
    class_car,
)
from fleet_slip.evaluation.identify import FOLDS, IDENTIFIED, Measured, identify
from fleet_slip.evaluation.judge import JudgedDrive, judge
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
class HeldOutDrive:
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


def read_measured_drives(
    warehouse: Warehouse, names: Sequence[str], designs: Mapping[str, Design]
) -> list[HeldOutDrive]:
    """Read drives with their designs' columns. Raises `DataError` where none has a label."""
    drives: list[HeldOutDrive] = []
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
            drives.append(HeldOutDrive(drive, columns, np.full(len(rows), len(drives) % FOLDS)))
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


def evaluate_measured(
    warehouse: Warehouse,
    versions: Sequence[ModelVersion],
    condition: str,
    file: str | None,
    executor: Executor,
) -> dict[str, Any]:
    """Evaluate models, those of Table I and, in a car, filters on measured drives.

    A model that was trained on labels of these drives is fitted anew; another is judged as it is.
    The car is that of a vehicle `file`, or of the drives' class where one ships. Returns the
    evaluation's document, the best first. Raises `DataError` without drives that have a label,
    `ConfigError` for an unknown car, and as `load_cohort`.
    """
    found = load_cohort(warehouse, condition).drives
    names = sorted({*found["drive_id"].to_pylist()})
    vehicle = load_vehicle(file) if file else class_car(found["vehicle_model"][0].as_py(), None)
    designs = designs_of(warehouse, versions, condition)
    drives = read_measured_drives(warehouse, choose_evenly(names, DRIVES_AT_MOST), designs)
    knowing: dict[str, tuple[str, list[FloatArray]]] = {
        name: (
            "as published" if design.published else "fitted to labels of the other parts",
            fit_left_out(drives, name, design),
        )
        for name, design in designs.items()
    }
    if vehicle is not None:
        knowing |= _filtered(drives, vehicle, executor)
    judged = [
        JudgedDrive(
            one.drive.drive_id,
            one.drive.sideslip_rad,
            _judged(one, vehicle),
            {name: estimates[place] for name, (_, estimates) in knowing.items()},
        )
        for place, one in enumerate(drives)
    ]
    kept = {name: one for name, one in judge(judged).items() if one.rmse_deg is not None}
    order = sorted(kept, key=lambda name: kept[name].rmse_deg or 0.0)
    return {
        "format": 1,
        "package_version": package_version("fleet-slip"),
        "model": versions[0].reference,
        "cohort": condition,
        "vehicle": vehicle.name if vehicle else None,
        "parts_of": "time" if len(drives) < FOLDS else "drives",
        "estimators": {name: {"told": knowing[name][0], **asdict(kept[name])} for name in order},
        "drives": [
            {
                "name": one.name,
                "sideslip_std_deg": one.sideslip_std_deg,
                "results": {name: asdict(found[name]) for name in order},
            }
            for one, found in ((one, judge([one])) for one in judged)
        ],
    }


def _judged(one: HeldOutDrive, vehicle: VehicleParameters | None) -> BoolArray:
    """Return the rows with a label where the car moves, by its wheel speeds."""
    labelled: BoolArray = np.isfinite(one.drive.sideslip_rad)
    if vehicle is None:
        return labelled
    try:
        return labelled & (measured_speed_mps(one.drive.signals, vehicle) > SLOWEST_MPS)
    except DataError:
        return labelled


def fit_left_out(drives: Sequence[HeldOutDrive], name: str, design: Design) -> list[FloatArray]:
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
    drives: Sequence[HeldOutDrive], vehicle: VehicleParameters, executor: Executor
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
    cars = {"tuned": ("the vehicle's file", vehicle)}
    try:
        identified = identify(Measured.of(vehicle), others, executor)
    except DataError as error:
        LOGGER.warning("no car is identified: %s", error)
    else:
        if vehicle.description == IDENTIFIED:
            del cars["tuned"]
        cars["identified"] = ("the identified car", identified.car)
        knows = "geometry, and a car identified from the other parts"
        ready["ekf_identified"] = (knows, identified.estimate)
    navigated = any(np.isfinite(one.signals.gps_vx_mps).any() for one in others)
    for one in FILTERS:
        for how, (knows, car) in cars.items():
            name = f"{one.module}_{how}"
            if one.informed or name in ready or (one.gps and not navigated):
                continue
            try:
                tuned = one.tune(others, car, executor).parameters
            except DataError as error:
                LOGGER.warning("%s does not compete: %s", name, error)
            else:
                estimate = partial(_estimate, one, car, tuned)
                ready[name] = (f"{knows}, and labels to be tuned by", estimate)
    return ready


def _estimate(
    one: Filter, car: VehicleParameters, parameters: Config, signals: DriveSignals
) -> FloatArray:
    return one.estimate(signals, car, parameters)


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
