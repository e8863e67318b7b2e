"""Drafts of mappings, of cars whose signals are known: how many guesses are right."""

import json
import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from asammdf import MDF, Signal

from fleet_slip.errors import InputError, UsageError
from fleet_slip.ingest.mapping import load_mapping
from fleet_slip.ingest.suspicion import RADIUS_M, WHEELS
from fleet_slip.ingest.vocabulary import parts_of
from tests.support.measured import read_measured
from tests.support.reported import call
from tests.support.suggested import LOGS, wrong_guesses
from tests.support.suggested import suggest as suggest_of
from tests.support.textbook_car import Car, a_car


def suggest(folder: Path, file: Path, *options: str) -> dict[str, Any]:
    """Return the draft as it stands in its file, which is filled in and loads."""
    written = folder / "draft.toml"
    call(folder / "root", "mapping", "suggest", str(file), "--output", str(written), *options)
    text = written.read_text()
    for line in ("day = 2024-05-31  #", 'vehicle_id = ""', 'vehicle_model = ""'):
        text = text.replace(f"# {line}", line.replace('""', '"A7"'))
    written.write_text(text)
    log = read_measured(file, load_mapping(str(written)))
    assert log.counts.quarantined == {}
    return tomllib.loads(text)


def as_logged(car: Car, names: dict[str, str], factors: dict[str, float]) -> pl.DataFrame:
    return pl.DataFrame({names[n]: values * factors.get(n, 1.0) for n, values in car.items()})


NAMES = (
    {
        "ax": "LongAcc", "ay": "LatAcc_obd", "yaw_rate": "YawRate", "steering_wheel": "SW_pos",
        "wheel_fl": "VelFL", "wheel_fr": "VelFR", "wheel_rl": "VelRL", "wheel_rr": "VelRR",
        "sideslip": "Correvit_slip_angle",
    },
    {
        "ax": "a_x", "ay": "a_y", "yaw_rate": "gyro_z", "steering_wheel": "steeringWheelAngle",
        "wheel_fl": "WhlSpd_VL", "wheel_fr": "WhlSpd_VR", "wheel_rl": "WhlSpd_HL",
        "wheel_rr": "WhlSpd_HR", "sideslip": "beta",
    },
    {
        "ax": "imu.acc.x", "ay": "imu.acc.y", "yaw_rate": "imu.yaw_rate",
        "steering_wheel": "Lenkradwinkel", "wheel_fl": "wheel speed front left",
        "wheel_fr": "wheel speed front right", "wheel_rl": "wheel speed rear left",
        "wheel_rr": "wheel speed rear right", "sideslip": "Schwimmwinkel",
    },
)  # fmt: skip
IN_DEGREES = dict.fromkeys(("yaw_rate", "steering_wheel", "sideslip"), 180 / np.pi)
IN_KMH = dict.fromkeys(WHEELS, 3.6 * RADIUS_M)


@pytest.mark.parametrize("names", NAMES)
def test_signals_are_guessed_by_name_and_values(tmp_path: Path, names: dict[str, str]) -> None:
    rows = as_logged(a_car(), names, {**IN_DEGREES, **IN_KMH})
    time_ms = pl.Series("time_ms", np.arange(rows.height) * 10)
    note = pl.Series("note", ["x"] * rows.height)
    rows.insert_column(0, time_ms).with_columns(note).write_csv(tmp_path / "log.csv")
    draft = suggest(tmp_path, tmp_path / "log.csv")
    assert draft["time"] == {"column": "time_ms", "unit": "ms"}
    assert {n: keys["column"] for n, keys in draft["signals"].items()} == names
    units = {n: keys["unit"] for n, keys in draft["signals"].items()}
    expected = {"ax": "m/s^2", "ay": "m/s^2", "yaw_rate": "deg/s", "steering_wheel": "deg"}
    assert units == {**expected, **dict.fromkeys(WHEELS, "km/h"), "sideslip": "deg"}
    assert not any("negate" in keys for keys in draft["signals"].values())


