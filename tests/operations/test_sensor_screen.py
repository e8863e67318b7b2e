"""What trains by hand is examined first, as a night does: wrong labels train no model."""

import shutil
from datetime import date
from pathlib import Path

import pytest

import fleet_slip
from fleet_slip.api.fleet import Fleet
from fleet_slip.catalog.signals import TRAINING_DRIVES
from fleet_slip.errors import DataError, NotScreenedError, RefusedError
from fleet_slip.models import acceptance
from fleet_slip.models.acceptance import load_thresholds
from fleet_slip.operations import sensor_screen
from fleet_slip.operations.sensor_screen import QualityReport
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.warehouse.database import (
    Predicate,
    describe_cohort,
    hash_drive,
    with_all_drives,
    without_drives,
)
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.commands import RunCommand
from tests.support.landing import Landing
from tests.support.model_lists import nested, write_list
from tests.support.once import made_once


@pytest.fixture(scope="module")
def landed(tmp_path_factory: pytest.TempPathFactory, smoke_root: Path) -> Path:
    """A folder with logs of a car, two drives with ay stuck, and a root, `data`."""

    def make(folder: Path) -> None:
        landing = Landing(folder / "landing", smoke_root)
        landing.prepare()
        drives, fleet = landing.drives(), fleet_slip.open(folder / "data")
        good = landing.land("good", drives[:4], date(2026, 10, 5))
        bad = landing.land("bad", drives[4:6], date(2026, 10, 6), ay_mps2="1.0 + 0 * ay_mps2")
        landing.land("late", drives[6:8], date(2026, 10, 7), yaw_rate_rad_s="0.1 + 0 * time_s")
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
    found = fleet.cohort().examine()
    assert (found.drives, found.faults) == (6, {"stuck ay": 2})

    def examine_again(*_: object) -> None:
        raise AssertionError("examined again")

    monkeypatch.setattr(sensor_screen, "examine_drives", examine_again)
    assert fleet.cohort().examine() == found
    monkeypatch.undo()
    told = run_command("select", "--models", "table1")
    assert told.exit_code == 0
    assert "2 drives of 6 left out: faulty sensors (2 stuck ay)" in told.stderr
    assert "4 drives" in told.stdout
    assert "6 drives" in run_command("select", "--models", "table1", "--include-faulty").stdout
    assert run_command("publish", "m", "--models", "table1").exit_code == 0
    assert fleet.models.get("m").manifest.trained_on.drives == 4
    by_hand = fleet.cohort().select(models="table1")
    assert by_hand.as_dict()["examined"] == str(found)
    assert fleet.models.publish("m", by_hand).reason == "The champion is the same model."
    scored = run_command("score", "m")
    assert "2 drives of 6 left out: faulty sensors (2 stuck ay)" in scored.stderr
    assert (
        fleet.evaluation.score("m").drives,
        fleet.evaluation.score("m", include_faulty=True).drives_left_out,
    ) == (4, 4)


def test_a_kept_verdict_of_which_a_bit_flipped_is_found_again(fleet: Fleet, tmp_path: Path) -> None:
    found = fleet.cohort().examine()
    (kept,) = (tmp_path / "cache").glob("fleet-slip/examined/*.json")
    whole = kept.read_bytes()
    place = whole.index(b"[") + 2
    kept.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
    assert fleet.cohort().examine() == found
    assert kept.read_bytes() == whole


def test_a_cohort_of_which_no_drive_is_in_order_says_so(fleet: Fleet) -> None:
    with pytest.raises(DataError, match=r"without 2 faulty drives.*: fleet-slip quality"):
        fleet.cohort("day = DATE '2026-10-06'").select(models="table1")


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ("2 * sideslip_rad", "scaled sideslip"),
        pytest.param("-sideslip_rad", "reversed sideslip", marks=pytest.mark.long),
    ],
)
def test_a_first_champion_of_a_label_that_is_wrong_in_all_drives_is_refused(
    tmp_path: Path, smoke_root: Path, wrong: str, told: str
) -> None:
    landing = Landing(tmp_path / "landing", smoke_root)
    landing.prepare()
    fleet = fleet_slip.open(tmp_path / "data")
    bad = landing.land("bad", landing.drives()[:5], date(2026, 10, 5), sideslip_rad=wrong)
    (report,) = fleet.ingest(bad, str(landing.mapping))
    assert told in {f"{one.kind} {one.signals[0]}" for one in report.suspicions}
    fleet.gram()
    chosen = fleet.cohort().select(models="table1")
    with pytest.raises(RefusedError, match=rf"of 5 inspected drives contradict .*{told}"):
        fleet.models.publish("m", chosen)
    night = fleet.nightly(landing.folder, str(landing.mapping), "m", models="table1")
    assert night.exit_code != 0
    assert night.after.champion is None
    assert fleet.models.publish("m", chosen, candidate=True).candidate
    assert fleet.models.publish("m", chosen, force=True).new


