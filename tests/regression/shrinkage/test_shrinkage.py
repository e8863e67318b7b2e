"""Noise-matched ridge and errors in variables by properties."""

from fractions import Fraction

import numpy as np
import pytest

from fleet_slip.errors import DataError, QuestionError
from fleet_slip.regression.least_squares import fit
from fleet_slip.regression.shrinkage import (
    fit_errors_in_variables,
    fit_noise_matched,
    fit_penalised,
)
from tests.support.counts import gram_of, names, random_drives, unit_scales


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