def test_signs_and_swapped_wheels_are_put_right(tmp_path: Path) -> None:
    car, names = a_car(), NAMES[0]
    car |= {"ay": -car["ay"], "wheel_rl": car["wheel_rr"], "wheel_rr": car["wheel_rl"]}
    rows = as_logged(car, names, {**IN_DEGREES, **IN_KMH})
    rows.insert_column(0, pl.Series("t", np.arange(rows.height) / 100))
    rows.write_csv(tmp_path / "log.csv", separator=";")
    signals = suggest(tmp_path, tmp_path / "log.csv")["signals"]
    assert signals["ay"]["negate"] is True
    assert (signals["wheel_rl"]["column"], signals["wheel_rr"]["column"]) == ("VelRR", "VelRL")
    assert sum("negate" in keys for keys in signals.values()) == 1


def test_units_and_rates_of_an_mdf_file(tmp_path: Path) -> None:
    car, time_s = a_car(), np.arange(6000) / 100
    units = {"ax": "g", "ay": "g", "yaw_rate": "°/s", "steering_wheel": "°", "sideslip": "rad"}
    factors = {
        "ax": 1 / 9.80665,
        "ay": 1 / 9.80665,
        "yaw_rate": 57.29578,
        "steering_wheel": 57.29578,
    }
    fast = [
        Signal(car[n] * factors.get(n, 1), time_s, name=NAMES[1][n], unit=units.get(n, "rad/s"))
        for n in car
        if n != "sideslip"
    ]
    slow = Signal(car["sideslip"][::10], time_s[::10], name="beta", unit="rad")
    with MDF(version="4.10") as mdf:
        mdf.append(fast)
        mdf.append([slow])
        file = Path(mdf.save(tmp_path / "log"))
    draft = suggest(tmp_path, file)
    assert draft["time"] == {"own_clock": True}
    signals = draft["signals"]
    assert signals["ay"] == {"column": "a_y", "unit": "g"}
    assert signals["yaw_rate"]["unit"] == "deg/s"
    assert signals["wheel_fl"] == {"column": "WhlSpd_VL", "unit": "rad/s"}
    assert signals["sideslip"] == {"column": "beta", "unit": "rad", "longest_gap_s": 0.2}
    shown = json.loads(call(tmp_path, "mapping", "suggest", str(file), "--json"))
    rates = {one["channel"]: round(one["rate_hz"]) for one in shown["channels"]}
    assert (rates["a_x"], rates["beta"]) == (100, 10)


@pytest.mark.parametrize("name", LOGS)
def test_files_of_every_format_are_guessed_right(tmp_path: Path, name: str) -> None:
    assert wrong_guesses(LOGS[name], suggest_of(LOGS[name], tmp_path)) == []


def test_a_wrong_guess_counts_as_wrong(tmp_path: Path) -> None:
    one = LOGS["CSV, names of a race team, km/h and degrees"]
    draft = suggest_of(one, tmp_path)
    del draft.guesses["ax"]
    draft.guesses["ay"] = draft.guesses["ay"].because("", negate=True)
    draft.guesses["yaw_rate"] = draft.guesses["yaw_rate"].because("", unit="rad/s")
    swapped = draft.guesses["wheel_rl"], draft.guesses["wheel_rr"]
    draft.guesses["wheel_rr"], draft.guesses["wheel_rl"] = swapped
    assert wrong_guesses(one, draft) == ["ax", "ay", "yaw_rate", "wheel_rl", "wheel_rr"]


