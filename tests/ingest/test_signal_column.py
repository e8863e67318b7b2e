"""What a mapping can say of one column, on files with known content."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_slip.ingest.columns import conversion_factor
from fleet_slip.ingest.resampling import build_resampler
from fleet_slip.ingest.suspicion import RADIUS_M
from tests.support.measured import a_mapping, good_columns, physical, read_columns, ticks
from tests.support.textbook_car import a_car


def signals(**columns: dict[str, Any]) -> Any:
    return a_mapping(signals=columns)


def test_wheels_logged_as_velocities_become_angular_velocities(tmp_path: Path) -> None:
    wheel = {"column": "v", "unit": "km/h", "radius_m": 0.3, "offset": 0.36}
    log = read_columns(tmp_path, {"t": [0, 0.01], "v": [36, 72]}, signals(wheel_fl=wheel))
    # 36 km/h and 0.36 km/h more are 10.1 m/s.
    assert physical(log, "wheel_fl", 0.01) == pytest.approx([10.1 / 0.3, 20.1 / 0.3], abs=5e-3)


def test_a_gain_applies_before_the_offset(tmp_path: Path) -> None:
    wheel = {"column": "road", "unit": "deg", "gain": 16, "negate": True, "offset": 3}
    log = read_columns(tmp_path, {"t": [0, 0.01], "road": [1, -2]}, signals(steering_wheel=wheel))
    expected = np.radians([-16 + 3, 32 + 3])
    assert physical(log, "steering_wheel", 0.0005) == pytest.approx(expected, abs=2.5e-4)


@pytest.mark.parametrize("first", [0.0, 0.0037], ids=["snapped", "interpolated"])
def test_a_delay_moves_a_signal_back_to_when_it_happened(tmp_path: Path, first: float) -> None:
    time_s = first + np.arange(100) / 100
    slope = {"column": "late", "unit": "m/s^2", "delay_s": 0.025}
    mapping = signals(ax={"column": "now", "unit": "m/s^2"}, ay=slope)
    columns = {"t": time_s.tolist(), "now": time_s.tolist(), "late": (time_s - 0.025).tolist()}
    log = read_columns(tmp_path, columns, mapping)
    now, late = physical(log, "ax", 0.001), physical(log, "ay", 0.001)
    measured = np.isfinite(late)
    assert late[measured] == pytest.approx(now[measured], abs=1.1e-3)
    # Nothing is extrapolated: the last 25 ms have not arrived yet.
    assert np.flatnonzero(~measured).tolist() == [97, 98, 99]


def test_a_slow_sensor_can_stay_as_slow_as_it_is(tmp_path: Path) -> None:
    fix = {"column": "fix", "unit": "m/s", "interpolate": False}
    mapping = signals(ax={"column": "ax", "unit": "m/s^2"}, gps_vx=fix)
    fixes = [10 if i % 5 == 2 else None for i in range(20)]
    columns = {"t": [i / 50 for i in range(20)], "ax": [0.5] * 20, "fix": fixes}
    log = read_columns(tmp_path, columns, mapping)
    assert ticks(log) == list(range(39))
    placed = physical(log, "gps_vx", 0.005)
    assert np.flatnonzero(np.isfinite(placed)).tolist() == [4, 14, 24, 34]
    assert np.isfinite(physical(log, "ax", 0.001)).all()


@given(st.lists(st.floats(0.001, 0.4), min_size=2, max_size=60), st.floats(-0.2, 0.2))
def test_placing_keeps_values_and_invents_none(steps: list[float], delay_s: float) -> None:
    time_s = np.cumsum(steps)
    values = np.arange(1.0, time_s.size + 1)
    resampler = build_resampler(time_s, "interpolate")
    placed = resampler.place(values, delay_s)
    kept = placed[np.isfinite(placed)]
    assert placed.shape == resampler.ticks.shape
    assert set(kept) <= set(values)
    assert (np.diff(kept) > 0).all()


def test_keys_at_their_default_do_not_change_the_identity_of_a_file(tmp_path: Path) -> None:
    plain = a_mapping()
    said = a_mapping(
        signals={
            "ax": {"column": "ax", "unit": "m/s^2", "gain": 1.0, "delay_s": 0.0},
            "sideslip": {"column": "beta", "unit": "deg", "interpolate": True},
        },
        where=[],
    )
    assert read_columns(tmp_path, good_columns(), said).digest == (
        read_columns(tmp_path, good_columns(), plain).digest
    )
    # The digest of the release before these keys.
    assert '"gain"' not in plain.canonical_json()


def test_the_label_is_moved_to_the_centre_of_gravity(tmp_path: Path) -> None:
    car = a_car()
    speed = (car["wheel_rl"] + car["wheel_rr"]) / 2 * RADIUS_M
    vy = speed * np.tan(car["sideslip"]) + car["yaw_rate"] * 1.5
    columns = {"r": car["yaw_rate"], "v": speed, "vy": vy, "b": np.arctan2(vy, speed)}
    assert np.abs(columns["b"] - car["sideslip"]).max() > 0.04
    told = {"t": np.arange(speed.size) / 100, **columns}
    rate, moved = {"yaw_rate": {"column": "r", "unit": "rad/s"}}, {"sensor_x_m": 1.5}
    mps: dict[str, Any] = {"column": "v", "unit": "m/s"}
    angle = {"vehicle_speed": mps, "sideslip": {"column": "b", "unit": "rad"}}
    pair = {"vx": mps, "vy": {"column": "vy", "unit": "m/s"}}
    for some, label in ((angle, moved), (pair, {**moved, "from_velocities": True})):
        log = read_columns(tmp_path, told, a_mapping(signals=rate | some, label=label))
        assert np.abs(physical(log, "sideslip", 1e-4) - car["sideslip"]).max() < 6e-4


UNITS = {
    "rad": {"deg": math.pi / 180, "°": math.pi / 180, "mrad": 1e-3, "turn": 2 * math.pi},
    "rad/s": {"deg/s": math.pi / 180, "°/s": math.pi / 180, "rpm": 2 * math.pi / 60},
    "m/s": {"km/h": 1 / 3.6, "mph": 0.44704, "knot": 1852 / 3600, "mm/ms": 1.0},
    "m/s^2": {"g": 9.80665, "m/s²": 1.0, "m/s2": 1.0, "m/s**2": 1.0, "cm/s^2": 0.01},
    "m": {"cm": 0.01, "foot": 0.3048},
    "s": {"ms": 1e-3, "µs": 1e-6, "min": 60.0},
}


@pytest.mark.parametrize(
    ("si", "unit", "factor"), [(si, u, f) for si, units in UNITS.items() for u, f in units.items()]
)
def test_factors_are_those_of_the_definitions(si: str, unit: str, factor: float) -> None:
    assert conversion_factor(unit, si) == pytest.approx(factor, rel=1e-12)


@pytest.mark.parametrize(
    ("unit", "si"),
    [
        ("km/h", "rad"),
        ("rad", "rad/s"),
        ("percent", "rad"),  # a ratio is no angle
        ("Hz", "rad/s"),  # 1 Hz is 2π rad/s, not 1
        ("m/s", "m/s^2"),
        ("gram", "m/s^2"),
        ("g", "m"),
        ("degC", "rad"),
        ("dB", "rad"),
        ("furlongs per fortnite", "m/s"),
        ("", "m"),
        ("2 m", "m"),
        ("m^99", "m"),
        ("9^9^9^9^9", "m"),
        ("m" * 100_000, "m"),
        ("__import__('os')", "m"),
    ],
)
def test_other_units_are_refused_with_what_is_needed(unit: str, si: str) -> None:
    with pytest.raises(ValueError, match=r"needs an? \w+"):
        conversion_factor(unit, si)
