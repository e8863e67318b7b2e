"""Bootstrap against the exact figures and theory."""

import numpy as np
import pytest

from fleet_slip.errors import DataError
from fleet_slip.regression.drives import (
    DriveMoments,
    bootstrap_correlations,
    held_out_products,
    percentile_interval,
)
from fleet_slip.regression.folds import CohortFolds, by_value, cross_validate, least_squares
from fleet_slip.regression.gram import GramTable
from fleet_slip.regression.least_squares import fit
from tests.support.counts import gram_of, names, random_drives, table_of, unit_scales

INPUTS = names(4)[:-1]


def table_of_drives(drives: list[np.ndarray]) -> GramTable:
    return table_of([gram_of(counts) for counts in drives])


def test_held_out_products_pool_to_the_cross_validated_correlation() -> None:
    drives = random_drives(2, noise=200)
    table = table_of_drives(drives)
    assignment = by_value([i % 4 for i in range(12)])
    folds = CohortFolds.of([table], assignment).serving(INPUTS[:2], "y")
    result = cross_validate("m", folds, least_squares(INPUTS[:2], "y"), unit_scales(4))
    models = [fit(folds.total - fold, INPUTS[:2], "y").model for fold in folds.grams]
    moments = DriveMoments.of(table.restrict([*INPUTS[:2], "y"]))
    products = held_out_products(moments, assignment.fold, models)
    n, e, ee, *_ = products.sum(axis=0)
    assert n == 12 * 60
    assert e / n * moments.spread[-1] == pytest.approx(result.pooled.error_mean, abs=1e-9)
    assert np.sqrt(ee / n) * moments.spread[-1] == pytest.approx(result.pooled.rmse, rel=1e-9)
    draws = bootstrap_correlations(products, 500, seed=1)
    interval = percentile_interval(draws)
    assert interval.low < result.correlation < interval.high
    assert interval.replicates == 500
    np.testing.assert_array_equal(draws, bootstrap_correlations(products, 500, seed=1))


def test_too_few_drives() -> None:
    with pytest.raises(DataError, match="at least two drives"):
        bootstrap_correlations(np.ones((1, 6)), 10, seed=0)
