"""`fleet-slip evaluate --cohort`: measured drives judge what was not fitted to them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

import fleet_slip
from fleet_slip.errors import DataError
from fleet_slip.evaluation import ekf, filters, measured_evaluation
from fleet_slip.evaluation.evaluated_drives import DriveSignals, LabelledDrive, Segments
from fleet_slip.evaluation.identify import IdentifiedVehicle, TuningResult, vehicle_with_fit
from fleet_slip.evaluation.measured_evaluation import (
    Learner,
    folds_by_kind,
    folds_of,
    prepare_drive,
    read_measured_drives,
)
from fleet_slip.grams.cohort import load_cohort
from fleet_slip.grams.update import update_grams
from fleet_slip.models.request import SelectionRequest
from fleet_slip.quality.drive_signals import WHEELS
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.storage.local import LocalFolder
from fleet_slip.vehicle.parameters import load_vehicle
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.commands import done_on, run_on
from tests.support.drives import rolling_drive
from tests.support.logs import land, log_rows
from tests.support.measured import OWN_MAPPING, csv_text, ingest_own

ROWS = 400
NO_SIGNALS = DriveSignals(*[np.full(ROWS, np.nan)] * 12)


def a_drive(number: int, *, trip: str | None = None, speed_mps: float = 10.0) -> LabelledDrive:
    wheels = np.full(ROWS, speed_mps / 0.31)
    signals = replace(NO_SIGNALS, wheel_rl_rad_s=wheels, ay_mps2=np.ones(ROWS))
    name, rows = f"drive-{number}", pa.table({"tick": np.arange(ROWS)})
    return LabelledDrive(name, signals, np.zeros(ROWS), rows=rows, trip=trip or name)


def drives_of(held_out: Segments) -> list[int]:
    assert all((name, quarter) in held_out for name, _ in held_out for quarter in range(4))
    return sorted({int(name.removeprefix("drive-")) for name, _ in held_out})


def test_drives_are_held_out_with_all_of_their_trip() -> None:
    drives = [a_drive(n, trip=f"trip-{n // 2}") for n in range(6)]
    assert [drives_of(fold) for fold in folds_of(drives)] == [[0, 1], [2, 3], [4, 5]]
    many = folds_of([a_drive(n) for n in range(20)])
    assert sorted(drive for fold in many for drive in drives_of(fold)) == [*range(20)]
    assert len(many) == 8


def test_quarters_of_few_drives_are_held_out() -> None:
    drives = [a_drive(0), a_drive(1)]
    first, *_ = parts = folds_of(drives)
    assert len(parts) == 4
    assert first == {("drive-0", 0), ("drive-1", 0)}
    assert np.isnan(drives[0].without(first).sideslip_rad).sum() == ROWS // 4


def test_kinds_of_driving_are_held_out_as_a_whole() -> None:
    drives = [a_drive(n, speed_mps=speed) for n, speed in enumerate((5.0, 20.0, 24.0))]
    drives_by_kind = {kind: drives_of(fold) for kind, fold in folds_by_kind(drives).items()}
    assert drives_by_kind == {
        "below 8 m/s, ay 1 to 2.5 m/s²": [0],
        "15 to 25 m/s, ay 1 to 2.5 m/s²": [1, 2],
    }
    assert folds_by_kind(drives[1:]) == {}


def test_a_missing_acceleration_is_derived_from_wheel_speeds() -> None:
    car, still = load_vehicle("d_class_sedan", SHIPPED_CONFIGS), np.zeros(ROWS)
    speed = still + np.linspace(10.0, 18.0, ROWS)  # 2 m/s²
    signals = rolling_drive(car, speed, still, still, still)
    logged = replace(a_drive(0), signals=signals)
    assert prepare_drive(logged, car).signals is signals
    missing = replace(logged, signals=replace(signals, ax_mps2=np.full(ROWS, np.nan)))
    assert prepare_drive(missing, car).signals.ax_mps2[100:] == pytest.approx(2.0, abs=0.01)
    blind = replace(logged, signals=NO_SIGNALS)
    assert prepare_drive(blind, car) is blind


@pytest.fixture(scope="module")
def measured_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data root with drives that no filter can serve, and a model of some of them."""
    folder = tmp_path_factory.mktemp("measured")
    root = folder / "data"
    ingest_own(root, folder, cars=6)
    done_on(root, "publish", "own", "--models", "table1", "--cohort", "vehicle_id < 'car-4'")
    return root


