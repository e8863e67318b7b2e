"""Finds the parameters of an estimator that suit training drives best, so that rivals are fair."""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.comparison.observers.drive_signals import DriveSignals, LabelledDrive
from fleet_slip.config import Config
from fleet_slip.errors import DataError
from fleet_slip.vehicle.parameters import VehicleParameters

P = TypeVar("P", bound=Config)
Estimator = Callable[[DriveSignals, VehicleParameters, P], FloatArray]
"""What every module of this package offers as `estimate`."""

FIRST_FACTOR = 8.0
LAST_FACTOR = 1.03
"""The search ends when changing any parameter by this factor does not help."""

LEAST_GAIN = 1e-3
"""A change must lower the error by this share; else a parameter without effect would wander off."""


@dataclass(frozen=True)
class Tuned(Generic[P]):
    """The best parameters found, and the root mean square of their error on the drives."""

    parameters: P
    rmse_rad: float
    evaluations: int


def rmse_rad(
    estimate: Callable[[DriveSignals], FloatArray],
    drives: Sequence[LabelledDrive],
    executor: Executor,
) -> float:
    """Return the RMSE over rows with estimate and truth. Raises `DataError` if no row has both."""
    estimates = executor.map(estimate, (drive.signals for drive in drives))
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
    """Search the positive parameters `names` by compass search in their logarithms.

    Each estimator's module lists its own as `TUNABLE`; "yaw_rate.gyro_std_rad_s" is a nested one.

    Each in turn is multiplied and divided by a factor and keeps what lowers the error; when none
    does, the factor becomes its square root (Kolda, Lewis and Torczon, "Optimization by direct
    search", SIAM Review 45, 2003). Values that the parameters' model refuses are passed over.
    """

    def cost(parameters: P) -> float:
        return rmse_rad(lambda drive: estimator(drive, car, parameters), drives, executor)

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


def _scaled(parameters: P, name: str, factor: float) -> P:
    """Return the parameters with one of them multiplied; a dot leads into a nested model."""
    field, _, inner = name.partition(".")
    value = getattr(parameters, field)
    changed = _scaled(value, inner, factor) if inner else value * factor
    return type(parameters).model_validate({**dict(parameters), field: changed})
