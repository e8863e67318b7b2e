"""What was forgotten does not land again: its rows are left out, good and refused, no others."""

from pathlib import Path
from typing import Literal

import pyarrow as pa
import pytest

from fleet_slip.files.local_folder import LocalFolder
from fleet_slip.ingest import MeasuredLog
from fleet_slip.ingest.forgotten import without_forgotten
from fleet_slip.warehouse.audit import Audit, Forgettable
from tests.support.measured import a_mapping, good_columns, read_columns


def two_cars(folder: Path) -> MeasuredLog:
    """A log of the cars a and b, a drive each, the last row of each refused."""
    columns = {name: values * 2 for name, values in good_columns(20).items()}
    columns["car"] = ["a"] * 20 + ["b"] * 20
    columns["ax"] = list(columns["ax"])
    columns["ax"][19] = columns["ax"][39] = "broken"
    return read_columns(folder, columns, a_mapping(drive={"vehicle_id": {"column": "car"}}))


def cars(rows: pa.Table) -> set[str]:
    return set(rows["vehicle_id"].cast(pa.string()).to_pylist())


def test_without_a_record_all_rows_are_kept(tmp_path: Path) -> None:
    log = two_cars(tmp_path)
    kept = without_forgotten(log.drives, log.quarantine, Audit(LocalFolder(tmp_path / "data")))
    assert (kept.logs.num_rows, kept.quarantine.num_rows) == (
        log.drives.num_rows,
        log.quarantine.num_rows,
    )
    assert (set(kept.vehicles), kept.left_out) == ({"a", "b"}, 0)


@pytest.mark.parametrize("kind", ["vehicle", "drive"])
def test_the_rows_of_what_was_forgotten_are_left_out(
    kind: Literal["vehicle", "drive"], tmp_path: Path
) -> None:
    log = two_cars(tmp_path)
    of_a = [one for one in log.drives.to_pylist() if one["vehicle_id"] == "a"]
    value = "a" if kind == "vehicle" else of_a[0]["drive_id"]
    audit = Audit(LocalFolder(tmp_path / "data"))
    audit.begin(Forgettable(kind, value), 1, [], {})
    kept = without_forgotten(log.drives, log.quarantine, audit)
    assert cars(log.drives) == cars(log.quarantine) == {"a", "b"}
    assert cars(kept.logs) == cars(kept.quarantine) == {"b"}
    assert kept.logs.num_rows == log.drives.num_rows - len(of_a)
    assert kept.left_out == 1
