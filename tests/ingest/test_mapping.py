"""Keys of a mapping: for the file, for a column, and for rows that are left out."""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from fleet_slip.catalog.catalog import Catalog, load_catalog
from fleet_slip.errors import ConfigError, InputError
from fleet_slip.ingest.columns import conversion_factor
from fleet_slip.ingest.mapping import FromPath, load_mapping
from fleet_slip.ingest.ticks import choose_grid, place_samples
from fleet_slip.quality.drive_signals import RADIUS_M
from fleet_slip.resources import SHIPPED_CONFIGS
from tests.support.catalog import CATALOG, configs_with
from tests.support.measured import (
    a_mapping,
    good_columns,
    physical,
    read_columns,
    read_measured,
    ticks,
)
from tests.support.textbook_car import a_car

GOOD = """
name = "car"
time = { column = "t", unit = "s" }
drive = { day = 2024-05-31, vehicle_id = "v", vehicle_model = "m" }
[signals]
ax = { column = "a", unit = "g", negate = true, offset = 0.5 }
steer_fl = { column = "steer_fl_deg", unit = "deg" }
"""


TIME = 'column = "t", unit = "s"'
STEER = 'steer_fl = { column = "steer_fl_deg", unit = "deg" }'
WHEEL = 'wheel_fl = { column = "v", unit = "km/h", radius_m = 0.3 }'


def load(folder: Path, text: str, catalog: Catalog = CATALOG) -> Any:
    file = folder / "m.toml"
    file.write_text(text, encoding="utf-8")
    return load_mapping(str(file), catalog)


def test_shipped_mappings_load() -> None:
    names = SHIPPED_CONFIGS.names("mappings")
    assert "race_car_250lm" in names
    assert [load_mapping(name, CATALOG).name for name in names] == names


def test_a_mapping_without_a_radius_says_nothing_of_one(tmp_path: Path) -> None:
    """Its text names the drives, and they must keep the names that they had before."""
    assert "radius" not in load(tmp_path, GOOD).canonical_json()
    assert '"radius_m":0.3' in load(tmp_path, GOOD.replace(STEER, WHEEL)).canonical_json()


def test_columns_are_listed_once(tmp_path: Path) -> None:
    text = GOOD.replace('"m" }', '{ column = "a" }, column = "run" }')
    assert load(tmp_path, text).time_bases() == {"t": ["t", "run", "a", "steer_fl_deg"]}


def test_names_of_drives_are_normalized(tmp_path: Path) -> None:
    text = GOOD.replace('"v"', '" Zoe\\u0308\\t"')
    assert load(tmp_path, text).drive.vehicle_id == "Zo\u00eb"


