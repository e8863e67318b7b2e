"""Drafts of mappings: of cars whose signals are known, and of logs as departments write them."""

import json
import re
import shlex
import tomllib
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from fleet_slip.errors import AlarmError, ConfigError, InputError, UsageError
from fleet_slip.ingest.checked_columns import IngestCounts
from fleet_slip.ingest.draft import draft_mapping, write_draft
from fleet_slip.ingest.mapping import load_mapping
from fleet_slip.ingest.measured_log import open_measured
from fleet_slip.ingest.profile import profile_file
from fleet_slip.ingest.signal_page import in_si
from fleet_slip.ingest.ticks import MeasuredDrive
from fleet_slip.ingest.vocabulary import unit_called
from fleet_slip.quality.drive_signals import RADIUS_M, WHEELS
from tests.support.catalog import CATALOG, SIGNALS
from tests.support.measured import read_measured
from tests.support.reported import call
from tests.support.textbook_car import Car, a_car

TO_DEG = 180 / np.pi
DEGREES = dict.fromkeys(("yaw_rate", "steering_wheel", "sideslip"), TO_DEG)
KMH = dict.fromkeys(WHEELS, 3.6 * RADIUS_M)
ENGLISH = {
    "ax": "LongAcc", "ay": "LatAcc_obd", "yaw_rate": "YawRate", "steering_wheel": "SW_pos",
    "wheel_fl": "VelFL", "wheel_fr": "VelFR", "wheel_rl": "VelRL", "wheel_rr": "VelRR",
    "sideslip": "Correvit_slip_angle",
}  # fmt: skip
START = datetime(2024, 3, 12, 9, 14, 30, tzinfo=UTC)
ROWS = 6000


def filled_in(draft: str, units: bool = True) -> str:
    """Return a draft with a day, a car, and the first of the units, where it asks for them."""
    for line in ("day = 2024-05-31  #", 'vehicle_id = ""', 'vehicle_model = ""'):
        draft = draft.replace(f"# {line}", line.replace('""', '"A7"'))
    pattern = r'# Choose the unit: "(.+?)"( with ([^ ]+ = [^ ]+))?( or .*)?\.\n(.*)"choose"'
    chosen = re.sub(pattern, lambda m: f'{m[5]}"{m[1]}"' + (f", {m[3]}" if m[3] else ""), draft)
    return chosen if units else draft


def suggest(folder: Path, file: Path, *options: str) -> dict[str, Any]:
    """Return the draft as it stands in its file, which is filled in and loads."""
    written = folder / "draft.toml"
    call(folder / "root", "mapping", "suggest", str(file), "--output", str(written), *options)
    text = filled_in(written.read_text())
    written.write_text(text)
    log = read_measured(file, load_mapping(str(written), CATALOG))
    assert log.counts.quarantined == {}
    return tomllib.loads(text)


def as_logged(car: Car, names: dict[str, str], factors: dict[str, float]) -> pl.DataFrame:
    return pl.DataFrame({names[n]: values * factors.get(n, 1.0) for n, values in car.items()})


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
    (tmp_path / "draft.toml").write_text(filled_in(text[text.index("name = ") :], units=False))
    with pytest.raises(ConfigError, match=r"signals\.ax\.unit: the file has no unit"):
        load_mapping(str(tmp_path / "draft.toml"), CATALOG)


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


@pytest.mark.parametrize(
    ("named", "unit"),
    [("Unit_DegreOfArcPerSecon", "deg/s"), ("Unit_ForceOfGravi", "g"), ("Unit_Furlong", None)],
)
def test_units_of_databases_are_known(named: str, unit: str | None) -> None:
    assert unit_called(named) == unit


@pytest.mark.parametrize("stem", ["2024-05-30_car", "Fahrt über Köln", "_", "x" * 90])
def test_a_draft_loads_whatever_the_file_is_called(tmp_path: Path, stem: str) -> None:
    names = {name: name for name in a_car()}
    rows = as_logged(a_car(), names, {}).with_columns(t=pl.Series(np.arange(6000) / 100))
    rows.write_parquet(tmp_path / f"{stem}.parquet")
    suggest(tmp_path, tmp_path / f"{stem}.parquet")
    text = (tmp_path / "draft.toml").read_text()
    assert f"# fleet-slip ingest {shlex.quote(f'{tmp_path}/{stem}.parquet')} --mapping" in text


