"""Gram rows compared: what differs is told, whichever side lacks it."""

import numpy as np
import pyarrow as pa
import pytest

from fleet_slip.grams.check import check_grams, differing_drives
from fleet_slip.grams.gram_files import gram_table
from fleet_slip.grams.job import update_grams
from fleet_slip.regression.gram import Gram, packed_size
from fleet_slip.warehouse.tables import Warehouse
from tests.support.logs import land, log_rows, random_counts

A = Gram.from_counts(("ax", "ay"), np.array([[1, 2], [3, 5]]))
B = Gram.from_counts(("ax", "ay"), np.array([[1, 2], [3, 6]]))
KEY = ("ax", "ay")


def test_a_drive_that_one_side_lacks_differs() -> None:
    assert differing_drives({("a", KEY): A}, {("a", KEY): A}) == []
    assert differing_drives({("a", KEY): A}, {("a", KEY): B}) == ["a"]
    assert differing_drives({("b", KEY): A, ("a", KEY): A}, {}) == ["a", "b"]
    assert differing_drives({}, {("a", KEY): A}) == ["a"]
    turned = A.restrict(("ay", "ax"))
    assert differing_drives({("a", KEY): A}, {("a", ("ay", "ax")): turned}) == []
    assert differing_drives({("a", KEY): A}, {("a", ("ax",)): A.restrict(("ax",))}) == ["a"]


@pytest.mark.parametrize("drives", [1, 3, 8])
def test_files_are_chosen_evenly(warehouse: Warehouse, drives: int) -> None:
    rng = np.random.default_rng(2)
    for number in range(5):
        land(warehouse, f"f{number}", log_rows(f"d{number}", random_counts(rng, 20)))
    update_grams(warehouse)
    seen: list[tuple[int, int]] = []
    report = check_grams(warehouse, drives, lambda more, total: seen.append((more, total)))
    assert (report.files, report.drives) == (min(drives, 5),) * 2
    assert report.rows == 20 * min(drives, 5)
    assert seen == [(1, min(drives, 5))] * min(drives, 5)


def test_gram_rows_that_came_in_pieces_are_one_table() -> None:
    counts = np.random.default_rng(4).integers(-9, 9, (6, 10, 2))
    grams = [Gram.from_counts(("ax", "ay"), one) for one in counts]
    rows = pa.table(
        {
            "n": [gram.n for gram in grams],
            "sums": [gram.sums for gram in grams],
            "products": [gram.products for gram in grams],
        }
    )
    pieces = pa.concat_tables([rows.slice(0, 1), rows.slice(1, 3), rows.slice(4)])
    assert pieces["sums"].num_chunks == 3
    for one in (rows, pieces):
        table = gram_table("ax,ay", one)
        assert table.signals == ("ax", "ay")
        assert table.products.shape == (6, packed_size(2))
        assert [table.sums[i].tolist() for i in range(6)] == [list(g.sums) for g in grams]
