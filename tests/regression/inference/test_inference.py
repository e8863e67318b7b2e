"""Standard errors, Chow test and variance inflation against dense formulas and closed forms."""

import numpy as np
import pytest
import scipy.stats
import statsmodels.api as sm
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import DataError
from fleet_slip.regression.choice import nested_fits
from fleet_slip.regression.gram import GramTable, complete_cases
from fleet_slip.regression.inference import (
    DriveMoments,
    Evidence,
    infer,
    pool,
    variance_inflation,
)
from fleet_slip.regression.least_squares import fit
from fleet_slip.regression.orders import best_subsets, rank
from tests.support.counts import (
    Matrix,
    by_rows,
    drives_of,
    gram_of,
    names,
    random_drives,
    table_of,
    unit_scales,
)


def moments_of(drives: list[np.ndarray], *, intercept: bool = True) -> DriveMoments:
    table = table_of([gram_of(counts) for counts in drives])
    return DriveMoments.from_table(table if intercept else table.about_origin())


@pytest.mark.parametrize("intercept", [True, False])
@settings(max_examples=20)
@given(st.integers(0, 10**6), st.integers(1, 5))
def test_cluster_errors_are_those_of_the_rows(intercept: bool, seed: int, inputs: int) -> None:
    drives = [counts + 500 for counts in random_drives(seed, drives=9, inputs=inputs)]
    order = [*range(inputs)][::-1][:3]
    signals = [f"x{i + 1}" for i in order]
    gram = gram_of(np.concatenate(drives))
    fitted = fit(gram if intercept else gram.about_origin(), signals, "y")
    result = infer(fitted, unit_scales(inputs), moments_of(drives, intercept=intercept))
    columns = [drive[:, [*order, -1]] for drive in drives]
    errors, degrees = by_rows(columns, intercept=intercept)
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
        for estimate in infer(fitted, unit_scales(3), moments_of(drives)).estimates[1:]:
            reach = scipy.stats.t.ppf(0.975, estimate.degrees_of_freedom) * estimate.standard_error
            inside.append(abs(estimate.value - 1) <= reach)
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
    small = gram_of(drives[0][:2, [0, -1]])
    with pytest.raises(DataError, match="2 rows are too few"):
        infer(fit(small, ["x1"], "y"), unit_scales(1))
    with pytest.raises(DataError, match="no drive of the cohort has all"):
        complete_cases([moments_table()], ["x9"])


def moments_table() -> GramTable:
    return table_of([gram_of(random_drives(1)[0])])


def test_complete_cases_stacks_tables() -> None:
    full = moments_table()
    table, mask = complete_cases([full, full.restrict(["x1", "y"]), full], ["y", "x2"])
    assert len(table) == 2
    assert mask.tolist() == [True, False, True]


AGREEMENT = 1e-9


