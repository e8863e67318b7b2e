"""Folds, cross-validation from Grams against the rows, and the choice of a winner."""

import math
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from fleet_slip.base import hash_fold
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.regression.choice import RmseGap, choose, compare_paired
from fleet_slip.regression.folds import (
    CohortFolds,
    CrossValidation,
    Folds,
    assemble,
    by_hash,
    by_value,
    cross_validate,
    error_sums,
    least_squares,
)
from fleet_slip.regression.gram import Gram
from fleet_slip.regression.least_squares import LinearModel
from tests.support.counts import dense_fit, gram_of, names, random_drives, table_of

SCALES = {**{name: Fraction(1, 100) for name in names(6)}, "y": Fraction(1, 10_000)}


def cohort_of(drives: list[np.ndarray], fold: list[int]) -> CohortFolds:
    table = table_of([gram_of(counts) for counts in drives])
    return CohortFolds.from_tables([table], by_value(fold))


def cross_validated(name: str, cohort: CohortFolds, inputs: Sequence[str]) -> CrossValidation:
    folds = cohort.complete_cases(inputs, "y")
    return cross_validate(name, folds, least_squares(inputs, "y"), SCALES)


@settings(max_examples=25)
@given(st.integers(0, 10**6), st.integers(2, 5))
def test_equals_cross_validation_on_rows(seed: int, count: int) -> None:
    drives = random_drives(seed, drives=10)
    fold = [i % count for i in range(10)]
    result = cross_validated("m", cohort_of(drives, fold), ["x1", "x3"])
    predicted, label, null = [], [], 0.0
    for number in range(count):
        columns = [drive[:, [0, 2, 4]] for drive in drives]
        train = np.concatenate([c for c, f in zip(columns, fold, strict=True) if f != number])
        test = np.concatenate([c for c, f in zip(columns, fold, strict=True) if f == number])
        solution, _ = dense_fit(train)
        estimate = solution[0] + test[:, :-1] @ solution[1:]
        figures = result.folds[number]
        assert figures.rows == len(test)
        assert figures.correlation == pytest.approx(np.corrcoef(estimate, test[:, -1])[0, 1])
        predicted.append(estimate)
        label.append(test[:, -1])
        null += float(np.sum((test[:, -1] - train[:, -1].mean()) ** 2))
    error = np.concatenate(predicted) - np.concatenate(label)
    pooled = result.pooled
    correlation = np.corrcoef(np.concatenate(predicted), np.concatenate(label))[0, 1]
    assert pooled.correlation == pytest.approx(correlation, rel=1e-9)
    assert pooled.rmse == pytest.approx(np.sqrt(np.mean(error**2)) * 1e-4, rel=1e-9)
    assert pooled.error_mean == pytest.approx(error.mean() * 1e-4, rel=1e-6, abs=1e-12)
    assert pooled.error_std == pytest.approx(error.std(ddof=1) * 1e-4, rel=1e-9)
    assert pooled.error_std_deg == np.degrees(pooled.error_std)
    assert pooled.relative_rmse == pytest.approx(np.sqrt(np.sum(error**2) / null), rel=1e-9)
    spread = np.std([f.correlation for f in result.folds], ddof=1) / np.sqrt(count)
    assert result.standard_error == pytest.approx(spread)


def test_drives_without_a_signal_serve_the_models_that_do_not_need_it() -> None:
    drives = random_drives(7, drives=12)
    full = table_of([gram_of(counts) for counts in drives[:6]])
    poor = table_of(
        [Gram.from_counts(("y", "x1", "x2"), counts[:, [4, 0, 1]]) for counts in drives[6:]]
    )
    cohort = CohortFolds.from_tables([full, poor], by_value([0, 1, 2] * 4))
    both = cross_validated("two", cohort, ["x1", "x2"])
    assert both.drives == 12
    assert both.pooled.rows == 12 * 60
    together = cohort_of(drives, [0, 1, 2] * 4)
    assert both == cross_validated("two", together, ["x1", "x2"])
    assert cross_validated("three", cohort, ["x3"]).drives == 6
    with pytest.raises(DataError, match="these drives lack gyro"):
        cohort.complete_cases(["gyro"], "y")


def test_folds_lacking_a_signal_are_an_error() -> None:
    drives = random_drives(7, drives=4)
    full = table_of([gram_of(counts) for counts in drives[:2]])
    cohort = CohortFolds.from_tables(
        [full, full.restrict(["x1", "y"])], by_value(["a", "a", "b", "b"])
    )
    with pytest.raises(DataError, match="only fold a has rows with all of x2, y"):
        cohort.complete_cases(["x2"], "y")


