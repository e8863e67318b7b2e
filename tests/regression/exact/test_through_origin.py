"""Models without an intercept, against least squares on the rows and statsmodels."""

import numpy as np
import pytest
import statsmodels.api as sm
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_slip.regression.choice import nested_fits
from fleet_slip.regression.drives import DriveMoments
from fleet_slip.regression.inference import (
    Evidence,
    infer_by_clusters,
    infer_classically,
)
from fleet_slip.regression.least_squares import fit
from fleet_slip.regression.orders import rank
from fleet_slip.regression.subsets import best_subsets
from tests.support.counts import Matrix, gram_of, names, random_drives, table_of, unit_scales
from tests.support.few_cars import by_rows

INPUTS = names(4)[:-1]


def offset_drives(seed: int, offset: int = 500) -> list[Matrix]:
    """Drives whose signals are far from zero on average, so that an intercept matters."""
    return [counts + offset for counts in random_drives(seed)]


def through_origin(counts: Matrix) -> Matrix:
    x, y = counts[:, :-1].astype(float), counts[:, -1].astype(float)
    return np.asarray(np.linalg.lstsq(x, y, rcond=None)[0])


@settings(max_examples=20)
@given(seed=st.integers(0, 10**6))
def test_coefficients_and_both_kinds_of_errors_are_those_of_statsmodels(seed: int) -> None:
    parts = offset_drives(seed)
    counts = np.concatenate(parts)
    fitted = fit(gram_of(counts), INPUTS, "y", intercept=False)
    model = sm.OLS(counts[:, -1].astype(float), counts[:, :-1].astype(float))
    moments = DriveMoments.of(table_of([gram_of(part) for part in parts]).about_origin())
    classical, clustered = (
        infer_classically(fitted, unit_scales(4)),
        infer_by_clusters(fitted, moments, unit_scales(4)),
    )
    expected = model.fit()
    both = (classical, expected.bse), (clustered, by_rows(parts, intercept=False)[0])
    for mine, errors_of_rows in both:
        assert [estimate.name for estimate in mine.estimates] == list(INPUTS)
        values = [estimate.value for estimate in mine.estimates]
        np.testing.assert_allclose(values, expected.params, rtol=1e-8, atol=1e-9)
        errors = [estimate.standard_error for estimate in mine.estimates]
        np.testing.assert_allclose(errors, errors_of_rows, rtol=1e-7)


def test_the_evidence_of_the_last_signal_is_its_squared_t_value() -> None:
    parts = offset_drives(3)
    gram = gram_of(np.concatenate(parts))
    moments = DriveMoments.of(table_of([gram_of(part) for part in parts]).about_origin())
    fits = nested_fits(gram, INPUTS, "y", intercept=False)
    counts = np.concatenate(parts)
    model = sm.OLS(counts[:, -1].astype(float), counts[:, :-1].astype(float))
    groups = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    theirs = model.fit(cov_type="cluster", cov_kwds={"groups": groups})
    last = Evidence.clustered(fits, moments).contributions[-1]
    assert last == pytest.approx(theirs.tvalues[-1] ** 2, rel=1e-9)


def test_the_best_subsets_and_orders_are_those_of_the_rows() -> None:
    counts = np.concatenate(offset_drives(4))
    gram = gram_of(counts).about_origin()

    def rss(columns: list[int]) -> float:
        part = counts[:, [*columns, 4]]
        return float(np.sum((part[:, -1] - part[:, :-1] @ through_origin(part)) ** 2))

    for result in best_subsets(gram, INPUTS, "y")[1:]:
        best = result.best
        assert best.model.intercept == 0
        mine = [INPUTS.index(name) for name in best.model.signals]
        assert float(best.rss) == pytest.approx(rss(mine), rel=1e-9)
        others = [rss([i for i in range(4) if mask >> i & 1]) for mask in range(1, 16)]
        sizes = [mask.bit_count() for mask in range(1, 16)]
        least = min(r for r, size in zip(others, sizes, strict=True) if size == best.size)
        assert float(best.rss) == pytest.approx(least, rel=1e-9)
    alone = min(range(4), key=lambda i: rss([i]))
    assert rank("forward", gram, INPUTS, "y")[0] == INPUTS[alone]
