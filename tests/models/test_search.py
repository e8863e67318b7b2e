"""Choice of signals: orders, searches, and the error of the choice."""

from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from sklearn.linear_model import LinearRegression
from sklearn.model_selection import LeaveOneGroupOut, cross_val_predict

from fleet_slip.errors import ConfigError, DataError
from fleet_slip.grams import cohort as folding
from fleet_slip.grams.cohort import EACH, FoldCount, Folding, assign_folds
from fleet_slip.models.request import (
    CandidateModel,
    ModelList,
    Search,
    SelectionPlan,
    SelectionRequest,
    load_model_list,
)
from fleet_slip.models.select import choose_by, cross_validate_choice, select, select_models
from fleet_slip.models.summary import Selection
from tests.support.catalog import CATALOG, SIGNALS
from tests.support.counts import INPUTS, LABEL, Driven, cohort_of, dense_fit, driven, rows_of

STRONG_FIRST = (0.0, 0.4, 0.9, 0.0)
"""Only ay and yaw_rate say anything of the label, yaw_rate more."""

FIVE = Folding(by="drive", count=5)


def plan_of(**options: Any) -> SelectionPlan:
    request = SelectionRequest(order=",".join(INPUTS), folds=5, **options)
    return SelectionPlan.from_request(CATALOG, request)


def ordered(drives: list[Driven], **options: Any) -> Selection:
    return select_models(cohort_of(drives), plan_of(**options))


def list_of(**content: Any) -> ModelList:
    return ModelList(description="one", **{"folds": FIVE, **content})


@pytest.mark.parametrize(
    ("entry", "problem"),
    [
        (
            "[[model]]\nname = 'a'\nsignals = ['ay', 'yaw_rat']",
            r"model\.0\.signals: yaw_rat is not in .*yaw_rate",
        ),
        (
            "[[search]]\ninputs = ['ay', 'yaw_rat']",
            r"search\.0\.inputs: yaw_rat is not in .*yaw_rate",
        ),
        ("features = 'window'\n[[model]]\nname = 'a'\nsignals = ['ay']", r"sets: signals, motion"),
    ],
)
def test_a_list_with_an_unknown_column_or_feature_set_is_an_invalid_file(
    tmp_path: Path, entry: str, problem: str
) -> None:
    file = tmp_path / "list.toml"
    file.write_text(f"description = 'one'\n{entry}\n")
    with pytest.raises(ConfigError, match=rf"list\.toml: .*{problem}"):
        load_model_list(CATALOG, str(file))


def test_an_order_is_chosen_from_with_cars_as_independent_units() -> None:
    selection = ordered(driven(1, STRONG_FIRST, drives=30), ranking="forward", criterion="bic")
    assert selection.choice is not None
    assert selection.choice.order[:2] == selection.winner.model.signals == ("yaw_rate", "ay")
    assert selection.choice.as_dict()["evidence"] == "vehicles"
    assert selection.winner.reason.startswith("bic keeps 2 of 4 signals of the order by forward")
    assert [len(model.signals) for model in selection.models] == [1, 2, 3, 4]


def test_the_errors_of_a_choice_are_of_the_choice_repeated_without_the_drives() -> None:
    drives = driven(5, (0.3, 0.1, 0.1, 0.1), drives=9, rows=15, noise=300)
    plan = plan_of(ranking="forward", criterion="aic")
    cohort = cohort_of(drives)
    nested = cross_validate_choice(cohort, plan)
    errors, choices = [], set()
    for number, held_out in enumerate(drives):
        remaining = [other for other in drives if other is not held_out]
        training = cohort.filter(np.arange(len(drives)) != number)
        chosen = select_models(training, plan).winner.model.signals
        at = [INPUTS.index(name) for name in chosen]
        b, _ = dense_fit(rows_of(remaining)[:, [*at, -1]])
        test = rows_of([held_out])
        errors.append(b[0] + test[:, at] @ b[1:] - test[:, -1])
        choices.add(chosen)
    assert len(choices) > 1
    assert nested is not None
    assert nested.groups == 9
    counts = nested.figures.rmse / float(SIGNALS[LABEL].scale)
    assert counts == pytest.approx(np.sqrt(np.mean(np.concatenate(errors) ** 2)), rel=1e-9)
    assert cross_validate_choice(cohort_of(drives[:2]), plan) is None


