"""The sweep over GPS noise: what is drawn, what the filter is told, and where it equals."""

import numpy as np
import pytest

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.evaluation import kalman
from fleet_slip.evaluation.drives import EvaluatedDrive, visible_signals
from fleet_slip.evaluation.evaluate import (
    LEVELS_MPS,
    drawn_gps,
    equal_at_mps,
    rmse_deg,
    sweep_gps_noise,
)
from fleet_slip.evaluation.filters import FILTERS, FilterEstimate
from fleet_slip.evaluation.judge import evaluate_drive
from fleet_slip.simulation.scenario import load_scenario
from tests.support.drives import noisy, slalom

(KALMAN,) = (one for one in FILTERS if one.name == "kalman")
NOMINAL = load_scenario("nominal")
FILTER = FilterEstimate(KALMAN, kalman.FilterNoise(), NOMINAL.car)


def drive(rows: int = 3000) -> EvaluatedDrive:
    """Return a drive of the nominal car with noisy sensors and no GPS at all."""
    exact, sideslip = slalom(NOMINAL.car, rows)
    seen = noisy(exact, seed=2)
    signals = {catalogue()[name].column: np.full(rows, np.nan) for name in visible_signals()}
    signals |= {name: values for name, values in vars(seen).items() if not name.startswith("gps")}
    vx = 20.0 + 5.0 * np.sin(0.2 * np.arange(rows) / 100)
    still = np.zeros(rows)
    return EvaluatedDrive(
        NOMINAL, np.arange(rows) / 100, signals, vx, vx * np.tan(sideslip), still, still, None
    )


def test_fixes_are_the_truth_with_noise_of_the_stated_size_ten_times_a_second() -> None:
    one = drive(100_000)
    gps = drawn_gps(one, 0.04, np.random.default_rng(1))
    fixes = np.isfinite(gps["gps_vx_mps"])
    assert fixes.sum() == 10_000
    assert fixes[::10].all()
    for name, truth in (("gps_vx_mps", one.vx_mps), ("gps_vy_mps", one.vy_mps)):
        error = (gps[name] - truth)[fixes]
        assert error.std() == pytest.approx(0.04, rel=0.03)
        assert abs(error.mean()) < 0.002


def test_the_error_rises_with_the_noise() -> None:
    errors = [rmse_deg(drive(), FILTER, std) for std in (0.01, 0.03, 0.1)]
    assert errors == sorted(errors)
    assert errors[0] < 0.7 * errors[-1]


def test_filter_and_regression_are_equal_where_the_line_between_levels_is() -> None:
    errors = [10 * std**2 for std in LEVELS_MPS]
    at_two, at_three = 10 * 0.02**2, 10 * 0.025**2
    expected = 0.02 + 0.005 * (0.005 - at_two) / (at_three - at_two)
    assert equal_at_mps(errors, 0.005) == pytest.approx(expected)
    assert equal_at_mps(errors, 0.0009) is None
    assert equal_at_mps(errors, 0.17) is None


def test_the_sweep_is_of_the_nominal_drive_and_the_same_every_time() -> None:
    run = evaluate_drive(drive(), {"model": lambda signals: 0 * signals["ay_mps2"]})
    sweep = sweep_gps_noise([run], {"kalman": FILTER}, ["model"])
    assert sweep is not None
    assert [level["velocity_std_mps"] for level in sweep["levels"]] == list(LEVELS_MPS)
    expected = np.degrees(np.sqrt(np.mean(run.drive.sideslip_rad**2)))
    assert sweep["regressions"]["model"] == pytest.approx(expected)
    again = sweep_gps_noise([run], {"kalman": FILTER}, ["model"])
    assert again == sweep
    assert sweep_gps_noise([], {"kalman": FILTER}, ["model"]) is None