def test_the_hash_of_a_drive_decides_its_fold_for_ever() -> None:
    assert [hash_fold(f"drive-{i}", 5) for i in range(8)] == [4, 4, 1, 4, 3, 1, 1, 1]
    ids = [f"d{i}" for i in range(200)]
    subset, many = by_hash(ids[:100], 5), by_hash(ids, 5)
    np.testing.assert_array_equal(subset.fold, many.fold[:100])
    sizes = np.bincount(by_hash([f"d{i}" for i in range(10_000)], 5).fold)
    assert sizes.min() > 1800
    assert sizes.max() < 2200


def test_folds_that_no_drive_falls_into_are_left_out() -> None:
    ids = [f"drive-{i}" for i in range(4)]
    folds = by_hash(ids, 50)
    assert folds.names == tuple(str(n + 1) for n in sorted({hash_fold(i, 50) for i in ids}))
    assert [folds.names[fold] for fold in folds.fold] == [str(hash_fold(i, 50) + 1) for i in ids]


def test_single_folds_are_errors() -> None:
    with pytest.raises(DataError, match="the cohort has one"):
        by_hash(["a", "a"], 5)
    with pytest.raises(DataError, match="the cohort has one"):
        by_hash(["a", "b"], 1)
    with pytest.raises(DataError, match="the cohort has one: waterford"):
        by_value(["waterford", "waterford"])
    with pytest.raises(DataError, match="no value"):
        by_value(["a", None])


def candidate(name: str, size: int, correlation: float, *rmses: float) -> CrossValidation:
    """Return a real result with its correlation and two folds' RMSEs placed."""
    cohort = cohort_of(random_drives(1, inputs=6), [0, 1] * 6)
    inputs = names(6)[:size]
    result = cross_validated(name, cohort, inputs)
    r = Fraction(correlation)
    sums = replace(
        result.sums, n=1, p=Fraction(0), y=Fraction(0), pp=Fraction(1), yy=Fraction(1), py=r
    )
    folds = tuple(replace(f, rmse=rmse) for f, rmse in zip(result.folds, rmses, strict=True))
    pooled = replace(result.pooled, correlation=correlation, rmse=math.fsum(rmses) / len(rmses))
    return replace(result, sums=sums, folds=folds, pooled=pooled)


def test_a_gain_that_is_real_and_worth_nothing_buys_no_signal() -> None:
    """Folds differ by much more than models do: unpaired, no gain would be real."""
    small = candidate("small", 3, 0.985, 1.10, 2.11)
    best = candidate("best", 5, 0.990, 1.05, 2.05)
    lacks = math.sqrt(1.605**2 - 1.55**2)
    assert choose([small, best], 1.01 * lacks).model is small
    chosen = choose([small, best], 0.99 * lacks)
    assert (chosen.model, chosen.best) == (best, best)
    shortfall = chosen.gaps[0]
    assert shortfall.rmse == pytest.approx(0.055)
    assert shortfall.independent_error == pytest.approx(lacks)
    assert shortfall.is_significant
    assert not shortfall.negligible
    reason = choose([small, best], 0.5).reason
    assert "fewest signals (3) of the 2 models that are about as good" in reason


@pytest.mark.parametrize("noise", [0.0, 0.5, 2.0])
def test_the_shortfall_of_a_model_does_not_depend_on_label_noise(noise: float) -> None:
    small = candidate("small", 3, 0.985, *(math.hypot(0.5, noise) for _ in range(2)))
    best = candidate("best", 5, 0.990, *(math.hypot(0.4, noise) for _ in range(2)))
    assert choose([small, best], 0.301).model is small
    assert choose([small, best], 0.299).model is best


def test_a_gain_that_is_not_real_buys_no_signal_however_large() -> None:
    small = candidate("small", 3, 0.985, 1.00, 2.50)
    best = candidate("best", 5, 0.990, 1.05, 2.05)
    chosen = choose([small, best], 0.001)
    assert chosen.model is small
    assert "below the tolerance or one standard error" in chosen.reason


def test_the_standard_error_of_a_shortfall_is_that_of_a_paired_t_test() -> None:
    cohort = cohort_of(random_drives(1, inputs=6), [0, 1, 2] * 4)
    smaller, other = (cross_validated(str(k), cohort, names(6)[:k]) for k in (3, 5))
    chosen = choose([smaller, other])
    gap = next(s for s in chosen.gaps if s.model is not chosen.best)
    a, b = ([fold.rmse for fold in m.folds] for m in (gap.model, chosen.best))
    expected = np.mean(np.subtract(a, b)) / stats.ttest_rel(a, b).statistic
    assert gap.standard_error == pytest.approx(expected, rel=1e-9)


