"""`--robust` leaves out the cars whose influence no honest car has, says so, and keeps it."""

from pathlib import Path

import numpy as np
import pytest

import fleet_slip
from fleet_slip.api.fleet import Fleet
from fleet_slip.grams.job import update_grams
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.tables import Warehouse
from tests.support.commands import RunCommand
from tests.support.logs import land, log_rows

INPUTS = "ay,yaw_rate"
LIAR = "it's me"


@pytest.fixture
def fleet(tmp_path: Path) -> Fleet:
    """Twenty-five cars, one of which has the sign of its label reversed."""
    random = np.random.default_rng(2)
    warehouse = Warehouse(LocalFolder(tmp_path / "data"))
    drives = []
    for car in range(25):
        ay, yaw_rate = random.integers(-3000, 3000, (2, 100))
        label = np.rint(0.05 * ay - 0.02 * yaw_rate + random.normal(0, 10, 100)) + car % 3
        name = LIAR if car == 6 else f"car-{car:02d}"
        counts = {
            "ay": ay.astype(np.int16),
            "yaw_rate": yaw_rate.astype(np.int16),
            "sideslip": (-label if car == 6 else label).astype(np.int16),
        }
        drives.append(log_rows(f"d{car:02d}", counts, vehicle_id=name))
    land(warehouse, "all", *drives)
    update_grams(warehouse)
    return fleet_slip.open(tmp_path / "data")


def test_the_liar_is_left_out_and_the_model_is_that_of_the_others(fleet: Fleet) -> None:
    robust = fleet.cohort().select(nested=INPUTS, robust=True)
    assert list(robust.left_out) == [LIAR]
    assert robust.left_out[LIAR].times > 5
    assert robust.left_out[LIAR].rows == 1 / 25
    others = fleet.cohort("vehicle_id <> 'it''s me'").select(nested=INPUTS)
    assert robust.winner.model.model == others.winner.model.model
    plain = fleet.cohort().select(nested=INPUTS)
    assert plain.winner.model.pooled.rmse_deg > 2 * robust.winner.model.pooled.rmse_deg
    assert plain.as_dict()["drives"] == 1 + robust.as_dict()["drives"]


def test_the_command_names_them_and_the_version_tells_its_cohort(
    fleet: Fleet, run_command: RunCommand
) -> None:
    told = run_command("select", "--nested", INPUTS, "--robust")
    assert told.exit_code == 0
    assert f"{LIAR} left out: its influence on the model is " in told.stderr
    before = run_command("diagnose", "--signals", INPUTS)
    assert f"{LIAR} would be left out by select --robust: its influence" in before.stderr
    assert [*run_command("diagnose", "--signals", INPUTS, "--json").json["influential"]] == [LIAR]
    assert list(
        run_command("select", "--nested", INPUTS, "--robust", "--json").json["vehicles_left_out"]
    ) == [LIAR]
    made = run_command("publish", "safe", "--nested", INPUTS, "--robust", "--force")
    assert made.exit_code == 0, made.stderr
    assert "NOT IN ('it''s me')" in fleet.model("safe").manifest.trained_on.cohort
    assert fleet.model("safe").manifest.trained_on.drives == 24


def test_honest_cars_stay(fleet: Fleet) -> None:
    honest = fleet.cohort("vehicle_id <> 'it''s me'").select(nested=INPUTS, robust=True)
    assert honest.left_out == {}
    assert honest.as_dict()["cohort"] == "vehicle_id <> 'it''s me'"


def test_few_cars_are_refused(fleet: Fleet, run_command: RunCommand) -> None:
    told = run_command("select", "--nested", INPUTS, "--robust", "--cohort", "drive_id < 'd05'")
    assert told.exit_code == 5
    assert "takes 20 of them, and these drives are of 5" in told.stderr
