"""Members of a kind are drawn towards its mean: known truths, and that what is stated holds."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fleet_slip.arrays import FloatArray
from fleet_slip.regression.inference import pool

BASEBALL = np.array([18, 17, 16, 15, 14, 14, 13, 12, 11, 11, 10, 10, 10, 10, 10, 9, 8, 7]) / 45
"""Hits of 18 players in 45 at bats, after Efron and Morris (1975)."""

NUMBERS = hnp.arrays(
    np.float64,
    st.shared(st.integers(4, 12), key="members"),
    elements=st.floats(-1.0, 1.0, allow_subnormal=False),
)
VARIANCES = hnp.arrays(
    np.float64,
    st.shared(st.integers(4, 12), key="members"),
    elements=st.floats(1e-4, 1.0),
)


def test_members_of_equal_variance_are_drawn_as_the_closed_form_says() -> None:
    """By the smaller root B of (1 - B) (k - 1 - B S / V) = 2: Morris and Tang (2011), V equal."""
    root = np.sqrt(45) * np.arcsin(2 * BASEBALL - 1)  # of variance 1
    mean, squares = root.mean(), root.var() * 18
    drawn = np.roots([squares, -(squares + 17), 17 - 2]).min()
    found = pool(root, np.ones(18))
    assert found is not None
    assert found.mean == pytest.approx(mean)
    assert found.values == pytest.approx(root + drawn * (mean - root))
    assert found.spread == pytest.approx(np.sqrt(1 / drawn - 1))


@given(NUMBERS, VARIANCES, st.floats(-10, 10), st.floats(0.1, 10))
def test_a_unit_and_an_origin_change_nothing_else(
    values: FloatArray, variances: FloatArray, origin: float, unit: float
) -> None:
    one, other = pool(values, variances), pool(unit * values + origin, unit**2 * variances)
    assert one is not None
    assert other is not None
    assert other.values == pytest.approx(unit * one.values + origin, abs=1e-6)
    assert other.errors == pytest.approx(unit * one.errors, rel=1e-3, abs=1e-6)
    assert other.spread == pytest.approx(unit * one.spread, rel=1e-3, abs=1e-5)


@given(NUMBERS, VARIANCES)
def test_members_come_nearer_to_the_mean_the_more_so_the_less_they_know(
    values: FloatArray, variances: FloatArray
) -> None:
    found = pool(values, variances)
    assert found is not None
    left = np.abs(found.values - found.mean)
    assert (left <= np.abs(values - found.mean) + 1e-12).all()
    apart = np.abs(values - found.mean) > 1e-6
    kept = (left[apart] / np.abs(values - found.mean)[apart])[np.argsort(variances[apart])]
    assert all(more >= less - 1e-9 for more, less in pairwise(kept))


def test_of_too_few_members_nothing_is_drawn() -> None:
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
        found = pool(values, variances)
        assert found is not None
        within.append(np.abs(found.values - true) <= 1.645 * found.errors)
        gain.append((found.values - true) ** 2 - (values - true) ** 2)
    assert np.mean(within) >= 0.885
    assert np.mean(within) <= (1 if spread == 0 else 0.94)
    assert np.mean(gain) < 0
