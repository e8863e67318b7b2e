"""Identification of parameters from labelled drives: of filters, and of vehicles.

Of a vehicle no measurements of its tyres are needed.

Given are mass, axle distances, track width and rolling radius. Fitted are yaw inertia, the front
share of the roll stiffness, cornering stiffness of the axles, friction of the tyres, errors of
steering and lateral accelerometer, and the noise of the extended Kalman filter: all that minimises
the filter's error on the labels. As a vehicle file the result serves every filter.
"""

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property, partial, reduce
from typing import Any, Generic, NamedTuple, Self, TypeVar

import numpy as np
from pydantic import Field, FiniteFloat

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.base import pluralize
from fleet_slip.config import Config
from fleet_slip.errors import DataError
from fleet_slip.evaluation import ekf
from fleet_slip.evaluation.evaluated_drives import STEP_S, DriveSignals, LabelledDrive, TestDrive
from fleet_slip.evaluation.evaluator import Estimator
from fleet_slip.evaluation.kalman import measured_speed_mps
from fleet_slip.rendering import Answer, Part, Remark, TextTable
from fleet_slip.vehicle.parameters import GRAVITY_MPS2, VehicleMeasures, VehicleParameters

# Search for the parameters of an estimator with the smallest error on training drives.

P = TypeVar("P", bound=Config)
TunableEstimator = Callable[[DriveSignals, VehicleParameters, P], FloatArray]
"""Side-slip in rad by row, from the signals of a drive, its vehicle and parameters."""

DriveEstimator = Estimator[LabelledDrive]

SUBSAMPLE = 5
"""Rows for each residual: errors of neighbouring rows at 100 Hz are correlated."""

START_DISTANCE = math.log(4)
"""Distance of further starts from the first one, in logarithms of the parameters."""

DERIVATIVE_STEP = 0.05
"""Step of a coordinate for derivatives: the errors of a filter are too rough for smaller ones."""

MAX_STEPS = 12
TRIAL_STEPS = 3
"""Maximum number of steps from each start, before the search goes on from the best."""

INITIAL_DAMPING, MAX_DAMPING = 1e-3, 1e4
"""Damping over the mean diagonal of the normal matrix: of the first step, and of the last trial."""

MAX_STEP = 1.0
"""Largest step of a coordinate: a linearisation does not reach further."""

MIN_GAIN = 1e-3
"""Share of the loss by which a step must lower it, for the search to go on."""

UNITS = {"steer_offset_rad": 0.02, "ay_offset_mps2": 0.2}
"""Additive parameters, around zero, with the unit of their coordinate; others are multiplied."""

Residuals = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class Coordinates(Generic[P]):
    """Parameters as a vector, 0 at a start: logarithms of factors, or multiples of `UNITS`."""

    start: P
    names: Sequence[str]
    """Parameters to search; "yaw_rate.gyro_std_rad_s" is one of a nested model."""

    def parameters(self, x: FloatArray) -> P:
        """Return the parameters at a point, within their limits."""
        parameters = self.start
        for name, change, limits in zip(self.names, x, self.limits, strict=True):
            start, unit = value_of(self.start, name), _unit(name)
            value = start * np.exp(change) if unit is None else start + unit * change
            parameters = _replace(parameters, name, float(np.clip(value, *limits)))
        return parameters

    def point(self, values: Iterable[float]) -> FloatArray:
        """Return the point of parameter values."""
        x = []
        for name, value in zip(self.names, values, strict=True):
            start, unit = value_of(self.start, name), _unit(name)
            if unit is not None:
                x.append((value - start) / unit)
            else:
                x.append(math.log(value / start) if value > 0 else -math.inf)
        return np.array(x)

    @cached_property
    def limits(self) -> list[tuple[float, float]]:
        """Smallest and largest value of each parameter, from the constraints of its field."""
        return [_limits(self.start, name) for name in self.names]

    @cached_property
    def bounds(self) -> FloatArray:
        """Smallest and largest coordinates, shape (2, n)."""
        return np.array([self.point(limits) for limits in zip(*self.limits, strict=True)])


def value_of(parameters: Config, name: str) -> float:
    """Return a parameter; a dot leads into a nested model."""
    return float(reduce(getattr, name.split("."), parameters))  # type: ignore[arg-type]


def _unit(name: str) -> float | None:
    return UNITS.get(name.rpartition(".")[2])


