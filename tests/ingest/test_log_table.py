"""The Arrow table of measured drives: what it says, and what it takes of memory."""

from datetime import date

import numpy as np
import pyarrow as pa
import pytest

from fleet_slip.catalogue.counts import as_arrow
from fleet_slip.ingest.measured_drives import SHARED_ROWS, MeasuredDrive, log_table
from tests.support.measured import a_mapping


def drive(name: str, rows: int) -> MeasuredDrive:
    """Return a drive whose car is called like it, with `ax` in the order of its ticks."""
    ticks = np.arange(rows, dtype=np.int32)
    known = {"drive_id": name, "vehicle_id": f"car of {name}", "day": date(2024, 5, 31)}
    metadata = {**known, "rows": rows, "track": None}
    return MeasuredDrive(name, metadata, "snap", ticks, {"ax": as_arrow(ticks.astype(np.int16))})


@pytest.mark.parametrize("sizes", [[5], [1, 2, 3], [SHARED_ROWS + 1, 3], [2 * SHARED_ROWS], [0, 4]])
def test_every_row_says_what_is_known_of_its_drive(sizes: list[int]) -> None:
    drives = [drive(f"drive {i}", rows) for i, rows in enumerate(sizes)]
    table = log_table(drives, a_mapping(signals={"ax": {"column": "ax", "unit": "m/s^2"}}))
    rows = [(one, tick) for one in drives for tick in one.ticks.tolist()]
    for column in ("drive_id", "vehicle_id", "rows", "day", "track"):
        assert table[column].to_pylist() == [one.metadata[column] for one, _ in rows]
    assert table["tick"].to_pylist() == [tick for _, tick in rows]
    assert table["vx"].null_count == len(rows)


def test_what_is_the_same_in_all_rows_of_a_drive_is_in_memory_once() -> None:
    rows = 20 * SHARED_ROWS
    table = log_table(
        [drive("one", rows)], a_mapping(signals={"ax": {"column": "ax", "unit": "m/s^2"}})
    )
    own = table.select(["tick", "ax"]).get_total_buffer_size()
    assert own == rows * (4 + 2)
    assert table.get_total_buffer_size() - own < rows * 8
    assert pa.types.is_dictionary(table["drive_id"].type)
