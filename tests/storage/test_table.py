"""Delta tables below a data root: whole commits or nothing, and transactions that land once."""

import gc
import hashlib
import pickle
import shutil
import threading
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import xxhash
from deltalake import DeltaTable

from fleet_slip.errors import ConflictError, StorageError
from fleet_slip.storage.data_files import (
    CHECKSUM_DIGITS,
    ROW_GROUP_ROWS,
    Encoding,
    checksum_in,
    checksum_of,
)
from fleet_slip.storage.folder import TEMPORARY_PREFIX
from fleet_slip.storage.local import LocalFolder
from fleet_slip.storage.table import AppTransaction, Change, retry_conflicts
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.logs import DAY, land, log_rows, path_of, random_counts


def rows(drive: str, count: int = 1000) -> object:
    return log_rows(drive, random_counts(np.random.default_rng(0), count))


def test_a_table_that_nobody_wrote_is_empty_and_touches_nothing(warehouse: Warehouse) -> None:
    snapshot = warehouse.logs.snapshot()
    assert (snapshot.version, snapshot.files, snapshot.rows) == (None, (), 0)
    assert not warehouse.root.exists()


def test_a_written_file_is_not_part_of_the_table_before_its_commit(warehouse: Warehouse) -> None:
    action = warehouse.logs.write_file("one", rows("a"), DAY)
    assert warehouse.logs.snapshot().files == ()
    warehouse.logs.snapshot().commit(
        Change(add=[action], transactions=[AppTransaction("u", 7)], note={"job": "t"})
    )
    snapshot = warehouse.logs.snapshot()
    (file,) = snapshot.files
    assert (file.rows, file.day, file.path) == (1000, DAY, action.path)
    assert file.null_counts["ax"] == 0
    assert (snapshot.transaction_version("u"), snapshot.transaction_version("other")) == (7, None)


def test_the_same_rows_make_the_same_bytes_by_which_their_file_is_named(
    warehouse: Warehouse,
) -> None:
    paths = [warehouse.logs.write_file("one", rows("a"), DAY).path for _ in range(2)]
    contents = [(path_of(warehouse.logs.folder) / path).read_bytes() for path in paths]
    assert contents[0] == contents[1]
    fast, checksum = xxhash.xxh3_64_hexdigest(contents[0]), checksum_of(contents[0])
    assert checksum == hashlib.sha256(contents[0]).hexdigest()[:32]
    assert paths[0] == f"day=2024-05-01/one-x{fast}-{checksum}.parquet"
    assert checksum_in(paths[1]) == checksum
    assert paths[1] != paths[0]  # each name has one writer, who may delete it until its commit
    assert checksum_in("day=2024-05-01/smoke-0000-0123456789ab.parquet") is None
    assert not list(path_of(warehouse.root).rglob(f"{TEMPORARY_PREFIX}*"))


def test_a_unit_lands_once_however_many_try(warehouse: Warehouse) -> None:
    land(warehouse, "one", rows("a"))
    stale = [warehouse.logs.snapshot() for _ in range(6)]
    outcomes: list[str] = []

    def attempt(number: int) -> None:
        extra = warehouse.logs.write_file(f"extra-{number}", rows(f"d{number}", 10), DAY)
        try:
            stale[number].commit(Change(add=[extra], transactions=[AppTransaction("same", 3)]))
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


def test_a_unit_lands_once_in_a_table_that_was_not_there_a_moment_ago(warehouse: Warehouse) -> None:
    action = warehouse.logs.write_file("one", rows("a"), DAY)
    change = Change(add=[action], transactions=[AppTransaction("u", 1)])
    before, also_before = (warehouse.logs.snapshot() for _ in range(2))
    before.commit(change)
    with pytest.raises(ConflictError, match="Run the same command again"):
        also_before.commit(change)
    assert warehouse.logs.snapshot().rows == 1000


