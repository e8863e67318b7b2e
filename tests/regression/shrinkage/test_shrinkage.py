"""Noise-matched ridge by properties."""

import numpy as np
import pytest

from fleet_slip.errors import QuestionError
from fleet_slip.regression.least_squares import fit
from fleet_slip.regression.shrinkage import fit_noise_matched
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


def test_without_noise_it_is_least_squares_exactly() -> None:
    gram = gram_of(np.concatenate(random_drives(6)))
    inputs = names(4)[:-1]
    model = fit_noise_matched(gram, inputs, "y", {}, unit_scales(4))
    assert model == fit(gram, inputs, "y").model
    with pytest.raises(QuestionError, match="noise is given for gyro"):
        fit_noise_matched(gram, inputs, "y", {"gyro": 1.0}, unit_scales(4))