def test_a_first_champion_of_measured_drives_needs_drives_and_rows_for_its_columns(
    fleet: Fleet, run_command: RunCommand, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    own = write_list(tmp_path / "own.toml", *nested("ay,yaw_rate"), tolerance="0.0001deg")
    command = ("publish", "m", "--models", own, "--dry-run")
    cohort = fleet.cohort("day = DATE '2026-10-05'")
    asked = cohort.select(order="ay,yaw_rate", tolerance="0.0001deg")
    for name, bound, told in (
        ("max_columns_per_drive", 0.1, r"columns? on 4 drives, more than 0\.1 a drive"),
        ("min_rows_per_column", 10**6, r"rows, fewer than 1000000 for each of its \d columns?"),
    ):
        strict = load_thresholds(SHIPPED_CONFIGS).model_copy(update={name: bound})
        monkeypatch.setattr(acceptance, "load_thresholds", lambda _, strict=strict: strict)
        with pytest.raises(RefusedError, match=told) as refused:
            fleet.models.publish("m", asked)
        dry = fleet.models.preview("m", asked)
        assert (dry.refused, dry.publishes, dry.reason) == (True, False, str(refused.value))
        assert fleet.models.preview("m", asked, candidate=True).candidate
        said = run_command(*command)
        assert "winner: " in said.stdout and said.exit_code == RefusedError.exit_code
        monkeypatch.setattr(acceptance, "load_thresholds", load_thresholds)
    assert not fleet.models.versions().num_rows
    assert "m would be published. " in run_command(*command).stderr
    assert fleet.models.publish("m", asked).new


def test_a_cohort_tells_what_it_was_before_drives_were_left_out() -> None:
    asked = "day > '2026-01-01' AND (mass_kg < 1500)"
    once = without_drives(asked, "drive", [hash_drive("drive", "a")])
    twice = without_drives(once, "fleet", [hash_drive("fleet", "b")])
    assert once != asked != twice
    assert with_all_drives(twice) == with_all_drives(once) == with_all_drives(asked) == asked
    assert describe_cohort(once) == f" where {asked}, without 1 faulty drive"
    assert Predicate(twice, "").quoted == f"{asked!r}, without 2 faulty drives"
    assert describe_cohort(asked) == f" where {asked}"
    assert describe_cohort("campaign = 'golf'") == " of golf"


def test_many_drives_are_examined_in_pieces_of_days_and_each_piece_once(
    landed: Path, fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []
    real = sensor_screen.examine_drives

    def counted(warehouse: Warehouse, predicate: Predicate) -> QualityReport:
        asked.append(predicate.text)
        return real(warehouse, predicate)

    monkeypatch.setattr(sensor_screen, "examine_drives", counted)
    monkeypatch.setattr(sensor_screen, "PIECE", 4)
    found = fleet.cohort().examine()
    assert (found.drives, found.faults, len(asked)) == (6, {"stuck ay": 2}, 2)
    landing = Landing(landed / "landing", landed)
    fleet.ingest(sorted(landing.folder.glob("late*")), str(landing.mapping))
    fleet.gram()
    found = fleet.cohort().examine()
    assert (found.drives, found.faults, len(asked)) == (8, {"stuck ay": 2, "stuck yaw_rate": 2}, 3)
    assert "2026-10-06" in asked[-1] and "2026-10-05" not in asked[-1]


def test_drives_without_gram_rows_are_reduced_and_examined_before_they_train(
    fleet: Fleet, run_command: RunCommand, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As after `gram --features`, where the rows that are examined may not be there."""
    shutil.rmtree(Path(str(fleet.root)) / "grams")
    fleet.gram("calibration")
    told = str(sensor_screen.screen_computed_drives(fleet.warehouse, TRAINING_DRIVES))
    assert (
        told.startswith("6 measured drives not checked for faulty sensors: ")
        and "Run: fleet-slip gram" in told
    )
    with monkeypatch.context() as patch:
        patch.setattr(sensor_screen, "CHECK_ROWS", 100)
        with pytest.raises(NotScreenedError, match=r"6 measured drives .* --include-faulty"):
            fleet.models.publish("m")
    done = run_command("publish", "m", "--models", "table1")
    assert done.exit_code == 0, done.stderr
    assert "computing Gram rows of signals from 2 log files" in done.stderr
    assert fleet.models.get("m").manifest.trained_on.drives == 4


def test_labels_that_are_late_on_new_drives_are_seen_beside_a_champion(
    tmp_path: Path, smoke_root: Path
) -> None:
    landing = Landing(tmp_path / "landing", smoke_root)
    landing.prepare()
    fleet, drives = fleet_slip.open(tmp_path / "data"), landing.drives()
    late = "coalesce(lag(sideslip_rad, 60) OVER (PARTITION BY drive_id ORDER BY time_s), 0)"
    for name, some, changes in (("a", drives[:4], {}), ("b", drives[4:], {"sideslip_rad": late})):
        day = date(2026, 10, 5 + (name == "b"))
        fleet.ingest(landing.land(name, some, day, **changes), str(landing.mapping))
        fleet.gram()
        if name == "a":
            assert fleet.models.publish("m", fleet.cohort()).new
    assert fleet.cohort().examine().faults == {"late sideslip": 4}
    chosen = fleet.cohort(include_faulty=True).select()
    with pytest.raises(RefusedError, match=r"of 4 inspected drives .*late sideslip\? it is \+0\.6"):
        fleet.models.publish("m", chosen)
    assert fleet.models.publish("m", chosen, candidate=True).candidate
