"""Gram rows that integer counts can have pass; others do not, by what they break."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_slip.grams.on_board import INDEFINITE, NO_ROWS, PRODUCTS, SUMS, find_impossible
from fleet_slip.regression.gram import Gram

RANGES = [(-100, 100), (0, 30000), (-32767, 32767)]


def arrays(gram: Gram) -> tuple[Any, Any, Any]:
    return (
        np.array([gram.n], np.int64),
        np.array([gram.sums], np.int64),
        np.array([gram.products], np.int64),
    )


@st.composite
def counts(draw: st.DrawFn) -> Any:
    rows = draw(st.integers(1, 12))
    columns = [st.one_of(st.sampled_from(r), st.integers(*r)) for r in RANGES]
    return np.array([[draw(column) for column in columns] for _ in range(rows)], np.int64)


@settings(max_examples=200)
@given(counts())
def test_what_counts_have_is_possible(rows: Any) -> None:
    assert find_impossible(*arrays(Gram.from_counts("abc", rows)), RANGES) == {}


@pytest.mark.parametrize("value", [-32767, 0, 1, 32767])
def test_the_longest_drive_at_the_ends_of_the_ranges_is_possible(value: int) -> None:
    n = 2**31 - 1
    gram = Gram(("a", "b"), n, (n * value, n * value), (n * value**2,) * 3)
    assert find_impossible(*arrays(gram), [(-32767, 32767)] * 2) == {}


DRIVE = Gram.from_counts("abc", np.array([[3, 5, -7], [4, 5, 900], [-2, 8, 11], [3, 0, 1]]))


@pytest.mark.parametrize(
    ("field", "place", "change", "reason"),
    [
        ("n", 0, -4, NO_ROWS),
        ("n", 0, 2**31, NO_ROWS),
        ("sums", 0, 1000, SUMS),
        ("sums", 1, -100, SUMS),
        ("products", 0, 1, PRODUCTS),  # odd where the sum is even
        ("products", 0, -36, PRODUCTS),  # less than whole numbers of that sum have
        ("products", 5, 2**62, PRODUCTS),
        ("products", 5, -(2**63) + 1, PRODUCTS),
        ("products", 1, 4 * 100 * 30000 + 1, PRODUCTS),
        ("products", 4, 50_000, INDEFINITE),
        ("products", 3, -50_000, INDEFINITE),
    ],
)
def test_what_no_counts_have_is_told(field: str, place: int, change: int, reason: str) -> None:
    known = dict(zip(("n", "sums", "products"), arrays(DRIVE), strict=True))
    values = known[field].reshape(-1)
    values[place] += np.int64(change)
    found = find_impossible(known["n"], known["sums"], known["products"], RANGES)
    assert {why: at.tolist() for why, at in found.items()} == {reason: [0]}


REPEATED = 100_000_000
"""A drive that goes on so long: one unit is 10^-17 of its largest products."""

LONG = Gram.from_counts(
    "abc", np.array([[30000, 30000, 7], [-29000, -29000, 3], [11, 11, 900], [500, 500, -4]])
)
FULL = [(-32767, 32767)] * 3


def repeated(change: int, place: int) -> tuple[Any, Any, Any]:
    n, sums, products = arrays(LONG)
    products = products * REPEATED
    products[0, place] += change
    return n * REPEATED, sums * REPEATED, products


@pytest.mark.parametrize(
    ("change", "place", "reason"),
    [
        (0, 0, None),  # two signals are the same: the matrix is exactly singular
        (-1, 1, None),
        (1, 1, INDEFINITE),
        (1, 3, INDEFINITE),
        (-1, 4, INDEFINITE),
        (2, 0, None),
        (-2, 0, INDEFINITE),
        (-2, 2, INDEFINITE),
        (-2, 5, None),
    ],
)
def test_one_unit_decides(change: int, place: int, reason: str | None) -> None:
    found = find_impossible(*repeated(change, place), FULL)
    assert list(found) == ([reason] if reason else [])


@settings(max_examples=100)
@given(counts(), st.integers(1, REPEATED))
def test_a_long_drive_of_few_different_rows_is_possible(rows: Any, times: int) -> None:
    n, sums, products = arrays(Gram.from_counts("abc", rows))
    assert find_impossible(n * times, sums * times, products * times, RANGES) == {}


def test_each_row_is_judged_by_itself() -> None:
    good, bad = arrays(DRIVE), arrays(DRIVE)
    bad[2][0, 4] += 50_000
    n, sums, products = (np.concatenate([a, b, a]) for a, b in zip(good, bad, strict=True))
    found = find_impossible(n, sums, products, RANGES)
    assert {why: at.tolist() for why, at in found.items()} == {INDEFINITE: [1]}
