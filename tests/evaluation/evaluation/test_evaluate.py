"""`fleet-slip evaluate` from end to end, on a small warehouse."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fleet_slip
from fleet_slip.arrays import FloatArray
from fleet_slip.errors import DataError, RefusedError
from fleet_slip.evaluation import kalman
from fleet_slip.evaluation.evaluated_drives import TestDrive, read_drive, simulate_drives
from fleet_slip.evaluation.evaluation_document import store_evaluation
from fleet_slip.evaluation.evaluator import EvaluatedDrive, evaluate
from fleet_slip.evaluation.filters import (
    FILTERS,
    FilterEstimate,
    checksum_of_sources,
    class_car,
    published_estimate,
)
from fleet_slip.evaluation.scenario_evaluation import rank
from fleet_slip.models.predict import Predictor
from fleet_slip.models.registry import Registry
from fleet_slip.models.score import score
from fleet_slip.regression.combination import EstimateCombination
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.simulation.scenario import Scenario, load_scenario
from fleet_slip.simulation.sensors import GPS_SIGNALS
from fleet_slip.storage.documents import DocumentFolder, Inventory
from fleet_slip.storage.local import LocalFolder
from fleet_slip.vehicle.parameters import load_vehicle
from fleet_slip.views import connect
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import CATALOG, SIGNALS
from tests.support.reported import LITTLE_S, SCENARIOS, answer


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory, evaluated: Path) -> Path:
    return shutil.copytree(evaluated, tmp_path_factory.mktemp("evaluated") / "data")


@pytest.fixture(scope="module")
def again(root: Path) -> Any:
    """The content of an evaluation that was done before."""
    return answer(root, "evaluate", "smoke", *SCENARIOS)


def test_evaluating_again_changes_nothing(root: Path, evaluated: Path, again: Any) -> None:
    assert again["number"] == 1
    before, after = (Warehouse(LocalFolder(copy)).logs.snapshot() for copy in (evaluated, root))
    assert after.version == before.version


def test_the_model_is_shown_together_with_filters_without_and_with_gps(again: Any) -> None:
    estimators = again["estimators"]
    pairs = {"combination": "ekf_class_tuned", "combination_gps": "kalman_tuned"}
    for name, filter_name in pairs.items():
        assert estimators[name]["of"] == ["smoke@1", filter_name]
        combination = EstimateCombination(**estimators[name]["combination"])
        assert combination.anchor == "line"
        for scenario in again["scenarios"]:
            errors = {n: scenario["results"][n] for n in (name, "smoke@1", filter_name)}
            assert errors[name]["coverage"] >= errors["smoke@1"]["coverage"]
            bound = errors["smoke@1"]["error_max_deg"]
            limit_deg = 3 * np.degrees(max(combination.std_rad))
            if errors["smoke@1"]["coverage"] == 1:
                assert errors[name]["error_max_deg"] <= bound + limit_deg
    standings = again["ranking"]["standings"]
    assert not {standing["winner"] for standing in standings} & {*pairs}, "a part of them competes"


def test_an_evaluation_of_another_process_is_not_stored_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    documents = DocumentFolder(LocalFolder(tmp_path), "evaluations")
    inventory = DocumentFolder.inventory

    def overtaken(folder: DocumentFolder) -> Inventory:
        before = inventory(folder)
        monkeypatch.undo()
        store_evaluation(documents, {"models": 5})
        return before

    monkeypatch.setattr(DocumentFolder, "inventory", overtaken)
    assert store_evaluation(documents, {"models": 5}).number == 1
    assert store_evaluation(documents, {"models": 6}).number == 2
    assert store_evaluation(documents, {"models": 6}).number == 2


def test_no_model_is_trained_on_scenarios(root: Path) -> None:
    with pytest.raises(RefusedError, match="scenario"):
        answer(root, "select", "--cohort", "source = 'scenario'")
    with pytest.raises(RefusedError, match="scenario"):
        answer(root, "publish", "leaking", "--cohort", "source IN ('simulation', 'scenario')")
    assert answer(root, "select", "--models", "table1")["drives"] == 8


def test_a_cohort_excludes_test_drives_by_default(root: Path, tmp_path: Path) -> None:
    copy = tmp_path / "data"
    shutil.copytree(root, copy)
    options = ("--cohort", "speed_factor > 0.1")
    assert answer(copy, "publish", "fast", *options, "--models", "table1")["version"] == 1
    assert fleet_slip.open(copy).models.get("fast").manifest.trained_on.drives == 8
    with pytest.raises(DataError, match="has 2 in the cohort"):  # and not for its test drives
        answer(copy, "monitor", "fast")
    assert answer(copy, "quality", *options)["drives"] == 8
    all_rows = answer(copy, "score", "fast", *options)["rows"]
    tests = answer(copy, "score", "fast", "--cohort", "source = 'scenario'")["rows"]
    assert answer(copy, "score", "fast", "--cohort", "source <> ''")["rows"] == all_rows + tests


def test_a_changed_scenario_is_refused(root: Path, tmp_path: Path) -> None:
    file = tmp_path / "nominal.toml"
    file.write_text('name = "mine"\ndescription = "x"\nbase = "nominal"\nlaps = 0.1\n')
    copy = tmp_path / "data"
    shutil.copytree(root, copy)
    answer(copy, "evaluate", "smoke", "--scenario", str(file))
    file.write_text(file.read_text().replace("0.1", "0.2"))
    with pytest.raises(RefusedError, match="has changed"):
        answer(copy, "evaluate", "smoke", "--scenario", str(file))


def test_views_contain_test_drives_only_by_source(root: Path) -> None:
    fleet = fleet_slip.open(root)
    count = "SELECT count(*) FROM drives"
    for hidden in (
        count,
        "SELECT count(DISTINCT drive_id) FROM log",
        "SELECT count(DISTINCT drive_id) FROM grams",
    ):
        assert fleet.sql(hidden).fetchall() == [(8,)]
        ((shown,),) = fleet.sql(f"{hidden} WHERE source IS NOT NULL").fetchall()
        assert shown > 8
    asking = f"{count} WHERE source = 'scenario'"
    rows = fleet.sql(asking).fetchall()
    with fleet.session() as fleet_alone, fleet.session(asking) as everything:
        assert fleet_alone.sql(asking).fetchall() == [(0,)]
        assert everything.sql(asking).fetchall() == rows != [(0,)]
    assert answer(root, "sql", count) == [{"count_star()": 8}]
    assert answer(root, "sql", asking) == [{"count_star()": rows[0][0]}]


def test_the_published_model_gets_the_same_estimates_as_in_sql(root: Path, again: Any) -> None:
    """SQL measures against the noisy label, here the truth counts: 0.03 degrees between them."""
    manifest = Registry(LocalFolder(root), CATALOG).resolve("smoke").manifest
    in_sql = score(Warehouse(LocalFolder(root)), manifest, "drive_id = 'scenario-nominal'")
    scenario = again["scenarios"][0]
    result = scenario["results"]["smoke@1"]
    assert result["rows"] == in_sql.rows == scenario["truth"]["rows"]
    assert result["error_mean_deg"] == pytest.approx(in_sql.error_mean_deg, abs=0.001)
    label_noise_deg = np.degrees(load_scenario("nominal", SHIPPED_CONFIGS).sensors.sideslip_std_rad)
    expected = np.hypot(result["error_std_deg"], label_noise_deg)
    assert in_sql.error_std_deg == pytest.approx(expected, rel=0.01)


def test_stability_is_lost_on_the_slippery_road_alone(again: Any) -> None:
    content = {scenario["name"]: scenario for scenario in again["scenarios"]}
    sections = {
        name: [section["name"] for section in scenario["sections"]]
        for name, scenario in content.items()
    }
    assert "unstable" not in sections["nominal"]
    assert "unstable" in sections["adhesion_0_4"]
    result = content["adhesion_0_4"]["results"]["smoke@1/4"]
    inside, outside = result["inside"]["unstable"], result["outside"]["unstable"]
    assert inside["rows"] + outside["rows"] == result["rows"]
    assert inside["error_std_deg"] > 3 * outside["error_std_deg"]


def test_a_missing_signal_lowers_the_coverage_of_models_with_it(again: Any) -> None:
    scenario = next(
        scenario for scenario in again["scenarios"] if scenario["name"] == "wheel_missing"
    )
    assert scenario["results"]["smoke@1/1"]["coverage"] == 1
    expected = 60 / scenario["truth"]["duration_s"]
    assert scenario["results"]["smoke@1/4"]["coverage"] == pytest.approx(expected, abs=0.001)


def test_an_estimator_does_not_see_the_truth(root: Path) -> None:
    (drive,) = simulate_drives(SIGNALS, [load_scenario("nominal", SHIPPED_CONFIGS)])
    assert not {"vx_mps", "vy_mps", "sideslip_rad", "station_m"} & set(drive.columns)
    manifest = Registry(LocalFolder(root), CATALOG).resolve("smoke").manifest
    estimate = published_estimate(SIGNALS, Predictor.from_manifest(SIGNALS, manifest), drive)
    assert np.corrcoef(estimate, drive.sideslip_rad)[0, 1] > 0.9


def test_the_filters_are_tuned_once(root: Path) -> None:
    (document,) = (root / "tuned").rglob("*.json")
    tuned = json.loads(document.read_text())["content"]
    assert (*tuned["parameters"],) == ("ekf", "kalman")
    assert (*tuned["cars"],) == ("d_class_sedan",)
    assert tuned["failing"] == []
    assert tuned["key"]["program"] == checksum_of_sources()
    seconds, *drives = tuned["key"]["drives"]
    assert seconds == LITTLE_S
    assert [model for _, model, _ in drives] == ["d_class_sedan"] * 8
    assert all(name.startswith("smoke-") for name, _, _ in drives)
    assert all(mass_kg is None for _, _, mass_kg in drives), "the model does not know it"


def test_a_car_identified_from_the_same_drives_competes(again: Any) -> None:
    about = again["estimators"]["ekf_identified"]
    assert (about["kind"], about["gps"], about["told"]) == ("filter", False, "labelled drives")
    results = again["scenarios"][0]["results"]
    assert results["ekf_identified"]["rmse_deg"] < 1.5 * results["ekf_class_tuned"]["rmse_deg"]


def test_filters_use_the_mass_if_the_model_does() -> None:
    (drive,) = simulate_drives(SIGNALS, [load_scenario("adhesion_0_4", SHIPPED_CONFIGS)])
    scenario = drive.scenario.model_copy(update={"sprung_mass_kg": 1500.0})
    heavy = replace(drive, scenario=scenario)
    for weighed, kg in ((False, drive.scenario.vehicle.body.sprung_mass_kg), (True, 1500.0)):
        estimate = FilterEstimate(FILTERS[1], FILTERS[1].default, weighed)
        assert estimate.car(heavy).body.sprung_mass_kg == kg
    assert class_car("suv", 2000.0, SHIPPED_CONFIGS) == load_vehicle(
        "suv", SHIPPED_CONFIGS
    ).with_sprung_mass(2000.0)
    assert class_car("a_strangers_car", None, SHIPPED_CONFIGS) is None


def test_a_filter_gives_the_same_estimates_here_as_by_itself(root: Path) -> None:
    scenario = load_scenario("nominal", SHIPPED_CONFIGS)
    (drive,) = simulate_drives(SIGNALS, [scenario])
    with connect(root, query="SELECT source FROM log") as database:
        alone = read_drive(SIGNALS, database, scenario.drive_id)
    expected = kalman.estimate(alone.signals, scenario.car, kalman.FilterNoise())
    estimates = FilterEstimate(FILTERS[0], FILTERS[0].default)(drive)
    np.testing.assert_allclose(estimates, expected, rtol=0, atol=1e-12)


ROWS = 1000


def drive(scenario: Scenario) -> TestDrive:
    """Return a drive straight ahead: the estimate is the error."""
    zeros, speed = np.zeros(ROWS), np.full(ROWS, 20.0)
    signals = {SIGNALS[name].column: zeros for name in (*SIGNALS.inputs, *GPS_SIGNALS)}
    time_s = np.arange(ROWS) / 100
    return TestDrive(scenario, time_s, signals, speed, zeros, zeros, zeros, None)


def off_by(error_deg: float, missing: int = 0) -> Callable[[TestDrive], FloatArray]:
    def estimate(drive: TestDrive) -> FloatArray:
        angles = np.full(len(drive.time_s), np.radians(error_deg))
        angles[:missing] = np.nan
        return angles

    return estimate


def run(
    scenario: Scenario | None = None, **errors_deg: float | tuple[float, int]
) -> EvaluatedDrive[TestDrive]:
    parts = {k: v if isinstance(v, tuple) else (v, 0) for k, v in errors_deg.items()}
    estimators = {name: off_by(*part) for name, part in parts.items()}
    scenario = scenario or load_scenario("nominal", SHIPPED_CONFIGS)
    (evaluated,) = evaluate([drive(scenario)], estimators)
    return evaluated


def standing(drive: EvaluatedDrive[TestDrive], estimator: str = "ours") -> dict[str, Any]:
    (standing_,) = rank([drive], estimator, excluded=())["standings"]
    return dict(standing_)


def test_the_smallest_error_wins() -> None:
    lost = standing(run(ours=-0.3, ekf=0.2, net=0.25))  # a bias is an error
    assert (lost["winner"], lost["won"]) == ("ekf", False)
    assert lost["ratio"] == pytest.approx(1.5)
    won = standing(run(ours=0.3, ekf=0.2, net=0.25), "ekf")
    assert (won["winner"], won["won"], won["ratio"]) == ("ekf", True, 1.0)


def test_satellite_navigation_does_not_compete() -> None:
    ranking = rank([run(ours=0.3, kalman=0.1, ekf=0.4)], "ours", excluded={"kalman"})
    assert ranking["won"] == 1


def test_an_estimator_with_low_coverage_neither_wins_nor_is_close() -> None:
    result = standing(run(ours=(0.1, 11), ekf=0.2))
    assert (result["winner"], result["rmse_deg"], result["ratio"], result["won"]) == (
        "ekf",
        None,
        None,
        False,
    )
    assert standing(run(ours=(0.1, 10), ekf=0.2))["won"]
    nobody = standing(run(ours=(0.1, ROWS), ekf=(0.1, ROWS)))
    assert (nobody["winner"], nobody["won"], nobody["ratio"]) == (None, False, None)


def test_drives_that_differ_in_satellite_navigation_alone_count_once() -> None:
    names = ("gps_clear", "nominal", "gps_urban", "wheel_missing", "gps_tunnel", "noise_doubled")
    ranking = rank(
        [run(load_scenario(name, SHIPPED_CONFIGS), ours=0.1, ekf=0.2) for name in names],
        "ours",
        excluded=(),
    )
    same = [entry["same_as"] for entry in ranking["standings"]]
    assert same == [None, "gps_clear", "gps_clear", None, "gps_clear", None]
    assert (ranking["drives"], ranking["won"]) == (3, 3)


def test_wins_and_close_losses_are_counted_apart() -> None:
    nominal = load_scenario("nominal", SHIPPED_CONFIGS)
    runs = [
        run(nominal.model_copy(update={"seed": seed}), ours=error, ekf=0.2)
        for seed, error in enumerate((0.1, 0.2, 0.24, 0.26))
    ]
    ranking = rank(runs, "ours", excluded=())
    assert (ranking["won"], ranking["close"]) == (2, 1), "a tie is won, 1.2 is close and 1.3 is not"
    assert [entry["won"] for entry in ranking["standings"]] == [True, True, False, False]
