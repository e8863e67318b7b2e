"""Drives are forgotten by what their owner calls them, and by the file that they came in."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import fleet_slip
from fleet_slip.api.fleet import Fleet
from fleet_slip.grams.cohort import load_cohort
from fleet_slip.ingest.mapping import Mapping
from fleet_slip.operations.forget import ForgetReport, forget
from tests.support.commands import RunCommand
from tests.support.measured import a_mapping, csv_text, good_columns


def mapping() -> Mapping:
    return a_mapping(drive={"column": "run", "vehicle_id": "car-of-mine"})


@pytest.fixture
def fleet(tmp_path: Path) -> Fleet:
    """Two files of two drives each; the drive `lap` is in both."""
    fleet = fleet_slip.open(tmp_path / "data")
    for number, names in enumerate((("lap", "slalom"), ("lap", "brake"))):
        columns = good_columns(40)
        columns["ax"] = [f"{0.1 * number:.1f}"] * 40
        columns["run"] = [name for name in names for _ in range(20)]
        file = tmp_path / f"log-{number}.csv"
        file.write_text(csv_text(columns))
        fleet.ingest(file, mapping())
    fleet.gram()
    return fleet


def drives(fleet: Fleet) -> list[tuple[str, str]]:
    return sorted(fleet.sql("SELECT source_file, drive_name FROM drives").fetchall())


def bytes_below(fleet: Fleet) -> bytes:
    files = [path for path in Path(str(fleet.root)).rglob("*") if path.is_file()]
    return b"".join(path.read_bytes() for path in files)


def test_a_drive_keeps_its_name_and_its_file(fleet: Fleet) -> None:
    assert drives(fleet) == [
        ("log-0.csv", "lap"),
        ("log-0.csv", "slalom"),
        ("log-1.csv", "brake"),
        ("log-1.csv", "lap"),
    ]
    assert load_cohort(fleet.warehouse, "drive_name = 'lap'").drive_count == 2


def test_every_drive_of_a_name_goes(fleet: Fleet, run_command: RunCommand) -> None:
    told = run_command("forget", "--drive-name", "slalom", "--now", "--json")
    assert (told.exit_code, told.json["drives"], told.json["rows"]) == (0, 1, 20)
    assert fleet.forget(drive_name="lap", now=True).drives == 2
    assert drives(fleet) == [("log-1.csv", "brake")]
    assert re.search(rb"slalom|\blap\b", bytes_below(fleet)) is None
    assert fleet.check().drives == 1


def test_every_drive_of_a_file_goes_and_does_not_come_back(
    fleet: Fleet, tmp_path: Path, run_command: RunCommand
) -> None:
    assert run_command("forget", "--source-file", "log-0.csv").exit_code == 0
    assert {file for file, _ in drives(fleet)} == {"log-1.csv"}
    (report,) = fleet.ingest(tmp_path / "log-0.csv", mapping())
    assert (report.new, report.drives_forgotten, report.counts.drives) == (False, 2, 0)
    assert {file for file, _ in drives(fleet)} == {"log-1.csv"}
    # The old files still tell the name: --now finds them when the command is repeated.
    assert run_command("forget", "--source-file", "log-0.csv", "--now").exit_code == 0
    assert b"slalom" not in bytes_below(fleet)


def test_a_file_that_is_allowed_again_lands_when_it_is_given_again(
    fleet: Fleet, tmp_path: Path, run_command: RunCommand
) -> None:
    before, rows = drives(fleet), fleet.sql("SELECT count(*) FROM log").fetchall()
    fleet.forget(source_file="log-0.csv", now=True)
    unknown = run_command("forget", "--source-file", "log-1.csv", "--allow")
    assert (unknown.exit_code, "was forgotten by the name of its file" in unknown.stderr) == (5, 1)
    assert run_command("forget", "--source-file", "log-0.csv", "--allow").exit_code == 0
    assert not fleet.allow(source_file="log-0.csv")
    (report,) = fleet.ingest(tmp_path / "log-0.csv", mapping())
    assert (report.new, report.counts.drives) == (True, 2)
    assert not fleet.ingest(tmp_path / "log-0.csv", mapping())[0].new
    fleet.gram()
    assert (drives(fleet), fleet.sql("SELECT count(*) FROM log").fetchall()) == (before, rows)
    assert not fleet.verify(full=True).damage


def test_what_may_have_the_rows_of_any_of_the_drives_is_pending(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first drive's files were forgotten about where the last drive had none: exit code 0."""
    left = iter((2, 0))

    def first_one_is_pending(*words: Any, **options: Any) -> ForgetReport:
        number = next(left)
        report = forget(*words, **options)
        return replace(report, old_files_left=number, pending=("logs/x.parquet",) * (number > 0))

    monkeypatch.setattr("fleet_slip.operations.forget.forget", first_one_is_pending)
    report = fleet.forget(drive_name="lap", now=True)
    assert (report.drives, report.old_files_left, report.pending) == (2, 2, ("logs/x.parquet",))


def test_a_name_that_no_drive_has_is_a_wrong_question(
    run_command: RunCommand, fleet: Fleet
) -> None:
    told = run_command("forget", "--drive-name", "Slalom")
    assert told.exit_code == 5
    assert "no drive has drive_name 'Slalom'" in told.stderr
    assert len(drives(fleet)) == 4


@pytest.mark.parametrize(
    "words",
    [["--drive-name", "lap", "--vehicle", "car"], ["--drive-name", "lap", "--allow"], []],
)
def test_what_is_forgotten_is_said_once(words: list[str], run_command: RunCommand) -> None:
    assert run_command("forget", *words).exit_code == 2
