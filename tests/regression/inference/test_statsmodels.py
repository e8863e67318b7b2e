"""Agreement with statsmodels: OLS, cluster-robust errors and AR(1) generalised least squares."""

import numpy as np
import pytest
import statsmodels.api as sm
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_slip.regression.choice import nested_fits
from fleet_slip.regression.drives import DriveMoments
from fleet_slip.regression.inference import Evidence, infer_classically
from fleet_slip.regression.least_squares import fit
from tests.support.counts import (
    gram_of,
    names,
    table_of,
    unit_scales,
)

AGREEMENT = 1e-9


def drives_of(
    seed: int, inputs: int, drives: int, collinearity: float, scale: float
) -> list[np.ndarray]:
    """Random counts with a common part in all inputs, and an offset of each drive's label."""
    rng = np.random.default_rng(seed)
    result = []
    for _ in range(drives):
        rows = int(rng.integers(20, 120))
        x = rng.normal(size=(rows, inputs)) + collinearity * rng.normal(size=(rows, 1))
        y = x @ np.arange(1, inputs + 1) + rng.normal() + rng.normal(size=rows)
        result.append(np.rint(scale * np.column_stack([x, y])).astype(np.int64))
    return result


@settings(max_examples=30)
@given(
    seed=st.integers(0, 10**6),
    inputs=st.integers(1, 8),
    drives=st.integers(3, 12),
    collinearity=st.floats(0, 10),
    scale=st.floats(30, 900),
)
def test_coefficients_and_both_kinds_of_errors_agree(
    seed: int, inputs: int, drives: int, collinearity: float, scale: float
) -> None:
    parts = drives_of(seed, inputs, drives, collinearity, scale)
    counts = np.concatenate(parts)
    fitted = fit(gram_of(counts), names(inputs)[:-1], "y")
    model = sm.OLS(counts[:, -1].astype(float), sm.add_constant(counts[:, :-1].astype(float)))
    groups = np.repeat(np.arange(drives), [len(part) for part in parts])
    moments = DriveMoments.of(table_of([gram_of(part) for part in parts]))
    mine, theirs = infer_classically(fitted, unit_scales(inputs)), model.fit()
    largest = np.abs(theirs.params).max()
    values = [estimate.value for estimate in mine.estimates]
    np.testing.assert_allclose(values, theirs.params, rtol=AGREEMENT, atol=AGREEMENT * largest)
    errors = [estimate.standard_error for estimate in mine.estimates]
    np.testing.assert_allclose(errors, theirs.bse, rtol=AGREEMENT)
    assert abs(mine.residual_std / np.sqrt(theirs.scale) - 1) < AGREEMENT
    p = [estimate.p for estimate in mine.estimates]
    np.testing.assert_allclose(p, theirs.pvalues, rtol=1e-7, atol=1e-14)
    clustered = model.fit(cov_type="cluster", cov_kwds={"groups": groups})
    fits = nested_fits(gram_of(counts), names(inputs)[:-1], "y")
    last = Evidence.clustered(fits, moments).contributions[-1]
    assert last == pytest.approx(clustered.tvalues[-1] ** 2, rel=1e-8)
