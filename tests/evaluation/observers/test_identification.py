"""A car is identified from labelled drives, of mass and geometry alone."""

from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import Field

from fleet_slip.arrays import FloatArray
from fleet_slip.config import Config
from fleet_slip.errors import DataError
from fleet_slip.evaluation import ekf, kalman
from fleet_slip.evaluation.evaluated_drives import DriveSignals, LabelledDrive
from fleet_slip.evaluation.filters import checksum_of_sources
from fleet_slip.evaluation.identify import (
    IdentifiedVehicle,
    identify,
    identify_held_out,
    rmse_rad,
    tune,
    vehicle_with_fit,
)
from fleet_slip.evaluation.kalman import FilterNoise
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.vehicle.parameters import VehicleMeasures, VehicleParameters, load_vehicle
from tests.support.drives import noisy, simulated_drive, slalom

CAR = load_vehicle("d_class_sedan", SHIPPED_CONFIGS)
MEASURED = VehicleMeasures.of_vehicle(CAR)


@pytest.fixture(scope="module")
def identified(drive: LabelledDrive, executor: Executor) -> IdentifiedVehicle:
    return identify(MEASURED, [drive], executor)


@pytest.fixture(scope="module")
def drive() -> LabelledDrive:
    return simulated_drive().beginning(4000)


def rmse_deg(estimate: np.ndarray, drive: LabelledDrive) -> float:
    return float(np.degrees(np.sqrt(np.mean((estimate - drive.sideslip_rad) ** 2))))


def test_the_start_depends_on_measures_alone() -> None:
    stiffer = CAR.with_tyres(stiffness_factor=0.8)
    assert VehicleMeasures.of_vehicle(stiffer) == MEASURED
    body = vehicle_with_fit(MEASURED).body
    assert body.mass_kg == pytest.approx(CAR.body.mass_kg)
    assert body.yaw_inertia_kgm2 != pytest.approx(CAR.body.yaw_inertia_kgm2, rel=0.01)


def test_an_identified_car_estimates_better_than_one_with_usual_tyres(
    drive: LabelledDrive, identified: IdentifiedVehicle
) -> None:
    vehicle = identified
    before = rmse_deg(
        ekf.estimate(drive.signals, vehicle_with_fit(MEASURED), ekf.EkfNoise()), drive
    )
    assert rmse_deg(ekf.estimate(drive.signals, vehicle.car, vehicle.noise), drive) < 0.7 * before
    assert vehicle.held_out_rad is None


def test_identifies_steering_ratio_offset_and_roll_from_a_steering_wheel(
    drive: LabelledDrive, identified: IdentifiedVehicle, executor: Executor
) -> None:
    exact, missing = drive.signals, np.full(len(drive.signals), np.nan)
    road = (exact.steer_fl_rad + exact.steer_fr_rad) / 2
    bias = identified.noise.sensors
    signals = replace(
        exact,
        steer_fl_rad=missing,
        steer_fr_rad=missing,
        steering_wheel_rad=18 * (road + 0.01),
        ay_mps2=1.08 * exact.ay_mps2 + 0.2,
    )
    vehicle = identify(MEASURED, [replace(drive, signals=signals)], executor)
    assert vehicle.car.steering.ratio == pytest.approx(18, rel=0.05)
    sensors = vehicle.noise.sensors
    assert sensors.steer_offset_rad - bias.steer_offset_rad == pytest.approx(0.01, abs=0.001)
    assert sensors.ay_gain / bias.ay_gain == pytest.approx(1.08, rel=0.001)
    expected = 0.2 + 1.08 * bias.ay_offset_mps2
    assert sensors.ay_offset_mps2 == pytest.approx(expected, abs=0.001)
    assert vehicle.fit_rad < 1.2 * identified.fit_rad
    assert "steer_gain" not in {*vehicle.at_bounds, *vehicle.not_identifiable}


def test_parameters_at_bounds_and_not_identifiable_ones_are_reported(
    drive: LabelledDrive, identified: IdentifiedVehicle, executor: Executor
) -> None:
    assert not identified.at_bounds
    assert {"friction", "yaw_inertia"} <= {*identified.not_identifiable}, "nobody slides"
    shaken = replace(drive, sideslip_rad=-8 * drive.sideslip_rad)  # no tyre does that
    wrong = identify(MEASURED, [shaken], executor)
    assert wrong.at_bounds
    assert wrong.as_dict()["at_bounds"]


