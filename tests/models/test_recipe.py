"""A model is trained again as it was, unless something else is asked for."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fleet_slip
from fleet_slip.errors import QuestionError
from fleet_slip.grams.update import update_grams
from fleet_slip.models.manifest import SelectedBy
from fleet_slip.models.publish import recipe_for, stored_options
from fleet_slip.models.registry import Registry
from fleet_slip.models.request import SelectionRequest
from fleet_slip.models.select import run_selection
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import CATALOG
from tests.support.commands import done_on
from tests.support.logs import land, log_rows, random_counts
from tests.support.manifests import manifest
from tests.support.reported import answer

FASTER = "speed_factor > 0.1"


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory, smoke_root: Path) -> Path:
    folder = tmp_path_factory.mktemp("recipes") / "data"
    shutil.copytree(smoke_root, folder)
    answer(folder, "publish", "plain", "--cohort", FASTER)
    fleet = fleet_slip.open(folder)
    options: dict[str, Any] = {"order": "ax,ay,yaw_rate", "ranking": "forward", "folds": 4}
    options["intercept"] = False
    fleet.models.publish("ranked", fleet.cohort(FASTER).select(**options))
    return folder


@pytest.mark.parametrize("name", ["plain", "ranked"])
def test_publishing_again_without_options_is_the_same_model(root: Path, name: str) -> None:
    again = answer(root, "publish", name)
    assert (again["version"], again["new"]) == (1, False)


def test_only_given_options_change_the_recipe(root: Path) -> None:
    registry = Registry(LocalFolder(root), CATALOG)
    recipe = recipe_for(registry, "ranked", SelectionRequest())
    assert (recipe.request.ranking, recipe.request.folds, recipe.request.intercept) == (
        "forward",
        4,
        False,
    )
    assert recipe.cohort == FASTER
    wider = recipe_for(registry, "ranked", SelectionRequest(folds=3), "true")
    assert (wider.request.ranking, wider.request.folds, wider.cohort) == ("forward", 3, "true")
    assert FASTER in wider.explanation
    assert "ranked@1" in wider.explanation
    other = recipe_for(registry, "ranked", SelectionRequest(models="table1"))
    assert other.request == SelectionRequest(models="table1")
    assert other.cohort == FASTER
    new = recipe_for(registry, "new", SelectionRequest())
    assert (new.request, new.explanation) == (SelectionRequest(), "")


@pytest.mark.parametrize(
    "options",
    [
        {"models": "table1", "tolerance": "0.0001deg"},
        {"order": "ax,ay,yaw_rate", "intercept": False},
        {"order": "ax,ay,yaw_rate", "ranking": "backward", "criterion": "bic"},
        {"order": "ax,ay,yaw_rate,steer_fl", "search": "forward", "max_features": 3},
        {"model": "ay,steering_wheel", "group_by": "day", "folds": "each"},
    ],
)
def test_a_saved_list_has_the_winner_of_its_selection(
    smoke_root: Path, tmp_path: Path, options: dict[str, Any]
) -> None:
    cohort = fleet_slip.open(smoke_root).cohort()
    selection = cohort.select(**options)
    file = tmp_path / "own.toml"
    file.write_text(selection.candidate_list.as_toml())
    again = cohort.select(models=str(file))
    assert again.winner.model.model == selection.winner.model.model
    assert again.winner.model.pooled == selection.winner.model.pooled


def test_options_of_earlier_versions_are_read_under_their_old_names(tmp_path: Path) -> None:
    registry = Registry(LocalFolder(tmp_path), CATALOG)
    stored: dict[str, bool | int | str] = {
        "nested": "ay,ax",
        "rank": "forward",
        "worth": "1deg",
        "most": 3,
        "by": "day",
    }
    chosen = SelectedBy(
        model_list="nested", model="5", reason="best", config_sha256="0", options=stored
    )
    registry.add(manifest(name="old").model_copy(update={"selected_by": chosen}), b"")
    assert recipe_for(registry, "old", SelectionRequest()).request == SelectionRequest(
        order="ay,ax", ranking="forward", tolerance="1deg", max_features=3, group_by="day"
    )
    given_up = chosen.model_copy(update={"options": {**stored, "all_subsets": True}})
    registry.add(manifest(name="older").model_copy(update={"selected_by": given_up}), b"")
    with pytest.raises(QuestionError, match="older@1 was selected with all_subsets, which"):
        recipe_for(registry, "older", SelectionRequest())


def test_a_version_from_before_that_no_list_chose_needs_to_be_told(tmp_path: Path) -> None:
    registry = Registry(LocalFolder(tmp_path), CATALOG)
    chosen = SelectedBy(
        model_list="nested:catalogue backward cv", model="5", reason="best", config_sha256="0"
    )
    registry.add(manifest(name="old").model_copy(update={"selected_by": chosen}), b"")
    with pytest.raises(QuestionError, match="old@1 was chosen from 'nested"):
        recipe_for(registry, "old", SelectionRequest())


def test_a_dry_run_publishes_nothing(root: Path) -> None:
    before = answer(root, "models")
    assert answer(root, "publish", "unborn", "--models", "table1", "--dry-run")["publishes"]
    document = answer(root, "publish", "plain", "--cohort", "day > '2024-05-01'", "--dry-run")
    assert document["model"] == "plain"
    assert answer(root, "models") == before


def test_select_and_publish_compare_what_run_does(root: Path) -> None:
    for name in ("plain", "smoke"):
        assert answer(root, "show", name)["selected_by"]["model_list"] == "estimator"


def test_without_the_columns_of_the_usual_list_logged_signals_are_compared(tmp_path: Path) -> None:
    warehouse = Warehouse(LocalFolder(tmp_path))
    rng = np.random.default_rng(3)
    land(warehouse, "a.parquet", *(log_rows(f"d{n}", random_counts(rng, 300)) for n in range(6)))
    update_grams(warehouse)
    answer = run_selection(warehouse, SelectionRequest(), "true")
    assert answer.model_list == "table1"
    assert "fleet-slip gram --features windows" in answer.remark
    assert stored_options(answer) == {}  # so that the usual list is asked for again
    assert (
        stored_options(run_selection(warehouse, SelectionRequest(models="table1"), "true")) is None
    )


def test_publishing_computes_the_columns_of_the_usual_list(smoke_copy: Path) -> None:
    fleet = fleet_slip.open(smoke_copy)
    for made_of_logs in ("grams", "models"):
        shutil.rmtree(smoke_copy / made_of_logs)
    fleet.gram()
    publication = answer(smoke_copy, "publish", "m")
    chosen = fleet.models.get("m").manifest
    assert (publication["new"], chosen.selected_by.model_list) == (True, "estimator")


def test_a_score_leaves_out_what_the_model_was_trained_on(root: Path) -> None:
    first = "day = '2024-05-01'"
    answer(root, "publish", "early", "--cohort", first, "--models", "table1", "--force")
    full, new = answer(root, "score", "smoke"), answer(root, "score", "early")
    assert (full["drives"], full["drives_trained"], full["drives_left_out"]) == (8, 8, 0)
    assert (new["drives"], new["drives_trained"], new["drives_left_out"]) == (8, 4, 4)
    old = answer(root, "score", "early", "--cohort", first)
    assert (old["drives"], old["drives_trained"], old["drives_left_out"]) == (4, 4, 0)
    assert old["rows"] + new["rows"] == full["rows"]
    message = done_on(root, "score", "early").stderr
    assert "left out: 4 drives of 8 that early@1 was trained on" in message


def test_the_only_model_need_not_be_named(smoke_root: Path, root: Path) -> None:
    assert answer(smoke_root, "show")["name"] == "smoke"
    with pytest.raises(QuestionError, match=r"Models: .*plain, .*smoke"):
        answer(root, "show")
    with pytest.raises(QuestionError, match="name a published model"):
        answer(root, "report")
