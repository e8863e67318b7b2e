"""Identifies a car from drives with a label, as one does without measurements of its tyres.

Given are what scales and a tape measure say: mass, axles, tracks and the wheels' radius. Fitted are
yaw inertia, the roll stiffness' share in front, the axles' cornering stiffness, the tyres' friction
and how steering and lateral accelerometer are off, together with the noise of the extended Kalman
filter, which errs least then on the drives' labels. As a vehicle file the car serves every filter.
"""

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property, partial, reduce
from pathlib import Path
from typing import Any, Generic, Self, TypeVar

import numpy as np
from pydantic import Field, FiniteFloat, ValidationError

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.base import pluralize, sha256_of
from fleet_slip.catalog.signals import Identifier
from fleet_slip.config import Config, faults_of
from fleet_slip.errors import DataError, UsageError
from fleet_slip.evaluation import ekf
from fleet_slip.evaluation.single_track import (
    STEP_S,
    DriveSignals,
    LabelledDrive,
    measured_speed_mps,
    without_rest,
)
from fleet_slip.rendering import Answer, Part, Remark, TextTable
from fleet_slip.vehicle.parameters import GRAVITY_MPS2, VehicleParameters

# Finds the parameters of an estimator that suit training drives best, so that rivals are fair.

P = TypeVar("P", bound=Config)
Estimator = Callable[[DriveSignals, VehicleParameters, P], FloatArray]
"""What every module of this package offers as `estimate`."""

FARTHER = math.log(4)
"""In logarithms, how far from what is given `tune` begins as well."""

EVERY = 5
"""Of the rows every so many-th is a residual: neighbours at 100 Hz err alike."""

STEP = 0.05
"""Of a logarithm, over which a derivative is taken."""

ROUNDS = 12
"""Steps of a search at most."""

TRIED_ROUNDS = 3
"""How far each start is followed, before the best of them goes on."""

LEAST_GAIN = 1e-3
"""Share of the error by which a step must lower it, for the search to go on."""


@dataclass(frozen=True)
class Tuned(Generic[P]):
    """The best parameters found, and the root mean square of their error on the drives."""

    parameters: P
    rmse_rad: float


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
    """Return the best of the parameters `names` that searches find from a start and around it.

    Each estimator's module lists its own as `TUNABLE`; "yaw_rate.gyro_std_rad_s" is a nested one.
    Raises as `rmse_rad`.
    """
    at = Coordinates(start, names)

    def estimate(parameters: P, drive: LabelledDrive) -> FloatArray:
        return estimator(drive.signals, drive.car or car, parameters)

    def errors(x: FloatArray) -> FloatArray:
        return errors_rad(partial(estimate, at.parameters(x)), drives, executor, EVERY)

    there = finite(errors(np.zeros(len(names))))
    sides = np.where(np.arange(len(names)) % 2, 1.0, -1.0)
    begins = [np.full(len(names), change) for change in (0.0, FARTHER, -FARTHER)]
    begins += [FARTHER * sides, -FARTHER * sides]
    found = search(lambda x: errors(x)[there], at, begins)
    best = at.parameters(found.x)
    return Tuned(best, rmse_rad(partial(estimate, best), drives, executor))


ADDED = {"steer_offset_rad": 0.02, "ay_offset_mps2": 0.2}
"""Parameters around zero, and by how much they differ from car to car; others are multiplied."""


@dataclass(frozen=True)
class Coordinates(Generic[P]):
    """Some parameters as a vector that is 0 at a start: logarithms of factors, or units added."""

    start: P
    names: Sequence[str]

    def parameters(self, x: FloatArray) -> P:
        """Return the parameters at a place, within what their models allow."""
        found = self.start
        for name, change, limits in zip(self.names, x, self.limits, strict=True):
            value, unit = _value(found, name), ADDED.get(name.rpartition(".")[2])
            moved = value * float(np.exp(change)) if unit is None else value + unit * float(change)
            found = _with(found, name, min(max(moved, limits[0]), limits[1]))
        return found

    @cached_property
    def limits(self) -> list[tuple[float, float]]:
        """The least and the largest value of each."""
        return [_limits(self.start, name) for name in self.names]

    @cached_property
    def bounds(self) -> FloatArray:
        """Least and largest coordinates, shape (2, n)."""
        return np.array([self.place(limits) for limits in zip(*self.limits, strict=True)])

    def place(self, values: Iterable[float]) -> FloatArray:
        """Return where some values are."""
        found = []
        for name, value in zip(self.names, values, strict=True):
            start, unit = _value(self.start, name), ADDED.get(name.rpartition(".")[2])
            if unit is not None:
                found.append((value - start) / unit)
            else:
                found.append(math.log(value / start) if value > 0 else -math.inf)
        return np.array(found)


