"""What was forgotten does not land again: its rows are left out, good and refused, no others."""

from pathlib import Path
from typing import Literal

import pyarrow as pa
import pytest

from fleet_slip.ingest.drives import MeasuredDrive
from fleet_slip.ingest.recordings import keep_drives, keep_refused
from fleet_slip.ingest.stream import open_measured
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.forgotten import Audit, Forgettable
from tests.support.measured import a_mapping, csv_text, good_columns


def two_cars(folder: Path) -> tuple[list[MeasuredDrive], pa.Table]:
    """The drives of a log of the cars a and b, one each, and its refused rows: the last of each."""
    columns = {name: values * 2 for name, values in good_columns(20).items()}
    columns["car"] = ["a"] * 20 + ["b"] * 20
    columns["ax"] = list(columns["ax"])
    columns["ax"][19] = columns["ax"][39] = "broken"
    mapping = a_mapping(drive={"vehicle_id": {"column": "car"}})
    file = folder / "log.csv"
    file.write_text(csv_text(columns))
    with open_measured(file, mapping) as stream:
        return list(stream.drives()), next(stream.quarantine())


def cars(rows: pa.Table) -> set[str]:
    return set(rows["vehicle_id"].cast(pa.string()).to_pylist())


def test_without_a_record_all_rows_are_kept(tmp_path: Path) -> None:
    drives, refused = two_cars(tmp_path)
    audit = Audit(LocalFolder(tmp_path / "data"))
    assert keep_drives(drives, audit) == drives
    assert keep_refused(refused, audit) == refused


@pytest.mark.parametrize("kind", ["vehicle", "drive"])
def test_the_rows_of_what_was_forgotten_are_left_out(
    kind: Literal["vehicle", "drive"], tmp_path: Path
) -> None:
    drives, refused = two_cars(tmp_path)
    of_a, of_b = drives
    audit = Audit(LocalFolder(tmp_path / "data"))
    audit.begin(Forgettable(kind, "a" if kind == "vehicle" else of_a.drive_id), 1, [], {})
    assert keep_drives(drives, audit) == [of_b]
    assert cars(refused) == {"a", "b"}
    assert cars(keep_refused(refused, audit)) == {"b"}


def test_the_refused_rows_of_a_drive_go_with_any_stretch_of_it(tmp_path: Path) -> None:
    _, refused = two_cars(tmp_path)
    stretch = f"{refused['drive_id'][0]}-2"
    audit = Audit(LocalFolder(tmp_path / "data"))
    audit.begin(Forgettable("drive", stretch), 1, [], {})
    assert cars(keep_refused(refused, audit, {stretch})) == {"b"}
    assert cars(keep_refused(refused, audit)) == {"a", "b"}