def test_transactions_are_those_of_the_delta_library(warehouse: Warehouse) -> None:
    for number in range(4):
        action = warehouse.logs.write_file(f"f{number}", rows(f"d{number}", 10), DAY)
        transactions = [AppTransaction(f"transaction-{number}-{i}", 1) for i in range(3)]
        warehouse.logs.snapshot().commit(Change(add=[action], transactions=transactions))
        if number == 1:
            DeltaTable(str(path_of(warehouse.logs.folder))).create_checkpoint()
    names = [f"transaction-{number}-{i}" for number in range(5) for i in range(4)]
    commits = sorted((path_of(warehouse.root) / "logs/_delta_log").glob("*.json"))
    commits[1].unlink()  # what the checkpoint sums up, Delta removes in time
    earlier, now = warehouse.logs.snapshot(3), warehouse.logs.snapshot()
    for snapshot, number in ((earlier, 9), (now, 12)):
        assert snapshot.delta is not None
        landed = [snapshot.has_committed(name) for name in names]
        assert landed == [snapshot.delta.transaction_version(n) is not None for n in names]
        assert sum(landed) == number
    assert not any(map(warehouse.quarantine.snapshot().has_committed, names))


def test_a_root_that_is_a_file_is_told_with_a_next_step(tmp_path: Path) -> None:
    (tmp_path / "data").write_text("not a folder")
    with pytest.raises(StorageError, match=r"Choose another path|not a directory|Not a directory"):
        Warehouse(LocalFolder(tmp_path / "data")).logs.write_file("one", rows("a"), DAY)


def test_a_conflict_is_retried_and_the_last_one_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    waits: list[float] = []
    monkeypatch.setattr("fleet_slip.storage.table.time.sleep", waits.append)
    outcomes = [ConflictError("once"), ConflictError("twice"), "done"]

    def attempt() -> object:
        outcome = outcomes.pop(0) if outcomes else ConflictError("always")
        if isinstance(outcome, ConflictError):
            raise outcome
        return outcome

    assert retry_conflicts(attempt) == "done"
    assert len(waits) == 2
    waits.clear()
    monkeypatch.setattr("fleet_slip.storage.table.random.uniform", lambda _, longest: longest)
    with pytest.raises(ConflictError, match="always"):
        retry_conflicts(attempt)
    doubled = [0.02, 0.04, 0.08, 0.16, 0.32, 0.64, 1.28, 2.56]
    assert waits == pytest.approx([*doubled, 5, 5, 5])


def test_a_removal_conflicts_with_a_removal_of_the_same_file(warehouse: Warehouse) -> None:
    for name in "ab":
        action = warehouse.logs.write_file(name, rows(name, 10), DAY)
        warehouse.logs.snapshot().commit(Change(add=[action]))
    first, second = warehouse.logs.snapshot(), warehouse.logs.snapshot()
    first.commit(Change(remove=first.files[:1]))
    with pytest.raises(ConflictError, match="Run the same command again"):
        second.commit(Change(remove=second.files[:1]))
    assert len(warehouse.logs.snapshot().files) == 1


def test_files_of_a_commit_are_added_and_removed(warehouse: Warehouse) -> None:
    action = warehouse.logs.write_file("one", rows("a", 10), DAY)
    warehouse.logs.snapshot().commit(Change(add=[action]))
    snapshot = warehouse.logs.snapshot()
    snapshot.commit(Change(add=[action], remove=snapshot.files))
    assert [file.path for file in warehouse.logs.snapshot().files] == [action.path]


@pytest.mark.parametrize(
    ("number", "message"), [(28, "the disk is full"), (30, "read-only"), (13, "permission denied")]
)
def test_a_fault_during_a_commit_is_told_as_what_it_is(
    warehouse: Warehouse, monkeypatch: pytest.MonkeyPatch, number: int, message: str
) -> None:
    action = warehouse.logs.write_file("one", rows("a", 10), DAY)
    warehouse.logs.snapshot().commit(Change(add=[action]))

    def fail(*_arguments: object, **_options: object) -> None:
        raise OSError(f"Generic LocalFileSystem error\n Unable to copy (os error {number})")

    snapshot = warehouse.logs.snapshot()
    monkeypatch.setattr("deltalake.DeltaTable.create_write_transaction", fail)
    with pytest.raises(StorageError, match=message):
        snapshot.commit(Change(add=[action]))


