"""A car by the textbook is above suspicion; each way of logging it wrongly is not."""

import json
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

import fleet_slip
from fleet_slip.arrays import FloatArray
from fleet_slip.errors import AlarmError
from fleet_slip.ingest.measured_log import find_rejections, open_measured
from fleet_slip.quality.checks import Fault
from fleet_slip.quality.drive_signals import RADIUS_M, WHEELS
from fleet_slip.quality.plausibility import SoundDrive, check_plausibility, find_one_sided
from tests.support.catalog import SIGNALS
from tests.support.commands import run_on
from tests.support.measured import MAPPING_TEXT, a_mapping, csv_text, good_columns
from tests.support.reported import call
from tests.support.textbook_car import Car, a_car, winding_car

Change = Callable[[Car], Car]
SIGNED = ("ax", "ay", "yaw_rate", "steering_wheel", "sideslip")


def kinds(car: Car) -> set[tuple[str, tuple[str, ...]]]:
    return {(fault.kind, fault.signals) for fault in check_plausibility(SIGNALS, car)}


@pytest.mark.parametrize("least_mps", [2.5, 8.0, 20.0])
def test_a_car_by_the_textbook_is_above_suspicion(least_mps: float) -> None:
    car = a_car(least_mps)
    assert kinds(car) == set()
    noise = np.random.default_rng(1)
    assert (
        kinds({n: v + 0.02 * v.std() * noise.normal(size=v.size) for n, v in car.items()}) == set()
    )


def times(name: str, factor: float) -> Change:
    return lambda car: {name: factor * car[name]}


def swapped(*pairs: tuple[str, str]) -> Change:
    return lambda car: {a: car[b] for pair in pairs for a, b in (pair, pair[::-1])}


FRONT, REAR = (WHEELS[0], WHEELS[1]), (WHEELS[2], WHEELS[3])
WRONG: list[tuple[Change, str, tuple[str, ...]]] = [
    *((times(name, -1), "reversed", (name,)) for name in SIGNED),
    *((times("sideslip", by), "scaled", ("sideslip",)) for by in (20, 2, 1 / 57.3)),
    (lambda car: {"sideslip": car["sideslip"] + np.radians(1)}, "biased", ("sideslip",)),
    (lambda car: {"ay": np.full(6000, 0.3)}, "stuck", ("ay",)),
    (lambda car: {"ax": np.full(6000, np.nan)}, "absent", ("ax",)),
    (swapped(("ax", "ay")), "swapped", ("ax", "ay")),
    (lambda car: {"ax": -car["ay"], "ay": car["ax"]}, "swapped", ("ax", "ay")),
    (swapped(FRONT), "swapped", FRONT),
    (swapped(REAR), "swapped", REAR),
    (swapped((FRONT[0], REAR[0]), (FRONT[1], REAR[1])), "swapped", WHEELS),
]


@pytest.mark.parametrize(("change", "kind", "signals"), WRONG)
def test_only_the_wrong_signals_are_named(
    change: Change, kind: str, signals: tuple[str, ...]
) -> None:
    car = a_car(least_mps=2.5)
    assert kinds({**car, **change(car)}) == {(kind, signals)}


def test_a_label_in_degrees_at_speed() -> None:
    car = a_car(20.0)
    assert ("scaled", ("sideslip",)) in kinds({**car, "sideslip": 57.3 * (car["sideslip"] + 0.02)})


def test_tyres_at_their_limit_tell_nothing_of_the_labels_sign() -> None:
    """As in the last minutes of a race: below 20 m/s the car only turned as hard as it could."""
    car = a_car()
    angle = -1.2 * car["yaw_rate"] / 14.0 - 0.003 * car["ay"]
    assert ("reversed", ("sideslip",)) in kinds({**car, "sideslip": angle})
    at_limit = np.where(np.abs(car["ay"]) > 5.0, angle, np.nan)
    assert ("reversed", ("sideslip",)) not in kinds({**car, "sideslip": at_limit})


def test_the_smaller_group_of_contradicting_signals_is_at_fault() -> None:
    car, wheels = a_car(), [("wheel_fl", "wheel_fr"), ("wheel_rl", "wheel_rr")]
    exchanged = {a: car[b] for pair in wheels for a, b in (pair, pair[::-1])}
    faults = check_plausibility(SIGNALS, {**car, **exchanged})
    axes = ("ay", "yaw_rate", "steering_wheel", "sideslip")
    assert [(fault.kind, fault.signals) for fault in faults] == [("reversed", axes)]
    assert "z-down (SAE J670)" in faults[0].figure
    assert "unless left and right are swapped" in faults[0].figure
    of_iso = check_plausibility(SIGNALS, {**car, **exchanged, "sideslip": -car["sideslip"]})
    assert [fault.signals for fault in of_iso] == [axes[:3]]
    two_reversed = {**car, "ay": -car["ay"], "yaw_rate": -car["yaw_rate"]}
    del two_reversed["steering_wheel"]
    assert ("reversed", ("ay", "yaw_rate")) in kinds(two_reversed)