def test_the_unit_of_a_speed_is_told_by_the_wheels(tmp_path: Path) -> None:
    car = a_car()
    rows = as_logged(car, NAMES[0], {**IN_DEGREES, **IN_KMH})
    speed = np.mean([car[name] for name in WHEELS], axis=0) * RADIUS_M
    rows = rows.with_columns(pl.Series("speedo", 3.75 * speed), pl.Series("gear", [3] * 6000))
    rows = rows.with_columns(pl.Series("brake_pressure", np.abs(car["ax"]) * 9))
    rows.insert_column(0, pl.Series("t", np.arange(rows.height) / 100))
    rows.write_csv(tmp_path / "log.csv")
    signals = suggest(tmp_path, tmp_path / "log.csv")["signals"]
    assert signals["vehicle_speed"] == {"column": "speedo", "unit": "km/h"}
    assert signals["brake_pressure"] == {"column": "brake_pressure", "unit": "bar"}
    assert signals["gear"] == {"column": "gear", "unit": "1"}
    assert {name: signals[name]["unit"] for name in WHEELS} == dict.fromkeys(WHEELS, "km/h")


def test_names_from_strangers_stay_names(tmp_path: Path) -> None:
    car = a_car()
    odd = 'ay "\\ # é [signals]'
    rows = pl.DataFrame({"t": np.arange(6000) / 100, odd: car["ay"], "yaw_rate": car["yaw_rate"]})
    rows = rows.with_columns(pl.col(odd).alias("ax\n"))
    rows.write_parquet(tmp_path / "log.parquet")
    assert suggest(tmp_path, tmp_path / "log.parquet")["signals"]["ay"]["column"] == odd


@pytest.mark.parametrize("stem", ["2024-05-30_car", "Fahrt über Köln", "_", "x" * 90])
def test_a_draft_loads_whatever_the_file_is_called(tmp_path: Path, stem: str) -> None:
    names = {name: name for name in a_car()}
    rows = as_logged(a_car(), names, {}).with_columns(t=pl.Series(np.arange(6000) / 100))
    rows.write_parquet(tmp_path / f"{stem}.parquet")
    suggest(tmp_path, tmp_path / f"{stem}.parquet")
    text = (tmp_path / "draft.toml").read_text()
    assert f"# fleet-slip ingest {shlex.quote(f'{tmp_path}/{stem}.parquet')} --mapping" in text


def test_a_long_comment_is_wrapped_and_a_key_in_a_comment_is_not(tmp_path: Path) -> None:
    names = {name: f"{name} of the second measuring box in the boot of the car" for name in a_car()}
    as_logged(a_car(), names, {}).with_columns(t=pl.Series(np.arange(6000) / 100)).write_parquet(
        tmp_path / "log.parquet"
    )
    suggest(tmp_path, tmp_path / "log.parquet")
    lines = (tmp_path / "draft.toml").read_text().splitlines()
    comments = [line for line in lines if re.match("#(?! fleet-slip )", line) and " = " not in line]
    assert max(map(len, comments)) <= 100
    assert any(line.startswith("#   ") for line in comments)


def test_what_cannot_be_drafted_says_so(tmp_path: Path) -> None:
    file = tmp_path / "log.csv"
    file.write_text("t,price\n0,1\n1,2\n")
    with pytest.raises(InputError, match="none of its channels looks like a signal: 't', 'price'"):
        call(tmp_path, "mapping", "suggest", str(file))
    with pytest.raises(InputError, match="no such file"):
        call(tmp_path, "mapping", "suggest", str(tmp_path / "absent.csv"))
    with pytest.raises(UsageError, match="it exists"):
        call(tmp_path, "mapping", "suggest", str(file), "--output", str(file))
    file.write_text("t,ay\n0,1\n1,x\n")
    assert "ay = { column" in call(tmp_path, "mapping", "suggest", str(file))


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("WhlSpdFL", ["whl", "spd", "fl"]),
        ("VelFR_obd", ["vel", "fr", "obd"]),
        ("ESP_02.YawRate", ["esp", "02", "yaw", "rate"]),
        ("a_x", ["a", "x"]),
    ],
)
def test_parts_of_a_name(name: str, parts: list[str]) -> None:
    assert parts_of(name) == parts
