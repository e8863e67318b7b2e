"""The Kalman filter with a decision tree: kinds of driving, and noise of its own for each."""

from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from fleet_slip.comparison.evaluation.filters import FILTERS, FilterEstimate
from fleet_slip.comparison.observers import ekf
from fleet_slip.comparison.observers.drive_signals import LabelledDrive
from fleet_slip.comparison.rivals.tree_filter import (
    LeafNoise,
    fit_tree_filter,
    kinds,
    train_tree_filter,
)
from fleet_slip.vehicle.parameters import load_vehicle
from tests.support.drives import noisy, slalom

CAR = load_vehicle("d_class_sedan")
(CLASS,) = (one for one in FILTERS if one.name == "ekf_class")
BASE = FilterEstimate(CLASS, ekf.EkfNoise(), CAR)


@pytest.fixture
def executor() -> Iterator[Executor]:
    with ThreadPoolExecutor(1) as threads:
        yield threads


def labelled(seed: int, rows: int = 1500) -> LabelledDrive:
    """Return a drive whose side-slip no single-track model explains in its second half."""
    exact, truth = slalom(CAR, rows)
    return LabelledDrive(str(seed), noisy(exact, seed), truth)


def error(drive: LabelledDrive, estimate: np.ndarray) -> float:
    return float(np.sqrt(np.mean((estimate - drive.sideslip_rad) ** 2)))


def test_kinds_of_driving_are_sizes_that_lag_and_see_no_future() -> None:
    drive = labelled(1).signals
    found = kinds(drive, CAR)
    assert found.shape == (1500, 4)
    assert (found >= 0).all()
    half = type(drive)(**{name: values[:500] for name, values in vars(drive).items()})
    np.testing.assert_array_equal(kinds(half, CAR), found[:500])


def test_a_tree_of_factors_one_is_the_filter_itself(executor: Executor) -> None:
    drives = [labelled(1), labelled(2)]
    fitted = fit_tree_filter(BASE, drives, executor)
    plain = ekf.estimate(drives[0].signals, CAR, ekf.EkfNoise())
    found = fitted.estimate(drives[0].signals, CAR, LeafNoise())
    np.testing.assert_array_equal(found, plain)


def test_the_tree_betters_the_drives_that_it_learned(executor: Executor) -> None:
    drives = [labelled(1), labelled(2)]
    fitted = fit_tree_filter(BASE, drives, executor)
    assert len(set(fitted.leaf(drives[0].signals, CAR))) > 1
    for drive in drives:
        found = error(drive, fitted.estimate(drive.signals, CAR, fitted.noise))
        assert found < error(drive, ekf.estimate(drive.signals, CAR, ekf.EkfNoise()))


def test_a_drive_is_judged_by_a_tree_that_has_not_seen_it(executor: Executor) -> None:
    drives = [labelled(1, 800), labelled(2, 800)]
    rival = train_tree_filter(BASE, drives, executor)
    alone = fit_tree_filter(BASE, drives[1:], executor)
    held_out = alone.estimate(drives[0].signals, CAR, alone.noise) - drives[0].sideslip_rad
    other = fit_tree_filter(BASE, drives[:1], executor)
    second = other.estimate(drives[1].signals, CAR, other.noise) - drives[1].sideslip_rad
    expected = np.degrees(np.sqrt(np.mean(np.concatenate([held_out, second]) ** 2)))
    assert rival.cross_validated.rmse_deg == pytest.approx(expected)
    assert rival.rows == 1600
    assert replace(rival, name="x").as_dict()["name"] == "x"
