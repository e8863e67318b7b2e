"""A car is identified from labelled drives, of mass and geometry alone."""

from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from fleet_slip.errors import DataError
from fleet_slip.evaluation import ekf
from fleet_slip.evaluation.identify import Fitted, Measured, identify, identify_held_out
from fleet_slip.evaluation.single_track import LabelledDrive
from fleet_slip.vehicle.parameters import load_vehicle
from tests.support.drives import simulated_drive

CAR = load_vehicle("d_class_sedan")
MEASURED = Measured.of(CAR)


@pytest.fixture
def executor() -> Iterator[Executor]:
    with ThreadPoolExecutor(2) as threads:
        yield threads


@pytest.fixture(scope="module")
def drive() -> LabelledDrive:
    return simulated_drive().beginning(4000)


def rmse_deg(estimate: np.ndarray, drive: LabelledDrive) -> float:
    return float(np.degrees(np.sqrt(np.mean((estimate - drive.sideslip_rad) ** 2))))


def test_the_start_knows_nothing_but_what_was_measured() -> None:
    stiffer = CAR.with_tyres(stiffness_factor=0.8)
    assert Measured.of(stiffer) == MEASURED
    body = MEASURED.car(Fitted()).body
    assert body.mass_kg == pytest.approx(CAR.body.mass_kg)
    assert body.yaw_inertia_kgm2 != pytest.approx(CAR.body.yaw_inertia_kgm2, rel=0.01)


def test_an_identified_car_estimates_better_than_one_with_usual_tyres(
    drive: LabelledDrive, executor: Executor
) -> None:
    found = identify(MEASURED, [drive], executor)
    before = rmse_deg(ekf.estimate(drive.signals, MEASURED.car(Fitted()), ekf.EkfNoise()), drive)
    assert rmse_deg(ekf.estimate(drive.signals, found.car, found.noise), drive) < 0.7 * before
    assert found.held_out_rad is None


def test_what_was_left_out_is_measured_without_it(drive: LabelledDrive, executor: Executor) -> None:
    wrong = replace(drive, drive_id="wrong", sideslip_rad=drive.sideslip_rad + np.radians(1))
    found = identify_held_out(MEASURED, [drive, wrong], executor)
    assert found.held_out_rad is not None
    assert np.degrees(found.held_out_rad) > 0.8 > np.degrees(found.fit_rad)


def test_drives_without_a_label_are_refused(drive: LabelledDrive, executor: Executor) -> None:
    unknown = replace(drive, sideslip_rad=np.full(len(drive.signals), np.nan))
    with pytest.raises(DataError, match="no row has both"):
        identify(MEASURED, [unknown], executor)