def test_logs_without_a_draft_are_refused(tmp_path: Path) -> None:
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


def write_bench(file: Path) -> None:
    """A test bench in Germany: cp1252, titles, a row of units, dates, commas, n.v. and -9999."""
    car = a_car()
    names = ["ax", "ay", "yaw_rate", "steering_wheel", *WHEELS, "sideslip"]
    factors = {"yaw_rate": TO_DEG, "steering_wheel": TO_DEG, "sideslip": TO_DEG}
    factors |= dict.fromkeys(WHEELS, 30 / np.pi)
    lines = [
        "Prüfstand Nord;;;;;;;;;",
        "Zeitstempel;Längsbeschleunigung;Querbeschleunigung;Giergeschwindigkeit;Lenkradwinkel;"
        "Raddrehzahl VL;Raddrehzahl VR;Raddrehzahl HL;Raddrehzahl HR;Schwimmwinkel",
        ";[m/s²];[m/s²];[°/s];[°];[1/min];[1/min];[1/min];[1/min];[°]",
    ]
    for i in range(ROWS):
        moment = (START + timedelta(milliseconds=10 * i)).strftime("%d.%m.%Y %H:%M:%S,%f")[:-3]
        cells = [f"{car[name][i] * factors.get(name, 1.0):.5f}" for name in names]
        cells[2] = "-9999.0" if i % 97 == 3 else cells[2]
        cells[-1] = "n.v." if i % 50 == 7 else cells[-1].replace(".", ",")
        lines.append(
            ";".join([moment, *(t.replace(".", ",") if t != "n.v." else t for t in cells)])
        )
    file.write_bytes("\r\n".join(lines).encode("cp1252"))


def write_fleet(file: Path) -> None:
    """Four cars in turns, with timestamps."""
    frames = []
    for number, name in enumerate(("A1", "B2", "C3", "D4")):
        car = a_car(7.0 + number)
        times = [START.replace(tzinfo=None) + timedelta(milliseconds=10 * i) for i in range(ROWS)]
        columns: dict[str, Any] = {"timestamp": times, "vehicle": [name] * ROWS, "trip": number}
        columns |= {
            "accel_lat (g)": car["ay"] / 9.80665,
            "yaw_rate (deg/s)": car["yaw_rate"] * TO_DEG,
        }
        columns |= {f"ws_{wheel[-2:]}": car[wheel] * RADIUS_M * 3.6 for wheel in WHEELS}
        frames.append(pl.DataFrame(columns | {"StWhlAng": car["steering_wheel"] * TO_DEG}))
    pl.concat(frames).sort("timestamp", maintain_order=True).write_parquet(file)


def write_student(file: Path) -> None:
    """No times, no units, single words."""
    car = a_car()
    speed = car["wheel_rl"] * RADIUS_M
    vy = speed * np.tan(car["sideslip"])
    columns = {"steer": car["steering_wheel"] * TO_DEG, "yaw": car["yaw_rate"] * TO_DEG}
    pl.DataFrame({**columns, "ax": car["ax"], "ay": car["ay"], "vx": speed, "vy": vy}).write_csv(
        file
    )


def write_bus(file: Path) -> None:
    """UTF-16, milliseconds since 1970, magnitudes with sign bits, 65535 for no value."""
    car = a_car()
    columns: dict[str, Any] = {"utc_ms": round(START.timestamp() * 1000) + 10 * np.arange(ROWS)}
    for name, column in (("yaw_rate", "ESP_Gierrate"), ("steering_wheel", "LWI_Lenkradwinkel")):
        columns[f"{column} [°]" if name != "yaw_rate" else f"{column} [°/s]"] = (
            np.abs(car[name]) * TO_DEG
        )
        columns[column.replace("_", "_VZ_")] = (car[name] < 0).astype(int)
    columns["Querbeschl. [g]"] = car["ay"] / 9.80665
    for wheel, place in zip(WHEELS, ("VL", "VR", "HL", "HR"), strict=True):
        kmh = np.round(car[wheel] * RADIUS_M * 3.6, 2)
        columns[f"Radgeschw_{place}"] = np.where(np.arange(ROWS) % 311 == 5, 65535.0, kmh)
    columns["Beta [°]"] = car["sideslip"] * TO_DEG
    file.write_bytes(pl.DataFrame(columns).write_csv(separator="\t").encode("utf-16"))


