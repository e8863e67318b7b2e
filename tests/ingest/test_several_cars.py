"""Logs of several cars that a mapping takes for those of one, and logs of one car that seem so."""

from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from fleet_slip.catalogue.faults import Fault
from fleet_slip.errors import AlarmError
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
