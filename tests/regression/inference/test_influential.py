"""Cars of unusual influence: leave-one-out by subtraction is leave-one-out by rows."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_slip.errors import DataError
from fleet_slip.regression.drives import LEAST_CARS, DriveMoments, find_influential
from fleet_slip.regression.gram import Gram
from tests.support.counts import table_of

SIGNALS = ("a", "b", "y")


def rows_of(seed: int, cars: int = 30, rows: int = 60) -> list[np.ndarray]:
    """Counts of honest cars: y is a sum of a and b, with noise and a little of each car."""
    random = np.random.default_rng(seed)
    found = []
    for _ in range(cars):
        x = random.integers(-2000, 2000, (rows, 2))
        y = x @ (0.5, -0.3) + random.normal(0, 30, rows) + random.normal(0, 5)
        found.append(np.column_stack([x, np.rint(y)]).astype(np.int64))
    return found


def found_in(cars: list[np.ndarray]) -> dict[int, float]:
    moments = DriveMoments.of(table_of([Gram.from_counts(SIGNALS, rows) for rows in cars]))
    return {one.car: one.times for one in find_influential(moments, np.arange(len(cars)))}


def influence_by_rows(cars: list[np.ndarray], left: int) -> float:
    """Fit all rows, and all but those of a car, by numpy's least squares."""
    every = np.concatenate(cars)
    others = np.concatenate([rows for i, rows in enumerate(cars) if i != left])
    fits = [
        np.linalg.lstsq(np.column_stack([np.ones(len(r)), r[:, :2]]), r[:, 2], rcond=None)[0]
        for r in (every, others)
    ]
    change = np.column_stack([np.ones(len(every)), every[:, :2]]) @ (fits[0] - fits[1])
    return float(np.sqrt(np.mean(change**2)))


def leverage_by_rows(cars: list[np.ndarray], car: int) -> tuple[float, float]:
    """Return trace and sum of squares of a car's block of the hat matrix of all rows."""
    x = np.concatenate([np.column_stack([np.ones(len(r)), r[:, :2]]) for r in cars])
    first = sum(len(rows) for rows in cars[:car])
    mine = slice(first, first + len(cars[car]))
    block = x[mine] @ np.linalg.pinv(x)[:, mine]
    return float(np.trace(block)), float((block**2).sum())


def of_drives(drives: Sequence[int], seed: int, wrong: float = 1.0) -> DriveMoments:
    """Return moments of cars of so many drives; the first has its label times `wrong`.

    Coefficients differ a little from car to car, the offset from drive to drive.
    """
    random = np.random.default_rng(seed)
    grams = []
    for car, many in enumerate(drives):
        own = np.array((0.5, -0.3)) + random.normal(0, 0.01, 2)
        total = None
        for _ in range(many):
            x = random.integers(-2000, 2000, (60, 2))
            y = x @ own + random.normal(0, 30, 60) + random.normal(0, 10)
            rows = np.column_stack([x, np.rint(y * (wrong if car == 0 else 1))])
            gram = Gram.from_counts(SIGNALS, rows.astype(np.int64))
            total = gram if total is None else total + gram
        assert total is not None
        grams.append(total)
    return DriveMoments.of(table_of(grams))


@pytest.mark.parametrize("drives", [(30, *[3] * 39), (1800, *[5] * 40)])
def test_an_honest_car_of_many_drives_stays(drives: tuple[int, ...]) -> None:
    """Ten times the drives, or 1,800 of 2,000, are ten times the influence, by right."""
    for seed in range(10 if drives[0] < 100 else 1):
        found = find_influential(of_drives(drives, seed), np.arange(len(drives)))
        assert 0 not in {one.car for one in found}


@pytest.mark.parametrize("many", [1, 3, 30])
def test_a_car_with_a_wrong_sensor_goes_whatever_its_drives(many: int) -> None:
    drives = (many, *[3] * 39)
    for seed in range(5):
        found = find_influential(of_drives(drives, seed, wrong=1.5), np.arange(40))
        assert found[0].car == 0
        assert found[0].rows == pytest.approx(many / sum(drives))


@settings(max_examples=10)
@given(st.integers(0, 100))
def test_the_multiple_of_the_median_is_that_of_fits_to_rows(seed: int) -> None:
    cars = rows_of(seed)
    cars[4][:, 2] *= -1
    found = found_in(cars)
    assert 4 in found
    given = np.array([leverage_by_rows(cars, i) for i in range(len(cars))])
    allowed = np.sqrt((given / np.median(given, axis=0)).max(axis=1))
    by_rows = [influence_by_rows(cars, i) for i in range(len(cars))] / allowed
    assert found[4] == pytest.approx(by_rows[4] / float(np.exp(np.median(np.log(by_rows)))))


def test_an_input_that_repeats_another_changes_nothing() -> None:
    cars = rows_of(3)
    cars[7][:, 2] += 4000
    doubled = [np.column_stack([rows[:, 0], rows]) for rows in cars]
    table = table_of([Gram.from_counts(("c", *SIGNALS), rows) for rows in doubled])
    found = find_influential(DriveMoments.of(table), np.arange(len(cars)))
    assert {one.car: pytest.approx(one.times, rel=1e-6) for one in found} == found_in(cars)


def test_several_drives_of_a_car_are_one_car() -> None:
    cars = rows_of(5)
    cars[2][:, 2] *= -1
    halves = [half for rows in cars for half in np.array_split(rows, 2)]
    moments = DriveMoments.of(table_of([Gram.from_counts(SIGNALS, rows) for rows in halves]))
    found = find_influential(moments, np.repeat(np.arange(len(cars)), 2))
    assert {one.car: pytest.approx(one.times) for one in found} == found_in(cars)


def test_at_most_a_tenth_is_left_out() -> None:
    cars = rows_of(1, cars=40)
    for car in range(6):
        cars[car][:, 2] *= -1 - car
    assert len(found_in(cars)) <= 4


def test_few_cars_do_not_tell_what_is_usual() -> None:
    with pytest.raises(DataError, match=f"takes {LEAST_CARS} of them, and these drives are of 5"):
        found_in(rows_of(1, cars=5))
