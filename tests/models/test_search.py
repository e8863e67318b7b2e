"""Which signals of a set: rankings, all subsets, and how good the choice is."""

from itertools import combinations
from typing import Literal

import numpy as np
import pytest
from sklearn.linear_model import LinearRegression
from sklearn.model_selection import LeaveOneGroupOut, cross_val_predict

from fleet_slip.errors import DataError, QuestionError
from fleet_slip.grams import cohort as folding
from fleet_slip.grams.cohort import EACH, FoldCount, Folding, assign_folds, drive_folds
from fleet_slip.models.request import CandidateModel, Search, SelectionRequest, parse_tolerance
from fleet_slip.models.search import (
    ALL_SUBSETS,
    choose_by,
    require_criterion,
    search_models,
    select_inputs,
)
from fleet_slip.models.select import select
from fleet_slip.regression.choice import CROSS_VALIDATION, Rule, select_nested
from fleet_slip.regression.folds import cross_validate, least_squares
from fleet_slip.regression.inference import ClusterUnit
from tests.support.catalog import CATALOG, SIGNALS
from tests.support.counts import INPUTS, LABEL, Driven, cohort_of, dense_fit, driven, rows_of

STRONG_FIRST = (0.0, 0.4, 0.9, 0.0)
"""Only ay and yaw_rate say anything of the label, yaw_rate more."""

USUAL = SelectionRequest()
FIVE = Folding(by="drive", count=5)


@pytest.fixture(scope="module")
def drives() -> list[Driven]:
    return driven(1, STRONG_FIRST, drives=30)


def squares(drives: list[Driven], inputs: tuple[str, ...]) -> float:
    """Residual sum of squares from the rows."""
    counts = rows_of(drives)
    return dense_fit(counts[:, [*(INPUTS.index(name) for name in inputs), -1]])[1]


def test_a_criterion_is_known_by_its_names() -> None:
    assert require_criterion("cv") == require_criterion(CROSS_VALIDATION) == CROSS_VALIDATION
    assert require_criterion("bic") == "bic"
    with pytest.raises(QuestionError, match=r"unknown criterion 'best'\. Known criteria: cv, "):
        require_criterion("best")


@pytest.mark.parametrize("criterion", ["bic", CROSS_VALIDATION])
@pytest.mark.parametrize("ranking", ["forward", "correlation"])
def test_a_ranking_begins_with_what_says_most_and_ends_before_what_says_nothing(
    drives: list[Driven], ranking: str, criterion: str
) -> None:
    found = select_inputs(cohort_of(drives), INPUTS, FIVE, Rule(ranking, criterion), USUAL)
    assert found.choice.nested is not None
    assert found.choice.nested.order[:2] == ("yaw_rate", "ay")
    assert found.winner.model.signals == ("yaw_rate", "ay")
    assert [len(model.signals) for model in found.models] == [1, 2, 3, 4]


def test_each_nested_model_has_the_figures_of_its_own_cross_validation(
    drives: list[Driven],
) -> None:
    cohort = cohort_of(drives)
    found = select_inputs(cohort, INPUTS, FIVE, Rule("forward", "bic"), USUAL)
    folds = cohort.folds("drive", 5).complete_cases(INPUTS, LABEL)
    for model in found.models:
        procedure = least_squares(model.signals, LABEL)
        alone = cross_validate("alone", folds, procedure, CATALOG.input_scales)
        assert model.sums == alone.sums


def test_the_honest_figures_are_of_the_choice_itself_and_need_three_folds() -> None:
    rule, two = Rule("forward", "aic"), Folding(by="drive", count=2)
    drives = driven(5, (0.3, 0.1, 0.1, 0.1), drives=9, rows=15, noise=300)
    honest = select_inputs(
        cohort_of(drives), INPUTS, FIVE, rule, SelectionRequest(cluster="drive")
    ).choice.honest
    fold = assign_folds([one.drive for one in drives], "drive", 5).fold
    errors, choices = [], set()
    for number in set(fold):
        rest = [one for one, mine in zip(drives, fold, strict=True) if mine != number]
        training, _ = drive_folds(cohort_of(rest), INPUTS, two, cluster="drive")
        chosen = select_nested(training, INPUTS, LABEL, rule).signals
        at = [INPUTS.index(name) for name in chosen]
        b, _ = dense_fit(rows_of(rest)[:, [*at, -1]])
        test = rows_of([one for one, mine in zip(drives, fold, strict=True) if mine == number])
        errors.append(b[0] + test[:, at] @ b[1:] - test[:, -1])
        choices.add(chosen)
    assert len(choices) > 1
    assert honest is not None
    counts = honest.pooled.rmse / float(SIGNALS[LABEL].scale)
    assert counts == pytest.approx(np.sqrt(np.mean(np.concatenate(errors) ** 2)), rel=1e-9)
    assert select_inputs(cohort_of(drives), INPUTS, two, rule, USUAL).choice.honest is None


