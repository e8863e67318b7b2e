"""The yaw rate filter: finds the gyroscope's bias, and equals the textbook."""

from dataclasses import replace

import numpy as np
import pytest

from fleet_slip.arrays import FloatArray
from fleet_slip.evaluation import kalman
from fleet_slip.evaluation.evaluated_drives import STEP_S, DriveSignals
from fleet_slip.evaluation.kalman import YawRateNoise, measured_speed_mps, undriven_axle
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.vehicle.parameters import load_vehicle
from tests.support.drives import noisy, rolling_drive, slalom

CAR = load_vehicle("d_class_sedan", SHIPPED_CONFIGS)
NOISE = YawRateNoise()


def textbook_filter(drive: DriveSignals, noise: YawRateNoise) -> FloatArray:
    """Both measurements at once, dense."""
    x = np.zeros(2)
    p = np.diag([1.0, noise.gyro_bias_std_rad_s**2])
    q = np.diag([(STEP_S * noise.yaw_acceleration_std_rad_s2) ** 2, 0])
    wheels = undriven_axle(drive, CAR).yaw_rate_rad_s
    estimates = []
    for gyro, wheel, ax in zip(drive.yaw_rate_rad_s, wheels, drive.ax_mps2, strict=True):
        p = p + q
        present = np.array([np.isfinite(gyro), np.isfinite(wheel) and ax > -0.5])
        h = np.array([[1.0, 1.0], [1.0, 0.0]])[present]
        z = np.array([gyro, wheel])[present]
        variances = [noise.gyro_std_rad_s**2, noise.wheel_yaw_rate_std_rad_s**2]
        r = np.diag(np.array(variances)[present])
        gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + r)
        x = x + gain @ (z - h @ x)
        p = (np.eye(2) - gain @ h) @ p
        estimates.append(x)
    return np.array(estimates).T


def test_agrees_with_the_textbook_filter_gaps_included() -> None:
    drive = noisy(slalom(CAR, 5000)[0], seed=1)
    row = np.arange(5000)
    drive = replace(
        drive,
        yaw_rate_rad_s=np.where(row // 700 == 2, np.nan, drive.yaw_rate_rad_s),
        wheel_rl_rad_s=np.where(row // 500 == 4, np.nan, drive.wheel_rl_rad_s),
        ax_mps2=np.where(row // 400 == 1, -3.0, drive.ax_mps2),
    )
    yaw_rate = kalman.estimate_yaw_rate(drive, CAR, NOISE)
    expected = textbook_filter(drive, NOISE)
    np.testing.assert_allclose(yaw_rate, expected, rtol=0, atol=1e-10)


def test_bias_is_found_and_noise_reduced() -> None:
    exact, _ = slalom(CAR, 20_000)
    yaw_rate, bias = kalman.estimate_yaw_rate(noisy(exact, seed=2), CAR, NOISE)
    assert bias[-1] == pytest.approx(0.01, abs=0.001)
    error = (yaw_rate - exact.yaw_rate_rad_s)[5000:]
    assert abs(error.mean()) < 0.001
    assert error.std() < 0.005, "half of the gyroscope's noise"


def test_wheel_speeds_are_ignored_in_braking() -> None:
    exact, _ = slalom(CAR, 4000)
    braking = replace(exact, ax_mps2=np.full(4000, -3.0))
    slipping = replace(braking, wheel_rl_rad_s=0.97 * braking.wheel_rl_rad_s)
    yaw_rate, expected = (
        kalman.estimate_yaw_rate(drive, CAR, NOISE)[0] for drive in (slipping, braking)
    )
    assert np.array_equal(yaw_rate, expected)


@pytest.mark.parametrize("name", ["d_class_sedan", "rear_drive_sedan"])
def test_undriven_axle_gives_speed_and_yaw_rate_of_a_rolling_car(name: str) -> None:
    car = load_vehicle(name, SHIPPED_CONFIGS)
    ones = np.ones(1)
    vx, vy, rate, steer = 12.0, -0.2, 0.35, 0.08
    drive = rolling_drive(car, vx * ones, vy * ones, rate * ones, steer * ones)
    axle = undriven_axle(drive, car)
    assert axle.yaw_rate_rad_s[0] == pytest.approx(rate, rel=1e-12)
    front = car.drivetrain.front_drive_share < 0.5
    assert axle.vx_mps[0] == pytest.approx(vx + front * np.tan(steer) * vy, rel=1e-12)


def test_a_single_speed_of_the_car_is_not_the_speed_of_steered_wheels() -> None:
    car = load_vehicle("rear_drive_sedan", SHIPPED_CONFIGS)
    motion = np.full(3, 12.0), np.zeros(3), np.full(3, 0.35), np.full(3, 0.2)
    drive = rolling_drive(car, *motion)
    wheel = np.full(3, 12.0 / car.tyre.rolling_radius_m)
    single = replace(drive, wheel_fl_rad_s=wheel, wheel_fr_rad_s=wheel)
    assert measured_speed_mps(single, car) == pytest.approx(12.0, rel=1e-12)
