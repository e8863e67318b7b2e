"""Finds the parameters of an estimator that suit training drives best, so that rivals are fair."""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.canonical import sha256_of
from fleet_slip.comparison.observers.drive_signals import DriveSignals, LabelledDrive
from fleet_slip.config import Config
from fleet_slip.errors import DataError
from fleet_slip.vehicle.parameters import VehicleParameters

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


def rmse_rad(
    estimate: Callable[[LabelledDrive], FloatArray],
    drives: Sequence[LabelledDrive],
    executor: Executor,
) -> float:
    """Return the RMSE over rows with estimate and truth. Raises `DataError` if no row has both."""
    estimates = executor.map(estimate, drives)
    errors = [found - drive.sideslip_rad for found, drive in zip(estimates, drives, strict=True)]
    error = np.concatenate(errors) if errors else np.empty(0)
    error = error[np.isfinite(error)]
    if not len(error):
        raise DataError("no row has both an estimate and a label. Choose other drives.")
    return float(np.sqrt(np.mean(error**2)))


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

    def rmse(found: Tuned[P]) -> float:
        return found.rmse_rad

    first = descend(estimator, start, names, drives, car, executor)
    wide = search(estimator, start, names, drives, car, executor)
    last = descend(estimator, wide.parameters, names, drives, car, executor)
    evaluations = sum(one.evaluations for one in (first, wide, last))
    return replace(min(first, wide, last, key=rmse), evaluations=evaluations)


def search(
    estimator: Estimator[P],
    start: P,
    names: Sequence[str],
    drives: Sequence[LabelledDrive],
    car: VehicleParameters,
    executor: Executor,
) -> Tuned[P]:
    """Search the positive parameters `names` by compass search in their logarithms.

    Each in turn is multiplied and divided by a factor and keeps what lowers the error; when none
    does, the factor becomes its square root (Kolda, Lewis and Torczon, "Optimization by direct
    search", SIAM Review 45, 2003). Values that the parameters' model refuses are passed over.
    """

    def cost(parameters: P) -> float:
        def estimate(drive: LabelledDrive) -> FloatArray:
            return estimator(drive.signals, drive.car or car, parameters)

        return rmse_rad(estimate, drives, executor)

    best, lowest, evaluations = start, cost(start), 1
    factor = FIRST_FACTOR
    while factor > LAST_FACTOR:
        improved = False
        for name in names:
            for candidate in _neighbours(best, name, factor):
                found = cost(candidate)
                evaluations += 1
                if found < lowest * (1 - LEAST_GAIN):
                    best, lowest, improved = candidate, found, True
                    break
        if not improved:
            factor **= 0.5
    return Tuned(best, lowest, evaluations)


def _neighbours(parameters: P, name: str, factor: float) -> list[P]:
    neighbours = []
    for change in (factor, 1 / factor):
        try:
            neighbours.append(_scaled(parameters, name, change))
        except ValueError:
            continue
    return neighbours


def descend(
    estimator: Estimator[P],
    start: P,
    names: Sequence[str],
    drives: Sequence[LabelledDrive],
    car: VehicleParameters,
    executor: Executor,
) -> Tuned[P]:
    """Search the positive parameters `names` by Levenberg's method in their logarithms.

    Several parameters do nearly the same, such as the stiffness of two axles, so that to change one
    after the other creeps along a valley; the derivatives of the errors show its direction
    (Levenberg, "A method for the solution of certain non-linear problems in least squares",
    Quarterly of Applied Mathematics 2, 1944). A parameter without effect stays, and so does one
    where its model refuses the next value. Raises as `rmse_rad`.
    """
    labels = np.concatenate([drive.sideslip_rad[::EVERY] for drive in drives])
    evaluations = 0

    def errors(parameters: P) -> FloatArray:
        nonlocal evaluations
        evaluations += 1

        def estimate(drive: LabelledDrive) -> FloatArray:
            return estimator(drive.signals, drive.car or car, parameters)[::EVERY]

        off: FloatArray = np.concatenate(list(executor.map(estimate, drives))) - labels
        return off

    best, found = start, errors(start)
    there = np.isfinite(found)
    if not there.any():
        raise DataError("no row has both an estimate and a label. Choose other drives.")
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
    every_row = rmse_rad(lambda one: estimator(one.signals, one.car or car, best), drives, executor)
    return Tuned(best, every_row, evaluations)


def _scaled(parameters: P, name: str, factor: float) -> P:
    """Return the parameters with one of them multiplied; a dot leads into a nested model."""
    field, _, inner = name.partition(".")
    value = getattr(parameters, field)
    changed = _scaled(value, inner, factor) if inner else value * factor
    return type(parameters).model_validate({**dict(parameters), field: changed})