@pytest.mark.parametrize(("cluster", "kind"), [("drive", "drives"), (None, "vehicles")])
def test_what_counts_as_independent_is_what_was_asked_for(
    drives: list[Driven], cluster: ClusterUnit | None, kind: str
) -> None:
    rule = Rule("forward", "bic")
    cohort, asked = cohort_of(drives), SelectionRequest(cluster=cluster)
    choice = select_inputs(cohort, INPUTS, FIVE, rule, asked).choice
    assert choice.evidence.kind == kind
    assert choice.as_dict()["evidence"] == choice.evidence.kind
    subsets = select_inputs(cohort_of(drives), INPUTS, FIVE, Rule(ALL_SUBSETS, "bic"), asked).choice
    assert subsets.evidence.kind == choice.evidence.kind


@pytest.mark.parametrize("ranking", ["forward", ALL_SUBSETS])
def test_where_nothing_says_more_than_chance_there_is_no_winner(ranking: str) -> None:
    cohort = cohort_of(driven(3, (0.0, 0.0, 0.0, 0.0), drives=20))
    with pytest.raises(DataError, match="the criterion bic selects no signal"):
        select_inputs(cohort, INPUTS, FIVE, Rule(ranking, "bic"), USUAL)


def test_the_best_subset_of_every_size_is_that_of_the_rows(drives: list[Driven]) -> None:
    found = select_inputs(cohort_of(drives), INPUTS, FIVE, Rule(ALL_SUBSETS, "bic"), USUAL)
    assert found.choice.subsets is not None
    assert found.choice.honest is None
    for size, result in enumerate(found.choice.subsets):
        best = min(combinations(INPUTS, size), key=lambda names: squares(drives, names))
        assert set(result.best.model.signals) == set(best)
        assert float(result.best.rss) == pytest.approx(squares(drives, best), rel=1e-9)
    assert [set(model.signals) for model in found.models] == [
        set(result.best.model.signals) for result in found.choice.subsets[1:]
    ]
    assert set(found.winner.model.signals) == {"ay", "yaw_rate"}
    assert found.choice.picks is not None
    assert found.choice.picks["bic"] == 2
    assert found.winner.reason.startswith("bic keeps 2 of 4 signals of the best subsets")
    document = found.choice.as_dict()
    assert len(document["subsets"]) == 5
    assert "honest" not in document


def test_subsets_can_be_chosen_by_cross_validation(drives: list[Driven]) -> None:
    found = select_inputs(
        cohort_of(drives), INPUTS, FIVE, Rule(ALL_SUBSETS, CROSS_VALIDATION), USUAL
    )
    assert set(found.winner.model.signals) == {"ay", "yaw_rate"}
    best = max(found.models, key=lambda model: model.correlation)
    assert found.winner.best is best
    shortfall = next(s for s in found.winner.gaps if s.model is found.winner.model)
    assert shortfall.negligible


@pytest.mark.parametrize("rule", ["best", "tolerance"])
@pytest.mark.parametrize("around", ["0.00499deg", "0.005deg", "0.0051deg"])
def test_a_tolerance_precedes_the_rule_of_the_list(
    rule: Literal["best", "tolerance"], around: str
) -> None:
    """The default tolerance counts if it is given; the weak signals are 0.0029 deg each."""
    cohort = cohort_of(driven(1, (0.00125, 0.4, 0.9, 0.00125), drives=30, noise=3))
    search = Search(method="exchange", max_features=4, rule=rule)
    models = search_models(
        cohort.folds("drive", 5), INPUTS, LABEL, CATALOG.input_scales, search
    ).models
    asked = {
        text: len(choose_by(search, models, parse_tolerance(text)).model.signals)
        for text in (around, "0.025deg", "0.0001deg")
    }
    assert asked == {around: 2, "0.025deg": 2, "0.0001deg": 4}
    assert len(choose_by(search, models).model.signals) == (4 if rule == "best" else 2)


