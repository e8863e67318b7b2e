"""Choosing among nested models, and the distances of the paper."""

import numpy as np
import pytest

from fleet_slip.errors import DataError, QuestionError
from fleet_slip.regression.choice import NestedChoice, Rule, choose_nested, nested_fits
from fleet_slip.regression.folds import CohortFolds, by_value, cross_validate, least_squares
from fleet_slip.regression.inference import DriveMoments, Evidence
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


def chosen(seed: int, rule: Rule, cluster: int | None = None) -> NestedChoice:
    """Choose in five folds; with a `cluster` all drives are one, so that rows are independent."""
    table = table_of([gram_of(counts) for counts in sparse_drives(seed)])
    folds = CohortFolds.from_tables([table], by_value([i % 5 for i in range(40)]))
    clusters = None if cluster is None else np.full(40, cluster)
    moments = DriveMoments.from_table(table, clusters)
    complete = folds.complete_cases(INPUTS, "y")
    return choose_nested(complete, moments, INPUTS, "y", unit_scales(5), rule)


@pytest.mark.parametrize("ranking", ["forward", "backward"])
@pytest.mark.parametrize("criterion", ["bic", "aic", "cv"])
def test_the_signals_that_matter_are_found(ranking: str, criterion: str) -> None:
    choice = chosen(1, Rule(ranking, criterion))
    assert {*choice.order[:2]} == {"x2", "x4"} <= {*choice.winner.model.signals}
    if criterion != "aic":
        assert choice.winner.model.signals == choice.order[:2]
    assert [model.signals for model in choice.models] == [choice.order[:j] for j in range(1, 6)]
    assert len(choice.values) == 6
    document = choice.as_dict()
    assert document["signals"] == [*choice.winner.model.signals]
    assert document["evidence"] == "drives"
    assert np.argmin(choice.values) >= 2


def test_nested_models_have_the_figures_of_their_own_cross_validation() -> None:
    table = table_of([gram_of(counts) for counts in sparse_drives(2)])
    folds = CohortFolds.from_tables([table], by_value([i % 5 for i in range(40)]))
    complete = folds.complete_cases(INPUTS, "y")
    for model in chosen(2, Rule("declared")).models:
        procedure = least_squares(model.signals, "y")
        assert model.sums == cross_validate("x", complete, procedure, unit_scales(5)).sums


def test_rows_taken_for_independent_keep_signals_that_drives_do_not_support() -> None:
    rule, by_drives, by_rows = Rule("backward", "bic"), 0, 0
    for seed in range(8):
        by_drives += len(chosen(seed, rule).winner.model.signals)
        single = chosen(seed, rule, cluster=0)
        assert single.evidence.kind == "rows"
        by_rows += len(single.winner.model.signals)
    assert by_drives < 8 * 2.5
    assert by_rows > 8 * 3.5


def test_unknown_rules_and_criteria_that_keep_nothing_are_errors() -> None:
    for rule, message in (
        (Rule("size"), "Known rankings: declared, forward, backward"),
        (Rule(criterion="cp"), "Known criteria: cv, aic, bic"),
    ):
        with pytest.raises(QuestionError, match=message):
            chosen(1, rule)
    noise = np.random.default_rng(3).integers(-500, 500, (40, 50, 6))
    table = table_of([gram_of(counts) for counts in noise])
    folds = CohortFolds.from_tables([table], by_value([i % 5 for i in range(40)]))
    with pytest.raises(DataError, match="the criterion bic selects no signal"):
        choose_nested(
            folds.complete_cases(INPUTS, "y"),
            DriveMoments.from_table(table),
            INPUTS,
            "y",
            unit_scales(5),
            Rule("forward", "bic"),
        )


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
    return Evidence.measure(nested_fits(gram, ORDER, "y"))


def test_the_distance_to_the_full_model_is_that_of_the_predictions() -> None:
    rng = np.random.default_rng(1)
    x, truth = drawn(rng)
    y = np.rint(truth + rng.normal(0, 30, 200))
    full = project(x, y)
    variance = np.sum((y - full) ** 2) / (200 - 5)
    distances = [np.sum((full - project(x[:, :j], y)) ** 2) / variance for j in range(5)]
    np.testing.assert_allclose(evidence_of(x, y).excess, distances, rtol=1e-9, atol=1e-9)


def test_the_expected_distance_is_what_the_true_model_is_away_on_average() -> None:
    """The constant is fitted by every model, and costs each of them one more."""
    rng = np.random.default_rng(2)
    x, truth = drawn(rng)
    estimated, real = np.zeros(5), np.zeros(5)
    trials = 400
    for _ in range(trials):
        y = np.rint(truth + rng.normal(0, 30, 200))
        estimated += np.array(evidence_of(x, y).distances) / trials
        away = [np.sum((truth - project(x[:, :j], y)) ** 2) / 30**2 for j in range(5)]
        real += (np.array(away) - 1) / trials
    assert real[:2].min() > 50
    assert estimated == pytest.approx(real, rel=0.04, abs=0.3)
