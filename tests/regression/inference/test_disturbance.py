"""Sensor disturbance from Grams against the rows."""

from fractions import Fraction

import numpy as np
import pytest

from fleet_slip.errors import QuestionError
from fleet_slip.regression.figures import error_sums
from fleet_slip.regression.least_squares import fit
from fleet_slip.regression.shrinkage import disturb
from tests.support.counts import (
    gram_of,
    names,
    random_drives,
)


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
