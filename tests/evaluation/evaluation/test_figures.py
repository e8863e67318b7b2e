"""Figures of errors, failures of sensors, and where a car is unstable."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fleet_slip.errors import QuestionError
from fleet_slip.evaluation.evaluated_drives import TestDrive, apply_failure, join, peak_slip
from fleet_slip.evaluation.evaluator import error_statistics
from fleet_slip.evaluation.filters import linear_estimate
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.simulation.scenario import Failure, load_scenario
from fleet_slip.vehicle.dynamics import cornering_stiffness
from fleet_slip.vehicle.parameters import constants, load_vehicle

ALL = np.ones(5, dtype=np.bool_)


def test_statistics_of_a_given_error() -> None:
    truth = np.radians([0.0, 1.0, 2.0, 3.0, 4.0])
    figures = error_statistics(truth + np.radians([1.0, 1.0, 1.0, 1.0, 2.0]), truth, ALL)
    assert figures.rows == 5
    assert figures.coverage == 1
    assert figures.error_mean_deg == pytest.approx(1.2)
    assert figures.error_std_deg == pytest.approx(np.sqrt(0.8 / 4))
    assert figures.rmse_deg == pytest.approx(np.sqrt(8 / 5))
    assert figures.error_median_deg == pytest.approx(1.0)
    assert figures.error_max_deg == pytest.approx(2.0)
    assert figures.correlation == pytest.approx(12 / np.sqrt(10 * 14.8))


def test_rows_without_an_estimate_count_for_the_coverage_alone() -> None:
    truth = np.zeros(5)
    estimate = np.array([np.nan, np.radians(1), np.radians(1), np.inf, 7.0])
    figures = error_statistics(estimate, truth, np.array([True, True, True, True, False]))
    assert figures.rows == 4
    assert figures.coverage == 0.5
    assert figures.error_mean_deg == pytest.approx(1.0)
    assert figures.correlation is None


def test_an_estimator_without_any_estimate_has_no_statistics() -> None:
    figures = error_statistics(np.full(5, np.nan), np.zeros(5), ALL)
    assert figures.coverage == 0
    assert figures.error_std_deg is None


def test_a_null_signal_leaves_no_estimate() -> None:
    coefficients = {"ay_mps2": 2.0, "yaw_rate_rad_s": -1.0}
    signals = {"ay_mps2": np.array([1.0, np.nan]), "yaw_rate_rad_s": np.array([3.0, 3.0])}
    zero, scenario = np.zeros(2), load_scenario("nominal", SHIPPED_CONFIGS)
    drive = TestDrive(scenario, zero, signals, zero, zero, zero, zero, None)
    np.testing.assert_array_equal(linear_estimate(0.5, coefficients, drive), [-0.5, np.nan])


def test_a_stuck_signal_keeps_its_value_and_a_missing_one_has_none() -> None:
    time_s = np.arange(6) / 100
    signals = {"ax": np.arange(6.0), "ay": np.arange(6.0)}
    stuck = Failure(kind="stuck", signals=("ax",), from_s=0.02, until_s=0.04)
    changed = apply_failure(signals, time_s, stuck)
    assert changed["ax"].tolist() == [0, 1, 2, 2, 4, 5]
    missing = Failure(kind="missing", signals=("ay",), from_s=0.03)
    np.testing.assert_array_equal(
        apply_failure(changed, time_s, missing)["ay"], [0, 1, 2, np.nan, np.nan, np.nan]
    )
    assert signals["ax"].tolist() == [0, 1, 2, 3, 4, 5]


def test_a_failure_after_the_drives_end_is_an_error() -> None:
    late = Failure(kind="missing", signals=("ax",), from_s=9)
    with pytest.raises(QuestionError, match="begins at"):
        apply_failure({"ax": np.zeros(3)}, np.arange(3) / 100, late)


def test_the_peak_of_a_tyre_whose_friction_does_not_fall_is_full_sliding() -> None:
    car = load_vehicle("d_class_sedan", SHIPPED_CONFIGS)
    tyre = car.tyre.model_copy(update={"friction_decay_speed_mps": 1e9})
    steady = car.model_copy(update={"tyre": tyre})
    for adhesion in (1.0, 0.4):
        c = constants(steady, adhesion)
        load = c.static_rear
        friction = c.friction - c.friction_per_load * load
        # Pacejka 2012, equation 3.9: full sliding begins at the slip 3 μ Fz / C.
        sliding = 3 * friction * load / cornering_stiffness(load, c.stiffness_rear, c)
        assert np.tan(peak_slip(steady, adhesion).rear_rad) == pytest.approx(sliding, rel=0.01)


def test_the_peak_moves_inwards_when_friction_falls_with_sliding() -> None:
    car = load_vehicle("d_class_sedan", SHIPPED_CONFIGS)
    tyre = car.tyre.model_copy(update={"friction_decay_speed_mps": 1e9})
    steady = car.model_copy(update={"tyre": tyre})
    assert peak_slip(car, 1.0).front_rad < peak_slip(steady, 1.0).front_rad
    assert peak_slip(car, 0.4).front_rad < peak_slip(car, 1.0).front_rad


@given(arrays(np.bool_, st.integers(0, 40)), st.integers(1, 6))
def test_joining_fills_short_gaps_and_nothing_else(mask: np.ndarray, gap: int) -> None:
    joined = join(mask, gap)
    assert (joined >= mask).all()
    np.testing.assert_array_equal(join(joined, gap), joined)
    text = "".join("1" if value else "0" for value in joined).strip("0")
    assert all(len(zeros) >= gap for zeros in text.split("1") if zeros)
    # Outside of the first and last run nothing is filled.
    if mask.any():
        ends = np.flatnonzero(mask)[[0, -1]]
        assert not joined[: ends[0]].any()
        assert not joined[ends[1] + 1 :].any()
