"""The course of measured logs: of the centre of gravity, at its fixes' ticks, whatever tells it."""

import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from fleet_slip.quality.plausibility import check_plausibility
from tests.support.cars import Signals, drive, speed_of, with_course
from tests.support.catalog import SIGNALS
from tests.support.measured import MeasuredLog, a_mapping, physical, read_columns, read_measured
from tests.support.reported import call

ROWS = 3000
ANTENNA = {"antenna_x_m": 1.2, "antenna_y_m": -0.4}
YAW_RATE: dict[str, dict[str, Any]] = {"yaw_rate": {"column": "r", "unit": "rad/s"}}
VELOCITIES: dict[str, dict[str, Any]] = {
    **YAW_RATE,
    "course": {"north": "vn", "east": "ve", "unit": "m/s", **ANTENNA},
}
ANGLE: dict[str, dict[str, Any]] = {
    **YAW_RATE,
    "course": {"column": "cog", "unit": "deg", "clockwise_from_north": True, **ANTENNA},
    "satellite_speed": {"column": "sog", "unit": "km/h"},
}
FIX = 10
Columns = dict[str, Any]


def time_s() -> NDArray[np.float64]:
    return np.arange(ROWS) / 100


def heading(time: NDArray[np.float64]) -> NDArray[np.float64]:
    """The integral of 0.3 + 0.2 sin(t / 2) rad/s."""
    return np.asarray(0.3 * time - 0.4 * np.cos(time / 2))


def velocity(time: NDArray[np.float64], x: float = 0.0, y: float = 0.0) -> NDArray[np.complex128]:
    """East and north velocity of a place of a car that slides, as a complex number."""
    r = 0.3 + 0.2 * np.sin(time / 2)
    moving = 15 - r * y + 1j * (0.3 * np.sin(1.1 * time) + r * x)
    return np.asarray(moving * np.exp(1j * heading(time)))


def logged(fix_s: NDArray[np.float64], rows: NDArray[np.int64]) -> Columns:
    """A log at 100 Hz with fixes in some rows, taken at times of their own; else empty."""
    seen = velocity(fix_s, ANTENNA["antenna_x_m"], ANTENNA["antenna_y_m"])
    log = {
        "vn": seen.imag,
        "ve": seen.real,
        "cog": np.degrees(np.pi / 2 - np.angle(seen)) % 360,
        "sog": np.abs(seen) * 3.6,
    }
    columns: Columns = {
        "t": [f"{t:.2f}" for t in time_s()],
        "r": list(0.3 + 0.2 * np.sin(time_s() / 2)),
    }
    for name, values in log.items():
        column: list[float | None] = [None] * ROWS
        for row, value in zip(rows.tolist(), values.tolist(), strict=True):
            column[row] = value
        columns[name] = column
    return columns


def on_time() -> Columns:
    rows = np.arange(0, ROWS, FIX)
    return logged(rows / 100, rows)


def course_error(log: MeasuredLog, shift_s: float = 0.0) -> NDArray[np.float64]:
    """Return by how much the course at each fix is off, in rad."""
    course = physical(log, "course", 2 * np.pi / 65536)
    fixes = np.flatnonzero(~np.isnan(course))
    true = np.angle(velocity(fixes / 100 - shift_s))
    return np.asarray(np.angle(np.exp(1j * (course[fixes] - true))))


@pytest.mark.parametrize("signals", [VELOCITIES, ANGLE], ids=["velocities", "angle"])
def test_the_course_is_that_of_the_centre_of_gravity(tmp_path: Path, signals: Columns) -> None:
    log = read_columns(tmp_path, on_time(), a_mapping(signals=signals))
    error = course_error(log)
    assert len(error) == ROWS / FIX
    assert np.abs(error).max() < 4e-4, "the side-slip angle's share of 0.4 m is left"
    speed = physical(log, "satellite_speed", 0.005)[::FIX]
    assert speed == pytest.approx(np.abs(velocity(time_s()[::FIX])), abs=2e-2)


def test_a_fix_that_the_file_holds_is_one_fix(tmp_path: Path) -> None:
    columns = on_time()
    for name in ("vn", "ve"):
        columns[name] = [columns[name][row - row % FIX] for row in range(ROWS)]
    log = read_columns(tmp_path, columns, a_mapping(signals=VELOCITIES))
    error = course_error(log)
    assert len(error) == ROWS / FIX and np.abs(error).max() < 4e-4


def test_a_fix_between_ticks_turns_to_its_tick_and_a_delay_is_taken_off(tmp_path: Path) -> None:
    rows = np.arange(FIX, ROWS, FIX)
    columns = logged(rows / 100 - 0.104, rows)
    signals = {**VELOCITIES, "course": {**VELOCITIES["course"], "delay_s": 0.104}}
    log = read_columns(tmp_path, columns, a_mapping(signals=signals))
    assert np.abs(course_error(log)).max() < 5e-4


