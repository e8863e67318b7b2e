"""Jobs that meet: nothing is doubled or lost, and what is forgotten stays forgotten.

Each is a schedule that `python -m benchmarks.interleave` found, as one test.
"""

import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

import fleet_slip
from fleet_slip.api.fleet import Fleet
from fleet_slip.grams import update
from fleet_slip.grams.cohort import load_cohort
from fleet_slip.grams.update import update_grams
from fleet_slip.ingest.mapping import Mapping
from fleet_slip.models.publish import manifest_of, publish_challenger
from fleet_slip.models.registry import Registry
from fleet_slip.models.request import SelectionRequest
from fleet_slip.models.select import run_selection
from fleet_slip.operations import rewriting
from fleet_slip.operations.forget import forget, marked_models
from fleet_slip.operations.rewriting import compact, find_expired
from fleet_slip.operations.verify import verify
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.simulation.campaign import load_campaign
from fleet_slip.simulation.simulate import simulate_batches
from fleet_slip.storage.local import LocalFolder
from fleet_slip.storage.runs import recording
from fleet_slip.storage.table import Change, Snapshot, Table
from fleet_slip.warehouse.erasure_log import ErasureLog, ErasureSubject
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import CATALOG
from tests.support.commands import RunCommand, run
from tests.support.erasure import CARS, drive, fill, mentions
from tests.support.logs import ask, land, path_of
from tests.support.measured import SIGNALS, a_mapping, csv_text, good_columns, ingest_file

BETA = ErasureSubject("vehicle", "beta")


def just_before_its_commit(
    monkeypatch: pytest.MonkeyPatch, work: Callable[[], Any], table: str = "logs"
) -> None:
    """Let work be done just before the next commit to a table."""
    commit = Snapshot.commit

    def later(self: Snapshot, change: Change) -> None:
        if self.table.folder.name == table:
            monkeypatch.setattr(Snapshot, "commit", commit)
            work()
        commit(self, change)

    monkeypatch.setattr(Snapshot, "commit", later)


def cars_in(warehouse: Warehouse, view: str) -> set[str]:
    return {car for (car,) in ask(warehouse.root, f"SELECT DISTINCT vehicle_id FROM {view}")}


def measured(folder: Path, *cars: str) -> Path:
    columns = {name: values * len(cars) for name, values in good_columns(50).items()}
    columns["car"] = [car for car in cars for _ in range(50)]
    columns["ax"][49::50] = ["broken"] * len(cars)
    file = folder / "log.csv"
    file.write_text(csv_text(columns))
    return file


