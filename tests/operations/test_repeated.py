"""Drives of one car that overlap in time are named: their rows count twice."""

from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from fleet_slip.grams.job import update_grams
from fleet_slip.operations.labels import find_repeated
from fleet_slip.warehouse.tables import Warehouse
from tests.support.commands import RunCommand
from tests.support.logs import land, log_rows, random_counts

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


def test_quality_names_two_recordings_of_a_car_at_once(
    warehouse: Warehouse, run_command: RunCommand
) -> None:
    rng = np.random.default_rng(1)
    known: dict[str, Any] = {"started_at": BEGAN, "duration_s": 40.0, "source": "measured"}
    drives = [log_rows(name, random_counts(rng, 4000), **known) for name in ("front", "rear")]
    land(warehouse, "both", *drives)
    update_grams(warehouse)
    told = run_command("quality", "--json")
    assert told.exit_code == 10
    found = [one for one in told.json["findings"] if one["kind"] == "repeated"]
    assert [(one["drive_id"], one["figure"]) for one in found] == [("rear", "40 s are in front")]
