"""The Gram job against plain Python integers, and its reconciliation with the logs."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fleet_slip.catalog.features import FeatureFile
from fleet_slip.compute.tasks import LocalThreads
from fleet_slip.errors import StorageError
from fleet_slip.grams import update
from fleet_slip.grams.compute import aggregate, compute_grams
from fleet_slip.grams.update import update_grams
from fleet_slip.operations.verify import check_grams, differing_drives, grams_of
from fleet_slip.regression.gram import Gram, packed_size
from fleet_slip.storage.local import LocalFolder
from fleet_slip.storage.table import AppTransaction, Change
from fleet_slip.warehouse.gram_reader import find_backlog, gram_table
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import SIGNALS
from tests.support.logs import DAY, land, log_rows, random_counts

NAMES = SIGNALS.gram_signals


def integer_gram(columns: list[list[int]]) -> tuple[list[int], list[int]]:
    """Sums and packed products by Python integers."""
    products = [
        sum(x * y for x, y in zip(columns[i], columns[j], strict=True))
        for i in range(len(columns))
        for j in range(i + 1)
    ]
    return [sum(column) for column in columns], products


def stored(warehouse: Warehouse) -> dict[tuple[str, tuple[str, ...]], Any]:
    paths = warehouse.grams.snapshot().paths
    return grams_of(pa.concat_tables([pa.parquet.read_table(path) for path in paths]))


def test_gram_rows_equal_sums_of_python_integers_at_the_ends_of_int16(warehouse: Warehouse) -> None:
    counts = {name: random_counts(np.random.default_rng(i), 3000) for i, name in enumerate("ab")}
    land(warehouse, "one", *(log_rows(drive, c) for drive, c in counts.items()))
    update_grams(warehouse)
    for drive, gram in ((key[0], gram) for key, gram in stored(warehouse).items()):
        columns = [counts[drive][name].tolist() for name in gram.signals]
        assert (list(gram.sums), list(gram.products)) == integer_gram(columns)
        assert (gram.n, {*gram.signals}) == (3000, {*NAMES})


def test_rows_that_lack_signals_have_gram_rows_of_their_own(warehouse: Warehouse) -> None:
    counts = random_counts(np.random.default_rng(1), 100)
    complete = {name: counts[name].tolist() for name in NAMES}
    holes = dict(complete, ay=[None if i % 3 == 0 else v for i, v in enumerate(complete["ay"])])
    absent = {name: values for name, values in complete.items() if not name.startswith("wheel")}
    land(warehouse, "one", log_rows("holes", holes), log_rows("absent", absent))
    update_grams(warehouse)
    grams = stored(warehouse)
    assert {(drive, gram.n) for (drive, _), gram in grams.items()} == {
        ("holes", 34), ("holes", 66), ("absent", 100),
    }  # fmt: skip
    without_ay = tuple(sorted({*NAMES} - {"ay"}))
    with_hole = [complete[name][::3] for name in without_ay]
    assert list(grams["holes", without_ay].products) == integer_gram(with_hole)[1]
    present = tuple(sorted(name for name in NAMES if not name.startswith("wheel")))
    assert (
        list(grams["absent", present].products)
        == integer_gram([complete[name] for name in present])[1]
    )
    assert check_grams(warehouse, 1).drives == 2


@settings(
    max_examples=8,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(seed=st.integers(0, 2**32), pieces=st.integers(1, 4), threads=st.integers(1, 3))
def test_rows_do_not_depend_on_files_order_or_threads(
    tmp_path_factory: pytest.TempPathFactory, seed: int, pieces: int, threads: int
) -> None:
    rng = np.random.default_rng(seed)
    drives = [log_rows(f"d{i}", random_counts(rng, int(rng.integers(2, 400)))) for i in range(4)]
    expected = None
    for split in (1, pieces):
        warehouse = Warehouse(LocalFolder(tmp_path_factory.mktemp("root")))
        shuffled = [drives[i] for i in rng.permutation(4)]
        for number, part in enumerate(np.array_split(np.arange(4), split)):
            rows = [shuffled[i].take(rng.permutation(len(shuffled[i]))) for i in part]
            land(warehouse, f"f{number}", *rows)
        with LocalThreads(threads) as executor:
            files = warehouse.logs.snapshot().files
            grams = grams_of(pa.concat_tables(compute_grams(warehouse, files, executor=executor)))
        expected = expected or grams
        assert grams == expected


def test_gram_rows_of_a_file_that_is_gone_are_dropped(warehouse: Warehouse) -> None:
    rng = np.random.default_rng(3)
    for name in "abc":
        land(warehouse, name, log_rows(name, random_counts(rng, 20)))
    update_grams(warehouse)
    logs = warehouse.logs.snapshot()
    removed = next(file for file in logs.files if "/b-" in file.path)
    logs.commit(Change(remove=[removed], transactions=[AppTransaction("test/remove", 1)]))
    assert find_backlog(warehouse.logs.snapshot(), warehouse.grams.snapshot()).stale == {
        removed.path
    }
    assert update_grams(warehouse).files_dropped == 1
    assert {drive for drive, _ in stored(warehouse)} == {"a", "c"}
    assert not update_grams(warehouse).changed


def test_merging_and_rewriting_take_few_rows_at_a_time(
    warehouse: Warehouse, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(update, "FILE_ROWS", 5)
    monkeypatch.setattr(update, "SMALL_FILES_MAX", 4)
    rng = np.random.default_rng(6)
    for number in range(9):
        drives = [log_rows(f"d{number}-{i}", random_counts(rng, 3)) for i in range(3)]
        land(warehouse, f"f{number}", *drives)
        before = {file.path: file.rows for file in warehouse.grams.snapshot().files}
        update_grams(warehouse)
        files = {file.path: file.rows for file in warehouse.grams.snapshot().files}
        assert sum(rows for path, rows in before.items() if path not in files) <= 10
        assert max(files.values()) < 10
    assert sum(rows < 5 for rows in files.values()) <= 5
    first, *remaining = warehouse.logs.snapshot().files
    warehouse.logs.snapshot().commit(Change(remove=[first, *remaining[:5]]))
    update_grams(warehouse)
    assert {drive for drive, _ in stored(warehouse)} == {
        f"d{number}-{i}" for number in range(6, 9) for i in range(3)
    }
    assert check_grams(warehouse, 100).drives == 9


def test_the_check_finds_a_gram_row_that_is_not_of_its_file(
    warehouse: Warehouse, tmp_path: Path
) -> None:
    land(warehouse, "one", log_rows("a", random_counts(np.random.default_rng(5), 30)))
    rows = aggregate(warehouse, warehouse.logs.snapshot().files)
    wrong = rows.set_column(rows.schema.get_field_index("n"), "n", pa.array([31]))
    action = warehouse.grams.write_file("wrong", wrong)
    warehouse.grams.snapshot().commit(Change(add=[action]))
    with pytest.raises(
        StorageError,
        match=r"the Gram row of drive a \(signals\) differs between the kernel and the stored",
    ):
        check_grams(warehouse, 1)
    assert DAY in rows["day"].to_pylist()


A = Gram.from_counts(("ax", "ay"), np.array([[1, 2], [3, 5]]))
B = Gram.from_counts(("ax", "ay"), np.array([[1, 2], [3, 6]]))
KEY = ("ax", "ay")


def test_a_drive_that_one_side_lacks_differs() -> None:
    assert differing_drives({("a", KEY): A}, {("a", KEY): A}) == []
    assert differing_drives({("a", KEY): A}, {("a", KEY): B}) == ["a"]
    assert differing_drives({("b", KEY): A, ("a", KEY): A}, {}) == ["a", "b"]
    assert differing_drives({}, {("a", KEY): A}) == ["a"]
    turned = pa.table(
        {"drive_id": ["a"], "part": pa.nulls(1, pa.string()), "signals": ["ay,ax"], "n": [A.n]}
        | {"sums": [A.restrict(KEY[::-1]).sums], "products": [A.restrict(KEY[::-1]).products]}
    )
    assert differing_drives({("a", KEY): A}, grams_of(turned)) == []
    assert differing_drives({("a", KEY): A}, {("a", ("ax",)): A.restrict(("ax",))}) == ["a"]


def test_gram_rows_that_came_in_pieces_are_one_table() -> None:
    counts = np.random.default_rng(4).integers(-9, 9, (6, 10, 2))
    grams = [Gram.from_counts(("ax", "ay"), item) for item in counts]
    rows = pa.table(
        {
            "n": [gram.n for gram in grams],
            "sums": [gram.sums for gram in grams],
            "products": [gram.products for gram in grams],
        }
    )
    pieces = pa.concat_tables([rows.slice(0, 1), rows.slice(1, 3), rows.slice(4)])
    assert pieces["sums"].num_chunks == 3
    for item in (rows, pieces):
        table = gram_table("ax,ay", item)
        assert table.signals == ("ax", "ay")
        assert table.products.shape == (6, packed_size(2))
        assert [table.sums[i].tolist() for i in range(6)] == [list(g.sums) for g in grams]


def test_no_feature_set_is_called_as_the_rows_of_cars_are() -> None:
    with pytest.raises(ValueError, match="received"):
        FeatureFile.model_validate({"sets": {"received": {}}}, context=SIGNALS)
