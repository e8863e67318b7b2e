"""Drives are examined before they train, by hand as at night: wrong labels train no model."""

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
    screened = fleet.cohort().examine()
    assert (screened.drives, screened.faults) == (6, {"stuck ay": 2})

    def examine_again(*_: object) -> None:
        raise AssertionError("examined again")

    monkeypatch.setattr(sensor_screen, "examine_drives", examine_again)
    assert fleet.cohort().examine() == screened
    monkeypatch.undo()
    result = run_command("select", "--models", "table1")
    assert result.exit_code == 0
    assert "2 drives of 6 left out: faulty sensors (2 stuck ay)" in result.stderr
    assert "4 drives" in result.stdout
    assert "6 drives" in run_command("select", "--models", "table1", "--include-faulty").stdout
    assert run_command("publish", "m", "--models", "table1").exit_code == 0
    assert fleet.models.get("m").manifest.trained_on.drives == 4
    by_hand = fleet.cohort().select(models="table1")
    assert by_hand.as_dict()["examined"] == str(screened)
    assert fleet.models.publish("m", by_hand).reason == "The champion is the same model."
    scored = run_command("score", "m")
    assert "2 drives of 6 left out: faulty sensors (2 stuck ay)" in scored.stderr
    assert (
        fleet.evaluation.score("m").drives,
        fleet.evaluation.score("m", include_faulty=True).drives_left_out,
    ) == (4, 4)


def test_a_kept_verdict_of_which_a_bit_flipped_is_found_again(fleet: Fleet, tmp_path: Path) -> None:
    screened = fleet.cohort().examine()
    (cached,) = (tmp_path / "cache").glob("fleet-slip/examined/*.json")
    content = cached.read_bytes()
    place = content.index(b"[") + 2
    cached.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
    assert fleet.cohort().examine() == screened
    assert cached.read_bytes() == content


def test_a_cohort_of_which_no_drive_is_in_order_says_so(fleet: Fleet) -> None:
    with pytest.raises(DataError, match=r"without 2 faulty drives.*: fleet-slip quality"):
        fleet.cohort("day = DATE '2026-10-06'").select(models="table1")


@pytest.mark.parametrize(
    ("wrong", "expected"),
    [
        ("2 * sideslip_rad", "scaled sideslip"),
        pytest.param("-sideslip_rad", "reversed sideslip", marks=pytest.mark.long),
    ],
)
def test_a_first_champion_of_a_label_that_is_wrong_in_all_drives_is_refused(
    tmp_path: Path, smoke_root: Path, wrong: str, expected: str
) -> None:
    landing = Landing(tmp_path / "landing", smoke_root)
    landing.prepare()
    fleet = fleet_slip.open(tmp_path / "data")
    bad = landing.land("bad", landing.drives()[:5], date(2026, 10, 5), sideslip_rad=wrong)
    (report,) = fleet.ingest(bad, str(landing.mapping))
    assert expected in {f"{fault.kind} {fault.signals[0]}" for fault in report.suspicions}
    fleet.gram()
    chosen = fleet.cohort().select(models="table1")
    with pytest.raises(RefusedError, match=rf"of 5 inspected drives contradict .*{expected}"):
        fleet.models.publish("m", chosen)
    night = fleet.nightly(landing.folder, str(landing.mapping), "m", models="table1")
    assert night.exit_code != 0
    assert night.after.champion is None
    assert fleet.models.publish("m", chosen, candidate=True).candidate
    assert fleet.models.publish("m", chosen, force=True).new


