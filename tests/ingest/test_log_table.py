"""The Arrow table of measured drives: what it says."""

import sys
from datetime import date
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from fleet_slip.catalogue.signals import as_arrow
from fleet_slip.ingest.drives import MeasuredDrive
from fleet_slip.ingest.load import log_table
from tests.support.commands import run
from tests.support.measured import a_mapping, csv_text, good_columns

INGEST = """
import sys
from pathlib import Path
from fleet_slip.storage.local import LocalFolder
from fleet_slip.ingest.load import ingest_files
from fleet_slip.ingest.mapping import Mapping
from fleet_slip.warehouse.tables import Warehouse
root, log, mapping = sys.argv[1:]
warehouse = Warehouse(LocalFolder(Path(root)))
(_,) = ingest_files(warehouse, [Path(log)], Mapping.model_validate_json(mapping))
assert "polars" in sys.modules
assert "pandas" not in sys.modules
"""


def drive(name: str, rows: int) -> MeasuredDrive:
    """Return a drive whose car is called like it, with `ax` in the order of its ticks."""
    ticks = np.arange(rows, dtype=np.int32)
    known = {"drive_id": name, "vehicle_id": f"car of {name}", "day": date(2024, 5, 31)}
    metadata = {**known, "rows": rows, "track": None}
    return MeasuredDrive(name, metadata, "snap", ticks, {"ax": as_arrow(ticks.astype(np.int16))})


@pytest.mark.parametrize("sizes", [[5], [1, 2, 3], [0, 4]])
def test_every_row_says_what_is_known_of_its_drive(sizes: list[int]) -> None:
    drives = [drive(f"drive {i}", rows) for i, rows in enumerate(sizes)]
    table = log_table(drives, a_mapping(signals={"ax": {"column": "ax", "unit": "m/s^2"}}))
    rows = [(one, tick) for one in drives for tick in one.ticks.tolist()]
    for column in ("drive_id", "vehicle_id", "rows", "day", "track"):
        assert table[column].to_pylist() == [one.metadata[column] for one, _ in rows]
    assert table["tick"].to_pylist() == [tick for _, tick in rows]
    assert pa.types.is_dictionary(table["drive_id"].type)
    assert table["vx"].null_count == len(rows)


def test_pandas_which_would_take_a_tenth_of_the_memory_is_not_loaded(tmp_path: Path) -> None:
    columns = good_columns()
    columns["t"][10:] = [f"{i / 100 + 0.305:.3f}" for i in range(10, 20)]  # ticks without a value
    columns["ax"][0] = columns["beta"][1] = None
    log = tmp_path / "log.csv"
    log.write_text(csv_text(columns))
    mapping = a_mapping().canonical_json()
    done = run([sys.executable, "-c", INGEST, str(tmp_path / "data"), str(log), mapping])
    assert not done.exit_code, done.stderr
