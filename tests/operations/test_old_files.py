"""Files that no version refers to, and the drives in them."""

import numpy as np
import pyarrow as pa
import pytest

from fleet_slip.grams.job import update_grams
from fleet_slip.operations.find_drives import find_old_files, quarantined_of, remove_old_files
from fleet_slip.operations.rewriting import compact
from fleet_slip.warehouse.forgotten import Forgettable
from fleet_slip.warehouse.tables import Warehouse
from tests.support.logs import DAY, land, log_rows, path_of, random_counts


def vehicle(name: str) -> Forgettable:
    return Forgettable("vehicle", name)


@pytest.fixture
def compacted(warehouse: Warehouse) -> Warehouse:
    """Two cars in a file each, and both in one file after compacting: two old files of logs."""
    rng = np.random.default_rng(0)
    for car in ("alfa", "beta"):
        land(warehouse, car, log_rows(f"{car}-1", random_counts(rng, 30), vehicle_id=car))
    update_grams(warehouse)
    compact(warehouse)
    return warehouse


def found(warehouse: Warehouse, subject: Forgettable) -> list[str]:
    """Folder and name of each old file, without its writer and the checksum."""
    old = [one.file for one in find_old_files(warehouse, subject)]
    return [f"{file.folder.name}/{file.path}".rsplit("-x", 1)[0] for file in old]


def test_old_files_with_the_car_are_found_and_no_others_those_of_the_logs_last(
    compacted: Warehouse,
) -> None:
    old = found(compacted, vehicle("alfa"))
    assert old[-1] == "logs/day=2024-05-01/alfa"
    assert len(old) > 1
    assert all(name.startswith("grams/") for name in old[:-1])
    assert found(compacted, vehicle("beta"))[-1] == "logs/day=2024-05-01/beta"
    assert found(compacted, Forgettable("drive", "alfa-1")) == old
    everything = found(compacted, Forgettable("before", "2024-05-02"))
    assert {"logs/day=2024-05-01/alfa", "logs/day=2024-05-01/beta"} < set(everything)
    assert found(compacted, Forgettable("before", "2024-05-01")) == []
    active = {*compacted.logs.snapshot().paths, *compacted.grams.snapshot().paths}
    paths = {str(one.file) for one in find_old_files(compacted, vehicle("alfa"))}
    assert not paths & active


def test_a_leftover_is_deleted_at_once_unless_a_job_may_commit_it(
    warehouse: Warehouse,
) -> None:
    """Of a forgotten car nobody can commit it; of drives before a day the job under way may."""
    rows = log_rows("alfa-1", random_counts(np.random.default_rng(0), 30), vehicle_id="alfa")
    land(warehouse, "other", log_rows("beta-1", random_counts(np.random.default_rng(1), 30)))
    path = path_of(warehouse.logs.folder) / warehouse.logs.write_file("left", rows, DAY).path
    before = Forgettable("before", "2024-05-02")
    assert remove_old_files(warehouse, before, replaced=True).pending == (
        f"logs/{path.relative_to(path_of(warehouse.logs.folder))}",
    )
    assert path.exists()
    assert remove_old_files(warehouse, vehicle("alfa"), replaced=False).deleted == 1
    assert not path.exists()


def test_half_a_file_is_passed_over(compacted: Warehouse) -> None:
    (victim,) = path_of(compacted.logs.folder).rglob("alfa*.parquet")
    victim.write_bytes(victim.read_bytes()[:100])
    left = found(compacted, vehicle("alfa"))
    assert left
    assert "logs/day=2024-05-01/alfa" not in left


def test_refused_rows_are_of_a_drive_or_of_the_whole_that_it_was_cut_from() -> None:
    ids = ["log", "log-1", "log-10", "log2", None]
    rows = pa.table({"drive_id": ids, "vehicle_id": ["a", None, "b", "a", "a"]})
    drive = Forgettable("drive", "log-1")
    assert quarantined_of(rows, drive, set()).to_pylist() == [True, True, False, False, False]
    by_car = quarantined_of(rows, vehicle("a"), {"log-10"}).to_pylist()
    assert by_car == [True, False, True, True, True]
