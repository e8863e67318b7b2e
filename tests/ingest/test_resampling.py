import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from fleet_slip.arrays import FloatArray
from fleet_slip.ingest.resampling import average, build_resampler, choose_method, interpolate

steps = st.lists(st.floats(0.0005, 0.09), min_size=3, max_size=60)
lines = st.tuples(st.floats(-100, 100), st.floats(-100, 100))


def times(step_s: list[float]) -> FloatArray:
    return np.concatenate([[0.0], np.cumsum(step_s)])


@given(steps, lines)
def test_a_linear_signal_is_interpolated_exactly(
    step_s: list[float], line: tuple[float, float]
) -> None:
    t = times(step_s)
    at = build_resampler(t, "interpolate").at_s
    offset, slope = line
    got = interpolate(t, offset + slope * t, at, longest_gap_s=0.1)
    assert_allclose(got, offset + slope * at, rtol=0, atol=1e-9)
    assert at[0] == t[0]
    assert at[-1] <= t[-1] + 1e-6 < at[-1] + 0.01 + 2e-6


@given(st.lists(st.floats(0.0002, 0.009), min_size=60, max_size=200), lines)
def test_a_linear_signal_is_averaged_exactly(
    step_s: list[float], line: tuple[float, float]
) -> None:
    t = times(step_s)
    at = build_resampler(t, "average").at_s
    offset, slope = line
    got = average(t, offset + slope * t, at, longest_gap_s=0.1)
    assert_allclose(got, offset + slope * at, rtol=0, atol=1e-8)


@pytest.mark.parametrize("frequency_hz", [5.0, 30.0, 50.0, 90.0, 100.0, 210.0, 400.0])
def test_averaging_has_the_frequency_response_of_a_moving_average(frequency_hz: float) -> None:
    t = np.arange(20_001) / 10_000
    at = build_resampler(t, "average").at_s
    phase = 0.4
    got = average(t, np.cos(2 * np.pi * frequency_hz * t + phase), at, longest_gap_s=0.1)
    gain = np.sinc(frequency_hz / 100)
    expected = gain * np.cos(2 * np.pi * frequency_hz * at + phase)
    assert_allclose(got, expected, rtol=0, atol=0.01)


def test_nothing_is_interpolated_across_a_long_gap() -> None:
    t = np.array([0.0, 0.02, 0.04, 0.30, 0.32])
    got = interpolate(t, np.ones(5), build_resampler(t, "interpolate").at_s, longest_gap_s=0.1)
    assert np.flatnonzero(~np.isnan(got)).tolist() == [0, 1, 2, 3, 4, 30, 31, 32]


def test_nothing_is_averaged_across_a_long_gap() -> None:
    t = np.concatenate([np.arange(0, 51), np.arange(300, 351)]) / 1000
    got = average(t, np.ones(t.size), build_resampler(t, "average").at_s, longest_gap_s=0.1)
    assert np.flatnonzero(~np.isnan(got)).tolist() == [0, 1, 2, 3, 4, 30, 31, 32, 33, 34]


def test_nothing_is_extrapolated() -> None:
    t = np.arange(11) / 50
    values = np.where((t > 0.05) & (t < 0.15), 1.0, np.nan)
    got = interpolate(t, values, build_resampler(t, "interpolate").at_s, longest_gap_s=0.1)
    assert np.flatnonzero(~np.isnan(got)).tolist() == list(range(6, 15))


def test_a_slow_sensor_is_resampled_from_its_own_samples() -> None:
    t = np.arange(51) / 50
    slow = np.where(np.arange(51) % 5 == 0, 3 * t, np.nan)  # 10 Hz
    at = build_resampler(t, "interpolate").at_s
    assert_allclose(interpolate(t, slow, at, longest_gap_s=0.1), 3 * at, atol=1e-12)
    sparse = interpolate(t, slow, at, longest_gap_s=0.05)
    assert np.flatnonzero(~np.isnan(sparse)).tolist() == list(range(0, 101, 10))


def test_an_absent_signal_stays_absent() -> None:
    t = np.arange(30) / 1000
    nothing = np.full(30, np.nan)
    assert np.isnan(interpolate(t, nothing, t, 0.1)).all()
    assert np.isnan(average(t, nothing, t, 0.1)).all()


@given(st.lists(st.floats(-0.00095, 0.00095), min_size=2, max_size=100))
def test_jitter_of_a_tenth_of_a_sample_is_snapped(jitter_s: list[float]) -> None:
    jitter = np.array([0.0, *jitter_s])
    t = np.arange(jitter.size) / 100 + jitter
    assert choose_method(t, 0.01) == "snap"
    assert build_resampler(t, "snap").ticks.tolist() == list(range(t.size))


@pytest.mark.parametrize(
    ("rate_hz", "method"),
    [(10, "interpolate"), (50, "interpolate"), (100, "snap"), (125, "average"), (1000, "average")],
)
def test_the_method_follows_the_rate(rate_hz: float, method: str) -> None:
    assert choose_method(np.arange(500) / rate_hz, 1 / rate_hz) == method


def test_a_clock_that_drifts_off_the_ticks_is_resampled() -> None:
    assert choose_method(np.arange(1000) / 100.5, 1 / 100.5) == "interpolate"


def test_two_samples_at_one_tick_are_resampled() -> None:
    assert choose_method(np.array([0, 0.0003, 0.01, 0.02]), 0.01) == "interpolate"