def read(file: Path, mapping: Any) -> tuple[list[MeasuredDrive], IngestCounts]:
    """Return the drives of a file, and what became of its rows."""
    with open_measured(file, mapping) as stream:
        return list(stream.drives()), stream.counts


LOGS: dict[str, tuple[Callable[[Path], None], int, set[str]]] = {
    "bench.csv": (write_bench, 1, {"ax", "ay", "yaw_rate", "steering_wheel", *WHEELS, "sideslip"}),
    "fleet.parquet": (write_fleet, 4, {"ay", "yaw_rate", "steering_wheel", *WHEELS}),
    "student.csv": (write_student, 1, {"ax", "ay", "vx", "vy"}),
    "bus.csv": (write_bus, 1, {"ay", "yaw_rate", "steering_wheel", *WHEELS, "sideslip"}),
}


@pytest.mark.parametrize("name", LOGS)
def test_a_strangers_log_becomes_the_drives_that_it_has(tmp_path: Path, name: str) -> None:
    write, drives, signals = LOGS[name]
    write(tmp_path / name)
    text = call(tmp_path, "mapping", "suggest", str(tmp_path / name)).partition("\n# A draft")[2]
    mapping = tmp_path / "draft.toml"
    mapping.write_text(f"# {filled_in(text)}", encoding="utf-8")
    drives_read, counts = read(tmp_path / name, load_mapping(str(mapping), CATALOG))
    assert counts.quarantined == {}
    assert len(drives_read) == drives
    for number, drive in enumerate(drives_read):
        car = a_car(7.0 + number if drives > 1 else 8.0)
        assert set(drive.counts) == signals
        assert_same(drive.counts, car)


def assert_same(counts: dict[str, Any], car: Car) -> None:
    """Assert that what was logged is what the car did, to a thousandth of its largest value."""
    for name in {"ay", "yaw_rate", "steering_wheel", "wheel_fl", "sideslip"} & set(counts):
        scale = {"ay": 1e-3, "yaw_rate": 1e-4, "steering_wheel": 5e-4, "wheel_fl": 1e-2}
        got = pl.Series(counts[name]).cast(pl.Float64).to_numpy() * scale.get(name, 1e-4)
        present = np.isfinite(got)
        assert present.mean() > 0.95
        off = np.abs(got - car[name])[present].max()
        assert off < 0.003 * np.abs(car[name]).max() + scale.get(name, 1e-4)


DATES = {
    "Datum": ("%d.%m.%Y", "Uhrzeit", "%H:%M:%S,%f"),
    "date": ("%d%m%y", "time", "%H%M%S.%f"),
    "Date": ("%m/%d/%Y", "Time of day", "%H:%M:%S.%f"),
    "day": ("%Y-%m-%d", "clock", "%H:%M:%S.%f"),
}


@pytest.mark.parametrize("column", DATES)
def test_date_and_time_stand_in_columns_of_their_own(tmp_path: Path, column: str) -> None:
    """The log goes on over midnight: of a time of the day alone that is another drive."""
    dated, clock, written = DATES[column]
    car, start = a_car(), datetime(2024, 3, 20, 23, 59, 40, tzinfo=UTC)
    lines = [f"{column};{clock};ay [m/s²];yaw_rate [°/s];speed [km/h]"]
    for i in range(ROWS):
        moment = start + timedelta(milliseconds=10 * i)
        cells = [car["ay"][i], car["yaw_rate"][i] * TO_DEG, car["wheel_rl"][i] * RADIUS_M * 3.6]
        values = [f"{value:.4f}" for value in cells]
        lines.append(";".join([f"{moment:{dated}}", f"{moment:{written}}"[:-3], *values]))
    (tmp_path / "log.csv").write_text("\n".join(lines), encoding="utf-8")
    draft = call(tmp_path, "mapping", "suggest", str(tmp_path / "log.csv"))
    text = draft.partition("\n# A draft")[2]
    assert "# day = " not in text
    (tmp_path / "m.toml").write_text(f"# {filled_in(text)}", encoding="utf-8")
    mapping = load_mapping(str(tmp_path / "m.toml"), CATALOG)
    (drive,), counts = read(tmp_path / "log.csv", mapping)
    assert drive.metadata["started_at"] == start
    assert (counts.rows_kept, counts.ticks, counts.quarantined) == (ROWS, ROWS, {})