def _replace(parameters: P, name: str, value: float) -> P:
    field, _, inner = name.partition(".")
    new = _replace(getattr(parameters, field), inner, value) if inner else value
    return parameters.model_copy(update={field: new})


def _limits(parameters: Config, name: str) -> tuple[float, float]:
    """Return the limits of a field, from its constraints."""
    *outer, field = name.split(".")
    model: Config = reduce(getattr, outer, parameters)
    constraints = type(model).model_fields[field].metadata
    lowest = [getattr(c, key) for c in constraints for key in ("ge", "gt") if hasattr(c, key)]
    highest = [c.le for c in constraints if hasattr(c, "le")]
    return max(lowest, default=-math.inf), min(highest, default=math.inf)


class Optimum(NamedTuple):
    """End of a search: point, sum of squares, and derivatives, shape (residuals, parameters)."""

    x: FloatArray
    loss: float
    jacobian: FloatArray


def minimize(
    residuals: Residuals, coordinates: Coordinates[P], x: FloatArray, max_steps: int = MAX_STEPS
) -> Optimum:
    """Minimise the sum of squares within bounds by Levenberg's method.

    The damping is the same for all coordinates, so that a parameter without effect stays where it
    is (Levenberg, "A method for the solution of certain non-linear problems in least squares",
    Quarterly of Applied Mathematics 2, 1944). SciPy's trust regions end at sums of squares that are
    larger by up to a third after as many derivatives, which are nearly all of the work.
    """
    lower, upper = coordinates.bounds
    errors = residuals(x)
    loss, damping = float(errors @ errors), INITIAL_DAMPING
    jacobian = np.zeros((len(errors), len(x)))
    for _ in range(max_steps):
        steps = np.diag(np.where(x + DERIVATIVE_STEP <= upper, DERIVATIVE_STEP, -DERIVATIVE_STEP))
        jacobian = np.stack([(residuals(x + s) - errors) / s.sum() for s in steps], axis=1)
        slope = jacobian.T @ errors
        is_stuck = ((x <= lower) & (slope > 0)) | ((x >= upper) & (slope < 0))
        free = np.where(is_stuck, 0.0, jacobian)
        normal, gain = free.T @ free, 0.0
        while normal.any() and not gain and damping < MAX_DAMPING:
            damped = normal + damping * np.trace(normal) / len(x) * np.eye(len(x))
            step = np.clip(-np.linalg.solve(damped, free.T @ errors), -MAX_STEP, MAX_STEP)
            damping *= 4
            candidate = np.clip(x + step, lower, upper)
            candidate_errors = residuals(candidate)
            if (candidate_loss := float(candidate_errors @ candidate_errors)) < loss:
                gain = 1 - candidate_loss / loss
                x, errors, loss, damping = candidate, candidate_errors, candidate_loss, damping / 16
        if gain < MIN_GAIN:
            break
    return Optimum(x, loss, jacobian)


def minimize_from(
    residuals: Residuals, coordinates: Coordinates[P], starts: Sequence[FloatArray]
) -> Optimum:
    """Minimise for `TRIAL_STEPS` from each start, then go on from the best."""
    points = [np.clip(start, *coordinates.bounds) for start in starts]
    trials = [minimize(residuals, coordinates, x, TRIAL_STEPS) for x in points]
    return minimize(residuals, coordinates, min(trials, key=lambda trial: trial.loss).x)


@dataclass(frozen=True)
class TuningResult(Generic[P]):
    """The best parameters, and their root mean square error on the drives."""

    parameters: P
    rmse_rad: float


def tune(
    estimator: TunableEstimator[P],
    start: P,
    names: Sequence[str],
    drives: Sequence[LabelledDrive],
    car: VehicleParameters,
    executor: Executor,
) -> TuningResult[P]:
    """Search the parameters `names` from a start and from points around it.

    Raises `DataError` if no row has both an estimate and a label.
    """
    coordinates = Coordinates(start, names)

    def estimate(parameters: P, drive: LabelledDrive) -> FloatArray:
        return estimator(drive.signals, drive.car or car, parameters)

    def errors(x: FloatArray) -> FloatArray:
        at_x = partial(estimate, coordinates.parameters(x))
        return estimation_errors_rad(at_x, drives, executor, SUBSAMPLE)

    rows = require_finite(errors(np.zeros(len(names))))
    alternating = np.where(np.arange(len(names)) % 2, 1.0, -1.0)
    directions = (*(np.full(len(names), sign) for sign in (0, 1, -1)), alternating, -alternating)
    starts = [START_DISTANCE * direction for direction in directions]
    best = coordinates.parameters(minimize_from(lambda x: errors(x)[rows], coordinates, starts).x)
    return TuningResult(best, rmse_rad(partial(estimate, best), drives, executor))


