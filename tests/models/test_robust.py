"""`--robust` counts drives less whose error is unusual, says so, and keeps it."""

from pathlib import Path

import numpy as np
import pytest

import fleet_slip
from fleet_slip.api.fleet import Fleet
from fleet_slip.catalogue.features import input_scales
from fleet_slip.grams.job import update_grams
from fleet_slip.regression.least_squares import fit
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.tables import Warehouse
from tests.support.commands import RunCommand
from tests.support.counts import gram_of
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


def test_the_liar_counts_for_nothing_and_the_model_is_that_of_the_others(fleet: Fleet) -> None:
    robust = fleet.cohort().select(nested=INPUTS, robust=True)
    assert list(robust.weighed) == ["d06"]
    assert robust.weighed["d06"].times > 10 and robust.weighed["d06"].weight == 0
    others = fleet.cohort("vehicle_id <> 'it''s me'").select(nested=INPUTS)
    assert robust.winner.model.model == others.winner.model.model
    plain = fleet.cohort().select(nested=INPUTS)
    assert plain.winner.model.pooled.rmse_deg > 2 * robust.winner.model.pooled.rmse_deg
    assert plain.as_dict()["drives"] == 1 + robust.as_dict()["drives"]


def test_the_command_names_it_and_the_version_keeps_how(
    fleet: Fleet, run_command: RunCommand
) -> None:
    told = run_command("select", "--nested", INPUTS, "--robust")
    assert told.exit_code == 0
    assert "d06: its error is " in told.stderr and "takes it 0.00 times" in told.stderr
    before = run_command("diagnose", "--signals", INPUTS)
    assert "d06: its error is " in before.stderr
    before_json = run_command("diagnose", "--signals", INPUTS, "--json").json
    assert list(before_json["drives_weighed"]) == ["d06"]
    document = run_command("select", "--nested", INPUTS, "--robust", "--json").json
    assert document["drives_weighed"]["d06"]["weight"] == 0
    made = run_command("publish", "safe", "--nested", INPUTS, "--robust", "--force")
    assert made.exit_code == 0, made.stderr
    manifest = fleet.model("safe").manifest
    assert manifest.selected_by.asked is not None and manifest.selected_by.asked["robust"]
    assert (manifest.trained_on.drives, manifest.trained_on.rows) == (24, 2400)
    again = run_command("publish", "safe", "--json")
    assert not again.json["new"], "it is trained as it was"


def test_honest_drives_keep_their_weight(fleet: Fleet) -> None:
    honest = fleet.cohort("vehicle_id <> 'it''s me'").select(nested=INPUTS, robust=True)
    assert honest.weighed == {}
    few = fleet.cohort("drive_id < 'd05'").select(nested=INPUTS, robust=True)
    assert few.weighed == {}


def test_a_drive_that_counts_partly_is_a_part_of_its_rows(tmp_path: Path) -> None:
    """By rows: each of the usual drives sixteen times, the noisy one as often as it counts."""
    random = np.random.default_rng(4)
    warehouse, drives, rows = Warehouse(LocalFolder(tmp_path / "data")), [], []
    for number in range(12):
        ay, yaw_rate = random.integers(-3000, 3000, (2, 100))
        noise = random.normal(0, 60 if number == 5 else 10, 100)
        label = np.rint(0.05 * ay - 0.02 * yaw_rate + noise)
        counts = {"ay": ay, "yaw_rate": yaw_rate, "sideslip": label}
        rows.append(np.stack([*counts.values()], axis=1).astype(np.int64))
        whole = {name: one.astype(np.int16) for name, one in counts.items()}
        drives.append(log_rows(f"d{number:02d}", whole, vehicle_id="a"))
    land(warehouse, "all", *drives)
    update_grams(warehouse)
    found = fleet_slip.open(tmp_path / "data").cohort().select(model=INPUTS, robust=True)
    assert list(found.weighed) == ["d05"] and 0 < found.weighed["d05"].weight < 1
    part = round(16 * found.weighed["d05"].weight)
    assert found.trained_rows == (1100 * 16 + 100 * part) // 16
    repeated = np.concatenate(
        [np.repeat(one, part if i == 5 else 16, axis=0) for i, one in enumerate(rows)]
    )
    slopes = fit(gram_of(repeated), ["x1", "x2"], "y").model.coefficients
    units = [input_scales()["sideslip"] / input_scales()[name] for name in ("ay", "yaw_rate")]
    expected = tuple(slope * unit for slope, unit in zip(slopes, units, strict=True))
    assert found.winner.model.model.coefficients == expected
