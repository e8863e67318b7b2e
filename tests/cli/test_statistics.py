"""Selection and diagnostics by command."""

import json
import math
import re
import shutil
from pathlib import Path

import duckdb
import numpy as np
import pytest

import fleet_slip
from fleet_slip.catalog.features import PLAIN
from fleet_slip.grams.update import update_grams
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.cars import TICKS, counts, drive
from tests.support.catalog import CATALOG
from tests.support.commands import RunCommand, done_on
from tests.support.logs import land, log_rows
from tests.support.model_lists import write_list
from tests.support.once import made_once


@pytest.fixture(scope="session")
def more_sets(tmp_path_factory: pytest.TempPathFactory, smoke_root: Path) -> Path:
    """A data root with the smoke campaign, its model and two more feature sets."""

    def make(root: Path) -> None:
        shutil.copytree(smoke_root, root)
        for name in ("motion", "blocks"):
            done_on(root, "gram", "--features", name)

    return made_once(tmp_path_factory, "more-sets", make)


@pytest.fixture
def own_set(more_sets: Path, tmp_path: Path) -> Path:
    """A copy of it, to publish in."""
    return shutil.copytree(more_sets, tmp_path / "copy")


@pytest.mark.long
def test_all_sets_are_made_and_up_to_date(run_command: RunCommand, own_set: Path) -> None:
    for done in (False, True):
        reports = run_command("gram", "--features", "all", "--json", root=own_set).json
        assert (sum(report["files_read"] for report in reports) == 0) == done
    assert [report["feature_set"] for report in reports] == [
        CATALOG.identity(name)
        for name in (PLAIN, *CATALOG.sets)
        if name not in CATALOG.stacked_sets
    ]


def test_a_criterion_chooses_from_a_ranking_and_says_how_sure(
    run_command: RunCommand, more_sets: Path
) -> None:
    nested = ("--order", "ax,ay,yaw_rate,steering_wheel,steer_fl")
    arguments = ("select", *nested, "--ranking", "backward", "--criterion", "bic")
    report = run_command(*arguments, "--json", root=more_sets).json
    choice = report["choice"]
    assert sorted(choice["order"]) == ["ax", "ay", "steer_fl", "steering_wheel", "yaw_rate"]
    best = min(range(6), key=lambda j: choice["criterion_values"][j])
    assert report["winner"] == f"first {best}"
    assert choice["evidence"] == "drives"
    assert choice["effective_rows"] < report["rows"] / 10
    winner = report["models"][best - 1]
    repeated = report["nested_cross_validation"]
    assert repeated["groups"] == 8
    assert abs(repeated["correlation"] - winner["correlation"]) < 0.01
    table = run_command(*arguments, root=more_sets).stdout
    assert "order by backward" in table
    assert re.search(r"^0 +\(none\)", table, re.MULTILINE)
    assert "with the choice repeated" in run_command(*arguments, root=more_sets).stderr


def test_a_published_model_with_features_explains_and_evaluates_them(
    run_command: RunCommand, own_set: Path
) -> None:
    nested = ("--order", "ay,steer_fl,curvature,speed_squared")
    arguments = ("--features", "motion", *nested, "--ranking", "declared", "--criterion", "aic")
    list_path = str(own_set.with_name("curved.toml"))
    done = run_command("select", *arguments, "--save", list_path, "--json", root=own_set)
    assert done.exit_code == 0, done.stderr
    published = ("publish", "curved", "--models", list_path, "--json")
    assert run_command(*published, root=own_set).json["new"]
    shown = run_command("show", "curved", "--json", root=own_set).json
    terms = {term["signal"]: term for term in shown["terms"]}
    assert terms["curvature"]["sql"] == CATALOG.features["curvature"].sql
    assert (terms["curvature"]["unit"], terms["ay"]["sql"]) == ("rad/m", "")
    assert shown["trained_on"]["feature_set"] == CATALOG.identity("motion")
    assert "per count" in run_command("show", "curved", "--all", root=own_set).stdout
    score = run_command("score", "curved", "--json", root=own_set).json
    assert score["rows"] == shown["trained_on"]["rows"]
    assert abs(score["error_mean_deg"]) < 1e-9  # an OLS fit has no mean error on its own rows
    with fleet_slip.connect(own_set, query="log_counts") as database:
        rows = database.sql("FROM log_counts").to_arrow_table()
    computed = duckdb.connect()
    computed.register("log_counts", rows)
    columns = [terms[name]["sql"] or name for name in terms]
    counts = computed.execute(f"SELECT {', '.join(columns)}, sideslip FROM log_counts")
    matrix = np.array(counts.fetchall(), dtype=np.float64)
    scales = np.array([term["scale"] for term in terms.values()], dtype=np.float64)
    weights = np.array([term["coefficient"] for term in terms.values()])
    error = matrix[:, :-1] @ (scales * weights) + shown["intercept"] - matrix[:, -1] * 1e-4
    assert score["rmse_deg"] == pytest.approx(math.degrees(math.sqrt(np.mean(error**2))), rel=1e-9)
    assert not run_command(*published, root=own_set).json["new"]