def collinear(
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


@pytest.mark.parametrize("intercept", [True, False])
@settings(max_examples=20)
@given(
    seed=st.integers(0, 10**6),
    inputs=st.integers(1, 8),
    drives=st.integers(3, 12),
    collinearity=st.floats(0, 10),
    scale=st.floats(30, 900),
)
def test_coefficients_errors_and_evidence_are_those_of_statsmodels(
    intercept: bool, seed: int, inputs: int, drives: int, collinearity: float, scale: float
) -> None:
    parts = collinear(seed, inputs, drives, collinearity, scale)
    counts = np.concatenate(parts)
    gram = gram_of(counts) if intercept else gram_of(counts).about_origin()
    fits = nested_fits(gram, names(inputs)[:-1], "y")
    x, y = counts[:, :-1].astype(float), counts[:, -1].astype(float)
    model = sm.OLS(y, sm.add_constant(x) if intercept else x)
    result, expected = infer(fits[-1], unit_scales(inputs)), model.fit()
    largest = np.abs(expected.params).max()
    values, errors, p = zip(
        *((e.value, e.standard_error, e.p) for e in result.estimates), strict=True
    )
    np.testing.assert_allclose(values, expected.params, rtol=AGREEMENT, atol=AGREEMENT * largest)
    np.testing.assert_allclose(errors, expected.bse, rtol=AGREEMENT)
    assert abs(result.residual_std / np.sqrt(expected.scale) - 1) < AGREEMENT
    np.testing.assert_allclose(p, expected.pvalues, rtol=1e-7, atol=1e-14)
    groups = np.repeat(np.arange(drives), [len(part) for part in parts])
    clustered = model.fit(cov_type="cluster", cov_kwds={"groups": groups})
    last = Evidence.measure(fits, moments_of(parts, intercept=intercept)).contributions[-1]
    assert last == pytest.approx(clustered.tvalues[-1] ** 2, rel=1e-8)


INPUTS = names(4)[:-1]


def through_origin(counts: Matrix) -> Matrix:
    x, y = counts[:, :-1].astype(float), counts[:, -1].astype(float)
    return np.asarray(np.linalg.lstsq(x, y, rcond=None)[0])


def test_the_best_subsets_and_orders_are_those_of_the_rows() -> None:
    counts = np.concatenate(random_drives(4)) + 500
    gram = gram_of(counts).about_origin()

    def rss(columns: list[int]) -> float:
        part = counts[:, [*columns, 4]]
        return float(np.sum((part[:, -1] - part[:, :-1] @ through_origin(part)) ** 2))

    for best in best_subsets(gram, INPUTS, "y")[1:]:
        assert best.model.intercept == 0
        chosen = [INPUTS.index(name) for name in best.model.signals]
        assert float(best.rss) == pytest.approx(rss(chosen), rel=1e-9)
        subset_errors = [rss([i for i in range(4) if mask >> i & 1]) for mask in range(1, 16)]
        sizes = [mask.bit_count() for mask in range(1, 16)]
        least = min(r for r, size in zip(subset_errors, sizes, strict=True) if size == best.size)
        assert float(best.rss) == pytest.approx(least, rel=1e-9)
    alone = min(range(4), key=lambda i: rss([i]))
    assert rank("forward", gram, INPUTS, "y")[0] == INPUTS[alone]


BASEBALL = np.array([18, 17, 16, 15, 14, 14, 13, 12, 11, 11, 10, 10, 10, 10, 10, 9, 8, 7]) / 45
"""Hits of 18 players in 45 at bats, after Efron and Morris (1975)."""

NUMBERS = hnp.arrays(
    np.float64,
    st.shared(st.integers(4, 12), key="members"),
    elements=st.floats(-1.0, 1.0, allow_subnormal=False),
)
VARIANCES = hnp.arrays(
    np.float64, st.shared(st.integers(4, 12), key="members"), elements=st.floats(1e-4, 1.0)
)


def test_members_of_equal_variance_are_drawn_as_the_closed_form_says() -> None:
    """By the smaller root B of (1 - B) (k - 1 - B S / V) = 2: Morris and Tang (2011), V equal."""
    root = np.sqrt(45) * np.arcsin(2 * BASEBALL - 1)  # of variance 1
    mean, squares = root.mean(), root.var() * 18
    drawn = np.roots([squares, -(squares + 17), 17 - 2]).min()
    pooled = pool(root, np.ones(18))
    assert pooled is not None
    assert pooled.mean == pytest.approx(mean)
    assert pooled.values == pytest.approx(root + drawn * (mean - root))
    assert pooled.spread == pytest.approx(np.sqrt(1 / drawn - 1))


@given(NUMBERS, VARIANCES, st.floats(-10, 10), st.floats(0.1, 10))
def test_a_unit_and_an_origin_change_nothing_else(
    values: FloatArray, variances: FloatArray, origin: float, unit: float
) -> None:
    original, other = pool(values, variances), pool(unit * values + origin, unit**2 * variances)
    assert original is not None
    assert other is not None
    assert other.values == pytest.approx(unit * original.values + origin, abs=1e-6)
    assert other.errors == pytest.approx(unit * original.errors, rel=1e-3, abs=1e-6)
    assert other.spread == pytest.approx(unit * original.spread, rel=1e-3, abs=1e-5)


def test_too_few_members_are_not_pooled() -> None:
    assert pool(np.arange(3.0), np.ones(3)) is None


@pytest.mark.parametrize("spread", [0.0, 0.5, 2.0])
@pytest.mark.parametrize("members", [5, 12, 40])
def test_errors_hold_as_often_as_stated_and_are_smaller(spread: float, members: int) -> None:
    """Over kinds that are drawn, of which a third of the members has 1, 3 and 10 pieces each."""
    random = np.random.default_rng([7, members])
    variances = np.resize([1.0, 1 / 3, 0.1], members)
    within, gain = [], []
    for _ in range(1200 // members):
        true = 3 + spread * random.standard_normal(members)
        values = true + np.sqrt(variances) * random.standard_normal(members)
        pooled = pool(values, variances)
        assert pooled is not None
        within.append(np.abs(pooled.values - true) <= 1.645 * pooled.errors)
        gain.append((pooled.values - true) ** 2 - (values - true) ** 2)
    assert np.mean(within) >= 0.885
    assert np.mean(within) <= (1 if spread == 0 else 0.94)
    assert np.mean(gain) < 0
