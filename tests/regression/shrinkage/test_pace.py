"""Pace regression with a mixture that is known or estimated, against closed forms and losses."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy import stats

from fleet_slip.arrays import FloatArray
from fleet_slip.regression.shrinkage.mixture import ChiSquareKernel, Mixture, fit_mixture
from fleet_slip.regression.shrinkage.pace import ESTIMATORS, pace1, pace3, pace5

EFFECTS = np.array([30, 8, 4, 2.5, 0.4, 0.2, -0.3, 0.1])
"""Four effects, and four that are noise."""

Procedure = Callable[[FloatArray, Mixture], FloatArray]


def weka_mixture(a: FloatArray) -> Mixture:
    return fit_mixture(a**2, ChiSquareKernel(reach=0.5))


def test_an_effect_of_four_standard_errors_is_kept() -> None:
    assert (ESTIMATORS["pace2"](EFFECTS) == [30, 8, 4, 2.5, 0, 0, 0, 0]).all()
    assert (ESTIMATORS["pace4"](EFFECTS) == [30, 8, 4, 2.5, 0, 0, 0, 0]).all()
    assert ESTIMATORS["pace6"](EFFECTS)[2] == pytest.approx(4, abs=0.1)


def test_weka_s_slip_drops_it() -> None:
    for procedure in (pace1, pace3, pace5):
        assert procedure(EFFECTS, weka_mixture(EFFECTS))[2] == 0


@pytest.mark.parametrize(
    ("truth", "most"), [(np.zeros(9), 0.6), (np.array([*EFFECTS[:4], 0, 0, 0, 0, 0]), 0.95)]
)
def test_a_symmetric_reach_lowers_the_loss(truth: FloatArray, most: float) -> None:
    rng = np.random.default_rng(1)
    loss = {0.5: 0.0, 3.0: 0.0}
    for _ in range(500):
        a = truth + rng.normal(size=truth.size)
        for reach in loss:
            mixture = fit_mixture(a**2, ChiSquareKernel(reach=reach))
            loss[reach] += float(np.sum((pace5(a, mixture) - truth) ** 2))
    assert loss[3.0] < most * loss[0.5], loss


def test_shrinking_by_a_known_mixture_is_the_posterior_mean() -> None:
    """Of |a*|, for effects that are 0 or 3, half and half."""
    mixture = Mixture(np.array([0.0, 9.0]), np.array([0.5, 0.5]))
    a = np.array([-4.0, 1.5, 2.0])
    none = 2 * stats.norm.pdf(a)
    three = stats.norm.pdf(np.abs(a) - 3) + stats.norm.pdf(np.abs(a) + 3)
    expected = np.sign(a) * 3 * three / (none + three)
    expected[expected**2 <= 0.5] = 0
    np.testing.assert_allclose(pace5(a, mixture), expected, rtol=1e-12)


def test_a_known_mixture_says_which_dimensions_to_keep() -> None:
    """By H(A) = E[2 a a* - a^2 | a], integrated over the signs and sizes of a* by hand."""
    mixture = Mixture(np.array([0.0, 9.0]), np.array([0.8, 0.2]))
    a = np.array([3.5, -2.6, 2.9, 1.0])
    centres, weights = np.array([0.0, 3.0, -3.0]), np.array([0.8, 0.1, 0.1])
    likely = weights * stats.norm.pdf(a[:, None] - centres)
    mean = (likely / likely.sum(axis=1, keepdims=True)) @ centres
    contributions = 2 * a * mean - a**2
    assert (pace3(a, mixture) == np.where(contributions > 0, a, 0)).all()
    kept = int(np.argmax(np.concatenate([[0], np.cumsum(contributions)])))
    assert (pace1(a, mixture) == np.where(np.arange(4) < kept, a, 0)).all()
    assert 0 < kept < 4


@pytest.mark.parametrize(
    ("known", "estimated"),
    [(pace1, ESTIMATORS["pace2"]), (pace3, ESTIMATORS["pace4"]), (pace5, ESTIMATORS["pace6"])],
)
def test_knowing_the_mixture_is_better_than_estimating_it(
    known: Procedure, estimated: Callable[[FloatArray], FloatArray]
) -> None:
    """Over effects that come from it; the even procedures estimate it from nine of them."""
    rng = np.random.default_rng(2)
    mixture = Mixture(np.array([0.0, 16.0]), np.array([2 / 3, 1 / 3]))
    loss = np.zeros(3)
    for _ in range(400):
        truth = np.sort(rng.choice([0.0, 4.0], size=9, p=mixture.weights))[::-1]
        a = truth + rng.normal(size=9)
        for i, found in enumerate((known(a, mixture), estimated(a), a)):
            loss[i] += np.sum((found - truth) ** 2)
    assert loss[0] < loss[1] < 1.05 * loss[2], loss