def test_a_rate_that_is_assumed_is_said_at_each_ingest(tmp_path: Path) -> None:
    write_student(tmp_path / "log.csv")
    text = call(tmp_path, "mapping", "suggest", str(tmp_path / "log.csv")).partition("\n# A draft")[
        2
    ]
    (tmp_path / "m.toml").write_text(f"# {filled_in(text)}", encoding="utf-8")
    assert load_mapping(str(tmp_path / "m.toml"), CATALOG).time.assumed
    words = ("ingest", str(tmp_path / "log.csv"), "--mapping", str(tmp_path / "m.toml"))
    with pytest.raises(AlarmError, match="100 Hz is assumed"):
        call(tmp_path / "root", *words)


def draft_of(folder: Path, **columns: Any) -> str:
    """Return the draft of a CSV file with these columns, each of 100 rows."""
    time_s = np.arange(100) / 100
    table = {"t_s": time_s, **{name: np.sin(7 * time_s) * scale for name, scale in columns.items()}}
    pl.DataFrame(table).write_csv(folder / "log.csv")
    file = folder / "log.csv"
    return write_draft(draft_mapping(SIGNALS, file, profile_file(file)), "log")


def test_units_in_names_are_read_and_weak_names_without_a_unit_are_questions(
    tmp_path: Path,
) -> None:
    text = draft_of(
        tmp_path, dpsi_radps=0.2, ay_mps2=3, deltawheel_rad=0.04, pBrakeR_bar=18, yawAngle_rad=1,
        gz=2, r_Nm=5, v=20,
    )  # fmt: skip
    lines = text.splitlines()
    assert 'yaw_rate = { column = "dpsi_radps", unit = "rad/s" }' in lines
    assert 'steer = { column = "deltawheel_rad", unit = "rad" }' in lines
    assert 'brake_pressure = { column = "pBrakeR_bar", unit = "bar" }' in lines
    assert '# vehicle_speed = { column = "v", unit = "choose" }' in lines
    two = draft_of(tmp_path, ay_mps2=3, pBrakeF_bar=20, pBrakeR_bar=18)
    assert two.count("\n# brake_pressure = {") == 2 and "\nbrake_pressure" not in two
    assert "r_Nm" not in text
    flat = " ".join(line.removeprefix("#").strip() for line in lines)
    assert 'course = { column = "yawAngle_rad", unit = "rad", clockwise_from_north' in flat


@pytest.mark.parametrize("separator", [".", "_"])
def test_names_of_the_vehicle_signal_specification_have_its_units(
    tmp_path: Path, separator: str
) -> None:
    names = {
        "Vehicle.Acceleration.Lateral": ("ay", "m/s^2"),
        "Vehicle.AngularVelocity.Yaw": ("yaw_rate", "deg/s"),
        "Vehicle.Chassis.SteeringWheel.Angle": ("steering_wheel", "deg"),
        "Vehicle.Chassis.Axle.Row1.Wheel.Left.Speed": ("wheel_fl", "km/h"),
        "Vehicle.Chassis.Axle.Row2.Wheel.Right.Speed": ("wheel_rr", "km/h"),
    }
    text = draft_of(tmp_path, **{name.replace(".", separator): 10 for name in names})
    signals = tomllib.loads(text)["signals"]
    for name, (signal, unit) in names.items():
        assert signals[signal]["column"] == name.replace(".", separator)
        assert signals[signal]["unit"] == unit


def test_a_lone_speed_may_stand_in_for_the_wheels(tmp_path: Path) -> None:
    text = draft_of(tmp_path, **{"Car.ay [m/s^2]": 3, "Car.v [m/s]": 20})
    assert 'vehicle_speed = { column = "Car.v [m/s]", unit = "m/s" }' in text
    assert "no wheel speeds: a speed of the car may replace all four" in text
    wheels = {f"wheel_{corner} [rad/s]": 60 for corner in ("fl", "fr", "rl", "rr")}
    assert "no wheel speeds" not in draft_of(tmp_path, **{"Car.v [m/s]": 20, **wheels})


