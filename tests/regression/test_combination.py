"""EstimateCombination of two estimators: answers by hand, properties, and the choice."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_slip.arrays import FloatArray
from fleet_slip.regression.combination import (
    KNOTS_MPS2,
    METHODS,
    EstimateCombination,
    PairedEstimates,
    choose_combination,
    fit_combination,
)


def pairs_of(
    line: FloatArray, filtered: FloatArray, label: FloatArray, group: FloatArray
) -> PairedEstimates:
    return PairedEstimates(line, filtered, label, np.zeros(len(label)), group)


def random_pairs(seed: int, line_std: float, filter_std: float, groups: int = 4) -> PairedEstimates:
    random, rows = np.random.default_rng(seed), 400 * groups
    label = random.normal(size=rows)
    return PairedEstimates(
        label + random.normal(scale=line_std, size=rows),
        label + random.normal(scale=filter_std, size=rows),
        label,
        random.uniform(0, 10, rows),
        np.repeat(np.arange(groups), rows // groups).astype(float),
    )


def test_weights_by_hand() -> None:
    # z = 1 and 3, the groups have the weight 1/2 each: Σ v z² = 5. w_cv = Σ v (−z)(y − l) / 5.
    line, filtered = np.array([1.0, 3.0]), np.zeros(2)
    label = np.array([0.5, 0.0])
    result = fit_combination(pairs_of(line, filtered, label, np.array([0.0, 1.0])), "constant")
    w_cv = 0.5 * ((-1) * (-0.5) + (-3) * (-3)) / 5
    assert result.line_share[0] == pytest.approx(1 - (w_cv + 0.5) / 2)
    assert result.std_rad[0] == pytest.approx(math.sqrt(5))


def test_extreme_weights_are_clipped_before_they_are_shrunk() -> None:
    line, label = np.ones(2), np.full(2, 100.0)
    share = fit_combination(pairs_of(line, np.zeros(2), label, np.zeros(2)), "constant").line_share
    assert share == (1.0,)  # w_cv = −99 is clipped to −1, w = (−1 + 1/2) / 2 to 0


def test_difference_is_clipped_and_missing_lines_leave_the_filter() -> None:
    combined = EstimateCombination("filter", (0.5,), (1.0,))
    line = np.array([2.0, 10.0, -10.0, np.nan])
    assert combined(line, np.zeros(4), np.zeros(4)).tolist() == [1.0, 1.5, -1.5, 0.0]
    anchored = EstimateCombination("line", (0.5,), (1.0,))
    assert anchored(line, np.zeros(4), np.zeros(4)).tolist() == [1.0, 8.5, -8.5, 0.0]


def test_shares_are_linear_between_knots() -> None:
    combined = EstimateCombination("filter", (0.0, 1.0, 1.0, 0.0), (9.0,) * 4, KNOTS_MPS2)
    lateral = np.array([0.0, 1.5, 3.0, 7.5, 20.0])
    assert combined(np.ones(5), np.zeros(5), lateral).tolist() == [0.0, 0.5, 1.0, 0.5, 0.0]


def test_equal_shares_at_all_knots_without_information_by_acceleration() -> None:
    pairs = random_pairs(1, 0.1, 0.1)
    constant, by_lateral = (fit_combination(pairs, m) for m in ("constant", "by_lateral"))
    np.testing.assert_allclose(by_lateral.line_share, constant.line_share[0], atol=0.1)
    np.testing.assert_allclose(by_lateral.std_rad, constant.std_rad[0], rtol=0.1)


def test_shares_by_acceleration_follow_the_better_estimate() -> None:
    pairs = random_pairs(2, 0.1, 0.1)
    hard = pairs.lateral_mps2 > 4.5
    pairs.line[hard] += 10 * (pairs.line - pairs.label)[hard]
    pairs.filter[~hard] += 10 * (pairs.filter - pairs.label)[~hard]
    shares = fit_combination(pairs, "by_lateral").line_share
    assert shares[0] > 0.8 > 0.2 > shares[-1]


@given(st.integers(0, 2**32), st.floats(0.01, 10), st.floats(0.01, 10), st.sampled_from(METHODS))
def test_combinations_stay_between_both_estimates(
    seed: int, line_std: float, filter_std: float, method: str
) -> None:
    pairs = random_pairs(seed, line_std, filter_std)
    combined = fit_combination(pairs, method)  # type: ignore[arg-type]
    assert all(0 <= share <= 1 for share in combined.line_share)
    estimate = combined(pairs.line, pairs.filter, pairs.lateral_mps2)
    low, high = np.minimum(pairs.line, pairs.filter), np.maximum(pairs.line, pairs.filter)
    assert (estimate >= low - 1e-9).all()
    assert (estimate <= high + 1e-9).all()


@given(st.integers(0, 2**32))
def test_mirrored_estimates_have_a_mirrored_combination(seed: int) -> None:
    pairs = random_pairs(seed, 0.2, 0.1)
    mirrored = pairs_of(-pairs.line, -pairs.filter, -pairs.label, pairs.group)
    original, other = (fit_combination(p, "constant") for p in (pairs, mirrored))
    assert original == other


def test_few_groups_keep_the_constant_share() -> None:
    assert choose_combination(random_pairs(3, 0.1, 0.1, groups=2)).method == "constant"


def test_a_much_better_estimate_is_chosen_alone() -> None:
    random = np.random.default_rng(4)
    label = random.normal(size=4000)
    group = np.repeat(np.arange(4.0), 1000)
    signs = np.where(group % 2, 1.0, -1.0)
    wrong = label + signs * 3.0  # off to either side, which no constant share removes
    pairs = PairedEstimates(label + 0.001 * random.normal(size=4000), wrong, label, group, group)
    choice = choose_combination(pairs)
    assert choice.method == "line"
    assert choice.rmse_rad["line"] < choice.rmse_rad["constant"]
    assert choice.worst_rmse_rad["line"] >= choice.rmse_rad["line"]


def test_equal_estimates_are_the_filter() -> None:
    label = np.arange(4.0)
    assert fit_combination(pairs_of(label, label, label, np.zeros(4)), "constant").std_rad == (0.0,)


def test_a_line_that_fails_on_another_kind_judges_and_does_not_weigh() -> None:
    pairs, kinds = random_pairs(5, 0.1, 0.1), random_pairs(6, 30.0, 0.1, groups=1)
    alone, judged = choose_combination(pairs), choose_combination(pairs, kinds)
    assert judged.combination.std_rad[0] < 1
    assert judged.worst_rmse_rad["line"] > 10 > alone.worst_rmse_rad["line"]
    assert judged.method != "line"
    assert judged.groups == alone.groups + 1