def estimation_errors_rad(
    estimate: DriveEstimator, drives: Sequence[LabelledDrive], executor: Executor, step: int = 1
) -> FloatArray:
    """Return the errors on every `step`-th row of each drive; NaN without estimate or label."""
    estimates = executor.map(estimate, drives)
    errors = [e[::step] - d.sideslip_rad[::step] for e, d in zip(estimates, drives, strict=True)]
    return np.concatenate(errors) if errors else np.empty(0)


def require_finite(errors: FloatArray) -> BoolArray:
    """Return the mask of finite errors. Raises `DataError` if there are none."""
    mask: BoolArray = np.isfinite(errors)
    if not mask.any():
        raise DataError("no row has both an estimate and a label. Choose other drives.")
    return mask


def rmse_rad(
    estimate: DriveEstimator, drives: Sequence[LabelledDrive], executor: Executor
) -> float:
    """Return the RMSE over rows with estimate and label. Raises as `require_finite`."""
    errors = estimation_errors_rad(estimate, drives, executor)
    return float(np.sqrt(np.mean(errors[require_finite(errors)] ** 2)))


# Identification of a vehicle.

IDENTIFIED = "Identified from labelled drives"
"""Description of an identified vehicle."""

UNSPRUNG_SHARE = 0.11
"""Share of wheels, hubs and brakes in the mass."""

STIFFNESS_PER_LOAD = 15.0
"""Initial cornering stiffness of a tyre over its static load, per rad."""


class FitParameters(Config):
    """Parameters to fit, within the range of real vehicles, and the noise of the filter."""

    stiffness_front: FiniteFloat = Field(default=1.0, ge=0.2, le=8)
    """Cornering stiffness of the axle over that of `STIFFNESS_PER_LOAD`."""
    stiffness_rear: FiniteFloat = Field(default=1.0, ge=0.2, le=8)
    yaw_inertia: FiniteFloat = Field(default=1.0, ge=0.4, le=2)
    """Yaw inertia over sprung mass times both axle distances."""
    front_roll_share: FiniteFloat = Field(default=0.55, ge=0.05, le=0.95)
    friction: FiniteFloat = Field(default=1.0, ge=0.4, le=2.5)
    steering_ratio: FiniteFloat = Field(default=15.0, ge=5, le=30)
    """Steering wheel over road wheel angle, where no road wheel angle is logged."""
    noise: ekf.EkfNoise = ekf.EkfNoise()


DEFAULT_FIT = FitParameters()


def vehicle_with_fit(
    measures: VehicleMeasures, fit: FitParameters = DEFAULT_FIT
) -> VehicleParameters:
    """Return the vehicle of these measures with fitted parameters."""
    sprung_kg = (1 - UNSPRUNG_SHARE) * measures.mass_kg
    wheel_n = measures.mass_kg * GRAVITY_MPS2 / 4
    content = {
        "name": measures.name,
        "description": IDENTIFIED,
        "body": {
            "sprung_mass_kg": sprung_kg,
            "unsprung_mass_front_kg": (measures.mass_kg - sprung_kg) / 2,
            "unsprung_mass_rear_kg": (measures.mass_kg - sprung_kg) / 2,
            "sprung_yaw_inertia_kgm2": (
                fit.yaw_inertia * sprung_kg * measures.front_axle_m * measures.rear_axle_m
            ),
            "front_axle_m": measures.front_axle_m,
            "rear_axle_m": measures.rear_axle_m,
            "height_m": measures.height_m,
            "track_front_m": measures.track_m,
            "track_rear_m": measures.track_m,
        },
        "suspension": {
            "front_roll_share": fit.front_roll_share,
            "roll_lag_s": 0.12,
            "pitch_lag_s": 0.12,
            "front_stiffness_factor": fit.stiffness_front,
            "rear_stiffness_factor": fit.stiffness_rear,
        },
        "tyre": {
            "rolling_radius_m": measures.rolling_radius_m,
            "spin_inertia_kgm2": 1.1,
            # A tyre is stiffest at twice its load at rest, where it has 5/4 of this stiffness.
            "peak_stiffness_n": 1.25 * STIFFNESS_PER_LOAD * wheel_n,
            "peak_stiffness_load_n": 2 * wheel_n,
            "longitudinal_stiffness_ratio": 1.3,
            "friction": fit.friction,
            "nominal_load_n": wheel_n,
            "friction_load_sensitivity": 0.1,
            "friction_decay_speed_mps": 60.0,
            "rolling_resistance": 0.012,
        },
        "steering": {"ratio": fit.steering_ratio, "lag_s": 0.05, "limit_rad": 8.7},
        "drivetrain": {
            "front_drive_share": measures.front_drive_share,
            "front_brake_share": 0.7,
            "lag_s": 0.1,
            "power_w": 100_000.0,
            "slip_control": 0.05,
        },
        "aerodynamics": {"drag_area_m2": 0.65},
    }
    return VehicleParameters.model_validate(content)