@dataclass(frozen=True)
class Descent:
    """Where a descent ended, the loss there, and the derivatives, shape (parameters, residuals)."""

    x: FloatArray
    loss: float
    slopes: FloatArray


def descend(
    residuals: Callable[[FloatArray], FloatArray],
    at: Coordinates[P],
    x: FloatArray,
    rounds: int = ROUNDS,
) -> Descent:
    """Minimise the sum of squares within bounds by SciPy's dogleg method.

    Derivatives are taken over `STEP`: the errors of a filter are too rough for smaller steps.
    """
    from scipy.optimize import least_squares  # noqa: PLC0415 - slow

    lower, upper = at.bounds

    def slopes(x: FloatArray) -> FloatArray:
        """Return the derivatives of the residuals, shape (residuals, parameters)."""
        start = residuals(x)
        steps = np.diag(np.where(x + STEP <= upper, STEP, -STEP))
        return np.stack([(residuals(x + step) - start) / step.sum() for step in steps], axis=1)

    result = least_squares(
        residuals,
        x,
        slopes,
        (lower, upper),
        method="dogbox",
        ftol=LEAST_GAIN,
        xtol=None,
        gtol=None,
        max_nfev=rounds,
    )
    return Descent(result.x, 2 * float(result.cost), result.jac.T)


def search(
    residuals: Callable[[FloatArray], FloatArray], at: Coordinates[P], begins: Sequence[FloatArray]
) -> Descent:
    """Follow some begins for `TRIED_ROUNDS`, and the best of them to its end."""
    within = [np.clip(begin, *at.bounds) for begin in begins]
    tried = [descend(residuals, at, begin, TRIED_ROUNDS) for begin in within]
    return descend(residuals, at, min(tried, key=lambda one: one.loss).x)


def _value(parameters: Config, name: str) -> float:
    """Return a parameter; a dot leads into a nested model."""
    return float(reduce(getattr, name.split("."), parameters))  # type: ignore[arg-type]


def _with(parameters: P, name: str, value: float) -> P:
    """Return the parameters with another value of one."""
    field, _, inner = name.partition(".")
    new = _with(getattr(parameters, field), inner, value) if inner else value
    return type(parameters).model_validate({**dict(parameters), field: new})


def _limits(parameters: Config, name: str) -> tuple[float, float]:
    """Return between which values a parameter may be."""
    *outer, field = name.split(".")
    said = type(reduce(getattr, outer, parameters)).model_fields[field].metadata
    least = (getattr(one, "ge", getattr(one, "gt", None)) for one in said)
    largest = (getattr(one, "le", None) for one in said)
    return (
        next((one for one in least if one is not None), -math.inf),
        next((one for one in largest if one is not None), math.inf),
    )


class Fitted(Config):
    """What is estimated from drives, within what cars are, and the noise of the filter."""

    stiffness_front: FiniteFloat = Field(default=1.0, ge=0.2, le=8)
    """Of the axle, over `STIFFNESS_PER_LOAD`."""
    stiffness_rear: FiniteFloat = Field(default=1.0, ge=0.2, le=8)
    yaw_inertia: FiniteFloat = Field(default=1.0, ge=0.4, le=2)
    """Over the sprung mass times both distances to the axles."""
    front_roll_share: FiniteFloat = Field(default=0.55, ge=0.05, le=0.95)
    friction: FiniteFloat = Field(default=1.0, ge=0.4, le=2.5)
    steering_ratio: FiniteFloat = Field(default=15.0, ge=5, le=30)
    """Of the steering wheel to the road wheels, where no angle of these is logged."""
    noise: ekf.EkfNoise = ekf.EkfNoise()


SPREAD = {
    "stiffness_front": 0.5,
    "stiffness_rear": 0.5,
    "friction": 0.3,
    "front_roll_share": 0.3,
    "yaw_inertia": 0.2,
    "steering_ratio": 0.2,
    "noise.sensors.steer_gain": 0.05,
    "noise.sensors.steer_offset_rad": 1.0,
}
"""What is found of a car and its sensors, and by how much that differs from car to car: standard
deviations of logarithms, or in units of `ADDED`."""

NOISE = tuple(f"noise.{name}" for name in ekf.TUNABLE if not name.startswith("stiffness"))
NOISE_SPREAD = 2.0
"""Of the logarithm of a noise: next to nothing is known of it."""

BELIEF_RAD = math.radians(0.04)
"""RMSE over drives that one standard deviation of what is known before is worth: errors of 0.3° of
some fifty independent pieces of each drive."""

