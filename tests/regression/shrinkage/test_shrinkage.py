"""Ridge, noise-matched ridge, errors in variables, James-Stein and Pace by properties."""

from fractions import Fraction

import numpy as np
import pytest
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from sklearn.linear_model import Ridge

from fleet_slip.errors import DataError, QuestionError
from fleet_slip.regression.choice.nested_choice import nested_fits
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.regression.exact.least_squares import fit
from fleet_slip.regression.inference.evidence import Evidence
from fleet_slip.regression.shrinkage.mixture import (
    ChiSquareKernel,
    NormalKernel,
    fit_mixture,
    nonnegative_least_squares,
    separable_groups,
)
from fleet_slip.regression.shrinkage.pace import (
    ESTIMATORS,
    OrthogonalResponses,
    james_stein,
    shrink,
)
from fleet_slip.regression.shrinkage.ridge import (
    fit_errors_in_variables,
    fit_noise_matched,
    fit_penalised,
    fit_ridge,
)
from fleet_slip.regression.validation.crossval import Procedure, cross_validate
from fleet_slip.regression.validation.folds import Folds
from tests.support.counts import gram_of, names, random_drives, unit_scales
from tests.support.weka import threshold


@settings(max_examples=25)
@given(st.integers(0, 10**6), st.floats(1e-6, 10))
def test_ridge_equals_scikit_learn(seed: int, penalty: float) -> None:
    counts = np.concatenate(random_drives(seed, drives=2)).astype(float)
    centred = counts - counts.mean(axis=0)
    x = centred / np.sqrt(np.sum(centred**2, axis=0))
    beta = Ridge(alpha=penalty, fit_intercept=False).fit(x[:, :4], x[:, 4]).coef_
    gram = gram_of(counts.astype(np.int64))
    model = fit_ridge(gram, names(4)[:-1], "y", penalty)
    spread = np.sqrt(np.sum(centred**2, axis=0))
    expected = beta * spread[4] / spread[:4]
    np.testing.assert_allclose([*model.weights.values()], expected, rtol=1e-6, atol=1e-9)
    predicted = counts[:, :4] @ [*model.weights.values()] + model.offset
    assert np.mean(predicted - counts[:, 4]) == pytest.approx(0, abs=1e-6)


def test_ridge_starts_at_least_squares_and_is_cross_validated() -> None:
    drives = random_drives(2)
    gram = gram_of(np.concatenate(drives))
    inputs = names(4)[:-1]
    ols = fit(gram, inputs, "y").model
    np.testing.assert_allclose(
        [*fit_ridge(gram, inputs, "y", 0).weights.values()],
        [*ols.weights.values()],
        rtol=1e-9,
    )

    def ridge(penalty: float) -> Procedure:
        return lambda gram: fit_ridge(gram, inputs, "y", penalty)

    folds = Folds(tuple(gram_of(counts) for counts in drives), tuple("abcdefghijkl"), 12)
    least, most = (
        cross_validate("ridge", folds, ridge(penalty), unit_scales(4)).pooled.rmse
        for penalty in (0.0, 10.0)
    )
    assert least < most


def test_noise_matched_ridge_is_best_under_that_noise() -> None:
    rng = np.random.default_rng(4)
    counts = np.concatenate(random_drives(4, drives=6)).astype(float)
    inputs = names(4)[:-1]
    sigma = {"x1": 200.0, "x3": 80.0}
    model = fit_noise_matched(gram_of(counts.astype(int)), inputs, "y", sigma, unit_scales(4))
    copies = np.tile(counts, (60, 1))
    copies[:, 0] += rng.normal(size=len(copies)) * 200
    copies[:, 2] += rng.normal(size=len(copies)) * 80
    refit = fit(gram_of(np.rint(copies).astype(int)), inputs, "y").model
    np.testing.assert_allclose(
        [*model.weights.values()], [*refit.weights.values()], rtol=0.05, atol=0.02
    )


def test_errors_in_variables_recovers_the_clean_slope() -> None:
    rng = np.random.default_rng(5)
    clean = rng.normal(size=200_000) * 1000
    noisy = np.column_stack([clean + rng.normal(size=clean.size) * 700, 0.5 * clean])
    gram = gram_of(np.rint(noisy).astype(np.int64))
    attenuated = fit(gram, ["x1"], "y").model.weights["x1"]
    assert attenuated == pytest.approx(0.5 / 1.49, rel=0.02)
    model = fit_errors_in_variables(gram, ["x1"], "y", {"x1": 700.0}, unit_scales(1))
    assert model.weights["x1"] == pytest.approx(0.5, rel=0.02)
    with pytest.raises(DataError, match="positive definite at x1"):
        fit_errors_in_variables(gram, ["x1"], "y", {"x1": 2000.0}, unit_scales(1))
    with pytest.raises(QuestionError, match="noise is given for gyro"):
        fit_errors_in_variables(gram, ["x1"], "y", {"gyro": 1.0}, unit_scales(1))


