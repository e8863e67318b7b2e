"""One model for all regimes, or one for each."""

from dataclasses import replace

import numpy as np
import pytest

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import QuestionError
from fleet_slip.grams.folding import Folding, assign_folds
from fleet_slip.models.regimes import (
    ROWS_PER_COEFFICIENT,
    band_order,
    compare_regimes,
    divided_set,
    regime_names,
)
from fleet_slip.regression.choice import Worth
from tests.support.cohorts import INPUTS, Driven, cohort_of, driven
from tests.support.counts import dense_fit

FIVE = Folding(by="drive", count=5)
SLOW, FAST = "speed < 10, |ay| < 1", "speed 10-15, |ay| < 1"
COEFFICIENTS = (0.1, 0.4, 0.9, 0.2)


def divided(fast: tuple[float, ...], rows: int = 100) -> list[Driven]:
    """Drives with a slow and a fast part; the fast ones may follow another law."""
    slow = driven(1, COEFFICIENTS, drives=15, rows=100, part=SLOW)
    return slow + driven(2, fast, drives=15, rows=rows, part=FAST)


def held_out(drives: list[Driven], *, own: bool) -> dict[str, np.ndarray]:
    """Estimate and truth of every row by part, from the rows: shape (2, rows)."""
    fold = assign_folds([one.drive for one in drives], "drive", 5).fold
    found: dict[str, list[np.ndarray]] = {}
    for number in sorted(set(fold)):
        for part in (SLOW, FAST):
            pairs = list(zip(drives, fold, strict=True))
            rest = [o.counts for o, f in pairs if f != number and (not own or o.part == part)]
            test = [o.counts for o, f in pairs if f == number and o.part == part]
            if test:
                b, _ = dense_fit(np.concatenate(rest))
                counts = np.concatenate(test)
                found.setdefault(part, []).append(
                    np.array([b[0] + counts[:, :-1] @ b[1:], counts[:, -1]])
                )
    return {part: np.concatenate(pairs, axis=1) for part, pairs in found.items()}


@pytest.mark.parametrize(
    ("signals", "name"),
    [(None, "regimes"), ("ay,curvature", "regimes"), ("ay, ay_mean_16", "windows_regimes")],
)
def test_rows_are_divided_by_a_set_that_has_the_inputs(signals: str | None, name: str) -> None:
    assert divided_set(signals) == name


def test_figures_by_regime_are_those_of_the_rows() -> None:
    drives = divided((0.3, 0.2, 0.5, 0.0))
    found = compare_regimes(cohort_of(drives, feature_set="regimes"), INPUTS, FIVE)
    unit = float(catalogue()["sideslip"].scale)
    for own in (False, True):
        by_part = held_out(drives, own=own)
        for one in found.regimes:
            estimate, truth = by_part[one.name]
            figures = one.split if own else one.pooled
            assert figures.rows == one.rows == 1500
            assert figures.rmse == pytest.approx(
                unit * np.sqrt(np.mean((estimate - truth) ** 2)), rel=1e-9
            )
        estimate, truth = np.concatenate(list(by_part.values()), axis=1)
        whole = found.split if own else found.pooled
        assert whole.correlation == pytest.approx(np.corrcoef(estimate, truth)[0, 1], rel=1e-9)
    assert [one.name for one in found.regimes] == [SLOW, FAST]
    assert [one.share for one in found.regimes] == [0.5, 0.5]
    assert all(one.own for one in found.regimes)
    folds = len(set(assign_folds([one.drive for one in drives], "drive", 5).fold))
    assert (found.signals, found.drives, found.folds) == (INPUTS, 15, folds)


def test_splitting_wins_where_the_law_differs_and_loses_where_it_is_one() -> None:
    differing = compare_regimes(
        cohort_of(divided((0.3, 0.2, 0.5, 0.0)), feature_set="regimes"), INPUTS, FIVE
    )
    assert differing.split_wins
    assert differing.gain > 0.01
    assert differing.as_dict()["winner"] == "split"
    same = compare_regimes(cohort_of(divided(COEFFICIENTS), feature_set="regimes"), INPUTS, FIVE)
    assert not same.split_wins
    assert abs(same.gain) < 1e-3
    assert same.as_dict()["winner"] == "pooled"


