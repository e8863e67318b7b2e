"""Nights with real cars: logs that land day by day, and what goes wrong with them."""

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import date, timedelta
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pytest

import fleet_slip
from fleet_slip.api import pipelines
from fleet_slip.api.pipelines import NightlyPipeline
from fleet_slip.errors import StorageError, UsageError
from fleet_slip.operations.night import Baseline, NightlyLog, NightReport
from fleet_slip.regression.gram import Gram
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.database import hash_drive, parse_predicate, without_drives
from tests.support.cars import counts, drive
from tests.support.catalog import SIGNALS
from tests.support.commands import Finished, run_on, start_on, until
from tests.support.counted_rows import START_S, row_of, write_counted
from tests.support.landing import Landing
from tests.support.logs import state
from tests.support.once import made_once

FIRST = date(2026, 10, 5)
OPTIONS = ("--models", "table1")
DRIVES = (4, 2, 2)
"""How many land on each day."""


def day_of(night: int) -> date:
    return FIRST + timedelta(days=night)


def land(landing: Landing, night: int, **changes: str) -> Path:
    begin = sum(DRIVES[:night])
    drives = landing.drives()[begin : begin + DRIVES[night]]
    return landing.land(f"night-{night}", drives, day_of(night), **changes)


def configs(folder: Path, old: str, new: str) -> str:
    """Return a folder of configs whose rules for champions are others."""
    shipped = Path(fleet_slip.__file__).parents[1] / "configs/publish.toml"
    text = shipped.read_text()
    assert old in text
    folder.mkdir(parents=True)
    (folder / "publish.toml").write_text(text.replace(old, new))
    return str(folder)


