"""`fleet-slip identify`: a vehicle file from labelled drives, with its error on those left out."""

import json
from pathlib import Path

import pytest

from fleet_slip.vehicle.parameters import load_vehicle
from tests.support.commands import run_on

CAR = ("--mass", "1480", "--front-axle", "1.11", "--rear-axle", "1.67", "--radius", "0.325")


def test_a_car_is_identified_and_its_file_is_a_vehicle(smoke_root: Path, tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    some = ("--cohort", "drive_id < 'smoke-2024-05-01-0002'")
    done = run_on(smoke_root, "identify", "mine", *CAR, *some, "--output", str(file), "--json")
    assert done.exit_code == 0, done.stderr
    found = json.loads(done.stdout)
    assert (found["name"], found["drives"]) == ("mine", 2)
    assert 0.028 < found["fit_deg"] < found["held_out_deg"] < 0.06, "the label's noise is 0.029"
    car = load_vehicle(str(file))
    assert car.body.mass_kg == pytest.approx(1480)
    assert car.body.yaw_inertia_kgm2 == pytest.approx(found["found"]["yaw_inertia_kgm2"])


def test_a_car_without_labelled_drives_cannot_be_identified(smoke_root: Path) -> None:
    done = run_on(smoke_root, "identify", "mine", *CAR, "--cohort", "drive_id = 'none'")
    assert done.exit_code == 5
    assert "none" in done.stderr


@pytest.mark.parametrize(
    ("words", "told"), [(("Golf", *CAR), "name: "), (("mine", *CAR, "--mass", "inf"), "mass_kg: ")]
)
def test_what_no_car_can_have_is_a_wrong_use(
    words: tuple[str, ...], told: str, smoke_root: Path
) -> None:
    done = run_on(smoke_root, "identify", *words)
    assert (done.exit_code, told in done.stderr) == (2, True), done.stderr
