"""The error of a difference over independent groups, beside the spread of many repetitions."""

from collections.abc import Sequence
from fractions import Fraction

import numpy as np
import pytest

from fleet_slip.regression.choice import Shortfall, Worth, compare_paired, compare_typical
from fleet_slip.regression.figures import error_sums
from fleet_slip.regression.folds import CrossValidation, Folds, assemble
from fleet_slip.regression.gram import Gram
from fleet_slip.regression.least_squares import LinearModel

SIGNALS = ("x", "z", "y")
SCALES = dict.fromkeys(SIGNALS, Fraction(1))


def predict(slopes: Sequence[int], groups: Sequence[np.ndarray]) -> CrossValidation:
    """Return the figures of a model that was fitted to none of the groups."""
    folds = Folds(
        tuple(Gram.from_counts(SIGNALS, group) for group in groups),
        tuple(str(number) for number in range(len(groups))),
        len(groups),
    )
    model = LinearModel(SIGNALS[:2], "y", tuple(map(Fraction, slopes)), Fraction(0))
    return assemble("m", folds, [error_sums(model, g) for g in folds.grams], model, SCALES)


def compare(groups: Sequence[np.ndarray]) -> Shortfall:
    return compare_paired(predict((2, 0), groups), predict((2, 1), groups), Worth(0.0))


def draw(rng: np.random.Generator, groups: int) -> list[np.ndarray]:
    """Groups of unequal size, each with a truth of its own around that of both models."""
    found = []
    for _ in range(groups):
        x, z, noise = rng.normal(0, 100, (3, int(rng.integers(20, 80))))
        y = 2 * x + rng.normal(0.5, 0.4) * z + noise
        found.append(np.rint(np.stack([x, z, y], axis=1)).astype(np.int64))
    return found


def test_the_error_is_the_spread_of_many_repetitions() -> None:
    rng = np.random.default_rng(1)
    made = [compare(draw(rng, 12)) for _ in range(120)]
    spread = np.std([one.rmse for one in made])
    assert np.mean([one.standard_error for one in made]) == pytest.approx(spread, rel=0.2)


def test_rows_of_a_group_are_not_taken_for_independent() -> None:
    rng = np.random.default_rng(2)
    groups = draw(rng, 12)
    again = [np.concatenate([group] * 9) for group in groups]
    assert compare(again).standard_error == pytest.approx(compare(groups).standard_error)


def test_the_error_in_the_median_group_is_the_spread_of_many_repetitions() -> None:
    rng = np.random.default_rng(5)
    made = []
    for _ in range(80):
        groups = draw(rng, 20)
        made.append(compare_typical(predict((2, 0), groups), predict((2, 1), groups), Worth(0.0)))
    spread = np.std([one.rmse for one in made])
    assert np.mean([one.standard_error for one in made]) == pytest.approx(spread, rel=0.25)


def test_groups_that_lie_do_not_decide_whatever_their_rows() -> None:
    groups = draw(np.random.default_rng(6), 21)
    for group in groups:
        group[:, -1] = 2 * group[:, 0] + 10 * group[:, 1]
    for liar in range(10):
        groups[liar] = np.concatenate([groups[liar]] * 50)
        groups[liar][:, -1] = 0
    wrong, right = predict((0, 0), groups), predict((2, 10), groups)
    assert compare_paired(wrong, right, Worth(0.0)).negligible
    assert not compare_typical(wrong, right, Worth(0.0)).negligible


def test_the_same_model_falls_short_of_itself_by_nothing() -> None:
    one = predict((1, 1), draw(np.random.default_rng(3), 5))
    for compared in (compare_paired, compare_typical):
        shortfall = compared(one, one, Worth(0.0))
        assert (shortfall.rmse, shortfall.standard_error) == (0.0, 0.0)


def test_other_rows_cannot_be_paired() -> None:
    rng = np.random.default_rng(4)
    with pytest.raises(ValueError, match="same rows"):
        compare_paired(predict((1, 0), draw(rng, 4)), predict((1, 0), draw(rng, 4)), Worth(0.0))
