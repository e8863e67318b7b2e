"""Compaction and vacuum: the same rows in fewer files, and nothing that anyone needs is removed."""

import os
import time
from pathlib import Path

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import fleet_slip
from fleet_slip.grams.update import update_grams
from fleet_slip.operations.rewriting import compact, find_unreferenced, vacuum
from fleet_slip.storage.folder import TEMPORARY_PREFIX
from fleet_slip.storage.local import LocalFolder
from fleet_slip.storage.table import Change
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.logs import DAY, ask, land, log_rows, path_of, random_counts
from tests.support.once import filled_once

ALL_LOGS = "SELECT * FROM log_counts ORDER BY ALL"
ALL_GRAMS = "SELECT * EXCLUDE file FROM grams ORDER BY ALL"


def answers(warehouse: Warehouse) -> list[object]:
    return [ask(warehouse.root, query) for query in (ALL_LOGS, ALL_GRAMS)]


@pytest.fixture
@filled_once
def six(warehouse: Warehouse) -> None:
    """A warehouse of six files of one drive each, with Gram rows."""
    rng = np.random.default_rng(0)
    for name in "fbdaec":
        land(warehouse, name, log_rows(name, random_counts(rng, 100), vehicle_id=f"car-{name}"))
    update_grams(warehouse)


def grow_old(warehouse: Warehouse) -> None:
    """Make all data files older than any retention."""
    for file in path_of(warehouse.root).rglob("*.parquet"):
        os.utime(file, (0, 0))


def test_compaction_keeps_every_row_and_gram_row(six: Warehouse) -> None:
    before = answers(six)
    report = compact(six)
    assert (report.files_before, report.files_after, report.rows_rewritten) == (6, 1, 600)
    assert answers(six) == before
    assert not compact(six).changed
    assert not update_grams(six).changed


def test_the_same_drives_make_the_same_file_however_they_were_divided(
    warehouse: Warehouse, tmp_path: Path
) -> None:
    rng = np.random.default_rng(1)
    drives = [log_rows(name, random_counts(rng, 50)) for name in "abcd"]
    other = Warehouse(LocalFolder(tmp_path / "other"))
    land(warehouse, "one", drives[2], drives[0])
    land(warehouse, "two", drives[3], drives[1])
    for number, drive in enumerate(drives):
        land(other, f"file{number}", drive)
    compact(warehouse)
    compact(other)
    assert [f.path for f in warehouse.logs.snapshot().files] == [
        f.path for f in other.logs.snapshot().files
    ]


def test_columns_that_the_catalog_no_longer_has_are_kept(warehouse: Warehouse) -> None:
    rng = np.random.default_rng(2)
    old = log_rows("a", random_counts(rng, 40)).append_column("retired", pa.array(range(40)))
    action = warehouse.logs.write_file("old", old, DAY)
    warehouse.logs.snapshot().commit(Change(add=[action]))
    land(warehouse, "new", log_rows("b", random_counts(rng, 40)))
    compact(warehouse)
    (path,) = warehouse.logs.snapshot().paths
    retired = pq.read_table(path, columns=["retired"])["retired"].to_pylist()
    assert retired == [*range(40), *[None] * 40]


def test_large_files_are_left_alone_and_small_ones_fill_up_to_the_target(six: Warehouse) -> None:
    compact(six, target_rows=250)
    assert [file.rows for file in six.logs.snapshot().files] == [200, 200, 200]
    assert not compact(six, target_rows=250).changed


def test_a_query_that_began_before_is_not_disturbed_by_compaction_and_vacuum(
    six: Warehouse,
) -> None:
    reader = fleet_slip.connect(six.root, query=ALL_LOGS)
    before = reader.execute(ALL_LOGS).fetchall()
    cursor = duckdb.connect().execute(
        "SELECT drive_id, tick FROM read_parquet($1)", [six.logs.snapshot().paths]
    )
    cursor.fetchone()
    compact(six)
    grow_old(six)
    assert vacuum(six).files == ()
    assert reader.execute(ALL_LOGS).fetchall() == before
    assert len(cursor.fetchall()) == 599


def test_vacuum_removes_replaced_files_after_the_retention(
    six: Warehouse, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = answers(six)
    with monkeypatch.context() as patch:
        patch.setattr("fleet_slip.storage.table._now_ms", lambda: 1000)
        compact(six)
    grow_old(six)
    planned = vacuum(six, dry_run=True)
    assert len(planned.files) == 7  # six log files and the Gram file that named them
    assert vacuum(six).files == planned.files
    assert not find_unreferenced(six.logs)
    assert answers(six) == before
    assert vacuum(six).files == ()


def test_vacuum_leaves_what_a_running_job_is_writing(six: Warehouse) -> None:
    action = six.logs.write_file(
        "new", log_rows("g", random_counts(np.random.default_rng(2), 9)), DAY
    )
    young = path_of(six.root) / "logs" / f"{TEMPORARY_PREFIX}young.parquet"
    old = path_of(six.root) / "models" / f"{TEMPORARY_PREFIX}old"
    for file in (young, old):
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(b"half")
    os.utime(old, (0, 0))
    assert vacuum(six, 1).files == (f"models/{old.name}",)
    six.logs.snapshot().commit(Change(add=[action]))
    assert six.logs.snapshot().rows == 609


@pytest.mark.parametrize("hours", [-24 * 400, 24 * 400])
def test_a_clock_that_was_wrong_removes_nothing_that_is_referred_to(
    six: Warehouse, monkeypatch: pytest.MonkeyPatch, hours: int
) -> None:
    before = answers(six)
    real = time.time
    monkeypatch.setattr(time, "time", lambda: real() + 3600 * hours)
    monkeypatch.setattr(time, "time_ns", lambda: int((real() + 3600 * hours) * 1e9))
    compact(six)
    removed = vacuum(six).files
    monkeypatch.undo()
    assert not removed  # the same clock says that they were just replaced
    assert answers(six) == before
