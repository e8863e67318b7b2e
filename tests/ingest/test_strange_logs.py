"""Logs as six departments write them, from draft to drives, and the keys of a mapping they need."""

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from fleet_slip.errors import AlarmError
from fleet_slip.ingest.drives import MeasuredDrive
from fleet_slip.ingest.mapping import load_mapping
from fleet_slip.ingest.stream import IngestCounts, open_measured
from fleet_slip.ingest.suspicion import RADIUS_M, WHEELS, find_one_sided, find_suspicions
from tests.support.reported import call
from tests.support.suggested import filled_in, with_first_units
from tests.support.textbook_car import Car, a_car

TO_DEG = 180 / np.pi
START = datetime(2024, 3, 12, 9, 14, 30, tzinfo=UTC)
ROWS = 6000


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
        told = [f"{car[name][i] * factors.get(name, 1.0):.5f}" for name in names]
        told[2] = "-9999.0" if i % 97 == 3 else told[2]
        told[-1] = "n.v." if i % 50 == 7 else told[-1].replace(".", ",")
        lines.append(";".join([moment, *(t.replace(".", ",") if t != "n.v." else t for t in told)]))
    file.write_bytes("\r\n".join(lines).encode("cp1252"))


def write_fleet(file: Path) -> None:
    """Four cars in turns, with timestamps."""
    frames = []
    for number, name in enumerate(("A1", "B2", "C3", "D4")):
        car = a_car(7.0 + number)
        times = [START.replace(tzinfo=None) + timedelta(milliseconds=10 * i) for i in range(ROWS)]
        told: dict[str, Any] = {"timestamp": times, "vehicle": [name] * ROWS, "trip": number}
        told |= {"accel_lat (g)": car["ay"] / 9.80665, "yaw_rate (deg/s)": car["yaw_rate"] * TO_DEG}
        told |= {f"ws_{wheel[-2:]}": car[wheel] * RADIUS_M * 3.6 for wheel in WHEELS}
        frames.append(pl.DataFrame(told | {"StWhlAng": car["steering_wheel"] * TO_DEG}))
    pl.concat(frames).sort("timestamp", maintain_order=True).write_parquet(file)


def write_student(file: Path) -> None:
    """No times, no units, single words."""
    car = a_car()
    speed = car["wheel_rl"] * RADIUS_M
    vy = speed * np.tan(car["sideslip"])
    told = {"steer": car["steering_wheel"] * TO_DEG, "yaw": car["yaw_rate"] * TO_DEG}
    pl.DataFrame({**told, "ax": car["ax"], "ay": car["ay"], "vx": speed, "vy": vy}).write_csv(file)


def write_bus(file: Path) -> None:
    """UTF-16, milliseconds since 1970, magnitudes with sign bits, 65535 for no value."""
    car = a_car()
    told: dict[str, Any] = {"utc_ms": round(START.timestamp() * 1000) + 10 * np.arange(ROWS)}
    for name, column in (("yaw_rate", "ESP_Gierrate"), ("steering_wheel", "LWI_Lenkradwinkel")):
        told[f"{column} [°]" if name != "yaw_rate" else f"{column} [°/s]"] = (
            np.abs(car[name]) * TO_DEG
        )
        told[column.replace("_", "_VZ_")] = (car[name] < 0).astype(int)
    told["Querbeschl. [g]"] = car["ay"] / 9.80665
    for wheel, place in zip(WHEELS, ("VL", "VR", "HL", "HR"), strict=True):
        kmh = np.round(car[wheel] * RADIUS_M * 3.6, 2)
        told[f"Radgeschw_{place}"] = np.where(np.arange(ROWS) % 311 == 5, 65535.0, kmh)
    told["Beta [°]"] = car["sideslip"] * TO_DEG
    file.write_bytes(pl.DataFrame(told).write_csv(separator="\t").encode("utf-16"))


def read(file: Path, mapping: Any) -> tuple[list[MeasuredDrive], IngestCounts]:
    """Return the drives of a file, and what became of its rows."""
    with open_measured(file, mapping) as stream:
        return list(stream.drives()), stream.counts


LOGS: dict[str, tuple[Callable[[Path], None], int, set[str]]] = {
    "bench.csv": (write_bench, 1, {"ax", "ay", "yaw_rate", "steering_wheel", *WHEELS, "sideslip"}),
    "fleet.parquet": (write_fleet, 4, {"ay", "yaw_rate", "steering_wheel", *WHEELS}),
    "student.csv": (write_student, 1, {"ax", "ay", "yaw_rate", "steering_wheel", "vx", "vy"}),
    "bus.csv": (write_bus, 1, {"ay", "yaw_rate", "steering_wheel", *WHEELS, "sideslip"}),
}


@pytest.mark.parametrize("name", LOGS)
def test_a_strangers_log_becomes_the_drives_that_it_has(tmp_path: Path, name: str) -> None:
    write, drives, signals = LOGS[name]
    write(tmp_path / name)
    text = call(tmp_path, "mapping", "suggest", str(tmp_path / name)).partition("\n# A draft")[2]
    mapping = tmp_path / "draft.toml"
    mapping.write_text(f"# {with_first_units(filled_in(text))}", encoding="utf-8")
    found, counts = read(tmp_path / name, load_mapping(str(mapping)))
    assert counts.quarantined == {}
    assert len(found) == drives
    for number, drive in enumerate(found):
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