def test_a_first_champion_of_measured_drives_needs_drives_and_rows_for_its_columns(
    fleet: Fleet, run_command: RunCommand, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    list_path = write_list(tmp_path / "own.toml", *nested("ay,yaw_rate"), tolerance="0.0001deg")
    command = ("publish", "m", "--models", list_path, "--dry-run")
    cohort = fleet.cohort("day = DATE '2026-10-05'")
    selection = cohort.select(order="ay,yaw_rate", tolerance="0.0001deg")
    for name, bound, message in (
        ("max_columns_per_drive", 0.1, r"columns? on 4 drives, more than 0\.1 a drive"),
        ("min_rows_per_column", 10**6, r"rows, fewer than 1000000 for each of its \d columns?"),
    ):
        strict = load_thresholds(SHIPPED_CONFIGS).model_copy(update={name: bound})
        monkeypatch.setattr(acceptance, "load_thresholds", lambda _, strict=strict: strict)
        with pytest.raises(RefusedError, match=message) as refused:
            fleet.models.publish("m", selection)
        dry = fleet.models.preview("m", selection)
        assert (dry.refused, dry.publishes, dry.reason) == (True, False, str(refused.value))
        assert fleet.models.preview("m", selection, candidate=True).candidate
        result = run_command(*command)
        assert "winner: " in result.stdout and result.exit_code == RefusedError.exit_code
        monkeypatch.setattr(acceptance, "load_thresholds", load_thresholds)
    assert not fleet.models.versions().num_rows
    assert "m would be published. " in run_command(*command).stderr
    assert fleet.models.publish("m", selection).new


def test_a_cohort_tells_what_it_was_before_drives_were_left_out() -> None:
    predicate = "day > '2026-01-01' AND (mass_kg < 1500)"
    once = without_drives(predicate, "drive", [hash_drive("drive", "a")])
    twice = without_drives(once, "fleet", [hash_drive("fleet", "b")])
    assert once != predicate != twice
    assert (
        with_all_drives(twice) == with_all_drives(once) == with_all_drives(predicate) == predicate
    )
    assert describe_cohort(once) == f" where {predicate}, without 1 faulty drive"
    assert Predicate(twice, "").quoted == f"{predicate!r}, without 2 faulty drives"
    assert describe_cohort(predicate) == f" where {predicate}"
    assert describe_cohort("campaign = 'golf'") == " of golf"


def test_many_drives_are_examined_in_pieces_of_days_and_each_piece_once(
    landed: Path, fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    queries: list[str] = []
    real = sensor_screen.examine_drives

    def counted(warehouse: Warehouse, predicate: Predicate) -> QualityReport:
        queries.append(predicate.text)
        return real(warehouse, predicate)

    monkeypatch.setattr(sensor_screen, "examine_drives", counted)
    monkeypatch.setattr(sensor_screen, "PIECE", 4)
    screened = fleet.cohort().examine()
    assert (screened.drives, screened.faults, len(queries)) == (6, {"stuck ay": 2}, 2)
    landing = Landing(landed / "landing", landed)
    fleet.ingest(sorted(landing.folder.glob("late*")), str(landing.mapping))
    fleet.gram()
    screened = fleet.cohort().examine()
    assert (screened.drives, screened.faults, len(queries)) == (
        8,
        {"stuck ay": 2, "stuck yaw_rate": 2},
        3,
    )
    assert "2026-10-06" in queries[-1] and "2026-10-05" not in queries[-1]


def test_drives_without_gram_rows_are_reduced_and_examined_before_they_train(
    fleet: Fleet, run_command: RunCommand, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As after `gram --features`, where the rows that are examined may not be there."""
    shutil.rmtree(Path(str(fleet.root)) / "grams")
    fleet.gram("calibration")
    message = str(sensor_screen.screen_computed_drives(fleet.warehouse, TRAINING_DRIVES))
    assert (
        message.startswith("6 measured drives not checked for faulty sensors: ")
        and "Run: fleet-slip gram" in message
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
    for name, batch, changes in (("a", drives[:4], {}), ("b", drives[4:], {"sideslip_rad": late})):
        day = date(2026, 10, 5 + (name == "b"))
        fleet.ingest(landing.land(name, batch, day, **changes), str(landing.mapping))
        fleet.gram()
        if name == "a":
            assert fleet.models.publish("m", fleet.cohort()).new
    assert fleet.cohort().examine().faults == {"late sideslip": 4}
    chosen = fleet.cohort(include_faulty=True).select()
    with pytest.raises(RefusedError, match=r"of 4 inspected drives .*late sideslip\? it is \+0\.6"):
        fleet.models.publish("m", chosen)
    assert fleet.models.publish("m", chosen, candidate=True).candidate