def test_without_a_vehicle_only_models_are_evaluated(measured_root: Path) -> None:
    four = "vehicle_id <> 'car-0' AND vehicle_id <> 'car-5'"
    evaluation = fleet_slip.open(measured_root).evaluation.evaluate_measured("own", four)
    assert "No filter was evaluated" in str(evaluation)
    assert f"stored as evaluations/measured/{evaluation.number}.json" in str(evaluation)
    content = evaluation.content
    assert content["vehicle"] is None
    assert content["estimators"]["own@1"]["told"] == "chosen and fitted without held-out rows"
    assert content["estimators"]["own@1"]["rmse_deg"] < 0.05
    assert {name for name in content["estimators"] if "/" not in name} == {"own@1"}
    assert (len(content["drives"]), content["parts"], content["parts_of"]) == (4, 4, "drives")
    assert "±: standard error over drives; worst: RMSE of the worst drive" in str(evaluation)
    assert 0 < content["estimators"]["own@1"]["rmse_standard_error_deg"] < 0.01
    assert content["estimators"]["own@1"]["worst_drive"] in [
        result["name"] for result in content["drives"]
    ]


def test_a_model_of_other_drives_is_evaluated_as_published(measured_root: Path) -> None:
    done = done_on(measured_root, "evaluate", "own", "--cohort", "vehicle_id >= 'car-4'", "--json")
    assert done.json["estimators"]["own@1"]["told"] == "as published"
    (lines,) = [line for line in done.stderr.splitlines() if "table1/2" in line]
    assert lines == (
        "table1/2, table1/3, table1/4: not evaluated: these drives lack steering_wheel."
    )
    two = done_on(measured_root, "evaluate", "own", "--cohort", "vehicle_id >= 'car-4'")
    assert "±: standard error over quarters" in two.stdout + two.stderr
    refused = run_on(measured_root, "select", "--model", "ax,steering_wheel")
    assert "can be fitted: these drives lack steering_wheel." in refused.stderr


