"""Sensors: noise has the stated figures, counts are rounded and clipped as a CAN bus does."""

from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.simulation.sensors import Gps, Sensors
from tests.support.measuring import measure, quantise

TICKS = 200_000
GPS = Gps(rate_hz=10, velocity_std_mps=0.05, time_between_outages_s=60, outage_duration_s=5)
SENSORS = Sensors(
    ax_bias_mps2=0.15,
    ay_bias_mps2=-0.2,
    acceleration_std_mps2=0.1,
    yaw_rate_bias_rad_s=0.01,
    yaw_rate_std_rad_s=0.01,
    wheel_speed_std_rad_s=0.05,
    steering_wheel_std_rad=0.002,
    steer_std_rad=0.0002,
    sideslip_std_rad=0.0005,
    gps=GPS,
)


def constant_truth(ticks: int = TICKS) -> dict[str, NDArray[np.float64]]:
    return {
        signal.column: np.full(ticks, 0.01 * (i + 1))
        for i, signal in enumerate(catalogue().signals.values())
    }


def generator(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_noise_has_the_stated_bias_and_standard_deviation() -> None:
    truth = constant_truth()
    measured = measure(truth, SENSORS, generator())
    for name, (bias, std) in SENSORS.bias_and_std.items():
        signal = catalogue()[name]
        error = measured.counts[name] * float(signal.scale) - truth[signal.column]
        # Rounding to counts adds a variance of scale² / 12.
        expected = np.hypot(std, float(signal.scale) / np.sqrt(12))
        assert np.mean(error) == pytest.approx(bias, abs=5 * expected / np.sqrt(TICKS)), name
        assert np.std(error) == pytest.approx(expected, rel=0.01), name


def test_noise_is_white_and_independent_between_signals() -> None:
    measured = measure(constant_truth(), SENSORS, generator())
    noise = np.stack([measured.counts[name] for name in SENSORS.bias_and_std]).astype(float)
    limit = 5 / np.sqrt(TICKS)
    between = np.corrcoef(noise) - np.eye(len(noise))
    assert np.abs(between).max() < limit
    for row in noise:
        assert abs(np.corrcoef(row[:-1], row[1:])[0, 1]) < limit


def test_gps_has_its_own_rate_noise_and_outages() -> None:
    truth = constant_truth()
    measured = measure(truth, SENSORS, generator())
    on_grid = np.zeros(TICKS, dtype=bool)
    on_grid[::10] = True
    assert not np.any(measured.gps_fix & ~on_grid)
    lost = 1 - measured.gps_fix.sum() / on_grid.sum()
    assert lost == pytest.approx(5 / 65, rel=0.6)
    assert np.diff(np.flatnonzero(measured.gps_fix)).max() > 200, "an outage lasts for seconds"
    for name in ("gps_vx", "gps_vy"):
        velocity = measured.counts[name][measured.gps_fix] * 0.005
        error = velocity - truth[catalogue()[name.removeprefix("gps_")].column][0]
        assert np.std(error) == pytest.approx(0.05, rel=0.03)
        assert not measured.counts[name][~measured.gps_fix].any()


def test_values_out_of_range_saturate_and_are_counted() -> None:
    truth = constant_truth(50)
    truth["yaw_rate_rad_s"][10:14] = [9.0, -9.0, np.inf, np.nan]
    truth["vx_mps"][0] = -500.0
    truth["vx_mps"][5] = 500.0
    del truth["gps_vx_mps"]  # then GPS measures the speed itself
    exact = SENSORS.model_copy(update={"yaw_rate_std_rad_s": 0.0})
    measured = measure(truth, exact, generator())
    assert measured.counts["yaw_rate"][10:14].tolist() == [32000, -32000, 32000, -32000]
    assert measured.counts["vx"][[0, 5]].tolist() == [-32000, 32000]
    # vx is clipped twice, and once more where GPS, with a fix at tick 0, measures it.
    assert measured.saturated == 4 + 2 + 1


def test_halves_round_to_even() -> None:
    signal = catalogue()["wheel_fl"].model_copy(update={"scale": Decimal("0.25")})
    counts, clipped = quantise(np.array([0.125, 0.375, 0.625, -0.125, -0.375]), signal)
    assert counts.tolist() == [0, 2, 2, 0, -2]
    assert clipped == 0


@given(
    name=st.sampled_from(sorted(catalogue().signals)),
    values=st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=20),
)
def test_counts_are_the_nearest_within_the_valid_range(name: str, values: list[float]) -> None:
    signal = catalogue()[name]
    counts, clipped = quantise(np.array(values), signal)
    inside = 0
    for value, count in zip(values, counts.tolist(), strict=True):
        assert signal.min_count <= count <= signal.max_count
        exact = Fraction(value) / signal.exact_scale
        if signal.min_count <= exact <= signal.max_count:
            assert abs(exact - count) <= Fraction(1, 2) + Fraction(1, 10**9)
            inside += 1
        else:
            nearest = signal.min_count if exact < 0 else signal.max_count
            assert count == nearest
    assert clipped <= len(values) - inside
