"""The search finds a known optimum, and lowers the error of a filter with wrong noise."""

from concurrent.futures import Executor
from pathlib import Path

import numpy as np
import pytest
from pydantic import Field

from fleet_slip.arrays import FloatArray
from fleet_slip.config import Config
from fleet_slip.evaluation import ekf, kalman
from fleet_slip.evaluation.identify import checksum_of_sources, rmse_rad, tune
from fleet_slip.evaluation.kalman import FilterNoise
from fleet_slip.evaluation.single_track import DriveSignals, LabelledDrive
from fleet_slip.vehicle.parameters import VehicleParameters, load_vehicle
from tests.support.drives import noisy, slalom

CAR = load_vehicle("d_class_sedan")


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
    found = tune(valley, Parameters(), ("a", "inner.b"), [labelled(1)], CAR, executor)
    assert found.parameters.a == pytest.approx(3, rel=0.05)
    assert found.parameters.inner.b == pytest.approx(0.2, rel=0.05)
    assert found.rmse_rad == pytest.approx(0.01, rel=0.1)


def test_a_parameter_without_effect_stays(executor: Executor) -> None:
    noise = FilterNoise(gps_vx_std_mps=0.07)
    found = tune(kalman.estimate, noise, ("bias_std_mps2",), [labelled(2)], CAR, executor)
    assert found.parameters.gps_vx_std_mps == 0.07


def test_tuning_makes_up_for_wrong_noise_and_never_makes_worse(executor: Executor) -> None:
    drives = [labelled(seed) for seed in range(3)]
    wrong = FilterNoise(ay_std_mps2=5.0)
    names = ("ay_std_mps2", "gps_vy_std_mps")
    before = rmse_rad(lambda d: kalman.estimate(d.signals, CAR, wrong), drives, executor)
    right = rmse_rad(lambda d: kalman.estimate(d.signals, CAR, FilterNoise()), drives, executor)
    found = tune(kalman.estimate, wrong, names, drives, CAR, executor)
    assert found.rmse_rad < 0.5 * before
    assert found.rmse_rad < 1.05 * right
    again = rmse_rad(lambda d: kalman.estimate(d.signals, CAR, found.parameters), drives, executor)
    assert again == found.rmse_rad


@pytest.mark.parametrize(
    ("names", "parameters"),
    [
        (kalman.TUNABLE, kalman.FilterNoise()),
        (ekf.TUNABLE, ekf.EkfNoise()),
    ],
)
def test_what_is_tunable_exists_and_is_positive(names: tuple[str, ...], parameters: Config) -> None:
    for name in names:
        value: object = parameters
        for part in name.split("."):
            value = getattr(value, part)
        assert isinstance(value, float)
        assert value > 0


def test_what_was_found_is_of_these_sources(tmp_path: Path) -> None:
    (tmp_path / "one.py").write_text("a = 1")
    (tmp_path / "two.py").write_text("b = 2")
    before = checksum_of_sources(tmp_path)
    (tmp_path / "two.py").write_text("b = 3")
    assert checksum_of_sources(tmp_path) != before
    (tmp_path / "two.py").write_text("b = 2")
    assert checksum_of_sources(tmp_path) == before != checksum_of_sources()