def test_one_speed_for_all_wheels_gives_no_yaw_rate(drive: LabelledDrive) -> None:
    speed = (drive.signals.wheel_rl_rad_s + drive.signals.wheel_rr_rad_s) / 2
    signals = replace(drive.signals, wheel_rl_rad_s=speed, wheel_rr_rad_s=speed)
    two = rmse_deg(ekf.estimate(drive.signals, CAR, ekf.EkfNoise()), drive)
    assert rmse_deg(ekf.estimate(signals, CAR, ekf.EkfNoise()), drive) < 2 * two


def test_the_held_out_error_is_that_of_a_fit_without_the_drive(
    drive: LabelledDrive, executor: Executor
) -> None:
    drive = drive.beginning(2000)
    wrong = replace(drive, name="wrong", sideslip_rad=drive.sideslip_rad + np.radians(1))
    result = identify_held_out(MEASURED, [drive, wrong], executor)
    assert result.held_out_rad is not None
    assert np.degrees(result.held_out_rad) > 0.8 > np.degrees(result.fit_rad)


def test_drives_without_a_label_are_refused(drive: LabelledDrive, executor: Executor) -> None:
    unknown = replace(drive, sideslip_rad=np.full(len(drive.signals), np.nan))
    with pytest.raises(DataError, match="no row has both"):
        identify(MEASURED, [unknown], executor)


class Inner(Config):
    b: float = Field(default=1.0, gt=0)


class Parameters(Config):
    a: float = Field(default=1.0, gt=0, le=4)
    inner: Inner = Inner()


def labelled(seed: int, rows: int = 4000) -> LabelledDrive:
    exact, truth = slalom(CAR, rows)
    return LabelledDrive(str(seed), noisy(exact, seed), truth)


def valley(drive: DriveSignals, car: VehicleParameters, p: Parameters) -> FloatArray:
    """Return an estimate whose error is smallest at a = 3 and inner.b = 0.2, in a bent valley."""
    x, y = np.log(p.a / 3), np.log(p.inner.b / 0.2)
    size = 0.01 + x**2 + y**2 + 0.5 * x * y
    _, truth = slalom(car, len(drive))
    ripple: FloatArray = truth + size * np.where(np.arange(len(drive)) % 2, 1.0, -1.0)
    return ripple


def test_finds_the_optimum_of_a_valley_with_a_nested_and_a_bounded_parameter(
    executor: Executor,
) -> None:
    result = tune(valley, Parameters(), ("a", "inner.b"), [labelled(1)], CAR, executor)
    assert result.parameters.a == pytest.approx(3, rel=0.05)
    assert result.parameters.inner.b == pytest.approx(0.2, rel=0.05)
    assert result.rmse_rad == pytest.approx(0.01, rel=0.1)


def test_a_parameter_without_effect_stays(executor: Executor) -> None:
    noise = FilterNoise(gps_vx_std_mps=0.07)
    result = tune(kalman.estimate, noise, ("bias_std_mps2",), [labelled(2)], CAR, executor)
    assert result.parameters.gps_vx_std_mps == 0.07


def test_tuning_makes_up_for_wrong_noise_and_never_makes_worse(executor: Executor) -> None:
    drives = [labelled(seed) for seed in range(3)]
    wrong = FilterNoise(ay_std_mps2=5.0)
    names = ("ay_std_mps2", "gps_vy_std_mps")
    before = rmse_rad(lambda d: kalman.estimate(d.signals, CAR, wrong), drives, executor)
    right = rmse_rad(lambda d: kalman.estimate(d.signals, CAR, FilterNoise()), drives, executor)
    result = tune(kalman.estimate, wrong, names, drives, CAR, executor)
    assert result.rmse_rad < 0.5 * before
    assert result.rmse_rad < 1.05 * right
    again = rmse_rad(lambda d: kalman.estimate(d.signals, CAR, result.parameters), drives, executor)
    assert again == result.rmse_rad


def test_the_checksum_depends_on_all_modules(tmp_path: Path) -> None:
    (tmp_path / "one.py").write_text("a = 1")
    (tmp_path / "two.py").write_text("b = 2")
    before = checksum_of_sources(tmp_path)
    (tmp_path / "two.py").write_text("b = 3")
    assert checksum_of_sources(tmp_path) != before
    (tmp_path / "two.py").write_text("b = 2")
    assert checksum_of_sources(tmp_path) == before != checksum_of_sources()
