"""Logs of several cars that a mapping takes for those of one, and logs of one car that seem so."""

from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from fleet_slip.catalogue.faults import Fault
from fleet_slip.errors import AlarmError
from fleet_slip.ingest.log_faults import _count_jumps
from fleet_slip.ingest.stream import open_measured
from fleet_slip.ingest.suspicion import WHEELS
from tests.ingest.test_strange_logs import a_mapping
from tests.support.reported import call
from tests.support.textbook_car import a_car

ROWS = 6000
SIGNALS = {"yaw_rate": "rad/s", "steering_wheel": "rad", **dict.fromkeys(WHEELS, "rad/s")}
TABLE = "\n".join(f'{name} = {{ column = "{name}", unit = "{u}" }}' for name, u in SIGNALS.items())
START = datetime(2024, 3, 12, 9, 14)


def cars(number: int) -> list[pl.DataFrame]:
    """Return minutes of as many cars, each at another place of its road."""
    return [
        pl.DataFrame(
            {
                "t": np.arange(ROWS) / 100,
                **{n: np.roll(a_car(8.0 + 3 * i)[n], 1700 * i) for n in SIGNALS},
                "vehicle": [f"car {i}"] * ROWS,
                "trip": [i] * ROWS,
            }
        )
        for i in range(number)
    ]


def said_of(rows: pl.DataFrame, folder: Path, mapping: Any) -> list[Fault]:
    rows.write_parquet(folder / "log.parquet")
    with open_measured(folder / "log.parquet", mapping) as stream:
        list(stream.drives())
        return list(stream.suspicions())


def in_turns(frames: list[pl.DataFrame]) -> pl.DataFrame:
    """Clocks of the cars differ by parts of a tick."""
    shifted = [f.with_columns(pl.col("t") + 0.01 * i / len(frames)) for i, f in enumerate(frames)]
    return pl.concat(shifted).sort("t")


def at_random(frames: list[pl.DataFrame]) -> pl.DataFrame:
    rows = pl.concat(frames)
    late = np.random.default_rng(3).uniform(0, 0.01, rows.height)
    return rows.with_columns(pl.col("t") + pl.Series(late)).sort("t")


def by_the_second(frames: list[pl.DataFrame]) -> pl.DataFrame:
    second = pl.col("t").floor() % len(frames)
    return pl.concat(f.filter(second == i) for i, f in enumerate(frames)).sort("t")


@pytest.mark.parametrize("mixed", [in_turns, at_random, by_the_second])
@pytest.mark.parametrize("number", [2, 4])
def test_rows_of_several_cars_jump_as_no_car_does(
    tmp_path: Path, mixed: Callable[[list[pl.DataFrame]], pl.DataFrame], number: int
) -> None:
    rows = mixed(cars(number)).drop("vehicle", "trip")
    for time in ('column = "t"\nunit = "s"', "rate_hz = 100"):
        (found,) = said_of(rows, tmp_path, a_mapping(tmp_path, TABLE, time))
        assert found.kind == "cars" and "jumps implausibly between rows" in found.figure


def coarse(rows: pl.DataFrame) -> pl.DataFrame:
    steps = dict.fromkeys(WHEELS, 0.9) | {"yaw_rate": 0.035, "steering_wheel": 0.035}
    return rows.with_columns((pl.col(n) / step).round() * step for n, step in steps.items())


def noisy(rows: pl.DataFrame) -> pl.DataFrame:
    rng = np.random.default_rng(5)
    noise = dict.fromkeys(WHEELS, 0.5) | {"yaw_rate": 0.05, "steering_wheel": 0.05}
    return rows.with_columns(
        pl.col(n) + pl.Series(rng.normal(0, size, rows.height)) for n, size in noise.items()
    )


def with_gaps(rows: pl.DataFrame) -> pl.DataFrame:
    """Some rows are lost, and half seconds at a time."""
    kept = np.random.default_rng(6).random(rows.height) > 0.1
    for start in range(300, rows.height, 700):
        kept[start : start + 50] = False
    return rows.filter(pl.Series(kept))


def with_faults(rows: pl.DataFrame) -> pl.DataFrame:
    """A hundredth of the values is anything, and for a while there is none, or the last one."""
    rng = np.random.default_rng(7)
    changed = {}
    for name in SIGNALS:
        values = rows[name].to_numpy().copy()
        wild = rng.random(values.size) < 0.01
        values[wild] = rng.uniform(values.min(), 2 * values.max(), wild.sum())
        for start in range(500, values.size - 400, 900):
            values[start : start + 30] = 0
            values[start + 300 : start + 350] = values[start + 300]
        changed[name] = values
    return rows.with_columns(pl.Series(name, values) for name, values in changed.items())


def slow(rows: pl.DataFrame) -> pl.DataFrame:
    return rows.gather_every(10)


