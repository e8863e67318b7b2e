"""Sensors: noise, counts as a CAN bus has them, and imperfections against closed forms."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray
from fleet_slip.catalog.signals import Signal
from fleet_slip.simulation.imperfections import Imperfections, SensorImperfections
from fleet_slip.simulation.sensors import (
    EXACT,
    Gps,
    Sensors,
    correlated_noise,
    delayed,
    distort,
    low_pass,
    noisy_counts,
    timed_pulses,
)
from fleet_slip.vehicle.batch import CHANNELS
from fleet_slip.vehicle.parameters import PERFECT, CarImperfections
from tests.support.catalog import SIGNALS
from tests.support.measurements import measure

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
        for i, signal in enumerate(SIGNALS.signals.values())
    }


def generator(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_noise_has_the_stated_bias_and_standard_deviation() -> None:
    truth = constant_truth()
    measured = measure(truth, SENSORS, generator())
    for name, (bias, std) in SENSORS.bias_and_std.items():
        signal = SIGNALS[name]
        error = measured.counts[name] * float(signal.scale) - truth[signal.column]
        # Rounding to counts adds a variance of scale² / 12.
        expected = np.hypot(std, float(signal.scale) / np.sqrt(12))
        assert np.mean(error) == pytest.approx(bias, abs=5 * expected / np.sqrt(TICKS)), name
        assert np.std(error) == pytest.approx(expected, rel=0.01), name


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
        error = velocity - truth[SIGNALS[name.removeprefix("gps_")].column][0]
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


@given(
    name=st.sampled_from(sorted(SIGNALS.signals)),
    values=st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=20),
)
def test_counts_are_the_nearest_within_the_valid_range(name: str, values: list[float]) -> None:
    signal = SIGNALS[name]
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


ROWS = 3000
TIME_S = np.arange(ROWS) / 100


def truth(**changes: FloatArray | float) -> dict[str, FloatArray]:
    """Return a straight drive at 20 m/s, with changes."""
    usual = {name: np.zeros(ROWS) for name in CHANNELS}
    usual |= {"vx_mps": np.full(ROWS, 20.0)}
    usual |= {f"wheel_{w}_rad_s": np.full(ROWS, 60.0) for w in ("fl", "fr", "rl", "rr")}
    return usual | {name: np.zeros(ROWS) + value for name, value in changes.items()}


def seen(
    channels: dict[str, FloatArray], car: CarImperfections = PERFECT, **sensors: float
) -> dict[str, FloatArray]:
    flaws = Imperfections(car=car, sensors=SensorImperfections.model_validate(sensors))
    return distort(channels, flaws, np.random.default_rng(1), np.random.default_rng(2))


def test_a_leaning_body_adds_its_share_of_the_weight() -> None:
    """At 4 °/g an accelerometer reads sin(4° ay/g) g more: 7 % (Milliken and Milliken 1995)."""
    car = CarImperfections(roll_gradient_deg_per_g=4.0, pitch_gradient_deg_per_g=2.0)
    signals = seen(
        truth(ay_mps2=5.0, leaning_ay_mps2=5.0, ax_mps2=-4.0, leaning_ax_mps2=-4.0), car=car
    )
    roll = np.radians(4.0 * 5.0 / 9.80665)
    assert signals["ay_mps2"][-1] == pytest.approx(
        5.0 * np.cos(roll) + 9.80665 * np.sin(roll), abs=1e-4
    )
    pitch = np.radians(2.0 * -4.0 / 9.80665)
    assert signals["ax_mps2"][-1] == pytest.approx(
        -4.0 * np.cos(pitch) + 9.80665 * np.sin(pitch), abs=1e-4
    )


def test_an_accelerometer_off_the_centre_feels_the_turning() -> None:
    """A point fixed to a body has a + ω̇ × r + ω × (ω × r)."""
    motion = truth(yaw_rate_rad_s=0.5, yaw_acceleration_rad_s2=1.2, ay_mps2=2.0)
    signals = seen(motion, inertial_x_m=0.4, inertial_y_m=-0.3)
    place = np.array([0.4, -0.3, 0.0])
    spin, spin_rate = np.array([0.0, 0.0, 0.5]), np.array([0.0, 0.0, 1.2])
    expected = (
        np.array([0.0, 2.0, 0.0])
        + np.cross(spin_rate, place)
        + np.cross(spin, np.cross(spin, place))
    )
    assert signals["ax_mps2"][0] == pytest.approx(expected[0])
    assert signals["ay_mps2"][0] == pytest.approx(expected[1])


def test_a_turned_unit_mixes_the_axes() -> None:
    signals = seen(truth(ay_mps2=4.0), inertial_yaw_deg=1.0, inertial_roll_deg=0.5)
    assert signals["ax_mps2"][0] == pytest.approx(np.sin(np.radians(1.0)) * 4.0, abs=2e-3)
    assert signals["ay_mps2"][0] == pytest.approx(4.0 + 9.80665 * np.sin(np.radians(0.5)), abs=1e-3)


def test_angles_have_an_offset_and_a_scale() -> None:
    signals = seen(
        truth(steering_wheel_rad=0.2, steer_fl_rad=0.01, steer_fr_rad=0.01, sideslip_rad=0.02),
        steering_offset_deg=2.0,
        wheel_angle_offset_fl_deg=0.1,
        wheel_angle_scale_error=0.05,
        label_offset_deg=-0.1,
    )
    assert signals["steering_wheel_rad"][0] == pytest.approx(0.2 + np.radians(2.0))
    assert signals["steer_fl_rad"][0] == pytest.approx(0.0105 + np.radians(0.1))
    assert signals["steer_fr_rad"][0] == pytest.approx(0.0105)
    assert signals["sideslip_rad"][0] == pytest.approx(0.02 - np.radians(0.1))


@pytest.mark.parametrize("latency_s", [0.01, 0.045, 0.2])
def test_a_late_sensor_reports_what_was(latency_s: float) -> None:
    signal = 3.0 * TIME_S
    late = delayed(signal, latency_s)
    np.testing.assert_allclose(late[50:], (signal - 3.0 * latency_s)[50:], atol=1e-9)
    assert late[0] == signal[0]


@pytest.mark.parametrize("bandwidth_hz", [2.0, 10.0])
def test_a_low_pass_passes_half_of_the_power_at_its_bandwidth(bandwidth_hz: float) -> None:
    wave = np.sin(2 * np.pi * bandwidth_hz * TIME_S)
    passed = low_pass(wave, bandwidth_hz)[ROWS // 2 :]
    # The trapezoidal rule warps a frequency f to tan(π f T) / (π T).
    warped = np.tan(np.pi * bandwidth_hz / 100) / (np.pi * bandwidth_hz / 100)
    assert np.var(passed) / np.var(wave) == pytest.approx(1 / (1 + warped**2), rel=0.02)
    assert low_pass(np.full(10, 7.0), bandwidth_hz)[-1] == 7.0


def test_pulses_are_timed_at_any_speed() -> None:
    speed = np.full(ROWS, 60.0)
    speeds = timed_pulses(speed, np.zeros(48))
    np.testing.assert_allclose(speeds[10:], 60.0, rtol=1e-9)
    slow = timed_pulses(np.full(ROWS, 0.8), np.zeros(48))  # six pulses a second
    np.testing.assert_allclose(slow[100:], 0.8, rtol=1e-6)


def test_uneven_pulses_repeat_with_every_turn() -> None:
    places = 0.02 * np.random.default_rng(3).standard_normal(48)
    speeds = timed_pulses(np.full(ROWS, 2 * np.pi * 10), places)  # a turn is ten samples
    error = speeds[20:] / (2 * np.pi * 10) - 1
    assert 0.001 < np.std(error) < 0.02
    assert np.corrcoef(error[10:], error[:-10])[0, 1] > 0.99


def test_lasting_errors_have_their_spread_and_forget_in_their_time() -> None:
    errors = correlated_noise(4, 200_000, 2.0, np.random.default_rng(5))
    assert np.std(errors, axis=1) == pytest.approx(np.ones(4), rel=0.1)
    for tau_s in (1.0, 2.0):
        ticks = int(tau_s * 100)
        correlations = [np.corrcoef(error[:-ticks], error[ticks:])[0, 1] for error in errors]
        assert np.mean(correlations) == pytest.approx(np.exp(-tau_s / 2.0), abs=0.05)
    assert abs(np.corrcoef(errors[0], errors[1])[0, 1]) < 0.15
    assert np.abs(np.diff(errors)).max() < 0.2  # no jump from one sample to the next


def quantise(physical: FloatArray, signal: Signal) -> tuple[NDArray[np.int16], int]:
    """Return `physical / scale` as counts, and how many values were clipped to the valid range.

    Halves round to even. NaN is clipped as well, to the lower end.
    """
    return noisy_counts(physical, np.zeros(len(physical), dtype=np.float32), EXACT, signal)
