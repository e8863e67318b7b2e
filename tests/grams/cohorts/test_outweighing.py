"""How many rows a car may count with, beside the others of its cohort."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_slip.grams.cohorts.outweighing import LEAST_CARS, MOST_CARS, most_rows


@pytest.mark.parametrize(
    ("rows", "most"),
    [
        ([30_000] * 100, None),
        ([30_000] * 100 + [8_640_000], 4 * 3_000_000 // 97),
        ([1_000] * 60 + [360_000] * 40, None),  # most cars have sent little yet
        ([1] * 100 + [30_000] * 100, None),  # names that somebody made up
        ([30_000] * 20 + [8_640_000] * 4, 4 * 600_000 // 8),
        ([30_000] * 18 + [8_640_000] * 6, None),  # a quarter of the cars
    ],
)
def test_a_car_counts_as_a_few(rows: list[int], most: int | None) -> None:
    found = most_rows(np.array(rows))
    assert found >= max(rows) if most is None else found == most


@given(st.lists(st.integers(1, 10**7), min_size=LEAST_CARS, max_size=40))
def test_it_is_the_largest_bound_by_the_mean_of_bounded_cars(rows: list[int]) -> None:
    def mean_of_bounded(bound: int) -> float:
        return MOST_CARS * sum(min(one, bound) for one in rows) / len(rows)

    most = most_rows(np.array(rows))
    if most < max(rows):
        assert most <= mean_of_bounded(most)
        assert most + 1 > mean_of_bounded(most + 1)
    else:
        assert max(rows) <= mean_of_bounded(max(rows))
