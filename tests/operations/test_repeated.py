"""Drives of one car that overlap in time are named: their rows count twice."""

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pyarrow as pa
import pytest

import fleet_slip
from fleet_slip.ingest.mapping import Mapping
from fleet_slip.operations.labels import find_repeated
from tests.support.commands import RunCommand
from tests.support.measured import csv_text

BEGAN = datetime(2024, 5, 31, 8, tzinfo=UTC)


def drives(*told: tuple[str, str, float | None, float]) -> pa.Table:
    """Drives by car, name, begin and duration in s."""
    at = [None if start is None else BEGAN + timedelta(seconds=start) for _, _, start, _ in told]
    return pa.table(
        {
            "vehicle_id": [car for car, *_ in told],
            "drive_id": [name for _, name, *_ in told],
            "started_at": pa.array(at, pa.timestamp("us", tz="UTC")),
            "duration_s": [lasted for *_, lasted in told],
            "source": ["measured"] * len(told),
            "n": [0] * len(told),
        }
    )


def received(car: str, start_s: float, rows: int) -> pa.Table:
    """A drive without a log."""
    name = f"{car}-{BEGAN + timedelta(seconds=start_s):%Y%m%dT%H%M%SZ}"
    table = drives((car, name, None, 0.0))
    table = table.set_column(2, "started_at", pa.nulls(1, table.schema.field(2).type))
    table = table.set_column(3, "duration_s", pa.nulls(1, pa.float64()))
    table = table.set_column(4, "source", [["received"]])
    return table.set_column(5, "n", [[rows]])


def test_the_later_of_two_drives_at_once_is_named() -> None:
    found = find_repeated(
        drives(
            ("car", "long", 0, 1000),
            ("car", "within", 100, 50),
            ("car", "beyond", 950, 100),
            ("car", "after", 1049.5, 10),
            ("other", "elsewhere", 0, 1000),
            ("car", "undated", None, 1000),
        )
    )
    assert {name: fault.figure for name, fault in found.items()} == {
        "within": "50 s are in long",
        "beyond": "50 s are in long",
    }
    assert {fault.kind for fault in found.values()} == {"repeated"}


def test_of_a_drive_without_a_log_and_a_log_at_once_that_without_is_named() -> None:
    found = find_repeated(
        pa.concat_tables(
            [
                received("car", 0, 4000),
                drives(("car", "resampled", 0.25, 39.5), ("car", "next", 41, 100)),
                received("car", 60, 1000),
                received("car", 60, 3000),  # another set of signals of the same drive
                received("car", 150, 1000),
                received("car", 155, 1000),
                received("other", 0, 1000),
                received("other", 9, 1000),  # its clock has whole seconds
            ]
        )
    )
    assert {name: fault.figure for name, fault in found.items()} == {
        "car-20240531T080000Z": "40 s are in resampled",
        "car-20240531T080100Z": "40 s are in next",
        "car-20240531T080235Z": "5 s are in car-20240531T080230Z",
    }


@pytest.mark.parametrize("start_s", [-300, 300])
def test_one_message_of_a_day_does_not_accuse_the_drives_of_that_day(start_s: int) -> None:
    honest = [received("car", 3600 * hour, 60_000) for hour in range(12)]
    forged = received("car", start_s, 8_640_000)
    assert (
        list(find_repeated(pa.concat_tables([*honest, forged]))) == forged["drive_id"].to_pylist()
    )


def test_two_recordings_of_a_car_at_once_count_twice_and_quality_says_so(
    tmp_path: Path, run_command: RunCommand
) -> None:
    rows = range(4000)
    plan = {
        "name": "test",
        "time": {"column": "t", "format": "%Y-%m-%dT%H:%M:%S%.f%:z"},
        "drive": {"vehicle_id": "car", "vehicle_model": "sedan"},
        "signals": {
            "ax": {"column": "ax", "unit": "m/s^2"},
            "sideslip": {"column": "beta", "unit": "deg"},
        },
    }
    fleet = fleet_slip.open(tmp_path / "data")
    for logger, period in (("front", 7), ("rear", 9)):
        log = {
            "t": [(BEGAN + timedelta(milliseconds=10 * i)).isoformat() for i in rows],
            "ax": [f"{i % period / 10:.1f}" for i in rows],
            "beta": [f"{i % (period - 2) / 10:.1f}" for i in rows],
        }
        file = tmp_path / f"{logger}.csv"
        file.write_text(csv_text(log))
        fleet.ingest(file, Mapping.model_validate(plan))
    fleet.gram()
    told = run_command("quality", "--json")
    assert told.exit_code == 10
    (finding,) = told.json["findings"]
    assert finding["kind"] == "repeated"
    assert finding["figure"].startswith("40 s are in test-")
