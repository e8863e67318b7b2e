from pathlib import Path
from typing import Any

import pytest

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import ConfigError
from fleet_slip.ingest.mapping import load_mapping
from fleet_slip.resources import config_file, config_names
from tests.support.measured import read_columns

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


def load(folder: Path, text: str) -> Any:
    file = folder / "m.toml"
    file.write_text(text, encoding="utf-8")
    return load_mapping(str(file))


def test_shipped_mappings_load() -> None:
    names = config_names("mappings")
    assert "race_car_250lm" in names
    assert [load_mapping(name).name for name in names] == names


def test_a_mapping_without_a_radius_says_nothing_of_one(tmp_path: Path) -> None:
    """Its text names the drives, and they must keep the names that they had before."""
    assert "radius" not in load(tmp_path, GOOD).canonical_json()
    assert '"radius_m":0.3' in load(tmp_path, GOOD.replace(STEER, WHEEL)).canonical_json()


def test_columns_are_listed_once(tmp_path: Path) -> None:
    text = GOOD.replace('"m" }', '{ column = "a" }, column = "run" }')
    assert load(tmp_path, text).time_bases() == {"t": ["t", "run", "a", "steer_fl_deg"]}


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
        ('unit = "s"', "rate_hz = 100", "either 'column' or 'rate_hz'"),
        ('unit = "s"', 'unit = "s", format = "%s"', "give one of them"),
        ('unit = "s"', 'format = "%Q nonsense"', "not a strftime format"),
        ('unit = "s"', 'unit = "s", split_gap_s = 0.01', "longest_gap_s cannot be larger"),
        ('unit = "s"', 'unit = "s", longest_gap_s = nan', "time.longest_gap_s"),
        ("day = 2024-05-31, ", "", "drive.day is missing"),
        ("2024-05-31", '"tomorrow"', "drive.day"),
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
        ("negate = true", "delay_s = 11", "delay_s: must be at most 10"),
        (STEER, "[label]\nfrom_velocities = true", "needs the signal vx"),
        (STEER, "[label]\nsensor_x_m = 1.0", "needs the signal sideslip"),
        ('unit = "s"', 'unit = "s", zone = "Europe/Berlin"', "without a time zone"),
        ('unit = "s"', 'format = "%H:%M", zone = "Nowhere"', "is no time zone"),
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
        load_mapping("no_such_mapping")


def test_tyres_need_a_column_of_the_catalogue(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shipped = config_file("signals.toml").read_text(encoding="utf-8")
    start = shipped.index("[drive.tyres]")
    own = shipped[:start] + shipped[shipped.index("[drive.adhesion]") :]
    (tmp_path / "signals.toml").write_text(own, encoding="utf-8")
    monkeypatch.setenv("FLEET_SLIP_SIGNALS", str(tmp_path / "signals.toml"))
    catalogue.cache_clear()
    try:
        with pytest.raises(ConfigError, match=r"drive\.tyres: the catalogue has no such drive"):
            load(tmp_path, GOOD.replace('"m" }', '"m", tyres = "winter" }'))
        assert load(tmp_path, GOOD)
    finally:
        catalogue.cache_clear()


@pytest.mark.parametrize("fact", ["tyres", "receiver"])
def test_a_fact_of_a_column_is_known_of_each_drive(tmp_path: Path, fact: str) -> None:
    said = GOOD.replace('"m" }', f'"m", {fact} = {{ column = "shoes" }} }}')
    columns = {"t": [0, 0.01, 0, 0.01], "shoes": ["slick"] * 2 + ["wet"] * 2, "a": [0.1] * 4}
    mapping = load(tmp_path, said.replace(STEER, ""))
    drives = read_columns(tmp_path, columns, mapping).drives.to_pylist()
    assert {d[fact] for d in drives} == {"slick", "wet"}
