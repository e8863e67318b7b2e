"""What trains by hand is examined first, as a night does: wrong labels train no model."""

import shutil
from datetime import date
from pathlib import Path

import pytest

import fleet_slip
from fleet_slip import Fleet
from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.errors import RefusedError
from fleet_slip.monitoring import examined
from fleet_slip.runs.nights import hash_drive, with_all_drives, without_drives
from tests.support.commands import RunCommand
from tests.support.landing import Landing
from tests.support.once import made_once

NEGATED = {"sideslip_rad": "-sideslip_rad"}


@pytest.fixture(scope="module")
def landed(tmp_path_factory: pytest.TempPathFactory, smoke_root: Path) -> Path:
    """A folder with logs of a car, two drives with ay stuck, and a root, `data`."""

    def make(folder: Path) -> None:
        landing = Landing(folder / "landing", smoke_root)
        landing.prepare()
        drives, fleet = landing.drives(), fleet_slip.open(folder / "data")
        good = landing.land("good", drives[:6], date(2026, 10, 5))
        bad = landing.land("bad", drives[6:8], date(2026, 10, 6), ay_mps2="1.0 + 0 * ay_mps2")
        fleet.ingest([good, bad], str(landing.mapping))
        fleet.gram()

    return made_once(tmp_path_factory, "examined", make)


@pytest.fixture
def fleet(landed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Fleet:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("CACHE_DIRECTORY", raising=False)
    shutil.copytree(landed / "data", tmp_path / "data")
    return fleet_slip.open(tmp_path / "data")


def test_drives_that_are_not_in_order_train_nothing_by_hand(
    fleet: Fleet, run_command: RunCommand, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = fleet.leave_out_faulty()
    assert (found.drives, found.faults) == (8, {"stuck ay": 2})

    def examine_again(*_: object) -> None:
        raise AssertionError("examined again")

    monkeypatch.setattr(examined, "examine_drives", examine_again)
    assert fleet.leave_out_faulty() == found
    monkeypatch.undo()
    told = run_command("select", "--models", "table1")
    assert told.exit_code == 0
    assert "2 drives of 8 left out, not in order: 2 stuck ay" in told.stderr
    assert "6 drives" in told.stdout
    assert "8 drives" in run_command("select", "--models", "table1", "--unexamined").stdout
    assert run_command("publish", "m", "--models", "table1").exit_code == 0
    assert fleet.model("m").manifest.trained_on.drives == 6


def test_a_first_champion_of_a_label_that_is_turned_in_all_drives_is_refused(
    tmp_path: Path, smoke_root: Path
) -> None:
    landing = Landing(tmp_path / "landing", smoke_root)
    landing.prepare()
    fleet = fleet_slip.open(tmp_path / "data")
    bad = landing.land("bad", landing.drives()[:5], date(2026, 10, 5), **NEGATED)
    fleet.ingest(bad, str(landing.mapping))
    fleet.gram()
    cohort = fleet.cohort()
    with pytest.raises(RefusedError, match=r"5 of 5 drives .* contradict .*sign of sideslip"):
        fleet.publish("m", cohort)
    assert fleet.publish("m", cohort, candidate=True).candidate
    assert fleet.publish("m", cohort, force=True).new


def test_a_cohort_tells_what_it_was_before_drives_were_left_out() -> None:
    asked = "day > '2026-01-01' AND (mass_kg < 1500)"
    once = without_drives(asked, "drive", [hash_drive("drive", "a")])
    twice = without_drives(once, "fleet", [hash_drive("fleet", "b")])
    assert once != asked != twice
    assert with_all_drives(twice) == with_all_drives(once) == with_all_drives(asked) == asked


def test_more_drives_than_take_seconds_are_not_examined_and_that_is_said(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(examined, "MOST_DRIVES", 7)
    found = fleet.leave_out_faulty()
    assert (found.cohort, found.drives, found.unexamined) == (TRAINING_DRIVES, 0, 8)
    assert str(found).startswith("8 drives were not examined: more than 7 take too long.")
    assert fleet.leave_out_faulty(f"{TRAINING_DRIVES} AND day = DATE '2026-10-05'").drives == 6


def test_drives_without_gram_rows_are_told_as_not_examined(landed: Path, tmp_path: Path) -> None:
    fleet = fleet_slip.open(shutil.copytree(landed / "data", tmp_path / "data"))
    shutil.rmtree(tmp_path / "data" / "grams")
    fleet.gram("calibration")
    told = str(fleet.leave_out_faulty())
    assert told.startswith("drives were not examined: ") and "fleet-slip gram" in told