def test_the_rule_of_one_standard_error_keeps_what_is_real_however_small() -> None:
    """The weak signals gain 0.0029 deg each, far more than their noise over folds."""
    cohort = cohort_of(driven(1, (0.00125, 0.4, 0.9, 0.00125), drives=30, noise=3))
    search = Search(method="exchange", max_features=4, rule="standard error")
    models = search_models(
        cohort.folds("drive", 5), INPUTS, LABEL, CATALOG.input_scales, search
    ).models
    assert len(choose_by(search, models).model.signals) == 4
    idle = search_models(
        cohort_of(driven(1, STRONG_FIRST, drives=30)).folds("drive", 5),
        INPUTS,
        LABEL,
        CATALOG.input_scales,
        search,
    )
    winner = choose_by(search, idle.models)
    assert set(winner.model.signals) == {"ay", "yaw_rate"}
    assert winner.best is winner.model or "one standard error" in winner.reason


def test_a_list_searches_among_some_inputs_and_then_all_where_drives_are_enough() -> None:
    searches = (
        Search(
            name="few",
            method="exchange",
            max_features=4,
            rule="standard error",
            inputs=("ay", "ax"),
        ),
        Search(name="all", method="exchange", max_features=4, min_drives=9),
    )
    for drives, found in ((8, ["few 1", "few 2"]), (9, ["few 1", "few 2", *ALL_SIZES])):
        cohort = cohort_of(driven(1, STRONG_FIRST, drives=drives))
        chosen = select(cohort, (), FIVE, searches=searches, inputs=INPUTS)
        assert [one.name for one in chosen.models] == found
        assert ("all (search)" in chosen.skipped) == (drives < 9)
    assert chosen.searched_winner is not None
    assert set(chosen.winner.model.signals) >= {"ay", "yaw_rate"}


def test_few_drives_allow_few_columns() -> None:
    search = Search(name="few", method="forward", max_features=4, max_features_per_drive=1)
    for drives, most in ((3, 3), (5, 4)):
        cohort = cohort_of(driven(1, STRONG_FIRST, drives=drives))
        chosen = select(cohort, (), FIVE, searches=[search], inputs=INPUTS)
        assert [one.name for one in chosen.models] == [f"few {n + 1}" for n in range(most)]


ALL_SIZES = [f"all {size}" for size in range(1, 5)]


def test_a_signal_that_repeats_another_is_named() -> None:
    drives = driven(6, STRONG_FIRST)
    for one in drives:
        one.counts[:, 3] = 2 * one.counts[:, 1]
    with pytest.raises(DataError, match="steering_wheel"):
        select_inputs(cohort_of(drives), INPUTS, FIVE, Rule(ALL_SUBSETS, "bic"), USUAL)
    assert np.linalg.matrix_rank(rows_of(drives)[:, :4]) == 3


MODEL = CandidateModel(name="all", signals=INPUTS)


@pytest.mark.parametrize("by", ["drive", "vehicle"])
def test_figures_are_those_of_leaving_each_out_on_the_rows(by: str) -> None:
    drives = driven(1, (0.5, -0.2, 0.1, 0.3), drives=9)
    cohort = cohort_of(drives)
    key = cohort.drives["drive_id" if by == "drive" else "vehicle_id"].to_pylist()
    groups = np.repeat(key, [len(one.counts) for one in drives])
    rows = np.concatenate([one.counts for one in drives]).astype(float)
    predicted = cross_val_predict(
        LinearRegression(), rows[:, :-1], rows[:, -1], groups=groups, cv=LeaveOneGroupOut()
    )
    selection = select(cohort, [MODEL], Folding.model_validate({"by": by, "count": EACH}))
    (found,) = selection.models
    assert found.fold_names == tuple(sorted(set(key)))
    assert selection.as_dict()["folds"]["count"] == len(set(key))
    scale = float(SIGNALS[LABEL].scale)
    rmse = float(np.sqrt(np.mean((predicted - rows[:, -1]) ** 2)))
    assert found.pooled.rmse == pytest.approx(rmse * scale, rel=1e-9)
    assert found.correlation == pytest.approx(np.corrcoef(predicted, rows[:, -1])[0, 1], rel=1e-9)


@pytest.mark.parametrize("count", [5, 6, 1000, EACH])
def test_five_drives_are_five_folds(count: FoldCount) -> None:
    """Hashed into five folds, some would share one; into four, they are."""
    names = [f"drive-{i}" for i in range(5)]
    assert assign_folds(names, "drive", count).names == tuple(names)
    assert set(assign_folds(names, "drive", 4).names) <= set("1234")


def test_more_folds_than_can_be_fitted_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(folding, "MAX_FOLDS", 4)
    with pytest.raises(DataError, match="the cohort has 5, and at most 4 can be folds"):
        assign_folds(list("abcde"), "drive", EACH)