def a_mapping(
    folder: Path, signals: str, time: str = 'column = "t"\nunit = "s"', more: str = ""
) -> Any:
    file = folder / "m.toml"
    drive = 'day = 2024-05-31\nvehicle_id = "A"\nvehicle_model = "m"'
    text = f'name = "m"\n{more}\n[time]\n{time}\n[drive]\n{drive}\n[signals]\n{signals}\n'
    file.write_text(text, encoding="utf-8")
    return load_mapping(str(file))


def test_the_label_is_moved_to_the_centre_of_gravity(tmp_path: Path) -> None:
    car = a_car()
    speed = (car["wheel_rl"] + car["wheel_rr"]) / 2 * RADIUS_M
    vy = speed * np.tan(car["sideslip"]) + car["yaw_rate"] * 1.5
    at_sensor = np.arctan2(vy, speed)
    told = {"t": np.arange(ROWS) / 100, "r": car["yaw_rate"], "v": speed, "vy": vy, "b": at_sensor}
    pl.DataFrame(told).write_parquet(tmp_path / "log.parquet")
    rate = 'yaw_rate = { column = "r", unit = "rad/s" }\n'
    angle = (
        'vehicle_speed = { column = "v", unit = "m/s" }\nsideslip = { column = "b", unit = "rad" }'
    )
    pair = 'vx = { column = "v", unit = "m/s" }\nvy = { column = "vy", unit = "m/s" }'
    for signals, label in ((angle, ""), (pair, "from_velocities = true\n")):
        table = f"{rate}{signals}\n[label]\n{label}sensor_x_m = 1.5"
        drives, _ = read(tmp_path / "log.parquet", a_mapping(tmp_path, table))
        got = pl.Series(drives[0].counts["sideslip"]).cast(pl.Float64).to_numpy() * 1e-4
        assert np.abs(got - car["sideslip"]).max() < 6e-4
        assert np.abs(at_sensor - car["sideslip"]).max() > 0.04


def test_a_time_zone_and_a_time_of_the_day_are_understood(tmp_path: Path) -> None:
    file = tmp_path / "log.csv"
    lines = [f"2024-07-01 10:00:00.{i:02d},10:00:00.{i:02d},0.{i:02d}" for i in range(100)]
    file.write_text("\n".join(["when,clock,a", *lines]))
    ay = 'ay = { column = "a", unit = "g" }'
    zoned = 'column = "when"\nformat = "%Y-%m-%d %H:%M:%S%.f"\nzone = "Europe/Berlin"'
    drives, _ = read(file, a_mapping(tmp_path, ay, zoned))
    assert drives[0].metadata["started_at"] == datetime(2024, 7, 1, 8, tzinfo=UTC)
    clock = 'column = "clock"\nformat = "%H:%M:%S%.f"'
    drives, counts = read(file, a_mapping(tmp_path, ay, clock))
    assert drives[0].metadata["started_at"] is None
    assert (counts.rows_kept, counts.ticks) == (100, 100)


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
        told = [car["ay"][i], car["yaw_rate"][i] * TO_DEG, car["wheel_rl"][i] * RADIUS_M * 3.6]
        values = [f"{value:.4f}" for value in told]
        lines.append(";".join([f"{moment:{dated}}", f"{moment:{written}}"[:-3], *values]))
    (tmp_path / "log.csv").write_text("\n".join(lines), encoding="utf-8")
    draft = call(tmp_path, "mapping", "suggest", str(tmp_path / "log.csv"))
    text = draft.partition("\n# A draft")[2]
    assert "# day = " not in text
    (tmp_path / "m.toml").write_text(f"# {filled_in(text)}", encoding="utf-8")
    mapping = load_mapping(str(tmp_path / "m.toml"))
    (drive,), counts = read(tmp_path / "log.csv", mapping)
    assert drive.metadata["started_at"] == start
    assert (counts.rows_kept, counts.ticks, counts.quarantined) == (ROWS, ROWS, {})


def test_a_rate_that_is_assumed_is_said_at_each_ingest(tmp_path: Path) -> None:
    write_student(tmp_path / "log.csv")
    assumed = a_mapping(
        tmp_path, 'ay = { column = "ay", unit = "m/s^2" }', "rate_hz = 100\nassumed = true"
    )
    assert assumed.time.assumed
    with pytest.raises(AlarmError, match="100 Hz is assumed"):
        call(
            tmp_path / "root",
            "ingest",
            str(tmp_path / "log.csv"),
            "--mapping",
            str(tmp_path / "m.toml"),
        )


def test_a_magnitude_without_its_sign_is_told() -> None:
    car = a_car() | {"yaw_rate": np.abs(a_car()["yaw_rate"])}
    long = {name: np.tile(values, 2) for name, values in car.items()}
    found = {one.signals: one.figure for one in find_suspicions(long) if one.kind == "magnitude"}
    assert found == {("yaw_rate",): "it is never negative in 2 min"}
    assert not [one for one in find_suspicions(a_car()) if one.kind == "magnitude"]


def test_a_car_on_an_oval_has_its_sign() -> None:
    turning = {"yaw_rate": np.full(9000, 0.2) + 0.05 * np.sin(np.arange(9000))}
    wheels = {"wheel_rl": np.full(9000, 40.0), "wheel_rr": np.full(9000, 42.0)}
    assert list(find_one_sided(turning, None))
    assert not list(find_one_sided({**turning, **wheels}, None))
