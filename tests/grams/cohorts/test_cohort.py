"""Cohorts of Gram rows: which drives have which signals, their folds, and the reader."""

import numpy as np
import pyarrow as pa
import pytest

from fleet_slip.errors import DataError
from fleet_slip.grams.cohort import (
    FULL_WEIGHT,
    MAX_LOST_SHARE,
    Cohort,
    DriveWeights,
    FoldKey,
    assign_folds,
    clustered_moments,
    hash_names,
    load_cohort,
    robust_weights,
    weighted,
)
from fleet_slip.grams.update import update_grams
from fleet_slip.regression.gram import Gram, GramTable
from fleet_slip.regression.inference import DriveMoments
from fleet_slip.warehouse.database import parse_predicate
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import CATALOG, SIGNALS
from tests.support.counts import INPUTS, LABEL, cohort_of, driven, gram_of, rows_of, table_of
from tests.support.logs import land, log_rows, random_counts

ROWS = [("a", "ax,ay"), ("b", "ax,ay"), ("b", "ax,ay,yaw_rate"), ("c", "ax,ay,yaw_rate")]
"""Drive b has rows of both kinds; c came without a log."""


def hashes(names: list[str]) -> list[int]:
    return sorted(hash_names(pa.array(names)).tolist())


def cohort() -> Cohort:
    columns = {
        "drive_hash": hash_names(pa.array([drive for drive, _ in ROWS])),
        "vehicle_hash": [7] * len(ROWS),
        "source": ["received" if drive == "c" else "simulated" for drive, _ in ROWS],
        "signals": [signals for _, signals in ROWS],
        "n": [10] * len(ROWS),
    }
    return Cohort(
        predicate=parse_predicate(SIGNALS, "true"),
        logs_version=1,
        grams_version=1,
        drives=pa.table(columns),
        catalog=CATALOG,
    )


def test_drives_with_signals_are_those_of_rows_that_have_them_all() -> None:
    assert cohort().hash_drives_with(["ay", "ax"]).tolist() == hashes(["a", "b", "c"])
    assert cohort().hash_drives_with(["ay", "yaw_rate"]).tolist() == hashes(["b", "c"])
    assert cohort().hash_drives_with(["yaw"]).tolist() == []


def test_a_car_counts_once() -> None:
    assert cohort().count_vehicles_with(["ax"]) == 1
    assert cohort().count_vehicles_with(["steering_wheel"]) == 0
    assert cohort().count_onboard_with(["ax"]) == 1
    assert (cohort().rows, cohort().drive_count) == (40, 3)


def test_the_statement_hashes_names_as_python_does(warehouse: Warehouse) -> None:
    land(warehouse, "one", log_rows("dé", random_counts(np.random.default_rng(1), 40)))
    update_grams(warehouse)
    cohort = load_cohort(warehouse)
    for name in ("drive", "vehicle"):
        hashes = hash_names(cohort.drives[f"{name}_id"])
        assert cohort.drives[f"{name}_hash"].to_pylist() == hashes.tolist()


COEFFICIENTS = (0.1, 0.4, 0.9, 0.2)


@pytest.mark.parametrize(
    ("by", "column"), [("drive", "drive_id"), ("vehicle", "vehicle_id"), ("day", "day")]
)
def test_a_fold_holds_out_whole_drives_cars_or_days(by: FoldKey, column: str) -> None:
    drives = driven(1, COEFFICIENTS, drives=20)
    cohort = cohort_of(drives)
    values = cohort.drives[column].to_pylist()
    assignment = assign_folds(values, by, 4)
    pairs = set(zip(values, assignment.fold.tolist(), strict=True))
    assert len(pairs) == len({value for value, _ in pairs})
    folds = cohort.folds(by, 4).complete_cases(INPUTS, LABEL)
    for number, gram in enumerate(folds.grams):
        members = [
            drive for drive, fold in zip(drives, assignment.fold, strict=True) if fold == number
        ]
        assert gram == Gram.from_counts((*INPUTS, LABEL), rows_of(members))
    assert folds.total.n == 20 * 80


