"""Drafts of mappings, of cars whose signals are known: how many guesses are right."""

import shlex
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from fleet_slip.errors import ConfigError, InputError, UsageError
from fleet_slip.ingest.mapping import load_mapping
from fleet_slip.ingest.suspicion import RADIUS_M, WHEELS
from tests.support import suggested
from tests.support.measured import read_measured
from tests.support.reported import call
from tests.support.suggested import DEGREES, ENGLISH, KMH, LOGS, filled_in, with_first_units
from tests.support.textbook_car import Car, a_car


def suggest(folder: Path, file: Path, *options: str) -> dict[str, Any]:
    """Return the draft as it stands in its file, which is filled in and loads."""
    written = folder / "draft.toml"
    call(folder / "root", "mapping", "suggest", str(file), "--output", str(written), *options)
    text = with_first_units(filled_in(written.read_text()))
    written.write_text(text)
    log = read_measured(file, load_mapping(str(written)))
    assert log.counts.quarantined == {}
    return tomllib.loads(text)


def as_logged(car: Car, names: dict[str, str], factors: dict[str, float]) -> pl.DataFrame:
    return pl.DataFrame({names[n]: values * factors.get(n, 1.0) for n, values in car.items()})


@pytest.mark.parametrize("name", LOGS)
def test_files_of_every_format_are_guessed_right(tmp_path: Path, name: str) -> None:
    assert suggested.wrong_guesses(LOGS[name], suggested.suggest(LOGS[name], tmp_path)) == []


def test_a_draft_does_not_load_until_its_units_are_chosen(tmp_path: Path) -> None:
    car = a_car()
    rows = as_logged(car, ENGLISH, {**DEGREES, **KMH})
    speed = np.mean([car[name] for name in WHEELS], axis=0) * RADIUS_M
    rows = rows.with_columns(pl.Series("speedo", 3.75 * speed), pl.Series("gear", [3] * 6000))
    rows = rows.with_columns(pl.Series("brake_pressure", np.abs(car["ax"]) * 9))
    rows.insert_column(0, pl.Series("t", np.arange(rows.height) / 100))
    rows.write_csv(tmp_path / "log.csv")
    signals = suggest(tmp_path, tmp_path / "log.csv")["signals"]
    assert signals["vehicle_speed"] == {"column": "speedo", "unit": "m/s"}
    assert signals["brake_pressure"] == {"column": "brake_pressure", "unit": "bar"}
    assert signals["gear"] == {"column": "gear", "unit": "1"}
    assert signals["yaw_rate"]["unit"] == "deg/s"
    (tmp_path / "draft.toml").unlink()
    text = call(tmp_path, "mapping", "suggest", str(tmp_path / "log.csv"))
    assert '# Choose the unit: "m/s" or "km/h" or "mph".\nvehicle_speed = {' in text
    (tmp_path / "draft.toml").write_text(filled_in(text[text.index("name = ") :]))
    with pytest.raises(ConfigError, match="no unit in the file: write the right one"):
        load_mapping(str(tmp_path / "draft.toml"))


_AXLE = "Vehicle.Chassis.Axle.Row"
IN_COVESA = {
    "ax": "Vehicle.Acceleration.Longitudinal", "ay": "Vehicle.Acceleration.Lateral",
    "yaw_rate": "Vehicle.AngularVelocity.Yaw",
    "steering_wheel": "Vehicle.Chassis.SteeringWheel.Angle",
    "wheel_fl": f"{_AXLE}1.Wheel.Left.Speed", "wheel_fr": f"{_AXLE}1.Wheel.Right.Speed",
    "wheel_rl": f"{_AXLE}2.Wheel.Left.Speed", "wheel_rr": f"{_AXLE}2.Wheel.Right.Speed",
}  # fmt: skip
ON_A_VOLVO = {
    "ax": "ALgt1", "ay": "ALat1", "yaw_rate": "YawRate1", "steering_wheel": "SteerWhlAg",
    "wheel_fl": "FLwhlspd", "wheel_fr": "FRwhlspd", "wheel_rl": "RLwhlspd", "wheel_rr": "RRwhlspd",
}  # fmt: skip


@pytest.mark.parametrize("names", [IN_COVESA, ON_A_VOLVO])
def test_the_names_of_departments_are_understood(tmp_path: Path, names: dict[str, str]) -> None:
    """Row 1 of COVESA is the front axle; what counts the car is its VIN."""
    car = a_car()
    rows = as_logged({name: car[name] for name in names}, names, {**DEGREES, **KMH})
    rows.insert_column(0, pl.Series("t", np.arange(rows.height) / 100))
    vin = "Vehicle.VehicleIdentification.VIN"
    rows = rows.with_columns(pl.lit("YV1").alias(vin))
    rows.write_parquet(tmp_path / "log.parquet")
    draft = suggest(tmp_path, tmp_path / "log.parquet")
    assert {name: keys["column"] for name, keys in draft["signals"].items()} == names
    assert draft["drive"]["vehicle_id"] == {"column": vin}


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


def test_what_cannot_be_drafted_says_so(tmp_path: Path) -> None:
    file = tmp_path / "log.csv"
    file.write_text("t,price\n0,1\n1,2\n")
    with pytest.raises(InputError, match="none of its channels looks like a signal: 't', 'price'"):
        call(tmp_path, "mapping", "suggest", str(file))
    with pytest.raises(InputError, match="no such file"):
        call(tmp_path, "mapping", "suggest", str(tmp_path / "absent.csv"))
    with pytest.raises(UsageError, match="exists"):
        call(tmp_path, "mapping", "suggest", str(file), "--output", str(file))
    file.write_text("t,ay\n0,1\n1,x\n")
    assert "ay = { column" in call(tmp_path, "mapping", "suggest", str(file))