@dataclass(frozen=True)
class IdentifiedVehicle(Answer):
    """An identified vehicle, the noise of the filter in it, and its errors in rad.

    Attributes
    ----------
    car, noise
        Fit on all drives.
    fit_rad
        RMSE on these drives.
    held_out_rad
        RMSE on held-out drives, in `FOLDS` folds; None for a single drive.
    drives
        Number of drives.
    at_bounds
        Parameters at a bound of their range.
    not_identifiable
        Parameters of vehicle and sensors that the drives do not determine.
    """

    car: VehicleParameters
    noise: ekf.EkfNoise
    fit_rad: float
    held_out_rad: float | None = None
    drives: int = 0
    fit: FitParameters | None = None
    at_bounds: tuple[str, ...] = ()
    not_identifiable: tuple[str, ...] = ()

    def parts(self) -> Iterator[Part]:
        """Yield the fitted parameters, the errors, and parameters without a usable value."""
        content = self.as_dict()
        title = f"{self.car.name}, identified from {pluralize(self.drives, 'drive')}"
        values = ((name.replace("_", " "), value) for name, value in content["found"].items())
        yield TextTable(title, "parameter|value", values, "{0}|{1:.4g}")
        held_out = content["held_out_deg"]
        yield Remark(
            f"RMSE of the extended Kalman filter: {content['fit_deg']:.4f} deg on these drives"
            + ("." if held_out is None else f", {held_out:.4f} deg on held-out drives.")
        )
        if self.at_bounds:
            yield Remark(
                f"at the bound of plausible values: {', '.join(content['at_bounds'])}. Drives or "
                "label contradict the model there: do not use it as the car's value."
            )
        if self.not_identifiable:
            names = ", ".join(content["not_identifiable"])
            yield Remark(f"not identifiable from these drives: {names}.")

    def estimate_drive(self, drive: LabelledDrive | TestDrive) -> FloatArray:
        """Estimate side-slip of a drive in rad by the filter, shape (rows,)."""
        return ekf.estimate(drive.signals, self.car, self.noise)

    def dump(self) -> dict[str, Any]:
        """Return its document."""
        content = {name: getattr(self, name).model_dump(mode="json") for name in ("car", "noise")}
        return {**content, "fit_rad": self.fit_rad}

    @classmethod
    def load(cls, content: Mapping[str, Any]) -> Self:
        """Restore from a document."""
        car = VehicleParameters.model_validate(content["car"])
        return cls(car, ekf.EkfNoise.model_validate(content["noise"]), content["fit_rad"])

    def as_dict(self) -> dict[str, Any]:
        """Return the fitted parameters, and errors in degrees."""
        car, sensors = self.car, self.noise.sensors
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
                "steer_gain": sensors.steer_gain,
                "steer_offset_deg": math.degrees(sensors.steer_offset_rad),
                "ay_gain": sensors.ay_gain,
                "ay_offset_mps2": sensors.ay_offset_mps2,
            },
            "at_bounds": [name.rpartition(".")[2] for name in self.at_bounds],
            "not_identifiable": [name.rpartition(".")[2] for name in self.not_identifiable],
            "noise": self.noise.model_dump(mode="json"),
            "fit_deg": math.degrees(self.fit_rad),
            "held_out_deg": None if self.held_out_rad is None else math.degrees(self.held_out_rad),
        }

    def as_toml(self, prefix: str = "") -> str:
        """Return the car as a vehicle file, or below the prefix of its tables."""
        content = self.car.model_dump()
        lines = [f"{name} = {json.dumps(content.pop(name))}" for name in ("name", "description")]
        for table, values in content.items():
            rows = (f"{name} = {value!r}" for name, value in values.items())
            lines += ["", f"[{prefix}{table}]", *rows]
        return "\n".join(lines) + "\n"

    def as_campaign(self) -> str:
        """Return a campaign with the car on the roads of the campaign `prior`."""
        head = f'name = "prior_{self.car.name}"\ndescription = "{IDENTIFIED}"\nbase = "prior"\n'
        return f"{head}\n[[plan.vehicles]]\n{self.as_toml('plan.vehicles.')}"