def test_cars_are_clusters_and_for_one_car_its_drives() -> None:
    cohort = cohort_of(driven(1, COEFFICIENTS))
    cars = clustered_moments(cohort.complete_cases(["ay", "ax"]))
    assert (cars.signals, cars.unit, len(cars)) == (("ay", "ax", LABEL), "vehicle", 4)
    one_car = np.array(cohort.drives["vehicle_id"].to_pylist()) == "car-0"
    of_one = clustered_moments(cohort.filter(one_car).complete_cases(["ay", "ax"]))
    assert (of_one.unit, len(of_one)) == ("drive", 3)
    with pytest.raises(DataError, match="wheel_fl"):
        cohort.complete_cases(["ay", "wheel_fl"])


TRUE = np.array([0.5, -0.2, 0.1])


def drives_of(seed: int, lost: dict[int, float], drives: int = 40, rows: int = 100) -> GramTable:
    """Drives of one law, but for lost ones, whose slopes are that many times it."""
    random, grams = np.random.default_rng(seed), list[Gram]()
    for number in range(drives):
        x = random.normal(size=(rows, 3)) * np.exp(0.2 * random.normal(size=3))
        y = x @ TRUE * lost.get(number, 1.0) + 0.05 * random.normal(size=rows)
        grams.append(gram_of(np.rint(1000 * np.column_stack([x, y])).astype(np.int64)))
    return table_of(grams)


def fitted(table: GramTable, weights: DriveWeights) -> np.ndarray:
    """Slopes of the exactly weighted sum."""
    m = DriveMoments.from_table(weighted(table, weights.weights))
    matrix = m.moments.sum(axis=0)
    slopes = np.linalg.solve(matrix[:-1, :-1], matrix[:-1, -1])[1:]
    return np.asarray(slopes * m.spread[-1] / m.spread[:-1])


def test_honest_drives_keep_all_of_their_weight() -> None:
    for seed in range(20):
        assert (
            robust_weights(DriveMoments.from_table(drives_of(seed, {}))).weights == FULL_WEIGHT
        ).all()


def test_lost_drives_count_next_to_nothing() -> None:
    """As good as knowing which they are: slopes within the noise of the others."""
    for seed in range(10):
        table = drives_of(seed, {3: -1.0, 17: 4.0})
        weights = robust_weights(DriveMoments.from_table(table))
        assert set(np.flatnonzero(weights.weights < FULL_WEIGHT).tolist()) == {3, 17}
        assert weights.weights[[3, 17]].max() <= 2
        expected_weights = np.where(np.isin(np.arange(40), [3, 17]), 0, FULL_WEIGHT)
        coefficients = fitted(table, DriveWeights(expected_weights, weights.times))
        assert fitted(table, weights) == pytest.approx(coefficients, abs=0.012)
        everything = fitted(table, DriveWeights(np.full(40, FULL_WEIGHT), weights.times))
        assert np.abs(everything - TRUE).max() > 3 * np.abs(fitted(table, weights) - TRUE).max()


def test_no_more_than_a_tenth_of_the_weight_is_lost() -> None:
    table = drives_of(1, dict.fromkeys(range(8), 3.0))
    weights = robust_weights(DriveMoments.from_table(table))
    lost = (table.n * (FULL_WEIGHT - weights.weights)).sum() / (FULL_WEIGHT * table.n.sum())
    assert 0 < lost <= MAX_LOST_SHARE


def test_the_order_and_the_size_of_counts_do_not_matter() -> None:
    table = drives_of(2, {5: -1.0})
    order = np.random.default_rng(3).permutation(len(table))
    parts = robust_weights(DriveMoments.from_table(table)).weights
    assert np.array_equal(
        robust_weights(DriveMoments.from_table(table.take(order))).weights, parts[order]
    )
    origin = robust_weights(DriveMoments.from_table(table.about_origin()))
    assert np.array_equal(origin.weights, parts)


def test_integers_beyond_64_bits_stay_exact() -> None:
    table = drives_of(5, {}, drives=2)
    large = GramTable(table.signals, table.n, table.sums, table.products * 2**34)
    expected = large.total()
    gram = weighted(large, np.array([FULL_WEIGHT, FULL_WEIGHT])).total()
    assert gram.products == tuple(FULL_WEIGHT * product for product in expected.products)