def test_a_compaction_that_loses_to_an_erasure_leaves_no_file_of_the_car(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    warehouse = fill(tmp_path, *CARS)
    just_before_its_commit(monkeypatch, lambda: forget(warehouse, BETA, now=True))
    compact(warehouse)
    assert not mentions(tmp_path, "beta")
    assert cars_in(warehouse, "log") == cars_in(warehouse, "grams") == {"alfa", "gamma"}


def test_an_erasure_that_loses_to_a_compaction_forgets_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The Delta library does not take what a compaction removes for removed."""
    warehouse = fill(tmp_path, *CARS)
    just_before_its_commit(monkeypatch, lambda: compact(warehouse))
    assert forget(warehouse, BETA, now=True).drives == 3
    assert cars_in(warehouse, "log") == cars_in(warehouse, "grams") == {"alfa", "gamma"}
    assert warehouse.logs.snapshot().rows == 6 * 200
    assert not mentions(tmp_path, "beta")


def test_a_drive_that_lands_before_the_fence_is_forgotten_and_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    warehouse, fence = fill(tmp_path, *CARS), Table.fence

    def later(table: Table) -> None:
        if table == warehouse.quarantine:
            land(warehouse, "late", drive("beta", 9))
        fence(table)

    monkeypatch.setattr(Table, "fence", later)
    assert forget(warehouse, BETA, now=True).drives == 4
    assert not mentions(tmp_path, "beta")


def test_two_compactions_that_pack_differently_double_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    warehouse = fill(tmp_path, *CARS)

    def land_and_compact() -> None:
        land(warehouse, "z", drive("alfa", 9))
        compact(warehouse)

    just_before_its_commit(monkeypatch, land_and_compact)
    compact(warehouse)
    assert warehouse.logs.snapshot().rows == 10 * 200
    assert not verify(warehouse, full=True).damage


def test_readers_see_every_drive_once_while_files_are_exchanged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    warehouse = fill(tmp_path, *CARS)
    seen: list[int] = []

    def look(*_: Any) -> list[Any]:
        seen.append(len(load_cohort(warehouse).drives))
        return []

    just_before_its_commit(monkeypatch, look)
    monkeypatch.setattr(rewriting, "reconcile", look)
    compact(warehouse)
    assert seen == [9, 9]  # before the exchange; and after it, old Gram rows not dropped yet
    update_grams(warehouse)
    assert len(load_cohort(warehouse).drives) == 9


def test_an_ingest_under_way_does_not_bring_a_forgotten_car_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    warehouse = fill(tmp_path / "data", "beta")
    mapping = a_mapping(drive={"vehicle_id": {"column": "car"}})
    file = measured(tmp_path, "alfa", "beta")
    just_before_its_commit(monkeypatch, lambda: forget(warehouse, BETA, now=True))
    report = ingest_file(warehouse, file, mapping)
    assert (report.new, report.counts.drives, report.drives_forgotten) == (True, 1, 1)
    assert cars_in(warehouse, "log") == cars_in(warehouse, "quarantine") == {"alfa"}
    assert not mentions(tmp_path / "data", "beta")


def test_nor_does_a_later_ingest_until_the_car_is_allowed_again(tmp_path: Path) -> None:
    warehouse = fill(tmp_path / "data", "alfa", "beta")
    forget(warehouse, BETA, now=True)
    mapping = a_mapping(drive={"vehicle_id": {"column": "car"}})
    file = measured(tmp_path, "beta")
    assert not ingest_file(warehouse, file, mapping).new
    assert cars_in(warehouse, "log") == {"alfa"}
    ErasureLog(warehouse.root).allow(BETA)
    assert ingest_file(warehouse, file, mapping).new
    assert cars_in(warehouse, "log") == {"alfa", "beta"}
    assert forget(warehouse, BETA, now=True).drives == 1
    assert ErasureLog(warehouse.root).state(BETA) == "done"


def test_a_simulation_under_way_does_not_bring_a_forgotten_drive_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    warehouse = Warehouse(LocalFolder(tmp_path))
    campaign = load_campaign("smoke", SHIPPED_CONFIGS)
    batches = campaign.batches(campaign.days()[0])
    erased = batches[0].drives[0]
    erasure_log = ErasureLog(warehouse.root)

    def forget_meanwhile() -> None:
        erasure_log.begin(ErasureSubject("drive", erased.drive_id), 1, [])
        warehouse.logs.fence()

    just_before_its_commit(monkeypatch, forget_meanwhile)
    with ThreadPoolExecutor(1) as executor:
        report = simulate_batches(warehouse, batches, executor)
        again = simulate_batches(warehouse, batches, executor)
    drives = {spec.drive_id for batch in batches for spec in batch.drives}
    assert (report.drives, report.drives_forgotten) == (len(drives) - 1, 1)
    assert not again.changed
    rows = ask(warehouse.root, "SELECT DISTINCT drive_id FROM log")
    assert {row[0] for row in rows} == drives - {erased.drive_id}
    assert len(list(tmp_path.glob("logs/day=*/*.parquet"))) == len(warehouse.logs.snapshot().files)


def test_gram_rows_of_a_forgotten_car_do_not_count_if_their_job_died_after_its_commit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    warehouse = fill(tmp_path, "alfa", "beta")
    stale = [warehouse.grams.read(file.path) for file in warehouse.grams.snapshot().files]
    forget(warehouse, BETA, now=True)
    action = warehouse.grams.write_file("landed-late", stale[0])
    warehouse.grams.snapshot().commit(Change(add=[action]))
    assert cars_in(warehouse, "grams") == {"alfa"}
    assert set(load_cohort(warehouse).drives["vehicle_id"].to_pylist()) == {"alfa"}


def test_no_gram_row_of_a_forgotten_car_lands_after_the_erasure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    warehouse = fill(tmp_path, "alfa")
    land(warehouse, "new", drive("beta", 1))
    just_before_its_commit(monkeypatch, lambda: forget(warehouse, BETA, now=True), "grams")
    monkeypatch.setattr(update, "require_active", lambda *_: None)  # killed before its last look
    update_grams(warehouse)
    assert not mentions(tmp_path, "beta")


def test_vacuum_does_not_remove_what_took_the_place_of_a_leftover(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    warehouse = Warehouse(LocalFolder(tmp_path / "data"))
    land(warehouse, "a", drive("alfa", 1))
    mapping = a_mapping(drive={"vehicle_id": {"column": "car"}})
    file = measured(tmp_path, "beta")

    def die(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Snapshot, "commit", die)
        ingest_file(warehouse, file, mapping)
    for path in (tmp_path / "data").rglob("*.parquet"):
        os.utime(path, (0, 0))
    listed = find_expired(warehouse, 1)
    assert ingest_file(warehouse, file, mapping).new
    for candidate in listed:
        candidate.folder.remove(candidate)
    assert listed
    assert not verify(warehouse).damage


def test_versions_published_from_gram_rows_before_an_erasure_are_marked(
    tmp_path: Path,
) -> None:
    """Whoever selected before the erasure and publishes after it."""
    warehouse = fill(tmp_path, *CARS)
    registry, answers = Registry(warehouse.root, CATALOG), {}
    cohorts = {"of_all": "true", "of_others": "vehicle_id <> 'beta'"}
    for name, cohort in cohorts.items():
        request = SelectionRequest(order="ay,yaw_rate")
        answers[name] = run_selection(warehouse, request, cohort)
    manifests = {name: manifest_of(answer, name) for name, answer in answers.items()}
    forget(warehouse, BETA, now=True)
    for name, answer in answers.items():
        publish_challenger(registry, manifests[name], answer, force=True)
    assert marked_models(warehouse) == {"of_all@1", "of_others@1"}
    answer = run_selection(warehouse, SelectionRequest(order="ay,yaw_rate"))
    publish_challenger(registry, manifest_of(answer, "later"), answer, force=True)
    assert marked_models(warehouse) == {"of_all@1", "of_others@1"}


def test_while_an_erasure_is_under_way_what_is_published_counts_as_trained_on_it(
    tmp_path: Path,
) -> None:
    warehouse = fill(tmp_path, *CARS)
    ErasureLog(warehouse.root).begin(BETA, 3, [], {"beta": 0})
    answer = run_selection(warehouse, SelectionRequest(order="ay,yaw_rate"))
    publish_challenger(
        Registry(warehouse.root, CATALOG), manifest_of(answer, "beta"), answer, force=True
    )
    assert marked_models(warehouse) == {"beta@1"}
    ErasureLog(warehouse.root).end(BETA, grams_version=0)
    assert not marked_models(warehouse)


def test_the_command_says_what_may_be_left_and_finishes_when_it_is_repeated(
    run_command: RunCommand, tmp_path: Path
) -> None:
    root = tmp_path / "data"
    warehouse = fill(root, "alfa", "beta")
    half = path_of(warehouse.logs.folder) / "day=2024-05-01" / ".tmp-half"
    half.write_bytes(b"beta, half a file")
    with recording(warehouse.root, "ingest", ["ingest"]):
        result = run_command("forget", "--vehicle", "beta", "--now")
        assert result.exit_code == 12
        assert "2 jobs or files may still hold its rows" in result.stderr
    assert cars_in(warehouse, "log") == {"alfa"}
    os.utime(half, (0, 0))
    done = run_command("forget", "--vehicle", "beta", "--now", "--json")
    assert (done.exit_code, done.json["pending"]) == (0, [])
    assert not half.exists()
    assert run_command("forget", "--vehicle", "beta", "--allow").exit_code == 0
    assert run_command("forget", "--vehicle", "gamma", "--allow").exit_code == 5
    assert run_command("forget", "--vehicle", "beta", "--allow", "--now").exit_code == 2


LAPS = {"column": "car", "vehicle_id": "car-of-mine"}


def forget_all(fleet: Fleet) -> int:
    drives = fleet.sql("SELECT drive_id FROM drives").fetchall()
    return sum(fleet.maintenance.forget(drive=drive, now=True).drives for (drive,) in drives)


def corrected() -> Mapping:
    turned = {"column": "beta", "unit": "deg", "negate": True}
    return a_mapping(drive=LAPS, signals={**SIGNALS, "sideslip": turned})


@pytest.fixture
def laps(tmp_path: Path) -> Fleet:
    """A file of two drives, `lap` and `slalom`."""
    fleet = fleet_slip.open(tmp_path / "data")
    fleet.ingest(measured(tmp_path, "lap", "slalom"), a_mapping(drive=LAPS))
    return fleet


def test_a_drive_erased_during_its_replacement_is_not_doubled(
    laps: Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    just_before_its_commit(monkeypatch, lambda: forget_all(laps))
    laps.ingest(tmp_path / "log.csv", corrected(), replace="all")
    rows = laps.sql("SELECT drive_name, count(DISTINCT drive_id) FROM log GROUP BY ALL").fetchall()
    assert all(many == 1 for _, many in rows)
    assert not laps.maintenance.verify(full=True).damage


@pytest.mark.long
@pytest.mark.parametrize(
    ("first", "second"),
    [(("compact", "ingest"), "forget"), (("ingest", "gram", "publish", "promote"), "migrate")],
)
def test_commands_that_meet_at_any_point_lose_and_double_nothing(
    first: tuple[str, ...], second: str
) -> None:
    """A part of what `python -m benchmarks.interleave` does; a new process, because it forks."""
    command = [sys.executable, "-m", "benchmarks.interleave", "--schedules", "10"]
    command += ["--first", *first, "--second", second]
    done = run(command, patience_s=1500, cwd=Path(__file__).parents[2])
    assert done.exit_code == 0, done.stdout + done.stderr
    assert "0 findings of 0 kinds" in done.stdout