LARGE_RAD = math.radians(1.0)
"""Larger errors count by their size, not its square: in a spin nobody's tyre model is right."""

STARTS: tuple[Mapping[str, float], ...] = (
    {},
    {"stiffness_front": 2.0, "stiffness_rear": 2.0, "noise.ay_std_mps2": 5.0},
)
"""Where a search begins: the tyres' force, or the yaw rate alone, tells of the angle."""

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
            "steering": {"ratio": fitted.steering_ratio, "lag_s": 0.05, "limit_rad": 8.7},
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


def measured_car(name: str, measured: Mapping[str, object]) -> Measured:
    """Return what was measured of a car. Raises `UsageError` for what no car can have."""
    known = {what: value for what, value in measured.items() if value is not None}
    try:
        return Measured.model_validate({"name": name, **known})
    except ValidationError as error:
        raise UsageError(f"what was measured of the car: {faults_of(error)}.") from None


@dataclass(frozen=True)
class Identified(Answer):
    """A car, the noise of the filter in it, and how far it errs, in rad.

    Attributes:
        car, noise: what was found on all drives.
        fit_rad: RMSE on them.
        held_out_rad: RMSE on drives that were left out, in `FOLDS` parts; None for a single drive.
        drives: from how many.
        at_bounds: which parameters ended at the bound of what they may be.
        not_identifiable: which of the car and its sensors these drives do not tell.
    """

    car: VehicleParameters
    noise: ekf.EkfNoise
    fit_rad: float
    held_out_rad: float | None = None
    drives: int = 0
    at_bounds: tuple[str, ...] = ()
    not_identifiable: tuple[str, ...] = ()

    def parts(self) -> Iterator[Part]:
        """Return what was found, how far the filter errs, and what the drives do not tell."""
        said = self.as_dict()
        title = f"{self.car.name}, identified from {pluralize(self.drives, 'drive')}"
        values = ((what.replace("_", " "), value) for what, value in said["found"].items())
        yield TextTable(title, "what|value", values, "{0}|{1:.4g}")
        left_out = said["held_out_deg"]
        yield Remark(
            f"RMSE of the extended Kalman filter in it: {said['fit_deg']:.4f} deg on these drives"
            + ("." if left_out is None else f", {left_out:.4f} deg on those left out.")
        )
        if self.at_bounds:
            yield Remark(
                f"at the bound of plausible values: {', '.join(said['at_bounds'])}. Drives or "
                "label contradict the model there: do not use it as the car's value."
            )
        if self.not_identifiable:
            names = ", ".join(said["not_identifiable"])
            yield Remark(f"not identifiable from these drives: {names}.")

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
                "steering_ratio": car.steering.ratio,
                "steer_gain": self.noise.sensors.steer_gain,
                "steer_offset_deg": math.degrees(self.noise.sensors.steer_offset_rad),
                "ay_gain": self.noise.sensors.ay_gain,
                "ay_offset_mps2": self.noise.sensors.ay_offset_mps2,
            },
            "at_bounds": [name.rpartition(".")[2] for name in self.at_bounds],
            "not_identifiable": [name.rpartition(".")[2] for name in self.not_identifiable],
            "noise": self.noise.model_dump(mode="json"),
            "fit_deg": math.degrees(self.fit_rad),
            "held_out_deg": None if self.held_out_rad is None else math.degrees(self.held_out_rad),
        }

    def as_toml(self) -> str:
        """Return the car as a vehicle file."""
        return "\n".join(self._lines("")) + "\n"

    def as_campaign(self) -> str:
        """Return a campaign in the car, on the roads of the campaign `prior`."""
        name = f"prior_{self.car.name}"
        head = [f"name = {json.dumps(name)}", f"description = {json.dumps(IDENTIFIED)}"]
        head += ['base = "prior"', "", "[[plan.vehicles]]"]
        return "\n".join([*head, *self._lines("plan.vehicles.")]) + "\n"

    def _lines(self, within: str) -> list[str]:
        lines = [f"name = {json.dumps(self.car.name)}"]
        lines.append(f"description = {json.dumps(self.car.description)}")
        for part, values in self.car.model_dump(exclude={"name", "description"}).items():
            rows = (f"{name} = {value!r}" for name, value in values.items())
            lines += ["", f"[{within}{part}]", *rows]
        return lines


MEAN_ROWS = 32
"""Accelerations are compared as means over so many rows: at 100 Hz they shake."""

LEAST_LATERAL_MPS2 = 0.3
"""Standard deviation of the lateral acceleration below which a drive tells no gain."""


ACCELEROMETER = ("ay_gain", "ay_offset_mps2")