def test_diagnose_shows_both_kinds_of_errors(run_command: RunCommand, more_sets: Path) -> None:
    arguments = ("diagnose", "--signals", "ay,steer_fl")
    report = run_command(*arguments, "--json", root=more_sets).json
    for naive, robust in zip(report["by_rows"], report["by_clusters"], strict=True):
        assert naive["value"] == robust["value"]
        assert robust["standard_error"] > naive["standard_error"]
    assert report["effective_rows"] < report["rows"]


def test_features_are_listed(run_command: RunCommand) -> None:
    assert "curvature" in run_command("features").stdout
    assert "motion" in run_command("features", "--sets").stdout
    listed = run_command("features", "--json").json
    assert listed["sets"]["motion"]["identity"] == CATALOG.identity("motion")


@pytest.mark.parametrize(
    "words", [*(f"select --folds {folds}" for folds in ("1001", "1", "-3", "few"))]
)
def test_a_number_of_folds_that_cannot_be_is_named(
    run_command: RunCommand, tmp_path: Path, words: str
) -> None:
    (tmp_path / "data").mkdir()
    done = run_command(*words.split())
    assert done.exit_code == 2
    number = words.partition("--folds ")[2].partition(" ")[0]
    assert f"error: folds = {number}: choose a number from 2 to 1000" in done.stderr


@pytest.mark.parametrize(
    "extra",
    [("--models", "table1"), pytest.param(("--order", "ax,ay,yaw_rate"), marks=pytest.mark.long)],
)
def test_as_many_folds_as_drives_leave_out_each(
    run_command: RunCommand, more_sets: Path, extra: tuple[str, ...]
) -> None:
    """Hashed, some folds would have two drives and others none."""
    five = ("select", "--cohort", "drive_id < 'smoke-2024-05-02-0001'", *extra, "--json")
    by_number = run_command(*five, "--folds", "5", root=more_sets).json
    assert (by_number["drives"], by_number["folds"]["count"]) == (5, 5)
    by_name = run_command(*five, "--folds", "each", root=more_sets).json
    assert by_number["models"] == by_name["models"]
    many = run_command("select", "--folds", "1000", *extra, "--json", root=more_sets).json
    assert many["folds"]["count"] == many["drives"] == 8
    fewer = run_command(*five, "--folds", "3", root=more_sets).json
    assert fewer["folds"]["count"] <= 3


def test_one_model_is_taken_without_a_list(run_command: RunCommand, more_sets: Path) -> None:
    selection = run_command("select", "--model", "ax, ay,yaw_rate", "--json", root=more_sets).json
    listed = run_command("select", "--models", "table1", "--json", root=more_sets).json
    (model,) = selection["models"]
    assert model["name"] == selection["winner"] == "given"
    assert model["coefficients"] == listed["models"][0]["coefficients"]


def test_an_order_has_its_distances_also_in_blocks_of_drives(
    run_command: RunCommand, more_sets: Path
) -> None:
    arguments = ("select", "--order", "ax,ay,yaw_rate,steer_fl", "--json")
    plain = run_command(*arguments, root=more_sets).json
    ranked = run_command(*arguments, "--ranking", "declared", root=more_sets).json
    assert plain == ranked
    choice = plain["choice"]
    assert choice["order"] == ["ax", "ay", "yaw_rate", "steer_fl"]
    assert len(choice["expected_distances"]) == 5
    assert choice["distances_to_full"][-1] == 0
    parts = run_command(*arguments, "--features", "blocks", "--group-by", "part", root=more_sets)
    assert parts.json["choice"]["evidence"] == "drives"