@pytest.mark.parametrize("changed", [coarse, noisy, with_gaps, with_faults, slow])
def test_a_poor_log_of_one_car_is_of_one_car(
    tmp_path: Path, changed: Callable[[pl.DataFrame], pl.DataFrame]
) -> None:
    time = 'column = "t"\nunit = "s"\nlongest_gap_s = 0.2'
    rows = changed(cars(1)[0])
    assert said_of(rows, tmp_path, a_mapping(tmp_path, TABLE, time)) == []


@pytest.mark.parametrize("held_ms", [10, 20, 40, 50])
@pytest.mark.parametrize("late_ms", [0, 5, 30])
@pytest.mark.parametrize("steps_a_turn", [60, 720])
def test_signals_as_a_bus_sends_them_are_of_one_car(
    held_ms: int, late_ms: int, steps_a_turn: int
) -> None:
    """Held between messages, some of which are late, and coarse: of a driver who turns fast."""
    time_s = np.arange(ROWS) / 100
    random = np.random.default_rng(held_ms + late_ms)
    sent = np.arange(0.0, 60.0, held_ms / 1000)
    arrived = np.maximum.accumulate(sent + random.uniform(0, late_ms / 1000, sent.size))
    last = sent[np.maximum(np.searchsorted(arrived, time_s, "right") - 1, 0)]
    steering_wheel = 6.0 * np.sin(20.0 / 6.0 * last)  # to 1150 degrees a second
    step = 2 * np.pi / steps_a_turn
    assert _count_jumps("steering_wheel", time_s, np.round(steering_wheel / step) * step) == 0


@pytest.mark.parametrize("jumps", [9, 10])
def test_ten_jumps_within_a_minute_are_told_and_nine_are_not(tmp_path: Path, jumps: int) -> None:
    """The steering wheel is turned there and back between two rows, and stays a while."""
    turned = np.full(ROWS, 0.5)
    for start in range(500, 500 + 400 * jumps, 400):
        turned[start:] = 2.0 - turned[start]
    rows = cars(1)[0].with_columns(steering_wheel=pl.Series(turned))
    told = [
        one for one in said_of(rows, tmp_path, a_mapping(tmp_path, TABLE)) if one.kind == "cars"
    ]
    assert [one.signals for one in told] == ([("steering_wheel",)] if jumps == 10 else [])


def test_a_column_of_cars_that_no_mapping_uses_is_told(tmp_path: Path) -> None:
    """Cars that drive behind one another do as one car does: a column tells them apart."""
    convoy = [cars(1)[0].with_columns(vehicle=pl.lit(name)) for name in ("A", "B")]
    rows = in_turns(convoy)
    (found,) = said_of(rows, tmp_path, a_mapping(tmp_path, TABLE))
    assert (found.kind, found.signals) == ("cars", ("vehicle",))
    assert 'vehicle_id = { column = "vehicle" }' in found.remedy
    used = 'where = [{ column = "vehicle", one_of = ["A"] }]'
    assert said_of(rows, tmp_path, a_mapping(tmp_path, TABLE, more=used)) == []
    assert said_of(convoy[0], tmp_path, a_mapping(tmp_path, TABLE)) == []
    command = ("ingest", str(tmp_path / "log.parquet"), "--mapping", str(tmp_path / "m.toml"))
    rows.write_parquet(tmp_path / "log.parquet")
    a_mapping(tmp_path, TABLE)
    with pytest.raises(AlarmError, match=r"several cars in vehicle\? it has 2 values"):
        call(tmp_path / "root", *command)


def test_trips_that_follow_one_another_are_drives_and_trips_in_turns_are_not(
    tmp_path: Path,
) -> None:
    first, second = (cars(1)[0].with_columns(trip=pl.lit(i)) for i in (1, 2))
    later = pl.concat([first, second.with_columns(pl.col("t") + 100)])
    assert said_of(later, tmp_path, a_mapping(tmp_path, TABLE)) == []
    at_once = second.with_columns(pl.col("t") + 60)  # nothing ends the first
    (found,) = said_of(pl.concat([first, at_once]), tmp_path, a_mapping(tmp_path, TABLE))
    assert (found.signals, found.remedy) == (("trip",), 'Write column = "trip" under [drive].')


def test_a_car_is_not_under_way_twice(tmp_path: Path) -> None:
    """Logs of two cars one after the other, at times of the same hour."""
    dated = (START + pl.duration(microseconds=(pl.col("t") * 1e6).cast(pl.Int64))).alias("t")
    both = pl.concat(f.with_columns(dated).drop("vehicle", "trip") for f in cars(2))
    mapping = a_mapping(tmp_path, TABLE, 'column = "t"')
    (found,) = said_of(both, tmp_path, mapping)
    assert str(found).startswith("repeated time? drives of one car overlap in time (1 time")
    assert said_of(both.head(ROWS), tmp_path, mapping) == []