def accelerometer(
    drives: Sequence[LabelledDrive], car: VehicleParameters
) -> ekf.SensorErrors | None:
    """Return gain and offset of ay by the label, ay = gain (v̇y + r vx) + offset; None of no bends.

    With vy = vx tan β this is geometry, in which no tyre has a part. By least squares, every drive
    with the same weight.
    """
    square, product = np.zeros((2, 2)), np.zeros(2)
    for one in drives:
        vx = measured_speed_mps(ekf.SensorErrors().corrected(one.signals, car), car)
        vy = vx * np.tan(one.sideslip_rad)
        turning, measured = (
            np.convolve(values, np.full(MEAN_ROWS, 1 / MEAN_ROWS), "valid")
            for values in (one.signals.yaw_rate_rad_s * vx, one.signals.ay_mps2)
        )
        gained = vy[MEAN_ROWS - 1 :] - vy[: len(vy) - MEAN_ROWS + 1]
        true = turning + gained / (MEAN_ROWS - 1) / STEP_S
        there = np.isfinite(true + measured)
        if there.any() and true[there].std() > LEAST_LATERAL_MPS2:
            columns = np.stack([true[there], np.ones(there.sum())])
            square += columns @ columns.T / there.sum()
            product += columns @ measured[there] / there.sum()
    if not square.any():
        return None
    at = Coordinates(ekf.SensorErrors(), ACCELEROMETER)
    return at.parameters(at.place(np.linalg.solve(square, product)))


def identify(measured: Measured, drives: Sequence[LabelledDrive], executor: Executor) -> Identified:
    """Fit a car, its sensors and the filter's noise to drives. Raises `DataError` without a label.

    Every drive has the same weight, large errors count less than their squares (pseudo-Huber), and
    what is known of cars before any drive is a further residual of each parameter: what the drives
    do not tell stays there.
    """
    drives = [without_rest(one, measured.car(Fitted())) for one in drives]
    finite(np.concatenate([one.sideslip_rad for one in drives]))
    told = [np.isfinite(one.sideslip_rad[::EVERY]) for one in drives]
    wheels = any(one.signals.has_road_wheels for one in drives)
    unused = "steering_ratio" if wheels else "noise.sensors.steer_gain"
    names = [name for name in (*SPREAD, *NOISE) if name != unused]
    sensors = accelerometer(drives, measured.car(Fitted()))
    start = Fitted(noise=ekf.EkfNoise(sensors=sensors or ekf.SensorErrors()))
    at = Coordinates(start, names)
    spread = np.array([SPREAD.get(name, NOISE_SPREAD) for name in names])

    def estimate(tried: Fitted, drive: LabelledDrive) -> FloatArray:
        return ekf.estimate(drive.signals, measured.car(tried), tried.noise)

    def residuals(x: FloatArray) -> FloatArray:
        estimates = executor.map(partial(estimate, at.parameters(x)), drives)
        parts = [BELIEF_RAD * x / spread]
        for found, one, there in zip(estimates, drives, told, strict=True):
            error = np.nan_to_num((found - one.sideslip_rad)[::EVERY][there], nan=LARGE_RAD)
            size = LARGE_RAD * np.sqrt(2 * (np.hypot(1, error / LARGE_RAD) - 1))
            parts.append(np.copysign(size, error) / math.sqrt(max(len(error), 1)))
        return np.concatenate(parts)

    begins = [at.place([one.get(n, _value(start, n)) for n in names]) for one in STARTS]
    found = search(residuals, at, begins)
    fitted = at.parameters(found.x)
    estimates = partial(estimate, fitted)
    inverse = np.linalg.inv(found.slopes @ found.slopes.T)
    known = np.sqrt(np.diag(inverse)) * BELIEF_RAD / spread
    ended = np.flatnonzero(np.isclose(found.x, at.bounds, atol=1e-6).any(axis=0))
    return Identified(
        measured.car(fitted),
        fitted.noise,
        rmse_rad(estimates, drives, executor),
        drives=len(drives),
        at_bounds=tuple(names[place] for place in ended),
        not_identifiable=(
            *(n for n, left in zip(names, known, strict=True) if n in SPREAD and left > UNKNOWN),
            *(() if sensors else (f"noise.sensors.{name}" for name in ACCELEROMETER)),
        ),
    )


UNKNOWN = 0.9
"""Standard deviation of a parameter over that before any drive, above which drives tell nothing."""


def identify_held_out(
    measured: Measured, drives: Sequence[LabelledDrive], executor: Executor
) -> Identified:
    """Identify a car from all drives, and measure it on drives that it was not identified from."""
    drives = [without_rest(one, measured.car(Fitted())) for one in drives]
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