def test_a_clear_best_wins_and_ties_go_to_the_declared_order() -> None:
    clear = [candidate("first", 1, 0.90, 2.0, 3.0), candidate("best", 5, 0.990, 1.0, 2.0)]
    assert choose(clear).model.name == "best"
    assert "no model with fewer signals is negligibly worse" in choose(clear).reason
    tied = [candidate("b", 2, 0.9, 1.0, 1.0), candidate("a", 2, 0.9, 1.0, 1.0)]
    assert choose(tied).model.name == "b"
    twins = [candidate("twin", 2, 0.91, 1.0, 1.0), candidate("a", 2, 0.9, 1.0, 1.0)]
    assert choose(twins[::-1]).model.name == "twin"
    assert choose(clear[:1]).reason == "Model first is the only one."
    with pytest.raises(QuestionError, match="empty"):
        choose([])


def test_a_json_document_has_what_is_promised() -> None:
    cohort = cohort_of(random_drives(2), [0, 1, 2] * 4)
    document = cross_validated("m1", cohort, ["x2"]).as_dict()
    assert document["name"] == "m1"
    assert document["signals"] == ["x2"]
    assert {"correlation", "rmse_deg", "error_mean_deg", "error_std_deg"} <= document.keys()
    assert document["coefficients"].keys() == {"x2"}
    assert len(document["folds"]) == 3


@given(st.lists(st.integers(0, 30), min_size=2, max_size=60), st.integers(2, 6))
def test_bands_are_contiguous_and_whole(values: list[int], count: int) -> None:
    if len(set(values)) < 2:
        return
    bands = by_value(values, count)
    assert len(bands.names) == min(count, len(set(values)))
    by_fold = [
        {v for v, f in zip(values, bands.fold, strict=True) if f == fold}
        for fold in range(len(bands.names))
    ]
    assert all(max(low) < min(high) for low, high in pairwise(by_fold))
    sizes = [len(band) for band in by_fold]
    assert max(sizes) - min(sizes) <= 1


def test_a_drive_without_a_speed_is_in_no_band() -> None:
    with pytest.raises(DataError, match="no value of the column to fold by"):
        by_value([0.5, None, 0.7], 2)


SIGNALS = ("x", "z", "y")
OF_ONE = dict.fromkeys(SIGNALS, Fraction(1))


def predict(slopes: Sequence[int], groups: Sequence[np.ndarray]) -> CrossValidation:
    """Return the figures of a model that was fitted to none of the groups."""
    folds = Folds(
        tuple(Gram.from_counts(SIGNALS, group) for group in groups),
        tuple(str(number) for number in range(len(groups))),
        len(groups),
    )
    model = LinearModel(SIGNALS[:2], "y", tuple(map(Fraction, slopes)), Fraction(0))
    return assemble("m", folds, [error_sums(model, g) for g in folds.grams], model, OF_ONE)


def compare(groups: Sequence[np.ndarray]) -> RmseGap:
    return compare_paired(predict((2, 0), groups), predict((2, 1), groups), 0.0)


def draw(rng: np.random.Generator, groups: int) -> list[np.ndarray]:
    """Groups of unequal size, each with a truth of its own around that of both models."""
    drives = []
    for _ in range(groups):
        x, z, noise = rng.normal(0, 100, (3, int(rng.integers(20, 80))))
        y = 2 * x + rng.normal(0.5, 0.4) * z + noise
        drives.append(np.rint(np.stack([x, z, y], axis=1)).astype(np.int64))
    return drives


def test_the_error_is_the_spread_of_many_repetitions() -> None:
    rng = np.random.default_rng(1)
    results = [compare(draw(rng, 12)) for _ in range(120)]
    spread = np.std([result.rmse for result in results])
    assert np.mean([result.standard_error for result in results]) == pytest.approx(spread, rel=0.2)


def test_rows_of_a_group_are_not_taken_for_independent() -> None:
    rng = np.random.default_rng(2)
    groups = draw(rng, 12)
    again = [np.concatenate([group] * 9) for group in groups]
    assert compare(again).standard_error == pytest.approx(compare(groups).standard_error)


def test_other_rows_cannot_be_paired() -> None:
    rng = np.random.default_rng(4)
    with pytest.raises(ValueError, match="same rows"):
        compare_paired(predict((1, 0), draw(rng, 4)), predict((1, 0), draw(rng, 4)), 0.0)
