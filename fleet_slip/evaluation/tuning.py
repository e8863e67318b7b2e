"""Search for the parameters of an estimator with the smallest error on training drives."""

import math
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property, partial, reduce
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.config import Config
from fleet_slip.errors import DataError
from fleet_slip.evaluation.labelled_drives import DriveSignals, LabelledDrive
from fleet_slip.vehicle.parameters import VehicleParameters

P = TypeVar("P", bound=Config)
TunableEstimator = Callable[[DriveSignals, VehicleParameters, P], FloatArray]
"""Side-slip in rad by row, from the signals of a drive, its vehicle and parameters."""

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
        """Smallest and largest value of each parameter."""
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
    limits = {"ge": -math.inf, "gt": -math.inf, "le": math.inf}
    for constraint in type(model).model_fields[field].metadata:
        limits |= {key: getattr(constraint, key) for key in limits if hasattr(constraint, key)}
    return max(limits["ge"], limits["gt"]), limits["le"]


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
    estimate: Callable[[LabelledDrive], FloatArray],
    drives: Sequence[LabelledDrive],
    executor: Executor,
    step: int = 1,
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
    estimate: Callable[[LabelledDrive], FloatArray],
    drives: Sequence[LabelledDrive],
    executor: Executor,
) -> float:
    """Return the RMSE over rows with estimate and label. Raises as `require_finite`."""
    errors = estimation_errors_rad(estimate, drives, executor)
    return float(np.sqrt(np.mean(errors[require_finite(errors)] ** 2)))