def test_no_penalty_is_least_squares_exactly() -> None:
    gram = gram_of(np.concatenate(random_drives(6)))
    inputs = names(4)[:-1]
    assert fit_penalised(gram, inputs, "y", [Fraction(0)] * 4) == fit(gram, inputs, "y").model


@settings(max_examples=60)
@given(st.integers(1, 12), st.integers(1, 8), st.integers(0, 10**6))
def test_nonnegative_least_squares_equals_scipy(rows: int, columns: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(rows, columns)), rng.normal(size=rows)
    x = nonnegative_least_squares(a, b)
    assert (x >= 0).all()
    _, residual = scipy.optimize.nnls(a, b)
    assert np.linalg.norm(a @ x - b) == pytest.approx(residual, abs=1e-9)


def test_mixtures_find_the_groups_of_effects() -> None:
    rng = np.random.default_rng(7)
    data = np.concatenate([rng.normal(size=40), 8 + rng.normal(size=10)])
    mixture = fit_mixture(data, NormalKernel())
    assert mixture.weights.sum() == pytest.approx(1)
    assert mixture.weights[mixture.points > 4].sum() == pytest.approx(0.2, abs=0.02)
    assert mixture.points @ mixture.weights == pytest.approx(data.mean(), abs=0.3)
    squares = fit_mixture(data**2, ChiSquareKernel())
    assert squares.weights[squares.points > 16].sum() == pytest.approx(0.2, abs=0.02)
    assert [len(g) for g in separable_groups(np.sort(data), NormalKernel())] == [40, 10]


@settings(max_examples=25)
@given(st.integers(0, 10**6))
def test_the_orthogonal_basis_is_a_rotation(seed: int) -> None:
    gram = gram_of(np.concatenate(random_drives(seed, drives=2)))
    order = ("x3", "x1", "x4", "x2")
    basis = OrthogonalResponses.of(gram, order, "y")
    fits = nested_fits(gram, order, "y")
    np.testing.assert_allclose(
        basis.responses[1:] ** 2, Evidence.naive(fits).contributions, rtol=1e-12
    )
    for size in range(5):
        kept = np.where(np.arange(5) <= size, basis.responses, 0)
        assert basis.model(kept) == fits[size].model


@given(
    hnp.arrays(
        np.float64, st.integers(2, 15), elements=st.floats(-50, 50).map(lambda x: round(x, 3))
    )
)
def test_estimators_shrink_and_keep_signs(a: np.ndarray) -> None:
    for name, estimator in ESTIMATORS.items():
        shrunk = estimator(a)
        assert shrunk.shape == a.shape
        assert np.isfinite(shrunk).all(), name
        if name in {"pace2", "pace4"}:
            assert ((shrunk == a) | (shrunk == 0)).all()
        if name in {"james-stein", "pace6"}:
            assert (shrunk * a >= 0).all()


def test_shrinkage_lowers_the_loss_when_most_effects_are_small() -> None:
    rng = np.random.default_rng(8)
    truth = np.concatenate([np.full(5, 4.0), np.zeros(55)])
    loss = dict.fromkeys(ESTIMATORS, 0.0)
    for _ in range(30):
        a = truth + rng.normal(size=60)
        for name, estimator in ESTIMATORS.items():
            loss[name] += float(np.sum((estimator(a) - truth) ** 2)) / 30
    assert max(loss.values()) < 0.7 * 60, loss  # 60: what least squares loses on average


def test_pace_needs_no_row_and_names_its_mistakes() -> None:
    gram = gram_of(np.concatenate(random_drives(9, inputs=6)))
    inputs = names(6)[:-1]
    found = shrink(gram, inputs, "y", lambda a: a)
    assert found.weights == pytest.approx(fit(gram, inputs, "y").model.weights)
    exact = Gram.from_counts(("x1", "y"), np.array([[1, 2], [2, 4], [3, 6], [5, 10]]))
    with pytest.raises(DataError, match="no noise"):
        shrink(exact, ["x1"], "y", ESTIMATORS["eb"])
    assert (james_stein(np.array([0.1, 0.1, 0.1])) == 0).all()
    assert james_stein(np.array([3.0, 4.0, 0.0])) == pytest.approx([2.88, 3.84, 0])  # 1 - 1/25
    assert james_stein(np.array([3.0, 4.0])) == pytest.approx([3, 4])  # nothing to gain from two
    assert (threshold(4.0)(np.array([1.9, -2.1])) == [0, -2.1]).all()
