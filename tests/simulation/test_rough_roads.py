"""Rough roads, drift, jitter, rates and labels: each does what its formula says."""

from dataclasses import replace

import numpy as np
import pytest

from fleet_slip.simulation.campaign import load_campaign
from fleet_slip.simulation.imperfections import Imperfections
from fleet_slip.simulation.job import simulate_logs
from fleet_slip.simulation.sensors import (
    AX,
    AY,
    FIRST_WHEEL,
    INERTIAL,
    LABEL,
    WHEELS,
    Distortion,
    Vibration,
    held,
)

TICKS = 60_000


def truth(speed_mps: float, yaw_rate_rad_s: float = 0.0) -> dict[str, np.ndarray]:
    names = [*INERTIAL, *WHEELS, LABEL, "steering_wheel_rad", "steer_fl_rad", "steer_fr_rad"]
    names += ["yaw_acceleration_rad_s2", "leaning_ax_mps2", "leaning_ay_mps2", "vx_mps", "vy_mps"]
    values = {name: np.zeros(TICKS) for name in names}
    values["vx_mps"] += speed_mps
    values["yaw_rate_rad_s"] += yaw_rate_rad_s
    for name in WHEELS:
        values[name] += speed_mps / 0.32
    return values


def seen(
    kind: str, figures: dict[str, float], before: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    flaws = Imperfections.model_validate({kind: figures})
    return Distortion(flaws, *map(np.random.default_rng, (1, 2))).apply(before)


def test_vibration_grows_with_the_root_of_speed_and_roughness() -> None:
    """ISO 8608: density of the vertical velocity is 4 π² n0² Gd v, so four times v is twice it."""
    deviations = {
        (rough, speed): Vibration(rough, np.random.default_rng(1))
        .next(np.full(TICKS, speed))
        .std(axis=1)
        for rough, speed in ((64.0, 10.0), (64.0, 40.0), (256.0, 10.0))
    }
    slow = deviations[64.0, 10.0]
    np.testing.assert_allclose(deviations[64.0, 40.0], 2 * slow)
    np.testing.assert_allclose(deviations[256.0, 10.0], 2 * slow)
    # A spring's deflection under white noise of density S: var = S (1 + 4 ζ²) / (8 ζ ω).
    density = 4 * np.pi**2 * 0.01 * 64e-6 * 10.0
    wheel = np.sqrt(density * (1 + 4 * 0.15**2) / (8 * 0.15 * 2 * np.pi * 12)) / (3 * 0.32)
    assert slow[FIRST_WHEEL] == pytest.approx(wheel, rel=0.15)
    roll = np.sqrt(density * (1 + 4 * 0.3**2) / (8 * 0.3 * 2 * np.pi * 1.5)) / 1.5
    assert slow[AY] == pytest.approx((9.81 + (2 * np.pi * 1.5) ** 2 * 0.3) * roll, rel=0.1)
    assert slow[AX] < slow[AY]


def test_vibration_is_of_the_body_and_of_the_wheels_and_cut_in_blocks_the_same() -> None:
    whole = Vibration(64.0, np.random.default_rng(1)).next(np.full(TICKS, 20.0))
    spectrum = np.abs(np.fft.rfft(whole, axis=1))
    frequency_hz = np.fft.rfftfreq(TICKS, 0.01)
    for channel, natural_hz in ((AY, 1.5), (FIRST_WHEEL, 12.0)):
        middle = np.sum(frequency_hz * spectrum[channel] ** 2) / np.sum(spectrum[channel] ** 2)
        assert 0.5 * natural_hz < middle < 2.5 * natural_hz
    shaken = seen("road", {"roughness_cm3": 64.0}, truth(20.0))
    assert shaken["ay_mps2"].std() == pytest.approx(whole[AY].std(), rel=0.1)
    assert shaken["wheel_rl_rad_s"].mean() == pytest.approx(20.0 / 0.32, rel=1e-3)


def test_biases_drift_within_a_drive_and_forget_with_their_time_constant() -> None:
    figures = {"acceleration_drift_mps2": 0.05, "yaw_rate_drift_rad_s": 0.001, "drift_s": 20.0}
    drifting = seen("sensors", figures, truth(20.0))
    rate, ay = drifting["yaw_rate_rad_s"], drifting["ay_mps2"]
    assert rate.std() == pytest.approx(0.001, rel=0.3)
    assert ay.std() == pytest.approx(0.05, rel=0.3)
    assert np.corrcoef(ay[:-100], ay[100:])[0, 1] > 0.9
    assert abs(np.corrcoef(ay, rate)[0, 1]) < 0.5


def test_the_label_is_noisier_the_slower_and_turned_by_its_lever() -> None:
    noise = {
        v: seen("sensors", {"label_velocity_std_mps": 0.01}, truth(v))[LABEL].std()
        for v in (5.0, 20.0)
    }
    assert noise[5.0] == pytest.approx(0.01 / 5, rel=0.02)
    assert noise[20.0] == pytest.approx(0.01 / 20, rel=0.02)
    turned = seen("sensors", {"label_x_m": 0.5}, truth(10.0, 0.2))[LABEL]
    np.testing.assert_allclose(turned, 0.5 * 0.2 / 10.0)


def test_jitter_is_age_within_its_bound_and_of_a_message() -> None:
    ramp = truth(20.0)
    for name in INERTIAL:
        ramp[name] = np.arange(TICKS) * 0.01  # a second for each second
    late = seen("sensors", {"clock_jitter_s": 0.004}, ramp)
    age_s = ramp["ax_mps2"] - late["ax_mps2"]
    assert 0.0 <= age_s[1:].min() < 1e-4
    assert 0.0039 < age_s.max() < 0.004
    np.testing.assert_allclose(late["ax_mps2"], late["ay_mps2"], atol=1e-12)


def test_a_value_is_held_until_the_next_whatever_the_blocks() -> None:
    counts = np.arange(1000, dtype=np.int16)
    whole = held(counts, 5, 0, counts[0])
    np.testing.assert_array_equal(whole, counts // 5 * 5)
    first = held(counts[:333], 5, 0, counts[0])
    np.testing.assert_array_equal(held(counts[333:], 5, 333, first[-1]), whole[333:])


def test_a_log_of_several_rates_holds_noise_too() -> None:
    campaign = load_campaign("fleet_rough")
    spec = replace(campaign.drives(campaign.first_day)[0], laps=0.1)
    sensors = spec.flaws.sensors.model_copy(update={"wheel_held_ticks": 5})
    (log,) = simulate_logs(
        [replace(spec, flaws=spec.flaws.model_copy(update={"sensors": sensors}))]
    )
    wheel = log.measurement.counts["wheel_rl"][: log.rows // 5 * 5].reshape(-1, 5)
    assert (wheel == wheel[:, :1]).all()
    assert len(np.unique(wheel)) > 50
