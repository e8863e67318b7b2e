"""All estimators on measured drives with a label, each part of them held out in turn.

Models are fitted, filters tuned and a car identified on the other parts; whatever is estimated was
not seen. A part is a quarter of the drives, or of each drive's time where there are few.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from importlib.metadata import version as package_version
from typing import Any

import numpy as np

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.comparison.evaluation.evaluated_drives import SLOWEST_MPS
from fleet_slip.comparison.evaluation.filters import (
    FILTERS,
    TUNING_DRIVES,
    TUNING_S,
    Filter,
    choose_evenly,
    class_car,
)
from fleet_slip.comparison.evaluation.own_drives import (
    Design,
    OwnDrive,
    designs_of,
    read_own_drives,
)
from fleet_slip.comparison.evaluation.scenario_runs import ErrorFigures, error_figures
from fleet_slip.comparison.observers import ekf
from fleet_slip.comparison.observers.drive_signals import STEP_S, DriveSignals, LabelledDrive
from fleet_slip.comparison.observers.identification import FOLDS, IDENTIFIED, Measured, identify
from fleet_slip.comparison.observers.single_track import follow, measured_speed_mps
from fleet_slip.comparison.observers.yaw_rate import YawRateNoise
from fleet_slip.comparison.observers.yaw_rate import estimate as estimate_yaw_rate
from fleet_slip.errors import DataError
from fleet_slip.files.documents import DocumentFolder
from fleet_slip.grams.cohorts.gram_cohort import load_cohort
from fleet_slip.models.model_version import ModelVersion
from fleet_slip.runs.log import LOGGER
from fleet_slip.simulation.sensing.sensors import SAMPLE_RATE_HZ
from fleet_slip.vehicle.parameters import VehicleParameters, load_vehicle
from fleet_slip.warehouse.tables import Warehouse

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
                name: {"told": self.told[name], **one.as_dict()}
                for name, one in self.figures.items()
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
    together = {
        name: error_figures(np.concatenate(found), np.concatenate(truth), np.concatenate(among))
        for name, found in estimates.items()
    }
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
