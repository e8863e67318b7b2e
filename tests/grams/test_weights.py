"""Weights of drives: of lost drives next to nothing is left, of others everything."""

import numpy as np
import pytest

from fleet_slip.grams.weights import FULL, MOST_LOST, DriveWeights, robust_weights, weighted
from fleet_slip.regression.drives import DriveMoments
from fleet_slip.regression.gram import Gram, GramTable
from tests.support.counts import gram_of, table_of

TRUE = np.array([0.5, -0.2, 0.1])


def drives_of(seed: int, lost: dict[int, float], drives: int = 40, rows: int = 100) -> GramTable:
    """Drives of one law, but for lost ones, whose slopes are that many times it."""
    random, found = np.random.default_rng(seed), list[Gram]()
    for number in range(drives):
        x = random.normal(size=(rows, 3)) * np.exp(0.2 * random.normal(size=3))
        y = x @ TRUE * lost.get(number, 1.0) + 0.05 * random.normal(size=rows)
        found.append(gram_of(np.rint(1000 * np.column_stack([x, y])).astype(np.int64)))
    return table_of(found)


def fitted(table: GramTable, found: DriveWeights) -> np.ndarray:
    """Slopes of the exactly weighted sum."""
    m = DriveMoments.of(weighted(table, found.parts))
    matrix = m.each.sum(axis=0)
    slopes = np.linalg.solve(matrix[:-1, :-1], matrix[:-1, -1])[1:]
    return np.asarray(slopes * m.spread[-1] / m.spread[:-1])


def test_honest_drives_keep_all_of_their_weight() -> None:
    for seed in range(20):
        assert (robust_weights(DriveMoments.of(drives_of(seed, {}))).parts == FULL).all()


def test_lost_drives_count_next_to_nothing() -> None:
    """As good as knowing which they are: slopes within the noise of the others."""
    for seed in range(10):
        table = drives_of(seed, {3: -1.0, 17: 4.0})
        found = robust_weights(DriveMoments.of(table))
        assert set(np.flatnonzero(found.parts < FULL).tolist()) == {3, 17}
        assert found.parts[[3, 17]].max() <= 2
        known = np.where(np.isin(np.arange(40), [3, 17]), 0, FULL)
        told = fitted(table, DriveWeights(known, found.times))
        assert fitted(table, found) == pytest.approx(told, abs=0.012)
        everything = fitted(table, DriveWeights(np.full(40, FULL), found.times))
        assert np.abs(everything - TRUE).max() > 3 * np.abs(fitted(table, found) - TRUE).max()


def test_no_more_than_a_tenth_of_the_weight_is_lost() -> None:
    table = drives_of(1, dict.fromkeys(range(8), 3.0))
    found = robust_weights(DriveMoments.of(table))
    lost = (table.n * (FULL - found.parts)).sum() / (FULL * table.n.sum())
    assert 0 < lost <= MOST_LOST


def test_the_order_and_the_size_of_counts_do_not_matter() -> None:
    table = drives_of(2, {5: -1.0})
    order = np.random.default_rng(3).permutation(len(table))
    parts = robust_weights(DriveMoments.of(table)).parts
    assert np.array_equal(robust_weights(DriveMoments.of(table.take(order))).parts, parts[order])
    origin = robust_weights(DriveMoments.of(table.about_origin()), intercept=False)
    assert np.array_equal(origin.parts, parts)


def test_each_weight_has_its_reason() -> None:
    found = robust_weights(DriveMoments.of(drives_of(4, {7: 5.0})))
    assert "times that of the median drive: robust takes it 0.0" in found.of(7).reason


def test_whole_numbers_beyond_64_bits_stay_exact() -> None:
    table = drives_of(5, {}, drives=2)
    large = GramTable(table.signals, table.n, table.sums, table.products * 2**34)
    expected = large.total()
    found = weighted(large, np.array([FULL, FULL])).total()
    assert found.products == tuple(FULL * one for one in expected.products)
