"""Of very many drives those of some days are read to see whom odd ones speak for."""

from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

import fleet_slip
from fleet_slip.grams.cohorts import outweighing
from fleet_slip.grams.rows import rollup
from fleet_slip.models.acceptance import vouching_drives
from tests.support.fleet_messages import messages_of
from tests.support.messages import START_S

CARS, DAYS = 150, 7


def test_of_many_days_five_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rollup, "ROWS_PER_CELL", 4)
    monkeypatch.setattr(outweighing, "MOST_GROUPS", 10)
    fleet, read = fleet_slip.open(tmp_path / "data"), list[pa.Table]()
    for day in range(DAYS):
        path = tmp_path / f"day-{day}"
        start_s = START_S + 86_400 * day
        path.write_bytes(messages_of(CARS, start_s, seed=day, label_follows=True))
        fleet.receive(path)
    fleet.publish("made", fleet.cohort(f"day < DATE '2024-05-0{DAYS}'").select(), force=True)
    compare = vouching_drives._compare

    def look(*given: Any) -> str | None:
        read.append(given[2].drives["day"])
        return compare(*given)

    monkeypatch.setattr(vouching_drives, "_compare", look)
    monkeypatch.setattr(vouching_drives, "MOST_DRIVES", 400)
    for most, days in ((10**6, [1, 2, 3, 4, 5, 6, 7]), (1000, [1, 3, 4, 5, 7])):
        monkeypatch.setattr(vouching_drives, "MOST_READ", most)
        vouching_drives.odd_gain(fleet.registry(), fleet.cohort().select(), fleet.model("made"))
        chosen = read[-1].to_pylist()
        assert sorted({day.day for day in chosen}) == days
        assert 200 < len(chosen) < 600