def test_a_course_with_times_of_its_own_is_the_same(tmp_path: Path) -> None:
    rows = pl.DataFrame(on_time()).with_columns(pl.col("t", "r").cast(pl.Float64))
    fix = rows.select(pl.col("t").alias("tg"), "vn", "ve").gather_every(FIX)
    empty = fix.clear(ROWS - fix.height)
    rows = rows.select("t", "r").hstack(pl.concat([fix, empty]))
    rows.write_parquet(tmp_path / "log.parquet")
    signals = {**VELOCITIES, "course": {**VELOCITIES["course"], "time": "tg"}}
    error = course_error(read_measured(tmp_path / "log.parquet", a_mapping(signals=signals)))
    assert len(error) == ROWS / FIX and np.abs(error).max() < 4e-4


def test_slow_and_sudden_courses_are_none(tmp_path: Path) -> None:
    columns = on_time()
    for name in ("vn", "ve"):
        columns[name][1000:2000] = [v and v / 20 for v in columns[name][1000:2000]]
    log = read_columns(tmp_path, columns, a_mapping(signals=VELOCITIES))
    course, speed = (physical(log, name, 1.0) for name in ("course", "satellite_speed"))
    assert np.isnan(course[1000:2000]).all() and not np.isnan(speed[1000:2000:FIX]).any()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"antenna_x_m": None}, "set antenna_x_m"),
        ({"antenna_x_m": 1200}, "less than or equal to 15"),
        ({"clockwise_from_north": None}, "set clockwise_from_north"),
    ],
)
def test_a_mapping_of_a_course_needs_its_keys(changes: Columns, message: str) -> None:
    course = {k: v for k, v in {**ANGLE["course"], **changes}.items() if v is not None}
    with pytest.raises(ValidationError, match=message):
        a_mapping(signals={**ANGLE, "course": course})


def test_a_course_comes_with_speed_and_yaw_rate() -> None:
    for needed in ("satellite_speed", "yaw_rate"):
        signals = {name: column for name, column in ANGLE.items() if name != needed}
        with pytest.raises(ValidationError, match=f"needs {needed}, too"):
            a_mapping(signals=signals)
    with pytest.raises(ValidationError, match="give the speed too"):
        a_mapping(signals={**VELOCITIES, "satellite_speed": ANGLE["satellite_speed"]})


def test_a_course_that_turns_the_other_way_is_suspicious() -> None:
    time = time_s()
    course = np.where(np.arange(ROWS) % FIX == 0, np.angle(velocity(time)), np.nan)
    signals = {"yaw_rate": 0.3 + 0.2 * np.sin(time / 2), "course": course}
    assert not [s for s in check_plausibility(SIGNALS, signals) if "course" in s.signals]
    (turned,) = (
        s
        for s in check_plausibility(SIGNALS, {**signals, "course": -course})
        if s.kind == "reversed"
    )
    assert turned.signals == ("course",) and "-1.0" in turned.figure
    strange = np.where(np.isnan(course), np.nan, np.sin(17 * time))
    (other,) = (
        s for s in check_plausibility(SIGNALS, {**signals, "course": strange}) if s.kind == "values"
    )
    assert "hardly correlates with the yaw rate" in other.figure


def suggested(tmp_path: Path, columns: Columns) -> str:
    file, written = tmp_path / "log.csv", tmp_path / "draft.toml"
    pl.DataFrame({"time_s": time_s(), "YawRate_rad_s": on_time()["r"], **columns}).write_csv(file)
    call(tmp_path / "root", "mapping", "suggest", str(file), "--output", str(written))
    return written.read_text()


@pytest.mark.parametrize("name", ["Heading", "True Heading", "Track", "gps_hdg", "Bearing"])
def test_a_heading_is_a_question_and_no_line(tmp_path: Path, name: str) -> None:
    columns = on_time()
    text = suggested(tmp_path, {name: columns["cog"], "GPS_Speed": columns["sog"]})
    assert "course" not in tomllib.loads(text)["signals"]
    notes = text.partition("# To check")[2].replace("\n#  ", "")
    assert f"column = {json.dumps(name)}" in notes and "antenna_x_m" in notes


@pytest.mark.parametrize(
    ("first", "other"),
    [
        *(("vel_north", "vel_east"), ("gnss_north_mps", "gnss_east_mps"), ("Vn", "Ve")),
        *(("Geschwindigkeit Nord", "Geschwindigkeit Ost"), ("GpsVelN", "GpsVelE")),
        *(("GPS_Course", "GPS_Speed"), ("Kurs über Grund", "GPS Geschwindigkeit")),
        ("headMot", "gSpeed"),
    ],
)
def test_strangers_call_a_course_and_velocities_otherwise(
    tmp_path: Path, first: str, other: str
) -> None:
    columns = on_time()
    if first in {"GPS_Course", "Kurs über Grund", "headMot"}:
        text = suggested(tmp_path, {first: columns["cog"], other: columns["sog"]})
        expected: Columns = {"column": first, "unit": "choose", "clockwise_from_north": True}
        assert tomllib.loads(text)["signals"]["satellite_speed"]["column"] == other
    else:
        text = suggested(tmp_path, {other: columns["ve"], first: columns["vn"]})
        unit = "m/s" if "mps" in first else "choose"
        expected = {"north": first, "east": other, "unit": unit}
    assert tomllib.loads(text)["signals"]["course"] == expected
    assert "antenna_x_m and antenna_y_m: to be filled in" in text