def test_canonical_json_does_not_depend_on_the_layout(tmp_path: Path) -> None:
    head, ax, steer = GOOD.rpartition("ax =")[0], *GOOD.splitlines()[-2:]
    turned = f"# a comment\n{head}{steer}\n{ax.replace('0.5', '0.50')}"
    assert load(tmp_path, turned).canonical_json() == load(tmp_path, GOOD).canonical_json()
    other = GOOD.replace("true", "false")
    assert load(tmp_path, other).canonical_json() != load(tmp_path, GOOD).canonical_json()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"deg"', '"km/h"', "steer_fl_deg is in 'km/h', steer_fl needs an angle"),
        ('"deg"', '"smoot"', "unknown unit 'smoot'; steer_fl needs an angle"),
        ("steer_fl =", "steer_f =", "unknown signal 'steer_f'. Do you mean steer"),
        (
            "steer_fl =",
            "speed =",
            "unknown signal 'speed'. Do you mean vehicle_speed or satellite_speed? Known",
        ),
        ("negate", "negat", "signals.ax.negat: unknown key"),
        ('unit = "s"', 'unit = "m"', "t is in 'm', it needs a time"),
        ('unit = "s"', "rate_hz = 100", "either 'column', 'rate_hz'"),
        ('unit = "s"', 'unit = "s", format = "%s"', "give one of them"),
        ('unit = "s"', 'format = "%Q nonsense"', "not a strftime format"),
        ('unit = "s"', 'unit = "s", split_gap_s = 0.01', "longest_gap_s cannot be larger"),
        ('unit = "s"', 'unit = "s", longest_gap_s = nan', "time.longest_gap_s"),
        ("day = 2024-05-31, ", "", "drive.day: is missing"),
        ("2024-05-31", '"tomorrow"', "drive.day"),
        ('"v"', '"  "', "drive.vehicle_id: is empty"),
        ('"v"', f'"{"v" * 201}"', "drive.vehicle_id: has more than 200 characters"),
        ('"v"', '"v\\u001b"', "drive.vehicle_id: has characters that cannot be printed"),
        (
            'vehicle_id = "v"',
            "mass_kg = -1",
            "drive.vehicle_id: is missing; drive.mass_kg: must be greater than 0",
        ),
        ("0.5", "inf", "signals.ax.offset"),
        ('"car"', '"Car; --"', "name: String should match"),
        ("time =", "csv = { decimal_comma = true }\ntime =", "the separator cannot be ','"),
        ('"a",', '"a\\n",', "has characters that cannot be printed"),
        ("time =", "csv = { separator = '--' }\ntime =", "one ASCII character"),
        ("[signals]", "[signal]", "signals: is missing"),
        ('"deg"', '"km/h", radius_m = 0.3', "radius_m, which is for wheel speeds"),
        ("steer_fl =", "wheel_fl =", "wheel_fl needs an angular velocity"),
        (STEER, WHEEL.replace("km/h", "rpm"), "wheel_fl needs a velocity, such as 'km/h'"),
        (STEER, WHEEL.replace(", radius_m = 0.3", ""), "add radius_m, the rolling radius"),
        (STEER, WHEEL.replace("0.3", "0"), "signals.wheel_fl.radius_m"),
        ("negate = true", "gain = 0", "gain cannot be 0"),
        ("negate = true", "delay_s = 11", "delay_s: must be less than or equal to 10"),
        (STEER, "[label]\nfrom_velocities = true", "needs the signal vx"),
        (STEER, "[label]\nsensor_x_m = 1.0", "needs the signal sideslip"),
        ('unit = "s"', 'unit = "s", zone = "Europe/Berlin"', "without a time zone"),
        ('unit = "s"', 'format = "%H:%M", zone = "Nowhere"', "is not a time zone"),
        ('unit = "s"', "epoch = true", "give their 'unit'"),
        ('unit = "s"', 'unit = "s", date = { column = "d" }', "has the time of day alone"),
        (
            'unit = "s"',
            'format = "%H:%M:%S", date = { column = "d", format = "%H" }',
            "'%H' is not a strftime format of a date",
        ),
        (TIME, "rate_hz = 100, assumed = true, epoch = true", "give their 'unit'"),
        ('unit = "s"', 'unit = "s", assumed = true', "an unknown rate_hz"),
    ],
)
def test_mistakes_are_named_by_file_key_and_reason(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    assert old in GOOD
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, GOOD.replace(old, new))
    assert "m.toml" in str(caught.value)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(ConfigError, match="race_car_250lm"):
        load_mapping("no_such_mapping", CATALOG)


def test_tyres_need_a_column_of_the_catalog(tmp_path: Path) -> None:
    shipped = SHIPPED_CONFIGS.file("signals.toml").read_text(encoding="utf-8")
    start = shipped.index("[drive.tyres]")
    text = shipped[:start] + shipped[shipped.index("[drive.adhesion]") :]
    catalog = load_catalog(configs_with(tmp_path / "configs", signals=text))
    with pytest.raises(ConfigError, match=r"drive\.tyres: the catalog has no such drive"):
        load(tmp_path, GOOD.replace('"m" }', '"m", tyres = "winter" }'), catalog)
    assert load(tmp_path, GOOD, catalog)


@pytest.mark.parametrize("fact", ["tyres", "receiver"])
def test_a_fact_of_a_column_is_known_of_each_drive(tmp_path: Path, fact: str) -> None:
    text = GOOD.replace('"m" }', f'"m", {fact} = {{ column = "shoes" }} }}')
    columns = {"t": [0, 0.01, 0, 0.01], "shoes": ["slick"] * 2 + ["wet"] * 2, "a": [0.1] * 4}
    mapping = load(tmp_path, text.replace(STEER, ""))
    drives = read_columns(tmp_path, columns, mapping).drives.to_pylist()
    assert {d[fact] for d in drives} == {"slick", "wet"}


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
    grid = choose_grid(time_s, 0.1)
    placed = place_samples(time_s - delay_s, values, grid)
    finite = placed[np.isfinite(placed)]
    assert placed.shape == grid.ticks.shape
    assert set(finite) <= set(values)
    assert (np.diff(finite) > 0).all()


