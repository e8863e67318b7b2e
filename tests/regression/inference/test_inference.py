"""Standard errors, Chow test and variance inflation against dense formulas and SciPy."""

import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import betainc

from fleet_slip.errors import DataError
from fleet_slip.regression.drives import DriveMoments, serving_drives
from fleet_slip.regression.figures import incomplete_beta, normal_cdf, normal_density
from fleet_slip.regression.gram import GramTable
from fleet_slip.regression.inference import (
    infer_by_clusters,
    infer_classically,
    variance_inflation,
)
from fleet_slip.regression.least_squares import fit
from tests.support.counts import gram_of, names, random_drives, table_of, unit_scales
from tests.support.few_cars import by_rows, drives_of


def moments_of(drives: list[np.ndarray]) -> DriveMoments:
    return DriveMoments.of(table_of([gram_of(counts) for counts in drives]))


@settings(max_examples=25)
@given(st.integers(0, 10**6), st.integers(1, 5))
def test_cluster_errors_are_those_of_the_rows(seed: int, inputs: int) -> None:
    drives = random_drives(seed, drives=9, inputs=inputs)
    order = [*range(inputs)][::-1][:3]
    fitted = fit(gram_of(np.concatenate(drives)), [f"x{i + 1}" for i in order], "y")
    result = infer_by_clusters(fitted, moments_of(drives), unit_scales(inputs))
    errors, degrees = by_rows([drive[:, [*order, -1]] for drive in drives])
    np.testing.assert_allclose([e.standard_error for e in result.estimates], errors, rtol=1e-7)
    np.testing.assert_allclose([e.degrees_of_freedom for e in result.estimates], degrees, rtol=1e-6)
    p = 2 * scipy.stats.t.sf(np.abs([e.t for e in result.estimates]), degrees)
    np.testing.assert_allclose([e.p for e in result.estimates], p, rtol=1e-5, atol=1e-14)
    assert result.degrees_of_freedom == 8


@pytest.mark.parametrize(("cars", "rows"), [(6, 30), (25, 30)])
def test_intervals_of_few_unequal_cars_hold(cars: int, rows: int) -> None:
    """At nominal 95 %: of 300 coefficients of cars that differ, 92 % and more."""
    random = np.random.default_rng(5)
    inside = []
    for _ in range(100):
        drives = drives_of(random, cars, 3, rows=rows)
        fitted = fit(gram_of(np.concatenate(drives)), names(3)[:-1], "y")
        for one in infer_by_clusters(fitted, moments_of(drives), unit_scales(3)).estimates[1:]:
            reach = scipy.stats.t.ppf(0.975, one.degrees_of_freedom) * one.standard_error
            inside.append(abs(one.value - 1) <= reach)
    assert np.mean(inside) >= 0.92


def test_variance_inflation_is_that_of_the_inverse_correlations() -> None:
    counts = np.concatenate(random_drives(11))
    expected = np.diag(np.linalg.inv(np.corrcoef(counts[:, :-1].T.astype(float))))
    inflation = variance_inflation(gram_of(counts), names(4)[:-1])
    np.testing.assert_allclose([*inflation.values()], expected, rtol=1e-9)
    twin = np.column_stack([counts[:, 0], counts[:, 0], counts[:, -1]])
    with pytest.raises(DataError, match="x2 is a linear combination of x1"):
        variance_inflation(gram_of(twin), ["x1", "x2"])


def test_questions_without_an_answer_are_errors() -> None:
    drives = random_drives(1, drives=2)
    gram = gram_of(drives[0])
    with pytest.raises(DataError, match="two drives"):
        infer_by_clusters(fit(gram, ["x1"], "y"), moments_of(drives[:1]), unit_scales(4))
    few = gram_of(drives[0][:2, [0, -1]])
    with pytest.raises(DataError, match="2 rows are too few"):
        infer_classically(fit(few, ["x1"], "y"), unit_scales(1))
    with pytest.raises(DataError, match="no drive of the cohort has all"):
        serving_drives([moments_table()], ["x9"])


def moments_table() -> GramTable:
    return table_of([gram_of(random_drives(1)[0])])


def test_serving_drives_stacks_tables() -> None:
    full = moments_table()
    table, mask = serving_drives([full, full.restrict(["x1", "y"]), full], ["y", "x2"])
    assert len(table) == 2
    assert mask.tolist() == [True, False, True]


@given(st.floats(0.05, 1e4), st.floats(0.05, 1e4), st.floats(0.0, 1.0))
def test_incomplete_beta_equals_scipy(a: float, b: float, x: float) -> None:
    assert incomplete_beta(a, b, x) == pytest.approx(betainc(a, b, x), rel=1e-8, abs=1e-12)


@given(st.floats(-40, 40))
def test_normal_distribution_equals_scipy(x: float) -> None:
    assert normal_cdf(x) == pytest.approx(scipy.stats.norm.cdf(x), rel=1e-12)
    assert normal_density(x) == pytest.approx(scipy.stats.norm.pdf(x), rel=1e-12)
