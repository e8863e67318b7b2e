"""`fleet-slip evaluate --cohort`: measured drives judge what was not fitted to them."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fleet_slip
from fleet_slip.arrays import FloatArray
from fleet_slip.columns.plan import ColumnPlan
from fleet_slip.evaluation import ekf, filters, measured
from fleet_slip.evaluation.identify import Fitted, Identified, Tuned
from fleet_slip.evaluation.measured import Design, HeldOutDrive, accelerated, fit_left_out
from fleet_slip.evaluation.single_track import DriveSignals, LabelledDrive
from fleet_slip.vehicle.parameters import load_vehicle
from tests.support.commands import done_on, run_on
from tests.support.drives import rolling_drive
from tests.support.own_logs import ingest_own

ROWS = 400
LINE = Design(ColumnPlan.of(("ay",), {}, {}), (1.0,))
NO_SIGNALS = DriveSignals(*[np.full(ROWS, np.nan)] * 11)


def a_drive(number: int, part: int, *, shifted_rad: float = 0.0) -> HeldOutDrive:
    ay = np.sin(np.arange(ROWS) / (20 + number))
    label: FloatArray = -ay / 200 + shifted_rad
    columns = {"line": ay[:, None]}
    drive = LabelledDrive(f"drive-{number}", NO_SIGNALS, label)
    return HeldOutDrive(drive, columns, np.full(ROWS, part))


def test_a_drive_is_estimated_by_what_never_saw_it() -> None:
    drives = [a_drive(n, n % 4, shifted_rad=1.0 if n == 2 else 0.0) for n in range(4)]
    estimates = fit_left_out(drives, "line", LINE)
    assert np.abs(estimates[2] - (drives[2].drive.sideslip_rad - 1.0)).max() < 1e-9
    assert estimates[0].mean() == pytest.approx(1 / 3, abs=0.01), "one of the three others is off"


def test_a_part_of_a_single_drive_is_estimated_by_the_others() -> None:
    whole = a_drive(0, 0)
    part = np.arange(ROWS) * 4 // ROWS
    label = np.where(part == 1, 1.0, whole.drive.sideslip_rad)
    drive = HeldOutDrive(LabelledDrive("one", NO_SIGNALS, label), whole.columns, part)
    (estimate,) = fit_left_out([drive], "line", LINE)
    assert np.abs((estimate - whole.drive.sideslip_rad)[part == 1]).max() < 1e-9
    assert np.isnan(drive.without(1).sideslip_rad).sum() == ROWS // 4


def test_an_acceleration_that_is_not_logged_is_made_of_the_wheels() -> None:
    car, still = load_vehicle("d_class_sedan"), np.zeros(ROWS)
    speed = still + np.linspace(10.0, 18.0, ROWS)  # 2 m/s²
    signals = rolling_drive(car, speed, still, still, still)
    logged = LabelledDrive("logged", signals, still)
    assert accelerated(logged, car) is logged
    missing = replace(logged, signals=replace(signals, ax_mps2=np.full(ROWS, np.nan)))
    assert accelerated(missing, car).signals.ax_mps2[100:] == pytest.approx(2.0, abs=0.01)
    blind = replace(logged, signals=NO_SIGNALS)
    assert accelerated(blind, car) is blind


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data root with drives that no filter can serve, and a model of some of them."""
    folder = tmp_path_factory.mktemp("measured")
    root = folder / "data"
    ingest_own(root, folder, cars=6)
    done_on(root, "publish", "own", "--cohort", "vehicle_id < 'car-4'")
    return root


def test_drives_without_a_vehicle_are_judged_by_models_alone(own: Path) -> None:
    found = json.loads(done_on(own, "evaluate", "own", "--cohort", "true", "--json").stdout)
    assert found["vehicle"] is None
    assert found["estimators"]["own@1"]["told"] == "fitted to labels of the other parts"
    assert found["estimators"]["own@1"]["rmse_deg"] < 0.05
    assert {name for name in found["estimators"] if "/" not in name} == {"own@1"}
    assert len(found["drives"]) == 6
    told = done_on(own, "evaluate", "own", "--cohort", "true")
    assert "No filter competes" in told.stdout
    assert f"kept as evaluations/measured/{found['number']}.json" in told.stderr, "kept once"


def test_a_model_that_saw_none_of_the_drives_is_judged_as_it_is(own: Path) -> None:
    done = done_on(own, "evaluate", "own", "--cohort", "vehicle_id >= 'car-4'", "--json")
    assert json.loads(done.stdout)["estimators"]["own@1"]["told"] == "as published"


@pytest.mark.parametrize(
    "words",
    [("--vehicle", "suv"), ("--cohort", "true", "--blind")],
)
def test_what_does_not_go_together_is_refused(own: Path, words: tuple[str, ...]) -> None:
    done = run_on(own, "evaluate", "own", *words)
    assert done.exit_code == 2
    assert "leave out" in done.stderr


def test_filters_compete_in_the_car_of_a_file_and_in_one_that_is_identified(
    smoke_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = Path(shutil.copytree(smoke_root, tmp_path / "data"))
    judged: list[float] = []

    def untuned(_: object, start: Any, *rest: Any) -> Tuned[Any]:
        judged.append(float(np.mean([np.isfinite(one.sideslip_rad).mean() for one in rest[1]])))
        return Tuned(start, 0.0, 1)

    monkeypatch.setattr(filters, "tune", untuned)
    monkeypatch.setattr(
        measured,
        "identify",
        lambda measured, *_: Identified(measured.car(Fitted()), ekf.EkfNoise(), 0.0),
    )
    one = "drive_id = 'smoke-2024-05-01-0001'"
    found = fleet_slip.open(root).evaluate_measured("smoke", one).content
    assert (found["vehicle"], found["parts_of"]) == ("d_class_sedan", "time")
    errors = {name: one["rmse_deg"] for name, one in found["estimators"].items()}
    assert {"kinematic", "ekf_tuned", "ekf_identified", "kalman_identified"} <= {*errors}
    assert errors["ekf_tuned"] < 0.06, "the label's noise is 0.029"
    assert list(errors.values()) == sorted(errors.values())
    assert judged == pytest.approx([0.75] * len(judged), abs=0.01), "a quarter is never seen"