def test_a_model_through_the_origin_is_published_as_one(
    run_command: RunCommand, own_set: Path, tmp_path: Path
) -> None:
    root = own_set
    chosen = ("--model", "ay,yaw_rate,steering_wheel")
    usual = run_command("select", *chosen, "--json", root=root).json
    list_path = str(tmp_path / "origin.toml")
    origin = ("--no-intercept", "--save", list_path, "--json")
    selected = run_command("select", *chosen, *origin, root=root).json
    assert (usual["intercept"], selected["intercept"]) == (True, False)
    assert usual["models"][0]["intercept"] != 0 == selected["models"][0]["intercept"]
    run_command("publish", "straight", "--models", list_path, root=root)
    shown = run_command("show", "straight", "--json", root=root).json
    assert shown["through_origin"] is True
    assert shown["intercept"] == 0
    coefficients = {item["signal"]: item["coefficient"] for item in shown["terms"]}
    assert coefficients == selected["models"][0]["coefficients"]
    assert "through the origin" in run_command("show", "straight", root=root).stdout
    by_rows = run_command("diagnose", "straight", "--json", root=root).json["by_rows"]
    assert {item["name"]: item["value"] for item in by_rows} == coefficients
    run_command("export", "straight", "--to", "json", "--output", str(tmp_path), root=root)
    exported = json.loads((tmp_path / "straight-1.json").read_text())
    assert exported["model"]["manifest"]["through_origin"] is True
    assert exported["program"]["angle"]["intercept"] == "0"
    scored = run_command("score", "straight", "--json", root=root).json
    with fleet_slip.connect(root, query="log") as database:
        terms = " + ".join(
            f"{value!r} * {item}"
            for item, value in zip(
                ("ay_mps2", "yaw_rate_rad_s", "steering_wheel_rad"),
                coefficients.values(),
                strict=True,
            )
        )
        by_hand = database.execute(
            f"SELECT degrees(sqrt(avg(({terms} - sideslip_rad) ** 2))) FROM log"
        ).fetchone()
    assert by_hand == (pytest.approx(scored["rmse_deg"], rel=1e-9),)


def test_a_set_is_not_asked_of_drives_that_no_gram_row_names(
    run_command: RunCommand, smoke_root: Path, tmp_path: Path
) -> None:
    ignored = shutil.ignore_patterns("grams")
    root = shutil.copytree(smoke_root, tmp_path / "data", ignore=ignored)
    assert run_command("gram", "--features", "motion", root=root).exit_code == 0
    command = ("select", "--features", "windows", "--order", "ax,ay", "--cohort")
    refused = run_command(*command, "campaign = 'smoke'", root=root)
    assert refused.exit_code == 5
    assert "features are missing for 4 log files. Run: fleet-slip gram &&" in refused.stderr
    assert "no drive matches" not in refused.stderr


def test_single_drives_have_errors_by_rows_with_a_warning(
    run_command: RunCommand, smoke_root: Path
) -> None:
    command = ("diagnose", "--signals", "ay,steer_fl", "--cohort", "drive_id LIKE '%05-01-0000'")
    done = run_command(*command, root=smoke_root)
    assert done.exit_code == 0
    assert "only one drive" in done.stderr
    diagnosis = run_command(*command, "--json", root=smoke_root).json
    assert (diagnosis["cluster"], diagnosis["clusters"]) == ("row", 1)
    assert diagnosis["by_clusters"] == diagnosis["by_rows"]


def test_rows_that_tell_nothing_are_told(
    run_command: RunCommand, warehouse: Warehouse, tmp_path: Path
) -> None:
    rng = np.random.default_rng(7)
    drives = [counts(drive(rng, gentleness=2)) for _ in range(30)]
    for signals in drives[24:]:
        del signals["sideslip"]
    land(warehouse, "all", *(log_rows(f"d{i}", signals) for i, signals in enumerate(drives)))
    update_grams(warehouse)
    options = ("--order", "ay,yaw_rate")
    message = f"{6 * TICKS:,} of {30 * TICKS:,} rows skipped"
    chosen = run_command("select", *options)
    assert message in chosen.stderr, chosen.stderr
    assert run_command("select", *options, "--json").json["rows_without"] == 6 * TICKS
    list_path = write_list(tmp_path / "own.toml", "ay,yaw_rate")
    assert run_command("publish", "beta", "--models", list_path, "--force").exit_code == 0
    cohort = ("--cohort", "true")
    assert message in run_command("score", "beta", *cohort).stderr
    assert run_command("score", "beta", *cohort, "--json").json["rows_without"] == 6 * TICKS
