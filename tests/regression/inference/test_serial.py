"""Serial correlation and sensor disturbance from Grams against the rows."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_slip.errors import DataError, QuestionError
from fleet_slip.regression.drives import fit_autoregressive, quasi_difference, serial_correlation
from fleet_slip.regression.figures import error_sums
from fleet_slip.regression.least_squares import fit
from fleet_slip.regression.shrinkage import disturb
from tests.support.counts import (
    autoregressive_drives,
    dense_fit,
    gram_of,
    lag_gram,
    names,
    random_drives,
)


@settings(max_examples=20)
@given(st.integers(0, 10**6), st.floats(-0.9, 0.95))
def test_rho_and_durbin_watson_equal_those_of_the_rows(seed: int, rho: float) -> None:
    drives = autoregressive_drives(seed, rho)
    gram = gram_of(np.concatenate(drives))
    model = fit(gram, ["x1", "x2"], "y").model
    b, _ = dense_fit(np.concatenate(drives))
    residuals = [d[:, -1] - b[0] - d[:, :-1] @ b[1:] for d in drives]
    steps = sum(float(np.sum(np.diff(e) ** 2)) for e in residuals)
    total = sum(float(np.sum(e**2)) for e in residuals)
    now_before = sum(float(e[1:] @ e[:-1]) for e in residuals)
    before = sum(float(e[:-1] @ e[:-1]) for e in residuals)
    result = serial_correlation(model, gram, lag_gram(drives))
    assert result.durbin_watson == pytest.approx(steps / total, rel=1e-8)
    assert result.rho == pytest.approx(now_before / before, rel=1e-8, abs=1e-10)


@given(st.integers(0, 10**6), st.fractions(-1, 1, max_denominator=64))
@settings(max_examples=20)
def test_quasi_differences_are_exact(seed: int, rho: Fraction) -> None:
    drives = autoregressive_drives(seed, 0.5, rows=30)
    p, q = rho.numerator, rho.denominator
    counts = np.concatenate([q * drive[1:] - p * drive[:-1] for drive in drives])
    assert quasi_difference(lag_gram(drives), names(2), rho) == gram_of(counts)


def test_generalised_least_squares_equals_iterated_rows() -> None:
    drives = autoregressive_drives(11, 0.9)
    result = fit_autoregressive(lag_gram(drives), ["x1", "x2"], "y")
    rho = 0.0
    for _ in range(50):
        rows = np.concatenate([d[1:] - rho * d[:-1] for d in drives])
        b, _ = dense_fit(rows)
        level = b[0] / (1 - rho)
        residuals = [d[:, -1] - level - d[:, :-1] @ b[1:] for d in drives]
        rho = sum(float(e[1:] @ e[:-1]) for e in residuals) / sum(
            float(e[:-1] @ e[:-1]) for e in residuals
        )
    assert result.rho == pytest.approx(rho, abs=1e-6)
    assert result.rho == pytest.approx(0.9, abs=0.05)
    np.testing.assert_allclose([*result.model.weights.values()], b[1:], rtol=1e-5)
    assert result.model.offset == pytest.approx(level, rel=1e-4)
    innovations = [e[1:] - result.rho * e[:-1] for e in residuals]
    assert abs(np.mean([np.corrcoef(e[1:], e[:-1])[0, 1] for e in innovations])) < 0.06


def test_serial_correlation_needs_a_residual() -> None:
    x = np.arange(20) ** 2
    drives = [np.column_stack([x, 3 * x + 1])]
    gram = gram_of(drives[0])
    with pytest.raises(DataError, match="no residual"):
        serial_correlation(fit(gram, ["x1"], "y").model, gram, lag_gram(drives))
    with pytest.raises(DataError, match="no residual"):
        fit_autoregressive(lag_gram(drives), ["x1"], "y")


def test_disturbance_equals_simulated_noise_and_bias() -> None:
    rng = np.random.default_rng(13)
    counts = np.concatenate(random_drives(13, drives=10))
    gram = gram_of(counts)
    scales = {name: Fraction(1, 1000) for name in names(4)}
    model = fit(gram, ["x1", "x2", "x4"], "y").model
    bias, noise = {"x1": 0.05, "x4": -0.1}, {"x1": 0.03, "x2": 0.2}
    sums = disturb(error_sums(model, gram), model, scales, bias=bias, noise=noise)
    expected = sums.figures(scales["y"])
    copies = np.tile(counts.astype(float), (150, 1)) / 1000
    copies[:, 0] += 0.05 + rng.normal(size=len(copies)) * 0.03
    copies[:, 1] += rng.normal(size=len(copies)) * 0.2
    copies[:, 3] -= 0.1
    physical = model.physical(scales)
    predicted = copies[:, [0, 1, 3]] @ [*physical.weights.values()] + physical.offset
    error = predicted - copies[:, 4]
    assert expected.rmse == pytest.approx(np.sqrt(np.mean(error**2)), rel=5e-3)
    assert expected.error_mean == pytest.approx(error.mean(), rel=1e-2)
    assert expected.error_std == pytest.approx(error.std(), rel=5e-3)
    correlation = np.corrcoef(predicted, copies[:, 4])[0, 1]
    assert expected.correlation == pytest.approx(correlation, abs=2e-4)


def test_bias_alone_is_exact_and_nothing_changes_nothing() -> None:
    counts = np.concatenate(random_drives(14))
    gram = gram_of(counts)
    scales = {name: Fraction(1, 100) for name in names(4)}
    model = fit(gram, ["x1", "x3"], "y").model
    moved = counts.copy()
    moved[:, 0] += 25
    sums = error_sums(model, gram)
    assert disturb(sums, model, scales, bias={"x1": 0.25}) == error_sums(
        model, gram_of(moved), Fraction(gram.sum("y"), gram.n)
    )
    assert disturb(sums, model, scales) == sums
    with pytest.raises(QuestionError, match="does not use x2: it uses x1, x3"):
        disturb(sums, model, scales, noise={"x2": 1.0})