def test_a_damaged_log_is_told(warehouse: Warehouse) -> None:
    land(warehouse, "one", rows("a"))
    for entry in (path_of(warehouse.root) / "logs/_delta_log").glob("*.json"):
        entry.write_text("{ damaged")
    with pytest.raises(StorageError, match="the Delta log cannot be used"):
        warehouse.logs.snapshot()


COUNTS = {"ax": np.arange(5), "sideslip": np.arange(5)}


def test_a_table_is_opened_again_after_a_commit_of_anybody(
    warehouse: Warehouse, monkeypatch: pytest.MonkeyPatch
) -> None:
    land(warehouse, "one", log_rows("one", COUNTS))
    opened: list[str] = []

    def opening(uri: str, **options: Any) -> DeltaTable:
        opened.append(uri)
        return DeltaTable(uri, **options)

    monkeypatch.setattr("deltalake.DeltaTable", opening)
    first = warehouse.logs.snapshot()
    assert len(first.files) == 1
    opened.clear()
    again = warehouse.logs.snapshot()
    assert (again is first, first.refresh() is first, opened) == (True, True, [])
    delta = DeltaTable(first.table.uri("")[:-1])  # as another process does
    delta.alter.set_table_properties({"by": "another"}, raise_if_not_exists=False)
    newer = warehouse.logs.snapshot()
    assert (newer.version, first.version) == (delta.version(), delta.version() - 1)
    assert first.refresh() is newer
    land(warehouse, "two", log_rows("two", COUNTS))
    assert len(warehouse.logs.snapshot().files) == 2
    assert len(newer.files) == len(first.files) == 1


def test_a_warehouse_owns_its_snapshots_and_releases_them(warehouse: Warehouse) -> None:
    land(warehouse, "one", log_rows("one", COUNTS))
    snapshot = warehouse.logs.snapshot()
    assert Warehouse(warehouse.root).logs.snapshot() is not snapshot
    assert pickle.loads(pickle.dumps(warehouse.logs)) == warehouse.logs  # noqa: S301
    released = weakref.ref(snapshot)
    warehouse.close()
    del snapshot
    gc.collect()
    assert released() is None


def test_a_table_in_the_place_of_another_is_opened(warehouse: Warehouse) -> None:
    land(warehouse, "one", log_rows("one", COUNTS))
    assert warehouse.logs.snapshot().rows == 5
    shutil.rmtree(path_of(warehouse.root) / "logs")
    assert warehouse.logs.snapshot().version is None
    land(warehouse, "two", log_rows("two", {name: np.arange(7) for name in COUNTS}))
    assert warehouse.logs.snapshot().rows == 7


def test_the_encodings_are_those_asked_for_in_groups_of_a_fixed_size() -> None:
    count = ROW_GROUP_ROWS + 1
    columns = {"car": ["a"] * count, "ax": pa.array(range(count), pa.int32())}
    encoding = Encoding(dictionary=("car",), delta_packed=("ax",), compression="zstd")
    encoded = encoding.encode(pa.table(columns))
    metadata = pq.read_metadata(pa.BufferReader(encoded.content))
    assert [metadata.row_group(i).num_rows for i in range(metadata.num_row_groups)] == [
        count - 1,
        1,
    ]
    car, ax = (metadata.row_group(0).column(i) for i in range(2))
    assert "RLE_DICTIONARY" in car.encodings
    assert "DELTA_BINARY_PACKED" in ax.encodings
    assert car.compression == "ZSTD"
    assert encoded.checksum == checksum_of(encoded.content)
    assert len(encoded.checksum) == CHECKSUM_DIGITS
    assert encoding.encode(pa.table(columns)).checksum == encoded.checksum
