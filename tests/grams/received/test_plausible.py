"""Gram rows that integer counts can have pass; others do not, by what they break."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_slip.grams.on_board import INDEFINITE, NO_ROWS, PRODUCTS, SUMS, find_impossible
from fleet_slip.regression.gram import Gram
from tests.support.counts import table_of

RANGES = [(-100, 100), (0, 30000), (-32767, 32767)]


@st.composite
def counts(draw: st.DrawFn) -> Any:
    rows = draw(st.integers(1, 12))
    columns = [st.one_of(st.sampled_from(r), st.integers(*r)) for r in RANGES]
    return np.array([[draw(column) for column in columns] for _ in range(rows)], np.int64)


@settings(max_examples=200)
@given(counts())
def test_what_counts_have_is_possible(rows: Any) -> None:
    assert find_impossible(table_of([Gram.from_counts("abc", rows)]), RANGES) == {}


@pytest.mark.parametrize("value", [-32767, 0, 1, 32767])
def test_the_longest_drive_at_the_ends_of_the_ranges_is_possible(value: int) -> None:
    n = 2**31 - 1
    gram = Gram(("a", "b"), n, (n * value, n * value), (n * value**2,) * 3)
    assert find_impossible(table_of([gram]), [(-32767, 32767)] * 2) == {}


DRIVE = Gram.from_counts("abc", np.array([[3, 5, -7], [4, 5, 900], [-2, 8, 11], [3, 0, 1]]))


@pytest.mark.parametrize(
    ("field", "place", "change", "reason"),
    [
        ("n", 0, -4, NO_ROWS),
        ("n", 0, 2**31, NO_ROWS),
        ("sums", 0, 1000, SUMS),
        ("sums", 1, -100, SUMS),
        ("products", 0, -38, INDEFINITE),
        ("products", 5, 2**62, PRODUCTS),
        ("products", 5, -(2**63) + 1, PRODUCTS),
        ("products", 1, 4 * 100 * 30000 + 1, PRODUCTS),
        ("products", 4, 50_000, INDEFINITE),
        ("products", 3, -50_000, INDEFINITE),
    ],
)
def test_what_no_counts_have_is_told(field: str, place: int, change: int, reason: str) -> None:
    table = table_of([DRIVE])
    getattr(table, field).reshape(-1)[place] += np.int64(change)
    assert find_impossible(table, RANGES) == {0: reason}


def test_each_row_is_judged_by_itself() -> None:
    table = table_of([DRIVE, DRIVE, DRIVE])
    table.products[1, 4] += 50_000
    assert find_impossible(table, RANGES) == {1: INDEFINITE}