def test_the_gain_is_the_mean_over_the_folds_with_its_standard_error() -> None:
    drives = divided((0.3, 0.2, 0.5, 0.0))
    fold = assign_folds([one.drive for one in drives], "drive", 5).fold
    gains = []
    for number in sorted(set(fold)):
        mine = [one for one, at in zip(drives, fold, strict=True) if at == number]
        rest = [one for one, at in zip(drives, fold, strict=True) if at != number]
        truth = np.concatenate([one.counts[:, -1] for one in mine])
        both = []
        for own in (True, False):
            estimates = []
            for one in mine:
                training = [r.counts for r in rest if not own or r.part == one.part]
                b, _ = dense_fit(np.concatenate(training))
                estimates.append(b[0] + one.counts[:, :-1] @ b[1:])
            both.append(signed_r(np.concatenate(estimates), truth))
        gains.append(both[0] - both[1])
    found = compare_regimes(cohort_of(drives, feature_set="regimes"), INPUTS, FIVE)
    assert found.gain == pytest.approx(np.mean(gains), rel=1e-6)
    assert found.gain_standard_error == pytest.approx(
        np.std(gains, ddof=1) / len(gains) ** 0.5, rel=1e-6
    )


def test_a_split_must_be_worth_its_coefficients() -> None:
    cohort = cohort_of(divided((0.3, 0.2, 0.5, 0.0)), feature_set="regimes")
    found = compare_regimes(cohort, INPUTS, FIVE)
    assert found.rmse_gain == pytest.approx(found.pooled.rmse - found.split.rmse)
    assert found.rmse_gain > found.rmse_gain_standard_error > 0
    gain = (found.pooled.rmse**2 - found.split.rmse**2) ** 0.5
    worths = [Worth(gain * factor) for factor in (0.99, 1.01)]
    chosen = [compare_regimes(cohort, INPUTS, FIVE, worth=worth) for worth in worths]
    assert [one.split_wins for one in chosen] == [True, False]
    share = Worth(found.rmse_gain / found.split.rmse * 1.01, relative=True)
    assert not compare_regimes(cohort, INPUTS, FIVE, worth=share).split_wins
    assert not replace(found, rmse_gain_standard_error=2 * found.rmse_gain).split_wins


def signed_r(estimate: np.ndarray, truth: np.ndarray) -> float:
    return float(np.corrcoef(estimate, truth)[0, 1])


def test_a_regime_with_too_few_rows_uses_the_model_of_all() -> None:
    enough = ROWS_PER_COEFFICIENT * (len(INPUTS) + 1)
    drives = divided((0.3, 0.2, 0.5, 0.0), rows=enough // 15)  # not enough without a fold
    found = compare_regimes(cohort_of(drives, feature_set="regimes"), INPUTS, FIVE)
    slow, fast = found.regimes
    assert (slow.own, fast.own) == (True, False)
    assert fast.split == fast.pooled
    assert slow.split != slow.pooled


def test_regimes_can_be_taken_together() -> None:
    cohort = cohort_of(divided(COEFFICIENTS), feature_set="regimes")
    assert set(regime_names(cohort, ["speed"])) == {"speed < 10", "speed 10-15"}
    assert set(regime_names(cohort, ["ay"])) == {"|ay| < 1"}
    assert set(regime_names(cohort, ["ay", "speed"])) == {
        "|ay| < 1, speed < 10",
        "|ay| < 1, speed 10-15",
    }
    together = compare_regimes(cohort, INPUTS, FIVE, over=["ay"])
    assert [one.name for one in together.regimes] == ["|ay| < 1"]
    assert together.split == together.pooled
    assert together.gain == 0.0


def test_bands_come_in_their_order_and_unknown_ones_last() -> None:
    cohort = cohort_of(divided(COEFFICIENTS), feature_set="regimes")
    names = ["unknown", "speed >= 30", "speed 10-15", "speed < 10"]
    assert band_order(cohort, names) == ["speed < 10", "speed 10-15", "speed >= 30", "unknown"]


def test_what_is_not_divided_is_told() -> None:
    plain = cohort_of(divided(COEFFICIENTS))
    with pytest.raises(QuestionError, match=r"not divided by any regime; .* regimes: regimes"):
        compare_regimes(plain, INPUTS, FIVE)
    cohort = cohort_of(divided(COEFFICIENTS), feature_set="regimes")
    with pytest.raises(QuestionError, match=r"not divided by weather regime; it has speed, ay"):
        compare_regimes(cohort, INPUTS, FIVE, over=["weather"])
    with pytest.raises(QuestionError, match="fold by drive"):
        compare_regimes(cohort, INPUTS, Folding(by="row", count=5))