def test_a_draft_fits_a_terminal_of_80_columns(tmp_path: Path) -> None:
    name = "bus_1_message_of_the_inertial_sensor_below_the_seat_on_the_left_side.ay [m/s^2]"
    text = draft_of(tmp_path, **{name: 3, "Car.v [m/s]": 20, "yaw rate with no unit": 1})
    assert [
        line
        for line in text.splitlines()
        if len(line) >= 80 and name not in line and "log.csv" not in line
    ] == []
    draft = tomllib.loads(text)
    assert draft["signals"]["ay"] == {"column": name, "unit": "m/s^2"}


def test_the_mapped_signals_are_drawn_in_si_units(tmp_path: Path) -> None:
    columns = {"t_s": np.arange(9000) / 100, "ay [g]": np.sin(np.arange(9000) / 99)}
    pl.DataFrame({**columns, "gz": columns["ay [g]"]}).write_csv(tmp_path / "log.csv")
    draft = draft_mapping(SIGNALS, tmp_path / "log.csv", profile_file(tmp_path / "log.csv"))
    np.testing.assert_allclose(
        in_si(SIGNALS, "ay", draft.guesses["ay"]), 9.80665 * columns["ay [g]"], rtol=1e-6
    )
    page, log = tmp_path / "page.html", str(tmp_path / "log.csv")
    call(tmp_path / "root", "mapping", "suggest", log, "--plot", str(page))
    text = page.read_text()
    assert len(text) < 200_000
    assert "ay of ay [g], m/s^2" in text and "yaw_rate (doubtful) of gz" in text
    listed = json.loads(call(tmp_path / "root", "mapping", "suggest", log, "--json"))["channels"]
    signals = {channel["channel"]: channel["signal"] for channel in listed}
    assert signals == {"t_s": None, "ay [g]": "ay", "gz": None}


def test_answers_fill_in_what_a_draft_leaves_open(tmp_path: Path) -> None:
    long_name = "bus_one_message_of_the_control_unit_for_stability.wheel_fl"
    wheels = {f"wheel_{corner}": 60 for corner in ("fr", "rl", "rr")}
    table = {"t_s": np.arange(100) / 100, "ay": np.sin(np.arange(100))}
    table |= dict.fromkeys((long_name, *wheels), 60.0 + table["ay"])
    file = tmp_path / "log.csv"
    pl.DataFrame(table).write_csv(file)
    draft = draft_mapping(SIGNALS, file, profile_file(file))
    answers = {"day": "2024-06-03", "vehicle_id": "A7", "vehicle_model": 's"1', "ay": "g"}
    assert {*answers, "wheel_fl"} <= draft.open_keys().keys()
    answers = {key: answers.get(key, "km/h") for key in draft.open_keys()}
    text = write_draft(draft, "log", answers)
    content = tomllib.loads(text)
    assert content["drive"]["vehicle_model"] == 's"1'
    assert content["signals"]["ay"]["unit"] == "g"
    for wheel in ("wheel_fl", "wheel_rr"):
        assert content["signals"][wheel]["radius_m"] == RADIUS_M
    (tmp_path / "log.toml").write_text(text)
    assert load_mapping(str(tmp_path / "log.toml"), CATALOG).drive.vehicle_id == "A7"
    unanswered = write_draft(draft, "log", dict.fromkeys(answers, ""))
    assert unanswered == write_draft(draft, "log")


def test_a_mapping_names_all_missing_keys_at_once(tmp_path: Path) -> None:
    file = tmp_path / "log.csv"
    pl.DataFrame({"t_s": np.arange(100) / 100, "ay": np.sin(np.arange(100))}).write_csv(file)
    (tmp_path / "log.toml").write_text(
        write_draft(draft_mapping(SIGNALS, file, profile_file(file)), "log")
    )
    with pytest.raises(ConfigError) as caught:
        load_mapping(str(tmp_path / "log.toml"), CATALOG)
    for key in ("drive.day", "drive.vehicle_id", "drive.vehicle_model", "signals.ay.unit"):
        assert key in str(caught.value)