def test_keys_at_their_default_do_not_change_the_identity_of_a_file(tmp_path: Path) -> None:
    plain = a_mapping()
    explicit = a_mapping(
        signals={
            "ax": {"column": "ax", "unit": "m/s^2", "gain": 1.0, "delay_s": 0.0},
            "sideslip": {"column": "beta", "unit": "deg", "interpolate": True},
        },
        where=[],
    )
    assert read_columns(tmp_path, good_columns(), explicit).digest == (
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
    columns_of_log = {"t": np.arange(speed.size) / 100, **columns}
    rate, moved = {"yaw_rate": {"column": "r", "unit": "rad/s"}}, {"sensor_x_m": 1.5}
    mps: dict[str, Any] = {"column": "v", "unit": "m/s"}
    angle = {"vehicle_speed": mps, "sideslip": {"column": "b", "unit": "rad"}}
    pair = {"vx": mps, "vy": {"column": "vy", "unit": "m/s"}}
    for signals, label in ((angle, moved), (pair, {**moved, "from_velocities": True})):
        log = read_columns(tmp_path, columns_of_log, a_mapping(signals=rate | signals, label=label))
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


IGNITION = [{"column": "KL15", "one_of": ["1"]}]


def columns() -> dict[str, Any]:
    speed = [4, 5, 5.5, None, "n/a", *[20] * 15]
    fix = ["RTK"] * 18 + ["none", ""]
    return good_columns(20) | {"speed": speed, "fix": fix}


@pytest.mark.parametrize(
    ("where", "remaining"),
    [
        ([{"column": "speed", "at_least": 5}], [1, 2, *range(5, 20)]),
        ([{"column": "speed", "above": 5}], [2, *range(5, 20)]),
        ([{"column": "speed", "other_than": 20}], [0, 1, 2]),
        ([{"column": "speed", "at_least": 5, "below": 5.6}], [1, 2]),
        ([{"column": "speed", "at_least": 5, "at_most": 5.5}], [1, 2]),
        ([{"column": "fix", "one_of": ["RTK", "float"]}], list(range(18))),
        (
            [{"column": "speed", "above": 5}, {"column": "fix", "one_of": ["RTK"]}],
            [2, *range(5, 18)],
        ),
    ],
)
def test_rows_that_do_not_meet_the_conditions_are_counted(
    tmp_path: Path, where: Any, remaining: list[int]
) -> None:
    rows = columns()
    rows["v"] = [18 if v is None else "" if v == "n/a" else 3.6 * v for v in rows["speed"]]
    signals = {
        "ax": {"column": "ax", "unit": "m/s^2"},
        "vehicle_speed": {"column": "v", "unit": "km/h"},
    }
    log = read_columns(tmp_path, rows, a_mapping(where=where, signals=signals))
    first = remaining[0]
    assert ticks(log) == [tick - first for tick in remaining]
    assert (log.counts.rows_read, log.counts.rows_left_out) == (20, 20 - len(remaining))
    assert (log.counts.rows_kept, log.counts.quarantined) == (len(remaining), {})


@pytest.mark.parametrize(
    ("where", "message"),
    [
        ("speed > 5", "write it as tables"),
        ({"column": "speed", "at_least": 1}, "write it as tables"),
        ([{"at_least": 1}], "column\n  Field required"),
        ([{"column": "speed"}], "needs either 'one_of', or bounds"),
        ([{"column": "speed", "at_least": 1, "one_of": ["a"]}], "needs either 'one_of', or bounds"),
        ([{"column": "speed", "at_least": float("nan")}], "finite number"),
        ([{"column": "speed", "at_least": 1}] * 65, "at most 64 items"),
    ],
)
def test_invalid_conditions_are_refused(where: Any, message: str) -> None:
    with pytest.raises(ValidationError, match=re.escape(message)):
        a_mapping(where=where)


def test_a_number_in_parquet_can_be_one_of_several(tmp_path: Path) -> None:
    table = {"t": [0, 0.01, 0.02, 0.03], "ax": [1.0] * 4, "beta": [0.0] * 4, "fix": [4.0, 4, 5, 1]}
    pq.write_table(pa.table(table), tmp_path / "log.parquet")
    where = [{"column": "fix", "one_of": ["4", "5"]}]
    log = read_measured(tmp_path / "log.parquet", a_mapping(where=where))
    assert ticks(log) == [0, 1, 2]
    assert log.counts.rows_left_out == 1


def test_rows_keep_their_numbers_in_the_quarantine(tmp_path: Path) -> None:
    bad = columns()
    bad["ax"][7] = "much"
    log = read_columns(tmp_path, bad, a_mapping(where=[{"column": "speed", "at_least": 6}]))
    assert log.quarantine["row"].to_pylist() == [8]


def test_a_condition_that_no_row_meets_is_an_error(tmp_path: Path) -> None:
    where = [{"column": "speed", "at_least": 500}]
    with pytest.raises(InputError, match=r"none of 20 rows .* 'speed', 'at_least': 500"):
        read_columns(tmp_path, columns(), a_mapping(where=where))


def test_a_drive_ends_where_the_ignition_is_off(tmp_path: Path) -> None:
    rows = good_columns(100)
    rows["t"] = [f"{i / 10:.1f}" for i in range(100)]  # at 10 Hz
    on = [0] * 5 + [1] * 40 + [0] * 15 + [1] * 40
    rows["KL15"] = on
    time = {"longest_gap_s": 0.2, "split_gap_s": 1}
    log = read_columns(tmp_path, rows, a_mapping(where=IGNITION, time=time))
    assert log.counts.rows_left_out == on.count(0)
    first, second = sorted(set(log.drives["drive_id"].to_pylist()))
    assert second == f"{first}-2"
    assert log.counts.ticks == 2 * 391
    assert log.counts.quarantined == {}
    short = {"longest_gap_s": 0.2, "split_gap_s": 2}
    drives = read_columns(tmp_path, rows, a_mapping(where=IGNITION, time=short))
    assert drives.counts.drives == 1


@pytest.mark.parametrize(
    ("pattern", "path", "value"),
    [
        ("{}/*", "/logs/golf7/monday.csv", "golf7"),
        ("{}/*", "/monday.csv", None),
        ("golf*/{}.csv", "/logs/golf7/monday.csv", "monday"),
        ("golf*/{}.csv", "/logs/polo/monday.csv", None),
        ("*_{}.csv", "/logs/a_b_c.csv", "c"),
        ("{}_*", "/logs/a_b_c.csv", "a"),
        ("logs/{}", "/old_logs/monday.csv", None),
        ("{}", "/logs/monday.csv", "monday.csv"),
    ],
)
def test_a_pattern_matches_the_end_of_a_path(pattern: str, path: str, value: str | None) -> None:
    if value is None:
        with pytest.raises(InputError, match="does not end as in"):
            FromPath(path=pattern).find(Path(path))
    else:
        assert FromPath(path=pattern).find(Path(path)) == value


@pytest.mark.timeout(60)
def test_a_pattern_of_many_stars_ends() -> None:
    with pytest.raises(InputError, match="does not end as in"):
        FromPath(path="*_" * 60 + "{}.csv").find(Path("/" + "_" * 205 + ".txt"))
    assert FromPath(path="*_*_{}_*_*.csv").find(Path("/a_b_c_d_e.csv")) == "c"


@pytest.mark.parametrize("unit", ["grad", "Grad", "grad/s", "Grad/s", "GRAD/s", "grad/sec"])
def test_a_unit_with_two_readings_is_refused_with_both(unit: str) -> None:
    si_unit = "rad/s" if "/" in unit else "rad"
    with pytest.raises(ValueError, match=r"ambiguous unit .*: write 'deg.*' for degrees"):
        conversion_factor(unit, si_unit)
    assert conversion_factor("gon", "rad") == pytest.approx(np.pi / 200)


def test_all_keys_that_a_draft_leaves_open_are_named_at_once(tmp_path: Path) -> None:
    text = """name = "draft"
time = { column = "t", unit = "s" }
signals.ax = { column = "a", unit = "choose" }
signals.ay = { column = "b", unit = "choose" }
[drive]
"""
    (tmp_path / "draft.toml").write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_mapping(str(tmp_path / "draft.toml"), CATALOG)
    for key in ("drive.vehicle_id", "drive.vehicle_model", "signals.ax.unit", "signals.ay.unit"):
        assert key in str(caught.value)
