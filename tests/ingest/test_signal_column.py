"""What a mapping can say of one column, on files with known content."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_slip.ingest.resampling import build_resampler
from tests.support.measured import a_mapping, good_columns, physical, read_columns, ticks


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
