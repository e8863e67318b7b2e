"""Identifies a car from drives with a label, as one does without measurements of its tyres.

Given are what scales and a tape measure say: mass, axles, tracks and the wheels' radius. Fitted are
yaw inertia, the roll stiffness' share in front, the axles' cornering stiffness and the tyres'
friction, together with the noise of the extended Kalman filter, which errs least then on the
drives' labels. As a vehicle file the car serves every filter here.
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Generic, Self, TypeVar

import numpy as np
from pydantic import Field, FiniteFloat, ValidationError

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.base import sha256_of
from fleet_slip.catalogue.signals import Identifier
from fleet_slip.config import Config, faults_of
from fleet_slip.errors import DataError, UsageError
from fleet_slip.evaluation import ekf
from fleet_slip.evaluation.single_track import DriveSignals, LabelledDrive
from fleet_slip.vehicle.parameters import GRAVITY_MPS2, VehicleParameters

# Finds the parameters of an estimator that suit training drives best, so that rivals are fair.

P = TypeVar("P", bound=Config)
Estimator = Callable[[DriveSignals, VehicleParameters, P], FloatArray]
"""What every module of this package offers as `estimate`."""

FIRST_FACTOR = 8.0
LAST_FACTOR = 1.25
"""The compass ends when changing any parameter by this factor does not help."""

EVERY = 5
"""Of the rows every so many-th is a residual: neighbours at 100 Hz err alike."""

STEP = 0.05
"""Of a logarithm, over which a derivative is taken."""

LONGEST = 1.0
"""Step of a logarithm at most: what a linearisation promises far away is not believed."""

ROUNDS = 12

LEAST_GAIN = 1e-3
"""A change must lower the error by this share; else a parameter without effect would wander off."""


@dataclass(frozen=True)
class Tuned(Generic[P]):
    """The best parameters found, and the root mean square of their error on the drives."""

    parameters: P
    rmse_rad: float
    evaluations: int


def checksum_of_sources(folder: Path = Path(__file__).parent) -> str:
    """Return the SHA-256 of the modules of a folder: by itself, of all that is tuned."""
    modules = sorted(folder.glob("*.py"))
    return sha256_of("\0".join(module.read_text(encoding="utf-8") for module in modules))


def errors_rad(
    estimate: Callable[[LabelledDrive], FloatArray],
    drives: Sequence[LabelledDrive],
    executor: Executor,
    every: int = 1,
) -> FloatArray:
    """Return the errors on every so many-th row of each drive; NaN without estimate or truth."""
    estimates = executor.map(estimate, drives)
    errors = [
        found[::every] - drive.sideslip_rad[::every]
        for found, drive in zip(estimates, drives, strict=True)
    ]
    return np.concatenate(errors) if errors else np.empty(0)


def finite(errors: FloatArray) -> BoolArray:
    """Return which errors there are. Raises `DataError` if there is none."""
    there: BoolArray = np.isfinite(errors)
    if not there.any():
        raise DataError("no row has both an estimate and a label. Choose other drives.")
    return there


def rmse_rad(
    estimate: Callable[[LabelledDrive], FloatArray],
    drives: Sequence[LabelledDrive],
    executor: Executor,
) -> float:
    """Return the RMSE over rows with estimate and truth. Raises `DataError` if no row has both."""
    errors = errors_rad(estimate, drives, executor)
    return float(np.sqrt(np.mean(errors[finite(errors)] ** 2)))


def tune(
    estimator: Estimator[P],
    start: P,
    names: Sequence[str],
    drives: Sequence[LabelledDrive],
    car: VehicleParameters,
    executor: Executor,
) -> Tuned[P]:
    """Return the best of the positive parameters `names` that two searches find from a start.

    Each estimator's module lists its own as `TUNABLE`; "yaw_rate.gyro_std_rad_s" is a nested one.
    A compass finds the right valley, derivatives its bottom. Raises as `rmse_rad`.
    """
    search = ParameterSearch(estimator, names, drives, car, executor)
    first, wide = search.descend(start), search.compass(start)
    last = search.descend(wide.parameters)
    evaluations = sum(one.evaluations for one in (first, wide, last))
    best = min(first, wide, last, key=lambda one: one.rmse_rad)
    return replace(best, evaluations=evaluations)


@dataclass(frozen=True)
class ParameterSearch(Generic[P]):
    """Two ways to the positive parameters `names` with which an estimator errs least on drives."""

    estimator: Estimator[P]
    names: Sequence[str]
    drives: Sequence[LabelledDrive]
    car: VehicleParameters
    executor: Executor

    def _estimate(self, parameters: P, drive: LabelledDrive) -> FloatArray:
        return self.estimator(drive.signals, drive.car or self.car, parameters)

    def rmse_rad(self, parameters: P) -> float:
        """Return the RMSE over all rows. Raises as `rmse_rad`."""
        return rmse_rad(partial(self._estimate, parameters), self.drives, self.executor)

    def compass(self, start: P) -> Tuned[P]:
        """Search along each parameter's logarithm in turn.

        Each in turn is multiplied and divided by a factor and keeps what lowers the error; when
        none does, the factor becomes its square root (Kolda, Lewis and Torczon, "Optimization by
        direct search", SIAM Review 45, 2003). Values that their model refuses are passed over.
        """
        best, lowest, evaluations = start, self.rmse_rad(start), 1
        factor = FIRST_FACTOR
        while factor > LAST_FACTOR:
            improved = False
            for name in self.names:
                for candidate in _neighbours(best, name, factor):
                    found = self.rmse_rad(candidate)
                    evaluations += 1
                    if found < lowest * (1 - LEAST_GAIN):
                        best, lowest, improved = candidate, found, True
                        break
            if not improved:
                factor **= 0.5
        return Tuned(best, lowest, evaluations)

    def descend(self, start: P) -> Tuned[P]:
        """Search by Levenberg's method in the parameters' logarithms.

        Several parameters do nearly the same, such as the stiffness of two axles, so that to change
        one after the other creeps along a valley; the derivatives of the errors show its direction
        (Levenberg, "A method for the solution of certain non-linear problems in least squares",
        Quarterly of Applied Mathematics 2, 1944). A parameter without effect stays, and so does one
        where its model refuses the next value. Raises as `rmse_rad`.
        """
        names, evaluations = self.names, 0

        def errors(parameters: P) -> FloatArray:
            nonlocal evaluations
            evaluations += 1
            estimate = partial(self._estimate, parameters)
            return errors_rad(estimate, self.drives, self.executor, EVERY)

        best, found = start, errors(start)
        there = finite(found)
        lowest, damping = float(np.mean(found[there] ** 2)), 1e-3
        for _ in range(ROUNDS):
            slopes = np.zeros((len(names), int(there.sum())))
            for place, name in enumerate(names):
                for change in (STEP, -STEP):
                    try:
                        moved = errors(_scaled(best, name, float(np.exp(change))))
                    except ValueError:
                        continue
                    slopes[place] = (moved[there] - found[there]) / change
                    break
            normal, slope = slopes @ slopes.T, slopes @ found[there]
            gained = False
            while not gained and damping < 1e4:
                damped = normal + damping * np.trace(normal) / len(names) * np.eye(len(names))
                step = np.clip(-np.linalg.solve(damped, slope), -LONGEST, LONGEST)
                damping *= 4
                candidate = best
                for name, change in zip(names, step, strict=True):
                    with suppress(ValueError):  # beyond what it may be: it stays
                        candidate = _scaled(candidate, name, float(np.exp(change)))
                tried = errors(candidate)
                mean = float(np.mean(tried[there] ** 2))
                if mean < lowest:
                    gain, gained = 1 - mean / lowest, True
                    best, found, lowest, damping = candidate, tried, mean, damping / 16
            if not gained or gain < LEAST_GAIN:
                break
        return Tuned(best, self.rmse_rad(best), evaluations)


def _neighbours(parameters: P, name: str, factor: float) -> list[P]:
    neighbours = []
    for change in (factor, 1 / factor):
        with suppress(ValueError):
            neighbours.append(_scaled(parameters, name, change))
    return neighbours


def _scaled(parameters: P, name: str, factor: float) -> P:
    """Return the parameters with one of them multiplied; a dot leads into a nested model."""
    field, _, inner = name.partition(".")
    value = getattr(parameters, field)
    changed = _scaled(value, inner, factor) if inner else value * factor
    return type(parameters).model_validate({**dict(parameters), field: changed})


class Fitted(Config):
    """What is estimated from drives, within what cars are, and the noise of the filter."""

    stiffness_front: FiniteFloat = Field(default=1.0, ge=0.4, le=2.5)
    """Of the axle, over `STIFFNESS_PER_LOAD`."""
    stiffness_rear: FiniteFloat = Field(default=1.0, ge=0.4, le=2.5)
    yaw_inertia: FiniteFloat = Field(default=1.0, ge=0.6, le=1.6)
    """Over the sprung mass times both distances to the axles."""
    front_roll_share: FiniteFloat = Field(default=0.55, ge=0.3, le=0.8)
    friction: FiniteFloat = Field(default=1.0, ge=0.6, le=1.5)
    noise: ekf.EkfNoise = ekf.EkfNoise()


CAR = ("stiffness_front", "stiffness_rear", "friction", "front_roll_share", "yaw_inertia")
NOISE = tuple(f"noise.{name}" for name in ekf.TUNABLE if not name.startswith("stiffness"))

FOLDS = 4

IDENTIFIED = "Identified from labelled drives"
"""The description of such a car."""

UNSPRUNG_SHARE = 0.11
"""Of the mass: wheels, hubs and brakes of both axles."""

STIFFNESS_PER_LOAD = 15.0
"""Cornering stiffness of a tyre at its load at rest, per rad, where the search begins."""


class Measured(Config):
    """What scales and a tape measure say of a car."""

    name: Identifier
    mass_kg: FiniteFloat = Field(gt=0)
    """Of the whole car, with the driver."""
    front_axle_m: FiniteFloat = Field(gt=0)
    """From the centre of gravity to the front axle."""
    rear_axle_m: FiniteFloat = Field(gt=0)
    track_m: FiniteFloat = Field(default=1.55, gt=0)
    height_m: FiniteFloat = Field(default=0.55, gt=0)
    """Of the centre of gravity above the road."""
    rolling_radius_m: FiniteFloat = Field(default=0.315, gt=0)
    front_drive_share: FiniteFloat = Field(default=1.0, ge=0, le=1)

    @classmethod
    def of(cls, car: VehicleParameters) -> Self:
        """Return what can be measured so of a car that is known."""
        return cls(
            name=car.name,
            mass_kg=car.body.mass_kg,
            front_axle_m=car.body.front_axle_m,
            rear_axle_m=car.body.rear_axle_m,
            track_m=(car.body.track_front_m + car.body.track_rear_m) / 2,
            height_m=car.body.height_m,
            rolling_radius_m=car.tyre.rolling_radius_m,
            front_drive_share=car.drivetrain.front_drive_share,
        )

    def car(self, fitted: Fitted) -> VehicleParameters:
        """Return the car with what was fitted."""
        sprung_kg = (1 - UNSPRUNG_SHARE) * self.mass_kg
        wheel_n = self.mass_kg * GRAVITY_MPS2 / 4
        content = {
            "name": self.name,
            "description": IDENTIFIED,
            "body": {
                "sprung_mass_kg": sprung_kg,
                "unsprung_mass_front_kg": (self.mass_kg - sprung_kg) / 2,
                "unsprung_mass_rear_kg": (self.mass_kg - sprung_kg) / 2,
                "sprung_yaw_inertia_kgm2": (
                    fitted.yaw_inertia * sprung_kg * self.front_axle_m * self.rear_axle_m
                ),
                "front_axle_m": self.front_axle_m,
                "rear_axle_m": self.rear_axle_m,
                "height_m": self.height_m,
                "track_front_m": self.track_m,
                "track_rear_m": self.track_m,
            },
            "suspension": {
                "front_roll_share": fitted.front_roll_share,
                "roll_lag_s": 0.12,
                "pitch_lag_s": 0.12,
                "front_stiffness_factor": fitted.stiffness_front,
                "rear_stiffness_factor": fitted.stiffness_rear,
            },
            "tyre": {
                "rolling_radius_m": self.rolling_radius_m,
                "spin_inertia_kgm2": 1.1,
                # A tyre is stiffest at twice its load at rest, where it has 5/4 of this stiffness.
                "peak_stiffness_n": 1.25 * STIFFNESS_PER_LOAD * wheel_n,
                "peak_stiffness_load_n": 2 * wheel_n,
                "longitudinal_stiffness_ratio": 1.3,
                "friction": fitted.friction,
                "nominal_load_n": wheel_n,
                "friction_load_sensitivity": 0.1,
                "friction_decay_speed_mps": 60.0,
                "rolling_resistance": 0.012,
            },
            "steering": {"ratio": 16.0, "lag_s": 0.05, "limit_rad": 8.7},
            "drivetrain": {
                "front_drive_share": self.front_drive_share,
                "front_brake_share": 0.7,
                "lag_s": 0.1,
                "power_w": 100_000.0,
                "slip_control": 0.05,
            },
            "aerodynamics": {"drag_area_m2": 0.65},
        }
        return VehicleParameters.model_validate(content)


def measured_car(name: str, measured: Mapping[str, float]) -> Measured:
    """Return what was measured of a car. Raises `UsageError` for what no car can have."""
    try:
        return Measured.model_validate({"name": name, **measured})
    except ValidationError as error:
        raise UsageError(f"what was measured of the car: {faults_of(error)}.") from None


@dataclass(frozen=True)
class Identified:
    """A car, the noise of the filter in it, and how far it errs, in rad.

    Attributes:
        car, noise: what was found on all drives.
        fit_rad: RMSE on them.
        held_out_rad: RMSE on drives that were left out, in `FOLDS` parts; None for a single drive.
        drives: from how many.
    """

    car: VehicleParameters
    noise: ekf.EkfNoise
    fit_rad: float
    held_out_rad: float | None = None
    drives: int = 0

    def estimate(self, signals: DriveSignals) -> FloatArray:
        """Return what the filter in the car estimates of a drive."""
        return ekf.estimate(signals, self.car, self.noise)

    def dump(self) -> dict[str, Any]:
        """Return what is kept of it."""
        content = {name: getattr(self, name).model_dump(mode="json") for name in ("car", "noise")}
        return {**content, "fit_rad": self.fit_rad}

    @classmethod
    def load(cls, content: Mapping[str, Any]) -> Self:
        """Return what was kept."""
        car = VehicleParameters.model_validate(content["car"])
        return cls(car, ekf.EkfNoise.model_validate(content["noise"]), content["fit_rad"])

    def as_dict(self) -> dict[str, Any]:
        """Return what a JSON document says: what was found, and errors in degrees."""
        car = self.car
        return {
            "name": car.name,
            "drives": self.drives,
            "found": {
                "front_stiffness_factor": car.suspension.front_stiffness_factor,
                "rear_stiffness_factor": car.suspension.rear_stiffness_factor,
                "yaw_inertia_kgm2": car.body.yaw_inertia_kgm2,
                "front_roll_share": car.suspension.front_roll_share,
                "friction": car.tyre.friction,
            },
            "noise": self.noise.model_dump(mode="json"),
            "fit_deg": math.degrees(self.fit_rad),
            "held_out_deg": None if self.held_out_rad is None else math.degrees(self.held_out_rad),
        }

    def as_toml(self) -> str:
        """Return the car as a vehicle file."""
        lines = [f"name = {json.dumps(self.car.name)}"]
        lines.append(f"description = {json.dumps(self.car.description)}")
        for part, values in self.car.model_dump(exclude={"name", "description"}).items():
            lines += ["", f"[{part}]", *(f"{name} = {value!r}" for name, value in values.items())]
        return "\n".join(lines) + "\n"


def identify(measured: Measured, drives: Sequence[LabelledDrive], executor: Executor) -> Identified:
    """Fit a car and the filter's noise to drives. Raises `DataError` without rows of a label."""

    def estimate(signals: DriveSignals, _: VehicleParameters, tried: Fitted) -> FloatArray:
        return ekf.estimate(signals, measured.car(tried), tried.noise)

    start = Fitted()
    car = measured.car(start)
    found = ParameterSearch(estimate, (*CAR, *NOISE), drives, car, executor).descend(start)
    car = measured.car(found.parameters)
    return Identified(car, found.parameters.noise, found.rmse_rad, drives=len(drives))


def identify_held_out(
    measured: Measured, drives: Sequence[LabelledDrive], executor: Executor
) -> Identified:
    """Identify a car from all drives, and measure it on drives that it was not identified from."""
    found = identify(measured, drives, executor)
    if len(drives) < 2:
        return found
    errors: list[FloatArray] = []
    for fold in range(min(FOLDS, len(drives))):
        others = [one for place, one in enumerate(drives) if place % FOLDS != fold]
        other = identify(measured, others, executor)
        left_out = drives[fold::FOLDS]
        estimates = executor.map(other.estimate, [one.signals for one in left_out])
        errors += [e - one.sideslip_rad for e, one in zip(estimates, left_out, strict=True)]
    error = np.concatenate(errors)
    error = error[np.isfinite(error)]
    return replace(found, held_out_rad=float(np.sqrt(np.mean(error**2))) if len(error) else None)
