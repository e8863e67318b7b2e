"""Properties of all estimators: on the simulated car, in a mirror, at rest, with gaps."""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import DataError
from fleet_slip.evaluation import ekf, kalman
from fleet_slip.evaluation.evaluated_drives import LabelledDrive
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.vehicle.parameters import load_vehicle
from tests.support.drives import mirrored, noisy, rolling_drive, simulated_drive, slalom

CAR = load_vehicle("d_class_sedan", SHIPPED_CONFIGS)
ESTIMATORS: dict[str, tuple[Callable[..., FloatArray], Any]] = {
    "kalman": (kalman.estimate, kalman.FilterNoise()),
    "ekf": (ekf.estimate, ekf.EkfNoise()),
}
ALL = pytest.mark.parametrize("name", ESTIMATORS)

simulated = cache(simulated_drive)


def run(name: str, drive: LabelledDrive) -> FloatArray:
    estimate, parameters = ESTIMATORS[name]
    return estimate(drive.signals, CAR, parameters)


@ALL
def test_follows_the_simulated_car(name: str) -> None:
    drive = simulated()
    error = np.degrees(run(name, drive) - drive.sideslip_rad)
    error = error[np.isfinite(error)]
    assert len(error) > 0.95 * len(drive.signals)
    assert error.std() < 0.35 * np.degrees(drive.sideslip_rad.std())
    assert abs(error.mean()) < 0.15


@ALL
def test_mirrored_drive_gives_mirrored_sideslip(name: str) -> None:
    estimate, parameters = ESTIMATORS[name]
    drive = noisy(slalom(CAR, 2000)[0], seed=1)
    angles = estimate(drive, CAR, parameters)
    other = estimate(mirrored(drive), CAR, parameters)
    np.testing.assert_allclose(other, -angles, rtol=0, atol=1e-12)


@ALL
def test_at_rest_with_the_wheels_turned_the_angle_stays_small(name: str) -> None:
    estimate, parameters = ESTIMATORS[name]
    zero = np.zeros(5000)
    drive = noisy(rolling_drive(CAR, zero, zero, zero, zero + 0.3), seed=2)
    assert np.abs(estimate(drive, CAR, parameters)[500:]).max() < 0.1


@ALL
def test_a_gap_of_the_sensors_is_bridged(name: str) -> None:
    estimate, parameters = ESTIMATORS[name]
    drive = noisy(slalom(CAR, 2000)[0], seed=3)
    gap = (np.arange(2000) >= 900) & (np.arange(2000) < 905)
    gappy = replace(
        drive,
        **{
            field: np.where(gap, np.nan, getattr(drive, field))
            for field in ("ax_mps2", "ay_mps2", "yaw_rate_rad_s", "wheel_rl_rad_s", "steer_fl_rad")
        },
    )
    angles, expected = (estimate(signals, CAR, parameters) for signals in (gappy, drive))
    assert np.isfinite(angles).all()
    assert np.abs(angles - expected).max() < 0.02
    np.testing.assert_array_equal(angles[:900], expected[:900])


@pytest.mark.parametrize(
    ("field", "message"),
    [("ay_mps2", "no ay"), ("wheel_rl_rad_s", "wheel speeds"), ("steer.*_rad", "steer_fl")],
)
def test_an_absent_sensor_is_named(field: str, message: str) -> None:
    drive = slalom(CAR, 50)[0]
    absent = {name: np.full(50, np.nan) for name in vars(drive) if re.fullmatch(field, name)}
    with pytest.raises(DataError, match=message):
        ekf.estimate(replace(drive, **absent), CAR, ekf.EkfNoise())


@pytest.mark.parametrize("fields", ["steer_fl_rad", "steer_fr_rad", "gps_vx_mps gps_vy_mps"])
def test_one_front_wheel_angle_suffices_and_gps_is_not_read(fields: str) -> None:
    drive = slalom(CAR, 500)[0]
    reduced = replace(drive, **dict.fromkeys(fields.split(), np.full(500, np.nan)))
    angles, expected = (ekf.estimate(signals, CAR, ekf.EkfNoise()) for signals in (reduced, drive))
    np.testing.assert_array_equal(angles, expected)


@ALL
def test_the_future_is_not_read(name: str) -> None:
    estimate, parameters = ESTIMATORS[name]
    drive = noisy(slalom(CAR, 1000)[0], seed=5)
    half = type(drive)(**{field: getattr(drive, field)[:500] for field in vars(drive)})
    np.testing.assert_array_equal(
        estimate(half, CAR, parameters), estimate(drive, CAR, parameters)[:500]
    )