@contextmanager
def champions_by(folder: Path, old: str, new: str) -> Iterator[None]:
    """Publish by other rules, here and in commands."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FLEET_SLIP_CONFIG", configs(folder, old, new))
        yield


@pytest.fixture(scope="module", autouse=True)
def forgiving(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Rules that let small differences pass: of few drives they are large. One file is verified."""
    folder = tmp_path_factory.mktemp("forgiving") / "configs"
    with (
        champions_by(folder, "tolerance_deg = 0.025", "tolerance_deg = 1.0  "),
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setattr(pipelines, "SAMPLE_FILES", 1)
        yield


@pytest.fixture(scope="module")
def two_nights(tmp_path_factory: pytest.TempPathFactory, smoke_root: Path) -> Path:
    """A folder with the landing folder, and a root, `data`, after two nights."""

    def make(folder: Path) -> None:
        landing = Landing(folder / "landing", smoke_root)
        landing.prepare()
        for night in range(2):
            land(landing, night)
            assert give(folder, night).problem is None

    return made_once(tmp_path_factory, "two-nights", make)


@pytest.fixture
def place(two_nights: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(two_nights, tmp_path / "place"))


@pytest.fixture
def landing(place: Path, smoke_root: Path) -> Landing:
    return Landing(place / "landing", smoke_root)


def give(place: Path, night: int, **options: Any) -> NightReport:
    fleet = fleet_slip.open(place / "data")
    mapping = str(place / "landing.toml")
    chosen = {"models": "table1", "night": day_of(night), **options}
    return fleet.nightly(place / "landing", mapping, "smoke", **chosen)


def command(place: Path, night: int, *options: str) -> list[str]:
    words = ["nightly", "--inbox", f"{place / 'landing'}", "--model", "smoke", *OPTIONS]
    mapping = [] if "--mapping" in options else ["--mapping", f"{place / 'landing.toml'}"]
    return [*words, *mapping, "--night", f"{day_of(night)}", *options]


def run_night(place: Path, night: int, *options: str) -> Finished:
    return run_on(place / "data", *command(place, night, *options))


def figures(report: NightReport) -> dict[str, Any]:
    """Return the figures of a summary, without times."""
    document = report.as_dict()
    del document["seconds"]
    return {**document, "steps": [(step.name, step.state) for step in report.steps]}


def test_a_night_brings_in_what_is_new_and_writes_its_summary(
    place: Path, landing: Landing, tmp_path: Path
) -> None:
    land(landing, 2)
    done = run_night(place, 2, "--json", "--output", str(tmp_path / "out"))
    assert done.exit_code == 0, done.stderr
    document = done.json
    assert (document["drives"], document["new_drives"], document["champion"]) == (8, 2, "smoke@3")
    assert document["champion_before"] == "smoke@2"
    assert {step["state"] for step in document["steps"]} == {"done", "left out"}
    assert json.loads((tmp_path / f"out/{day_of(2)}.json").read_text()) == document
    assert "2 drives" in (tmp_path / f"out/{day_of(2)}.txt").read_text()
    again = str(give(place, 3))
    assert "0 new rows" in again
    assert "smoke@3 is up to date" in again


def test_a_fleet_that_counts_on_board_alone_has_nights(place: Path, tmp_path: Path) -> None:
    shutil.rmtree(place / "data")
    shutil.rmtree(place / "landing")
    (place / "landing").mkdir()
    fleet = fleet_slip.open(place / "data")
    rng = np.random.default_rng(2)
    names = SIGNALS.gram_signals
    for night in range(2):
        rows = []
        for car in range(12):
            counts_of_drive = counts(drive(rng, gentleness=2.0))
            matrix = np.column_stack([counts_of_drive[name].astype(np.int64) for name in names])
            gram = Gram.from_counts(names, matrix)
            rows.append(row_of(gram, f"VIN{car}", START_S + 86_400 * night))
        fleet.import_onboard_grams(write_counted(tmp_path / f"{night}", rows))
        report = give(place, night)
        assert (report.exit_code, report.after.drives, report.after.champion) == (
            0,
            12 + 12 * night,
            f"smoke@{night + 1}",
        ), str(report)
    assert "smoke@2 is up to date" in str(give(place, 2))
    assert fleet.maintenance.verify(full=True).findings == []


class Killed(BaseException):
    """The end of a process, as far as it can be told from within."""


@pytest.mark.long
@pytest.mark.parametrize("step", ["_retain", "_publish", "_verify"])
def test_a_night_that_is_killed_and_given_again_ends_at_the_same_place(
    place: Path, landing: Landing, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, step: str
) -> None:
    land(landing, 2)
    twin = Path(shutil.copytree(place, tmp_path / "twin"))
    undisturbed = give(twin, 2)

    def kill(_: NightlyPipeline) -> None:
        raise Killed

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(NightlyPipeline, step, kill)
        give(place, 2)
    again = give(place, 2)
    assert figures(again) == figures(undisturbed)
    assert state(place / "data") == state(twin / "data")
    assert not fleet_slip.open(place / "data").maintenance.verify().damage


def test_a_file_that_cannot_be_used_does_not_hold_up_the_others(
    place: Path, landing: Landing
) -> None:
    land(landing, 2)
    (place / "landing/torn.parquet").write_bytes(b"PAR1 half a file")
    report = give(place, 2)
    assert (report.exit_code, report.after.champion, report.after.drives) == (4, "smoke@3", 8)
    assert "ingest failed" in str(report.problem)
    assert "torn.parquet" in str(report.problem)


def test_no_night_erases_drives_whose_date_has_rolled_over(place: Path, landing: Landing) -> None:
    begin = sum(DRIVES[:2])
    rolled_over = date.today() - timedelta(weeks=1024)
    landing.land("rolled", landing.drives()[begin : begin + DRIVES[2]], rolled_over)
    for night in (2, 3):  # the second knows these drives
        report = give(place, night)
        (retain,) = (step for step in report.steps if step.name == "retain")
        assert (retain.state, report.after.drives, report.exit_code) == ("attention", 8, 10)
        assert str(rolled_over) in retain.summary


def test_with_a_wrong_mapping_what_is_there_is_looked_after(place: Path, landing: Landing) -> None:
    land(landing, 2)
    wrong = place / "wrong.toml"
    wrong.write_text(landing.mapping.read_text().replace('"m/s^2"', '"furlongs"'))
    done = run_night(place, 2, "--mapping", str(wrong), "--json")
    assert done.exit_code == 3
    assert done.stderr == f"error: the night of {day_of(2)}: ingest failed\n"
    assert "furlongs" in done.json["steps"][0]["told"]
    states = {step["name"]: step["state"] for step in done.json["steps"]}
    assert states["ingest"] == "failed"
    assert states["verify"] == states["quality"] == "done"
    mended = give(place, 2)
    assert (mended.exit_code, mended.after.drives - mended.before.drives) == (0, 2)


def test_a_broken_sensor_is_told_once_and_trains_no_model(place: Path, landing: Landing) -> None:
    land(landing, 2, yaw_rate_rad_s="0.01")
    first = give(place, 2)
    assert first.exit_code == 10
    assert len(first.new_faults) == 2
    assert {fault.fault.signals for fault in first.new_faults} == {("yaw_rate",)}
    assert all(fault.drive_id in str(first) for fault in first.new_faults)
    assert first.after.champion == "smoke@2"
    second = give(place, 3)
    assert second.exit_code == 0
    assert (len(second.faults), second.new_faults) == (2, ())
    hostile = replace(first.faults[0], drive_id="\x1b[2J<b>")
    shown = replace(first, faults=(hostile,))
    assert "\x1b" not in str(shown)
    record = "".join(file.read_text() for file in (place / "data/nights").iterdir())
    assert first.new_faults[0].drive_id not in record


def test_a_worse_winner_becomes_a_candidate_and_calls_for_attention(
    place: Path, landing: Landing
) -> None:
    land(landing, 2)
    with champions_by(place / "configs", "min_correlation = 0.5", "min_correlation = 0.999999"):
        report, again, next_night = (give(place, night) for night in (2, 2, 3))
    assert report.exit_code == 10
    assert (report.after.champion, report.after.candidate) == ("smoke@2", "smoke@3")
    assert "publish: smoke@3" in str(report.problem)
    assert (again.exit_code, again.after.candidate) == (10, "smoke@3")
    assert (next_night.exit_code, next_night.after.candidate) == (0, "smoke@3"), str(next_night)


def refused(place: Path, night: int, **options: Any) -> tuple[int, str]:
    report = give(place, night, **options)
    return report.exit_code, str(report.problem)


@pytest.mark.parametrize(
    ("options", "exit_code", "message"),
    [
        ({"cohort": "no such thing"}, 5, "quality failed"),
        ({"models": "no-such-list"}, 3, "gram failed"),
        ({"retention": "no-such-file"}, 3, "retain failed"),
    ],
)
def test_a_step_that_fails_is_named(
    place: Path, options: dict[str, Any], exit_code: int, message: str
) -> None:
    code, problem = refused(place, 2, **options)
    assert code == exit_code
    assert message in problem


def test_before_anything_has_landed_it_says_so(tmp_path: Path, smoke_root: Path) -> None:
    landing = Landing(tmp_path / "landing", smoke_root)
    landing.prepare()
    report = give(tmp_path, 0)
    assert report.exit_code == 10
    assert "No log is in the folder" in str(report)
    shutil.rmtree(landing.folder)
    assert refused(tmp_path, 0)[0] == 4


def test_meaningless_options_are_refused_before_anything_is_written(
    run_command: Callable[..., Finished], tmp_path: Path
) -> None:
    done = run_command(
        *("nightly", "--inbox", ".", "--mapping", "m", "--model", "m", "--night", "yesterday")
    )
    assert done.exit_code == 2
    assert "night yesterday: not a date" in done.stderr
    fleet = fleet_slip.open(tmp_path / "data")
    with pytest.raises(UsageError, match="no/name"):
        fleet.nightly(tmp_path, "m", "no/name")
    assert not (tmp_path / "data").exists()


MONDAY, TUESDAY = date(2026, 10, 5), date(2026, 10, 6)
NOW = Baseline("fleet@1", drives=4, rows=100, quarantined=0)


@pytest.fixture
def nights(tmp_path: Path) -> NightlyLog:
    return NightlyLog(LocalFolder(tmp_path), "fleet")


def past(night: date, *faulty: str) -> dict[str, object]:
    return {"night": night.isoformat(), "drives": 4, "faulty": faulty}


def test_a_night_that_is_given_again_has_the_beginning_it_had(nights: NightlyLog) -> None:
    assert nights.begin(MONDAY, NOW) == NOW
    later = Baseline("fleet@2", drives=8, rows=200, quarantined=3)
    assert nights.begin(MONDAY, later) == NOW
    nights.end(past(MONDAY, "cd"))
    assert nights.begin(MONDAY, later) == NOW
    nights.end(past(MONDAY, "ab"))  # as it ended at last
    assert nights.begin(TUESDAY, later) == replace(later, known_faults=frozenset({"ab"}))


def test_a_changed_record_is_refused(nights: NightlyLog, tmp_path: Path) -> None:
    nights.end(past(MONDAY))
    file = tmp_path / "nights/1.json"
    file.write_text(file.read_text().replace('"drives": 4', '"drives": 5'))
    with pytest.raises(StorageError, match="changed or damaged"):
        nights.begin(TUESDAY, NOW)


def test_drives_are_left_out_by_hashes_that_do_not_name_them() -> None:
    hashes = [hash_drive("fleet", drive) for drive in ("car's <1>", "b")]
    predicate = without_drives("mass_kg > 1000 OR true", "fleet", hashes)
    parse_predicate(SIGNALS, predicate)
    assert "car" not in predicate
    with duckdb.connect() as database:
        excluded = database.execute(
            "SELECT drive_id FROM (VALUES ('car''s <1>', 1320), ('b', 1320), ('c', 1320)) "
            f"AS drives(drive_id, mass_kg) WHERE {predicate}"
        ).fetchall()
    assert excluded == [("c",)]
    assert without_drives("true", "fleet", []) == "true"


@pytest.mark.long
def test_a_process_that_is_killed_leaves_a_night_that_can_be_given_again(
    place: Path, landing: Landing
) -> None:
    land(landing, 2)
    commits = place / "data/grams/_delta_log"
    before = len(list(commits.glob("*.json")))
    process = start_on(place / "data", *command(place, 2))
    until(lambda: len(list(commits.glob("*.json"))) > before)
    process.kill()
    process.communicate()
    assert process.returncode < 0
    again = give(place, 2)
    assert (again.exit_code, again.after.drives, again.after.champion) == (0, 8, "smoke@3")
    assert again.after.drives - again.before.drives == 2