def test_an_error_of_a_published_model_stops_the_evaluation(
    measured_root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Missing estimates would pass for a model that does not compete."""

    def fail(*_: object) -> None:
        raise DataError("the drive has too many rows for windows.")

    monkeypatch.setattr(measured_evaluation, "predict_drive", fail)
    done = run_on(measured_root, "evaluate", "own", "--cohort", "vehicle_id >= 'car-4'")
    assert done.exit_code == DataError.exit_code
    assert "too many rows" in done.stderr


def test_a_model_that_cannot_be_fitted_is_reported_with_the_reason(
    measured_root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train = Learner.train

    def fail(learner: Learner, *words: Any) -> Any:
        if learner.plan.request.model == "ax,ay,yaw_rate":
            raise DataError("the training drives have no ax.")
        return train(learner, *words)

    monkeypatch.setattr(Learner, "train", fail)
    fleet = fleet_slip.open(measured_root)
    fleet.models.publish("three", fleet.cohort().select(model="ax,ay,yaw_rate"), force=True)
    done = done_on(measured_root, "evaluate", "three", "--cohort", "vehicle_id >= 'car-2'")
    assert "three@1: not evaluated: the training drives have no ax." in done.stderr


MORE_SIGNALS = """
steering_wheel = { column = "steer", unit = "rad" }
steer_fl = { column = "left", unit = "rad" }
steer_fr = { column = "right", unit = "rad" }
"""


def test_a_choice_on_the_test_drives_understates_the_error(tmp_path: Path) -> None:
    generator = np.random.default_rng(2)
    cars, rows = 9, 200
    sizes = {"ax": 1, "ay": 2, "r": 0.1, "steer": 0.3, "left": 0.02, "right": 0.02, "beta": 0.02}
    columns: dict[str, Any] = {
        "t": list(np.tile(np.arange(rows) / 100, cars)),
        "car": list(np.repeat([f"car-{item}" for item in range(cars)], rows)),
    }
    for name, size in sizes.items():  # nothing has to do with the label: each drive is one draw
        of_drive = np.repeat(generator.standard_normal(cars), rows)
        noise = 0.1 * generator.standard_normal(cars * rows)
        columns[name] = list((size * (of_drive + noise)).round(5))
    (tmp_path / "log.csv").write_text(csv_text(columns))
    (tmp_path / "noise.toml").write_text(OWN_MAPPING + MORE_SIGNALS)
    root = tmp_path / "data"
    done_on(root, "ingest", tmp_path / "log.csv", "--mapping", tmp_path / "noise.toml")
    done_on(root, "gram")
    fleet = fleet_slip.open(root)
    search: Any = {"search": "exchange", "max_features": 3, "tolerance": "0deg", "folds": "each"}
    selection = fleet.cohort().select(SelectionRequest(**search), nested=True)
    fleet.models.publish("again", selection, force=True)
    chosen = fleet_slip.open(root).models.get("again").manifest.signals
    fleet.models.publish("once", fleet.cohort().select(model=",".join(chosen)), force=True)
    evaluation = (
        fleet_slip.open(root).evaluation.evaluate_measured("again", "true", ["once"]).content
    )
    spread_deg = float(np.degrees(np.std(columns["beta"])))
    errors = {name: item["rmse_deg"] for name, item in evaluation["estimators"].items()}
    assert errors["once@1"] < 0.7 * spread_deg
    assert errors["again@1"] > spread_deg
    assert selection.nested is not None
    assert selection.nested.figures.rmse_deg == pytest.approx(errors["again@1"], rel=1e-6)
    assert selection.winner.model.pooled.rmse_deg < selection.nested.figures.rmse_deg
    assert f"{errors['again@1']:.4f} deg on held-out drives" in str(selection)
    assert fleet.cohort().select(**search).nested is None, "only for publications"
    columns_of_parts = evaluation["estimators"]["again@1"]["found"]
    assert len({tuple(item) for item in columns_of_parts}) > 1


def test_gram_rows_of_quarters_add_up_to_those_of_drives(measured_root: Path) -> None:
    fleet = fleet_slip.open(measured_root)
    cohort = load_cohort(fleet.warehouse, "true")
    drives = read_measured_drives(fleet.warehouse, cohort)
    request = SelectionRequest(model="ax,ay,yaw_rate")
    learner = Learner.prepare(fleet.warehouse, request, "true", drives)
    (full,), (quarters,) = cohort.tables, learner.quarters.tables
    assert len(quarters) == 4 * len(full)
    assert quarters.total() == full.total()
    of_quarters = learner.choose(frozenset((drive.name, 3) for drive in drives))
    assert of_quarters.winner.model.pooled.rows == 6 * 375


SEARCHES = """
description = "A search among few columns, and one that needs four drives"
[[search]]
name = "few"
max_features = 3
max_features_per_drive = 1
inputs = ["ax", "ay", "yaw_rate"]
[[search]]
name = "many"
min_drives = 4
"""


def test_quarters_of_drives_do_not_count_as_drives(measured_root: Path, tmp_path: Path) -> None:
    """An evaluation of two drives must choose by the recipe that publish has for two drives."""
    fleet, predicate = fleet_slip.open(measured_root), "vehicle_id < 'car-2'"
    (tmp_path / "searches.toml").write_text(SEARCHES)
    request = SelectionRequest(models=str(tmp_path / "searches.toml"))
    drives = read_measured_drives(fleet.warehouse, load_cohort(fleet.warehouse, predicate))
    learner = Learner.prepare(fleet.warehouse, request, predicate, drives)
    published = fleet.cohort(predicate).select(request)
    chosen = learner.choose(folds_of(drives)[3])
    assert (
        chosen.skipped
        == published.skipped
        == {"many (search)": "it needs 4 drives, and there are 2"}
    )
    assert len(chosen.models) == len(published.models) == 2, "a column for each drive"
    assert chosen.winner.model.fold_names == published.winner.model.fold_names
    alone = learner.choose(folds_of(drives)[3] | {(drives[0].name, n) for n in range(4)})
    assert (alone.cohort.drive_count, len(alone.winner.model.folds)) == (1, 3)


def test_rows_at_standstill_are_judged_nowhere(tmp_path: Path) -> None:
    """Logs of earlier releases have labels there, such as 180 degrees of a navigation system."""
    random, stood = np.random.default_rng(1), np.arange(400) < 100
    warehouse = Warehouse(LocalFolder(tmp_path / "data"))
    drives = []
    for number in range(3):
        ay = random.integers(-3000, 3000, 400)
        wheels = {name: np.where(stood, 0, 2000).astype(np.int16) for name in WHEELS}
        label = np.where(stood, 20_000, np.rint(0.05 * ay))
        counts = {"ay": ay.astype(np.int16), "sideslip": label.astype(np.int16), **wheels}
        drives.append(log_rows(f"d{number}", counts))
    land(warehouse, "all", *drives)
    update_grams(warehouse)
    fleet = fleet_slip.open(tmp_path / "data")
    fleet.models.publish("own", fleet.cohort().select(model="ay"), force=True)
    score = fleet.evaluation.score("own", "true")
    assert score.rows == 900 and score.rows_without == 0
    measured = read_measured_drives(warehouse, load_cohort(warehouse, "true"))
    assert [int(drive.evaluated.sum()) for drive in measured] == [300] * 3
    content = fleet.evaluation.evaluate_measured("own", "true").content
    assert content["estimators"]["own@1"]["rows"] == 900


@pytest.mark.parametrize(
    "words",
    [
        ("--vehicle", "suv"),
        ("--blind", "--scenario", "nominal"),
        ("--cohort", "true", "--blind"),
    ],
)
def test_conflicting_options_are_refused(measured_root: Path, words: tuple[str, ...]) -> None:
    done = run_on(measured_root, "evaluate", "own", *words)
    assert done.exit_code == 2
    assert "leave out" in done.stderr


def test_filters_compete_in_the_car_of_a_file_and_in_one_that_is_identified(
    smoke_copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    judged: list[float] = []

    def untuned(_: object, start: Any, *arguments: Any) -> TuningResult[Any]:
        judged.append(
            float(np.mean([np.isfinite(drive.sideslip_rad).mean() for drive in arguments[1]]))
        )
        return TuningResult(start, 0.0)

    monkeypatch.setattr(filters, "tune", untuned)
    monkeypatch.setattr(
        measured_evaluation,
        "identify",
        lambda measured, *_: IdentifiedVehicle(vehicle_with_fit(measured), ekf.EkfNoise(), 0.0),
    )
    item = "drive_id = 'smoke-2024-05-01-0001'"
    evaluation = fleet_slip.open(smoke_copy).evaluation.evaluate_measured("smoke", item).content
    assert (evaluation["vehicle"], evaluation["parts_of"]) == ("d_class_sedan", "time")
    errors = {name: item["rmse_deg"] for name, item in evaluation["estimators"].items()}
    assert {"kinematic", "ekf_tuned", "ekf_identified", "kalman_identified"} <= {*errors}
    assert errors["ekf_tuned"] < 0.06, "the label's noise is 0.029"
    assert list(errors.values()) == sorted(errors.values())
    assert judged == pytest.approx([0.75] * len(judged), abs=0.01), "a quarter is never seen"
