"""Delta tables below a data root: whole commits or nothing, and units that land once."""

import threading
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from fleet_slip.errors import ConflictError, StorageError
from fleet_slip.storage import TEMPORARY_PREFIX, Change, Unit
from fleet_slip.warehouse import Warehouse
from tests.conftest import DAY, log_rows, random_counts


def rows(drive: str, count: int = 1000) -> object:
    return log_rows(drive, random_counts(np.random.default_rng(0), count))


def test_a_table_that_nobody_wrote_is_empty_and_touches_nothing(warehouse: Warehouse) -> None:
    snapshot = warehouse.logs.snapshot()
    assert (snapshot.version, snapshot.files, snapshot.rows) == (None, (), 0)
    assert not warehouse.root.exists()


def test_a_written_file_is_not_part_of_the_table_before_its_commit(warehouse: Warehouse) -> None:
    action = warehouse.logs.write_file("one", rows("a"), DAY)
    assert warehouse.logs.snapshot().files == ()
    warehouse.logs.snapshot().commit(Change(add=[action], units=[Unit("u", 7)], note={"job": "t"}))
    snapshot = warehouse.logs.snapshot()
    (file,) = snapshot.files
    assert (file.rows, file.day, file.path) == (1000, DAY, "day=2024-05-01/one.parquet")
    assert file.null_counts["ax"] == 0
    assert (snapshot.landed("u"), snapshot.landed("other")) == (7, None)


def test_counts_are_delta_packed_and_strings_are_dictionaries(warehouse: Warehouse) -> None:
    warehouse.logs.write_file("one", rows("a"), DAY)
    columns = pq.read_metadata(warehouse.root / "logs/day=2024-05-01/one.parquet").row_group(0)
    encodings = {
        columns.column(i).path_in_schema: columns.column(i).encodings
        for i in range(columns.num_columns)
    }
    assert "DELTA_BINARY_PACKED" in encodings["ax"]
    assert "RLE_DICTIONARY" in encodings["vehicle_id"]
    assert "day" not in encodings


def test_the_same_rows_make_the_same_bytes(warehouse: Warehouse) -> None:
    path = warehouse.root / "logs/day=2024-05-01/one.parquet"
    warehouse.logs.write_file("one", rows("a"), DAY)
    first = path.read_bytes()
    warehouse.logs.write_file("one", rows("a"), DAY)
    assert path.read_bytes() == first
    assert not list(path.parent.glob(f"{TEMPORARY_PREFIX}*"))


def test_a_unit_lands_once_however_many_try(warehouse: Warehouse) -> None:
    action = warehouse.logs.write_file("one", rows("a"), DAY)
    warehouse.logs.snapshot().commit(Change(add=[action], units=[Unit("u", 1)]))
    stale = [warehouse.logs.snapshot() for _ in range(6)]
    outcomes: list[str] = []

    def attempt(number: int) -> None:
        extra = warehouse.logs.write_file(f"extra-{number}", rows(f"d{number}", 10), DAY)
        try:
            stale[number].commit(Change(add=[extra], units=[Unit("same", 3)]))
        except ConflictError:
            outcomes.append("conflict")
        else:
            outcomes.append("landed")

    threads = [threading.Thread(target=attempt, args=(n,)) for n in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(outcomes) == ["conflict"] * 5 + ["landed"]
    assert len(warehouse.logs.snapshot().files) == 2


def test_different_units_land_side_by_side(warehouse: Warehouse) -> None:
    snapshots = [warehouse.logs.snapshot() for _ in range(4)]
    for number, snapshot in enumerate(snapshots):
        action = warehouse.logs.write_file(f"f{number}", rows(f"d{number}", 10), DAY)
        snapshot.commit(Change(add=[action], units=[Unit(f"unit-{number}", 1)]))
    assert warehouse.logs.snapshot().rows == 40


def test_a_snapshot_does_not_see_later_commits(warehouse: Warehouse) -> None:
    first = warehouse.logs.write_file("one", rows("a"), DAY)
    warehouse.logs.snapshot().commit(Change(add=[first], units=[Unit("1", 1)]))
    before = warehouse.logs.snapshot()
    second = warehouse.logs.write_file("two", rows("b"), DAY)
    warehouse.logs.snapshot().commit(Change(add=[second], units=[Unit("2", 1)]))
    assert (before.rows, warehouse.logs.snapshot().rows) == (1000, 2000)


def test_a_root_that_is_a_file_is_told_with_a_next_step(tmp_path: Path) -> None:
    (tmp_path / "data").write_text("not a folder")
    with pytest.raises(
        StorageError, match=r"Choose another --root|not a directory|Not a directory"
    ):
        Warehouse(tmp_path / "data").logs.write_file("one", rows("a"), DAY)


def test_a_damaged_log_is_told(warehouse: Warehouse) -> None:
    action = warehouse.logs.write_file("one", rows("a"), DAY)
    warehouse.logs.snapshot().commit(Change(add=[action], units=[Unit("u", 1)]))
    for entry in (warehouse.root / "logs/_delta_log").glob("*.json"):
        entry.write_text("{ damaged")
    with pytest.raises(StorageError, match="the Delta log cannot be used"):
        warehouse.logs.snapshot()