PRIOR_STD = {
    "stiffness_front": 0.5,
    "stiffness_rear": 0.5,
    "friction": 0.3,
    "front_roll_share": 0.3,
    "yaw_inertia": 0.2,
    "steering_ratio": 0.2,
    "noise.sensors.steer_gain": 0.05,
    "noise.sensors.steer_offset_rad": 1.0,
}
"""Standard deviation between vehicles of each parameter of vehicle and sensors, in coordinates."""

NOISE_NAMES = tuple(f"noise.{name}" for name in ekf.TUNABLE if not name.startswith("stiffness"))
NOISE_PRIOR_STD = 2.0
"""Standard deviation of the logarithm of a noise: nearly uninformative."""

PRIOR_WEIGHT_RAD = math.radians(0.04)
"""RMSE over drives that counts as much as one standard deviation of a parameter: errors of 0.3° in
some fifty independent segments of each drive."""

OUTLIER_RAD = math.radians(1.0)
"""Larger errors count by their size, not its square: in a spin no tyre model is right."""

STARTS: tuple[Mapping[str, float], ...] = (
    {},
    {"stiffness_front": 2.0, "stiffness_rear": 2.0, "noise.ay_std_mps2": 5.0},
)
"""Starts of a search: the angle follows from the force of the tyres, or from the yaw rate alone."""

FOLDS = 4

MAX_STD_RATIO = 0.9
"""Ratio of a parameter's standard deviation after and before the drives, above which they do not
determine it."""

AVERAGED_ROWS = 32
"""Rows over which accelerations are averaged: at 100 Hz they contain vibration."""

MIN_LATERAL_STD_MPS2 = 0.3
"""Standard deviation of the lateral acceleration below which a drive determines no gain."""

ACCELEROMETER = ("ay_gain", "ay_offset_mps2")


def fit_accelerometer(
    drives: Sequence[LabelledDrive], car: VehicleParameters
) -> ekf.SensorErrors | None:
    """Fit gain and offset of ay to the label, ay = gain (v̇y + r vx) + offset; None without bends.

    With vy = vx tan β this is geometry, without tyres. By least squares, all drives with the same
    weight.
    """
    square, product = np.zeros((2, 2)), np.zeros(2)
    for drive in drives:
        signals = drive.signals
        vx = measured_speed_mps(ekf.SensorErrors().corrected(signals, car), car)
        vy = vx * np.tan(drive.sideslip_rad)
        turning, measured = (
            np.convolve(values, np.full(AVERAGED_ROWS, 1 / AVERAGED_ROWS), "valid")
            for values in (signals.yaw_rate_rad_s * vx, signals.ay_mps2)
        )
        change = vy[AVERAGED_ROWS - 1 :] - vy[: len(vy) - AVERAGED_ROWS + 1]
        true = turning + change / (AVERAGED_ROWS - 1) / STEP_S
        rows = np.isfinite(true + measured)
        if rows.any() and true[rows].std() > MIN_LATERAL_STD_MPS2:
            columns = np.stack([true[rows], np.ones(rows.sum())])
            square += columns @ columns.T / rows.sum()
            product += columns @ measured[rows] / rows.sum()
    if not square.any():
        return None
    coordinates = Coordinates(ekf.SensorErrors(), ACCELEROMETER)
    return coordinates.parameters(coordinates.point(np.linalg.solve(square, product)))