@pytest.mark.parametrize(
    ("name", "factor"), [("yaw_rate", 57.3), ("ay", 1 / 9.81), ("ax", 9.81), ("wheel_rl", 3.6)]
)
def test_a_unit_that_lies(name: str, factor: float) -> None:
    car = a_car()
    faults = check_plausibility(SIGNALS, {**car, name: factor * car[name]})
    assert any(name in fault.signals for fault in faults if fault.kind == "scaled")


STEPS = {"ax": 0.08, "ay": 0.08, "yaw_rate": 0.005, "steering_wheel": 0.026, "sideslip": 0.002}


@pytest.mark.parametrize("held", [1, 2, 4, 5])
@pytest.mark.parametrize("least_mps", [2.5, 20.0])
def test_signals_as_buses_send_them_are_above_suspicion(held: int, least_mps: float) -> None:
    """Each is held between messages of 10 to 50 ms, comes up to 30 ms late, and is rounded."""
    random, car = np.random.default_rng(held), a_car(least_mps)
    ticks = np.arange(car["ay"].size)
    sent = {}
    for name, values in car.items():
        late = random.integers(0, held) + random.integers(0, 4)
        last = np.maximum((ticks - late) // held * held, 0)
        step = STEPS.get(name, 0.1)
        sent[name] = np.round(values[last] / step) * step
    assert kinds(sent) == set()


@pytest.mark.parametrize("change", [lambda v: v[:50], lambda v: 0 * v, lambda v: np.nan * v])
def test_too_little_raises_no_more_than_what_is_plain(
    change: Callable[[FloatArray], FloatArray],
) -> None:
    kinds_ = kinds({name: change(values) for name, values in a_car().items()})
    assert {kind for kind, _ in kinds_} <= {"stuck", "absent"}


MAPPING = """name = "car"
[time]
rate_hz = 100
[drive]
day = 2024-05-31
vehicle_id = "A7"
vehicle_model = "sedan"
[signals]
"""


def write_car(folder: Path, car: Car) -> tuple[str, str]:
    units = {"ax": "m/s^2", "ay": "m/s^2", "yaw_rate": "rad/s"}
    lines = [
        f'{n} = {{ column = "{n}", unit = "{units.get(n, "rad/s" if n in WHEELS else "rad")}" }}'
        for n in car
    ]
    (folder / "car.toml").write_text(MAPPING + "\n".join(lines))
    pl.DataFrame(car).write_csv(folder / "car.csv")
    return str(folder / "car.csv"), str(folder / "car.toml")


def test_one_speed_in_place_of_four_at_different_delays_is_no_swap() -> None:
    """A car that mostly brakes in left bends: the later of two wheels is faster in these."""
    car = winding_car()
    yaw_rate = car["yaw_rate"] - car["yaw_rate"].mean()
    speed = 15 + 4 * np.sin(0.5 * np.arange(9000) / 100) - 6 * yaw_rate.cumsum() / 100
    car |= dict.fromkeys(WHEELS, speed / RADIUS_M)
    for name in ("wheel_fl", "wheel_rl"):
        car[name] = np.concatenate([np.full(10, car[name][0]), car[name][:-10]])
    assert "swapped" not in {kind for kind, _ in kinds(car)}


def test_a_spin_swaps_no_axles() -> None:
    """One speed in place of four, later at the rear, of a car that brakes as it spins."""
    time_s = np.arange(6000) / 100
    share = (time_s % 15) / 3
    spins = share < 1
    speed = np.where(spins, 13 - 9 * share, 4 + 9 * np.clip((share - 1) / 4, 0, 1))
    yaw_rate = np.where(spins, 0.1 + 1.2 * share, 0.1 * np.sin(time_s))
    car = {"yaw_rate": yaw_rate, "ay": yaw_rate * speed}
    late = np.concatenate([np.full(10, speed[0]), speed[:-10]])
    car |= {name: (late if name in REAR else speed) / RADIUS_M for name in WHEELS}
    assert kinds(car) == set()


def test_one_angle_of_the_road_wheels_and_a_speed_of_the_bus_are_looked_at() -> None:
    car = a_car()
    speed = np.mean([car[name] for name in WHEELS], axis=0) * RADIUS_M
    signals = {**car, "steer": car["steering_wheel"] / 15, "vehicle_speed": speed}
    assert kinds(signals) == set()
    reversed_ = {**signals, **dict.fromkeys(("steer", "steer_fl", "steer_fr"), -signals["steer"])}
    del reversed_["steering_wheel"]
    assert kinds(reversed_) == {("reversed", ("steer",))}
    assert ("scaled", ("vehicle_speed",)) in kinds({**signals, "vehicle_speed": 3.6 * speed})
    slow = {**signals, "steer": 57.3 * signals["steer"]}
    assert ("scaled", ("steering_wheel", "steer")) in kinds(slow)


def test_a_unit_that_lies_so_much_that_rows_are_refused_is_told(tmp_path: Path) -> None:
    car = a_car()
    file, mapping = write_car(tmp_path, {**car, "yaw_rate": 57.3 * car["yaw_rate"]})
    command = ("ingest", file, "--mapping", mapping, "--json")
    ended = run_on(tmp_path / "root", *command)
    assert ended.exit_code == AlarmError.exit_code  # most rows are refused
    (report,) = ended.json
    (suspicion,) = report["suspicions"]
    assert (suspicion["kind"], suspicion["signals"]) == ("scaled", ["yaw_rate"])
    refused = report["quarantined"]["out_of_range"]
    assert suspicion["figure"] == f"{refused:,} of 6,000 rows were refused: out_of_range"
    with pytest.raises(AlarmError, match="1 suspicion, see above"):
        call(tmp_path / "other", *command, "--dry-run")


def test_few_refused_rows_are_no_suspicion() -> None:
    refused = {("ax", "out_of_range"): 100, ("ay", "not_a_number"): 101, ("vx", "new"): 500}
    reasons = {reason: count for (_, reason), count in refused.items()}
    faults = [(fault.kind, fault.signals) for fault in find_rejections(refused, 1000, reasons)]
    assert faults == [("texts", ("ay",)), ("values", ("vx",))]
    small_counts = {("ax", "out_of_range"): 60, ("ay", "out_of_range"): 60}
    (together,) = find_rejections(small_counts, 1000, {"out_of_range": 120})
    assert together.figure == "120 of 1,000 rows were refused, 120 of them: out_of_range"
    assert not list(find_rejections({("ax", "out_of_range"): 10}, 12, {"out_of_range": 10}))
    for reason, hint in (("time_duplicate", True), ("time_backwards", True), ("not_a_time", False)):
        (untimed,) = find_rejections({}, 1000, {reason: 60, "missing": 50})
        assert (untimed.kind, untimed.signals) == ("values", ("time",))
        assert f"110 of 1,000 rows were refused, 60 of them: {reason}" in str(untimed)
        assert ("drive.column if the file mixes cars or trips" in untimed.remedy) == hint
    assert not list(find_rejections({}, 1000, {"no_value": 90}))


def test_ingest_says_once_what_looks_wrong_in_files_that_land_together(tmp_path: Path) -> None:
    """And goes on: their rows are stored."""
    car, logs = {**a_car(), "ay": -a_car()["ay"]}, tmp_path / "logs"
    logs.mkdir()
    write_car(logs, {name: 1.02 * values[:4000] for name, values in car.items()})
    (logs / "car.csv").rename(logs / "short.csv")
    file, mapping = write_car(logs, car)
    words = ("ingest", str(logs), "--mapping", mapping)
    done = run_on(tmp_path / "root", *words, "--json")
    assert done.exit_code == AlarmError.exit_code
    suspicions = {Path(entry["file"]).name: entry["suspicions"] for entry in done.json}
    assert [(entry["kind"], entry["signals"]) for entry in suspicions["car.csv"]] == [
        ("reversed", ["ay"])
    ]
    assert suspicions["short.csv"] == [] and all(entry["new"] for entry in done.json)
    assert "Its rows are stored." in done.stderr
    (message,) = [line for line in done.stderr.splitlines() if "looks wrong: reversed ay?" in line]
    assert message.startswith(file) and message.endswith("Write negate = true.")
    assert json.loads(call(tmp_path / "root", *words, "--json")) == []
    with pytest.raises(AlarmError, match="1 suspicion, see above"):
        call(tmp_path / "root", *words, "--dry-run")


def test_rows_that_are_refused_for_their_time_call_for_attention(tmp_path: Path) -> None:
    columns = {name: [f"{v}" for v in values] for name, values in good_columns(300).items()}
    columns["t"] = [f"{i // 3 / 100:.2f}" for i in range(300)]
    (tmp_path / "log.csv").write_text(csv_text(columns))
    (tmp_path / "test.toml").write_text(MAPPING_TEXT)
    words = ("ingest", str(tmp_path / "log.csv"), "--mapping", str(tmp_path / "test.toml"))
    with pytest.raises(AlarmError, match="200 of 300 rows were refused"):
        call(tmp_path / "root", *words)
    fleet = fleet_slip.open(tmp_path / "root")
    assert fleet.sql("SELECT count(*) FROM log").fetchall() == [(100,)]


def test_a_magnitude_without_its_sign_is_told() -> None:
    car = a_car() | {"yaw_rate": np.abs(a_car()["yaw_rate"])}
    long = {name: np.tile(values, 2) for name, values in car.items()}
    faults = {
        fault.signals: fault.figure
        for fault in check_plausibility(SIGNALS, long)
        if fault.kind == "magnitude"
    }
    assert faults == {("yaw_rate",): "it is never negative in 2 min"}
    assert not [
        fault for fault in check_plausibility(SIGNALS, a_car()) if fault.kind == "magnitude"
    ]


def test_a_car_on_an_oval_has_its_sign() -> None:
    turning = {"yaw_rate": np.full(9000, 0.2) + 0.05 * np.sin(np.arange(9000))}
    wheels = {"wheel_rl": np.full(9000, 40.0), "wheel_rr": np.full(9000, 42.0)}
    everywhere = np.ones(9000, dtype=np.bool_)
    assert list(find_one_sided(SoundDrive(turning, "sideslip", everywhere)))
    assert not list(find_one_sided(SoundDrive({**turning, **wheels}, "sideslip", everywhere)))


def cars(number: int) -> list[pl.DataFrame]:
    """Return minutes of as many cars, each at another place of its road."""
    return [
        pl.DataFrame(
            {
                "t": np.arange(6000) / 100,
                **{n: np.roll(a_car(8.0 + 3 * i)[n], 1700 * i) for n in LOGGED},
                "vehicle": [f"car {i}"] * 6000,
                "trip": [i] * 6000,
            }
        )
        for i in range(number)
    ]


LOGGED = {
    name: {"column": name, "unit": unit}
    for name, unit in {
        **{"yaw_rate": "rad/s", "steering_wheel": "rad"},
        **dict.fromkeys(WHEELS, "rad/s"),
    }.items()
}


def said_of(rows: pl.DataFrame, folder: Path, **changes: Any) -> list[Fault]:
    rows.write_parquet(folder / "log.parquet")
    with open_measured(folder / "log.parquet", a_mapping(signals=LOGGED, **changes)) as stream:
        list(stream.drives())
        return list(stream.suspicions())


def test_a_column_of_cars_that_no_mapping_uses_is_told(tmp_path: Path) -> None:
    """Cars that drive behind one another do as one car does: a column tells them apart."""
    first, second = (cars(1)[0].with_columns(vehicle=pl.lit(name)) for name in ("A", "B"))
    rows = pl.concat([first, second.with_columns(pl.col("t") + 0.005)]).sort("t")
    (suspicion,) = said_of(rows, tmp_path)
    assert (suspicion.kind, suspicion.signals) == ("cars", ("vehicle",))
    assert str(suspicion).startswith("several cars in vehicle? it has 2 values")
    assert 'vehicle_id = { column = "vehicle" }' in suspicion.remedy
    assert said_of(rows, tmp_path, where=[{"column": "vehicle", "one_of": ["A"]}]) == []
    assert said_of(first, tmp_path) == []


def test_trips_that_follow_one_another_are_drives_and_trips_in_turns_are_not(
    tmp_path: Path,
) -> None:
    first, second = (cars(1)[0].with_columns(trip=pl.lit(i)) for i in (1, 2))
    assert said_of(pl.concat([first, second.with_columns(pl.col("t") + 100)]), tmp_path) == []
    at_once = second.with_columns(pl.col("t") + 60)  # nothing ends the first
    (suspicion,) = said_of(pl.concat([first, at_once]), tmp_path)
    assert (suspicion.signals, suspicion.remedy) == (
        ("trip",),
        'Write column = "trip" under [drive].',
    )


def test_a_car_is_not_under_way_twice(tmp_path: Path) -> None:
    """Logs of two cars one after the other, at times of the same hour."""
    since = datetime(2024, 3, 12, 9, 14) + pl.duration(
        microseconds=(pl.col("t") * 1e6).cast(pl.Int64)
    )
    both = pl.concat(f.with_columns(since.alias("t")).drop("vehicle", "trip") for f in cars(2))
    (suspicion,) = said_of(both, tmp_path, time={"unit": None})
    assert str(suspicion).startswith("repeated time? drives of one car overlap in time (1 time")
    assert said_of(both.head(6000), tmp_path, time={"unit": None}) == []