def test_a_course_that_stands_still_while_the_car_turns_is_none(tmp_path: Path) -> None:
    columns = on_time()
    fix_rows = range(0, ROWS, FIX)
    for row in fix_rows:
        columns["cog"][row] = columns["cog"][row - row % (5 * FIX)]
        columns["sog"][row] += row / 1e4
    log = read_columns(tmp_path, columns, a_mapping(signals=ANGLE))
    course, speed = (physical(log, name, 1.0) for name in ("course", "satellite_speed"))
    assert np.flatnonzero(~np.isnan(course)).tolist() == list(range(0, ROWS, 5 * FIX))
    assert np.flatnonzero(~np.isnan(speed)).tolist() == list(fix_rows)
    signals = {
        "course": course * 2 * np.pi / 65536,
        "satellite_speed": speed * 0.005,
        "yaw_rate": np.array(columns["r"]),
    }
    (fault,) = (s for s in check_plausibility(SIGNALS, signals) if "course" in s.signals)
    assert "80% of its fixes repeat the last" in fault.figure


def test_driving_backwards_has_no_course(tmp_path: Path) -> None:
    """For wheels without a sign, the accelerometer decides."""
    columns = on_time()
    ay = 15 * np.array(columns["r"])
    ay[1000:2000] *= -0.2
    columns["ay"] = list(ay)
    for name in ("vn", "ve"):
        columns[name][1000:2000] = [v and -v / 5 for v in columns[name][1000:2000]]
    signals = {**VELOCITIES, "ay": {"column": "ay", "unit": "m/s^2"}}
    course = physical(read_columns(tmp_path, columns, a_mapping(signals=signals)), "course", 1.0)
    assert np.isnan(course[1050:1950]).all()
    assert not np.isnan(course[:900:FIX]).any() and not np.isnan(course[2100::FIX]).any()


def suspected(change: Callable[[Signals], None], slip: float = 1.0) -> list[tuple[str, str]]:
    """Return the kinds and remedies of what looks wrong in the course of a usual drive."""
    rng = np.random.default_rng(3)
    signals = with_course(drive(rng, gentleness=2), rng, slip)
    change(signals)
    satellites = {"course", "satellite_speed"}
    faults = [s for s in check_plausibility(SIGNALS, signals) if satellites & set(s.signals)]
    return [(s.kind, s.remedy) for s in faults]


def shift(place_m: float) -> Callable[[Signals], None]:
    def change(signals: Signals) -> None:
        signals["course"] = signals["course"] + place_m * signals["yaw_rate"] / speed_of(signals)

    return change


@pytest.mark.parametrize(
    ("change", "slip", "kind", "message"),
    [
        (lambda signals: None, 0.0, "no slip", "It is a heading"),
        (shift(-1.5), 1.0, "place", "antenna_x_m"),
        (shift(2.0), 1.0, "place", "antenna_x_m"),
        (
            lambda s: s.update(satellite_speed=s["satellite_speed"] / 3.6),
            1.0,
            "scaled",
            "Check the units",
        ),
        (lambda s: s.update(yaw_rate=s["yaw_rate"] * 1.04), 1.0, "scale", "gyroscope"),
    ],
)
def test_a_column_that_is_no_course_is_suspicious(
    change: Callable[[Signals], None], slip: float, kind: str, message: str
) -> None:
    assert suspected(lambda signals: None) == []
    ((fault, remedy),) = suspected(change, slip)
    assert fault == kind and message in remedy


def test_fixes_at_irregular_times_come_onto_a_grid_and_lost_rows_are_bridged(
    tmp_path: Path,
) -> None:
    """A logger that lost one row in thirty: no two fixes were whole seconds apart any more."""
    columns = on_time()
    rng = np.random.default_rng(11)
    rows = np.sort(rng.choice(np.arange(1, ROWS), ROWS * 29 // 30, replace=False))
    rows = np.concatenate([[0], rows])
    fixes = rows[::FIX]
    lossy = logged(fixes / 100, fixes)
    lost = {name: [values[row] for row in rows] for name, values in {**columns, **lossy}.items()}
    log = read_columns(tmp_path, lost, a_mapping(signals=VELOCITIES))
    assert log.drives.num_rows == rows[-1] + 1, "lost rows are interpolated"
    course = physical(log, "course", 1.0)
    fix_ticks = np.flatnonzero(~np.isnan(course))
    assert (fix_ticks % FIX == 0).all() and len(fix_ticks) > 0.95 * ROWS / FIX
    assert np.abs(course_error(log)).max() < 1e-3
