"""Choosing among nested models, and the honest figures of the choice."""

import numpy as np
import pytest

from fleet_slip.errors import QuestionError
from fleet_slip.regression.choice import (
    CROSS_VALIDATION,
    Rule,
    TrainingFolds,
    cross_validate_nested,
    cross_validate_selection,
    nested_fits,
    select_nested,
)
from fleet_slip.regression.folds import (
    CohortFolds,
    by_value,
    cross_validate,
    error_sums,
    least_squares,
)
from fleet_slip.regression.inference import DriveMoments, Evidence
from fleet_slip.regression.least_squares import fit
from fleet_slip.regression.subsets import best_size, best_subsets, pick_sizes
from tests.support.counts import gram_of, names, table_of, unit_scales

INPUTS = names(5)[:-1]


def sparse_drives(seed: int, drives: int = 40) -> list[np.ndarray]:
    """Two signals matter; drives have an offset of their own."""
    rng = np.random.default_rng(seed)
    result = []
    for _ in range(drives):
        x = rng.normal(size=(50, 5)) * 400 + rng.normal(size=5) * 200
        y = 0.8 * x[:, 1] - 0.5 * x[:, 3] + rng.normal() * 120 + rng.normal(size=50) * 40
        result.append(np.rint(np.column_stack([x, y])).astype(np.int64))
    return result


def training_of(drives: list[np.ndarray]) -> tuple[TrainingFolds, np.ndarray]:
    table = table_of([gram_of(counts) for counts in drives])
    assignment = by_value([i % 5 for i in range(len(drives))])
    folds = CohortFolds.from_tables([table], assignment).complete_cases(INPUTS, "y")
    return TrainingFolds(folds, DriveMoments.from_table(table), unit_scales(5)), assignment.fold


@pytest.mark.parametrize("ranking", ["forward", "backward", "t"])
@pytest.mark.parametrize("criterion", ["bic", CROSS_VALIDATION])
def test_the_signals_that_matter_are_found(ranking: str, criterion: str) -> None:
    training, _ = training_of(sparse_drives(1))
    selection = select_nested(training, INPUTS, "y", Rule(ranking, criterion))
    assert set(selection.order[: selection.size]) == {"x2", "x4"}
    assert selection.fit == fit(training.folds.total, selection.order[:2], "y")
    assert len(selection.values) == 6
    document = selection.as_dict()
    assert document["signals"] == [*selection.signals]
    assert document["evidence"] == "drives"
    assert np.argmin(selection.values) >= 2


def test_rows_taken_for_independent_keep_signals_that_drives_do_not_support() -> None:
    by_drives = by_rows = 0
    for seed in range(8):
        training, _ = training_of(sparse_drives(seed))
        chosen = select_nested(training, INPUTS, "y", Rule("backward", "bic"))
        by_drives += chosen.size
        by_rows += best_size("bic", Evidence.naive(training.nested_fits(chosen.order, "y")))
    assert by_drives < 8 * 2.5
    assert by_rows > 8 * 3.5


def test_the_choice_is_made_again_inside_every_training_fold() -> None:
    drives = sparse_drives(3, drives=20)
    training, fold = training_of(drives)
    rule = Rule("forward", "aic")
    result = cross_validate_selection("rule", training, fold, INPUTS, "y", rule)
    tests = []
    for number in range(5):
        rest = [drive for drive, f in zip(drives, fold, strict=True) if f != number]
        table = table_of([gram_of(counts) for counts in rest])
        folds = CohortFolds.from_tables([table], by_value([i % 4 for i in range(16)]))
        inner = TrainingFolds(
            folds.complete_cases(INPUTS, "y"), DriveMoments.from_table(table), unit_scales(5)
        )
        model = select_nested(inner, INPUTS, "y", rule).fit.model
        tests.append(error_sums(model, training.folds.grams[number]))
    pooled = sum(tests[1:], tests[0])
    assert result.pooled.rmse == pooled.figures(unit_scales(5)["y"]).rmse
    assert result.pooled.correlation == pooled.figures(unit_scales(5)["y"]).correlation
    assert result.signals == select_nested(training, INPUTS, "y", rule).fit.model.signals


def test_nested_models_are_cross_validated_in_order() -> None:
    training, _ = training_of(sparse_drives(2))
    order = ("x4", "x2", "x1", "x3", "x5")
    models = cross_validate_nested(training, order, "y")
    assert [model.signals for model in models] == [order[:j] for j in range(6)]
    alone = cross_validate("x", training.folds, least_squares(order[:2], "y"), training.scales)
    assert models[2].pooled == alone.pooled


def test_inner_cross_validation_needs_folds() -> None:
    drives = sparse_drives(4, drives=6)
    table = table_of([gram_of(counts) for counts in drives])
    assignment = by_value([0, 0, 0, 1, 1, 1])
    folds = CohortFolds.from_tables([table], assignment).complete_cases(INPUTS, "y")
    training = TrainingFolds(folds, DriveMoments.from_table(table), unit_scales(5))
    with pytest.raises(QuestionError, match="at least three folds"):
        cross_validate_selection(
            "x", training, assignment.fold, INPUTS, "y", Rule("t", CROSS_VALIDATION)
        )


def test_criteria_choose_among_the_best_subsets() -> None:
    training, _ = training_of(sparse_drives(5))
    selection = select_nested(training, INPUTS, "y", Rule("t", "cp"))
    results = best_subsets(training.folds.total, INPUTS, "y")
    picked = pick_sizes(results, selection.evidence)
    assert picked["bic"] == 2
    assert set(results[2].best.model.signals) == {"x2", "x4"}
    assert results[2].as_dict()["signals"] == ["x2", "x4"]


ORDER = ("x1", "x2", "x3", "x4")


def project(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    design = np.column_stack([np.ones(len(x)), x])
    return np.asarray(design @ np.linalg.lstsq(design, y, rcond=None)[0])


def drawn(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs and the label without noise, in counts; the last two signals have no effect."""
    x = np.rint(rng.normal(0, 1000, (200, 4)) + rng.normal(0, 500, (200, 1)))
    return x, 0.04 * x[:, 0] - 0.02 * x[:, 1]


def evidence_of(x: np.ndarray, y: np.ndarray) -> Evidence:
    gram = gram_of(np.column_stack([x, y]).astype(np.int64))
    return Evidence.naive(nested_fits(gram, ORDER, "y"))


def test_the_distance_to_the_full_model_is_that_of_the_predictions() -> None:
    rng = np.random.default_rng(1)
    x, truth = drawn(rng)
    y = np.rint(truth + rng.normal(0, 30, 200))
    full = project(x, y)
    variance = np.sum((y - full) ** 2) / (200 - 5)
    distances = [np.sum((full - project(x[:, :j], y)) ** 2) / variance for j in range(5)]
    np.testing.assert_allclose(evidence_of(x, y).excess(), distances, rtol=1e-9, atol=1e-9)


def test_the_expected_distance_is_what_the_true_model_is_away_on_average() -> None:
    """The constant is fitted by every model, and costs each of them one more."""
    rng = np.random.default_rng(2)
    x, truth = drawn(rng)
    estimated, real = np.zeros(5), np.zeros(5)
    trials = 400
    for _ in range(trials):
        y = np.rint(truth + rng.normal(0, 30, 200))
        estimated += np.array(evidence_of(x, y).distances()) / trials
        away = [np.sum((truth - project(x[:, :j], y)) ** 2) / 30**2 for j in range(5)]
        real += (np.array(away) - 1) / trials
    assert real[:2].min() > 50
    assert estimated == pytest.approx(real, rel=0.04, abs=0.3)