def identify(
    measures: VehicleMeasures,
    drives: Sequence[LabelledDrive],
    executor: Executor,
    start: "IdentifiedVehicle | None" = None,
) -> IdentifiedVehicle:
    """Fit a vehicle, its sensors and the filter's noise to drives.

    The search begins at `start`, a fit to similar drives, else at both `STARTS`.

    All drives have the same weight, large errors count less than their squares (pseudo-Huber), and
    a prior is a further residual of each parameter: it decides what the drives do not determine.
    Raises `DataError` without a label.
    """
    require_finite(np.concatenate([drive.sideslip_rad for drive in drives]))
    labelled = [np.isfinite(drive.sideslip_rad[::SUBSAMPLE]) for drive in drives]
    has_road_wheels = any(drive.signals.has_road_wheels for drive in drives)
    unused = "steering_ratio" if has_road_wheels else "noise.sensors.steer_gain"
    names = [name for name in (*PRIOR_STD, *NOISE_NAMES) if name != unused]
    sensors = fit_accelerometer(drives, vehicle_with_fit(measures))
    usual = FitParameters(noise=ekf.EkfNoise(sensors=sensors or ekf.SensorErrors()))
    coordinates = Coordinates(usual, names)
    prior_std = np.array([PRIOR_STD.get(name, NOISE_PRIOR_STD) for name in names])

    def estimate(fit: FitParameters, drive: LabelledDrive) -> FloatArray:
        return ekf.estimate(drive.signals, vehicle_with_fit(measures, fit), fit.noise)

    def residuals(x: FloatArray) -> FloatArray:
        estimates = executor.map(partial(estimate, coordinates.parameters(x)), drives)
        blocks = [PRIOR_WEIGHT_RAD * x / prior_std]
        for angle_rad, drive, rows in zip(estimates, drives, labelled, strict=True):
            error = (angle_rad - drive.sideslip_rad)[::SUBSAMPLE][rows]
            error = np.nan_to_num(error, nan=OUTLIER_RAD)
            size = OUTLIER_RAD * np.sqrt(2 * (np.hypot(1, error / OUTLIER_RAD) - 1))
            blocks.append(np.copysign(size, error) / math.sqrt(max(len(error), 1)))
        return np.concatenate(blocks)

    fit = start and start.fit
    starts = [{name: value_of(fit, name) for name in names}] if fit else STARTS
    points = [
        coordinates.point([values.get(name, value_of(usual, name)) for name in names])
        for values in starts
    ]
    optimum = minimize_from(residuals, coordinates, points)
    fit = coordinates.parameters(optimum.x)
    covariance = np.linalg.inv(optimum.jacobian.T @ optimum.jacobian)
    std_ratio = np.sqrt(np.diag(covariance)) * PRIOR_WEIGHT_RAD / prior_std
    at_bounds = np.isclose(optimum.x, coordinates.bounds, atol=1e-6).any(axis=0)
    unknown = [
        name
        for name, ratio in zip(names, std_ratio, strict=True)
        if name in PRIOR_STD and ratio > MAX_STD_RATIO
    ]
    if sensors is None:
        unknown += [f"noise.sensors.{name}" for name in ACCELEROMETER]
    return IdentifiedVehicle(
        vehicle_with_fit(measures, fit),
        fit.noise,
        rmse_rad(partial(estimate, fit), drives, executor),
        drives=len(drives),
        fit=fit,
        at_bounds=tuple(names[index] for index in np.flatnonzero(at_bounds)),
        not_identifiable=tuple(unknown),
    )


def identify_held_out(
    measures: VehicleMeasures, drives: Sequence[LabelledDrive], executor: Executor
) -> IdentifiedVehicle:
    """Identify a vehicle from all drives, with its error on drives held out in turn."""
    identified = identify(measures, drives, executor)
    if len(drives) < 2:
        return identified
    errors: list[FloatArray] = []
    for fold in range(min(FOLDS, len(drives))):
        training = [drive for number, drive in enumerate(drives) if number % FOLDS != fold]
        vehicle, held_out = identify(measures, training, executor), drives[fold::FOLDS]
        errors.append(estimation_errors_rad(vehicle.estimate_drive, held_out, executor))
    error = np.concatenate(errors)
    error = error[np.isfinite(error)]
    rmse = float(np.sqrt(np.mean(error**2))) if len(error) else None
    return replace(identified, held_out_rad=rmse)