@pytest.mark.parametrize("rule", ["best", "tolerance"])
@pytest.mark.parametrize("around", ["0.00499deg", "0.005deg", "0.0051deg"])
def test_a_tolerance_precedes_the_rule_of_the_list(
    rule: Literal["best", "tolerance"], around: str
) -> None:
    """The default tolerance counts if it is given; the weak signals are 0.0029 deg each."""
    cohort = cohort_of(driven(1, (0.00125, 0.4, 0.9, 0.00125), drives=30, noise=3))
    search = Search(method="exchange", max_features=4, rule=rule)
    models = select(cohort, list_of(search=search)).models
    options = {
        text: len(choose_by(list_of(search=search, tolerance=text), models).model.signals)
        for text in (around, "0.025deg", "0.0001deg")
    }
    assert options == {around: 2, "0.025deg": 2, "0.0001deg": 4}
    chosen = choose_by(list_of(search=search), models).model
    assert len(chosen.signals) == (4 if rule == "best" else 2)


def test_the_rule_of_one_standard_error_keeps_what_is_real_however_small() -> None:
    """The weak signals gain 0.0029 deg each, far more than their noise over folds."""
    cohort = cohort_of(driven(1, (0.00125, 0.4, 0.9, 0.00125), drives=30, noise=3))
    compared = list_of(search=Search(method="exchange", max_features=4, rule="standard error"))
    assert len(select(cohort, compared).winner.model.signals) == 4
    winner = select(cohort_of(driven(1, STRONG_FIRST, drives=30)), compared).winner
    assert set(winner.model.signals) == {"ay", "yaw_rate"}


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
    for drives, names in ((8, ["few 1", "few 2"]), (9, ["few 1", "few 2", *ALL_SIZES])):
        cohort = cohort_of(driven(1, STRONG_FIRST, drives=drives))
        chosen = select(cohort, list_of(search=searches))
        assert [model.name for model in chosen.models] == names
        assert ("all (search)" in chosen.skipped) == (drives < 9)
    assert chosen.searched_winner is not None
    assert set(chosen.winner.model.signals) >= {"ay", "yaw_rate"}


def test_few_drives_allow_few_columns() -> None:
    search = Search(name="few", method="forward", max_features=4, max_features_per_drive=1)
    for drives, max_columns in ((3, 3), (5, 4)):
        cohort = cohort_of(driven(1, STRONG_FIRST, drives=drives))
        chosen = select(cohort, list_of(search=search))
        assert [model.name for model in chosen.models] == [
            f"few {n + 1}" for n in range(max_columns)
        ]


ALL_SIZES = [f"all {size}" for size in range(1, 5)]


def test_a_signal_that_repeats_another_is_named() -> None:
    drives = driven(6, STRONG_FIRST)
    for drive in drives:
        drive.counts[:, 3] = 2 * drive.counts[:, 1]
    with pytest.raises(DataError, match="steering_wheel"):
        ordered(drives)
    assert np.linalg.matrix_rank(rows_of(drives)[:, :4]) == 3


MODEL = CandidateModel(name="all", signals=INPUTS)


@pytest.mark.parametrize("by", ["drive", "vehicle"])
def test_figures_are_those_of_leaving_each_out_on_the_rows(by: str) -> None:
    drives = driven(1, (0.5, -0.2, 0.1, 0.3), drives=9)
    cohort = cohort_of(drives)
    key = cohort.drives["drive_id" if by == "drive" else "vehicle_id"].to_pylist()
    groups = np.repeat(key, [len(drive.counts) for drive in drives])
    rows = np.concatenate([drive.counts for drive in drives]).astype(float)
    predicted = cross_val_predict(
        LinearRegression(), rows[:, :-1], rows[:, -1], groups=groups, cv=LeaveOneGroupOut()
    )
    selection = select(cohort, list_of(model=(MODEL,), folds={"by": by, "count": EACH}))
    (model,) = selection.models
    assert model.fold_names == tuple(sorted(set(key)))
    assert selection.as_dict()["folds"]["count"] == len(set(key))
    scale = float(SIGNALS[LABEL].scale)
    rmse = float(np.sqrt(np.mean((predicted - rows[:, -1]) ** 2)))
    assert model.pooled.rmse == pytest.approx(rmse * scale, rel=1e-9)
    assert model.correlation == pytest.approx(np.corrcoef(predicted, rows[:, -1])[0, 1], rel=1e-9)


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
