"""Forgetting: nothing of the drives is left, and the models are those of a world without them."""

import json
import os
import shutil
import time
from datetime import date, timedelta
from fractions import Fraction
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from fleet_slip.errors import AlarmError, QuestionError, RefusedError, StorageError
from fleet_slip.grams import update
from fleet_slip.grams.cohort import load_cohort
from fleet_slip.grams.compute import compute_grams
from fleet_slip.grams.update import update_grams
from fleet_slip.operations.forget import (
    Retention,
    forget,
    retain,
)
from fleet_slip.operations.rewriting import compact, vacuum
from fleet_slip.operations.verify import verify
from fleet_slip.regression.least_squares import fit
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.erasure_log import ErasureLog, ErasureSubject
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import SIGNALS
from tests.support.commands import RunCommand
from tests.support.erasure import CARS, drive, fill, mentions
from tests.support.logs import ask, land
from tests.support.measured import a_mapping, csv_text, good_columns, ingest_file


def coefficients(warehouse: Warehouse) -> dict[str, Fraction]:
    cohort = load_cohort(warehouse)
    (table,) = cohort.tables
    model = fit(table.total(), SIGNALS.inputs, SIGNALS.label).model
    return {
        "intercept": model.intercept,
        **dict(zip(model.signals, model.coefficients, strict=True)),
    }


def test_afterwards_every_coefficient_is_that_of_a_world_where_the_car_never_drove(
    tmp_path: Path,
) -> None:
    warehouse = fill(tmp_path / "with", *CARS)
    without = fill(tmp_path / "without", "alfa", "gamma")
    with_all = coefficients(warehouse)
    report = forget(warehouse, ErasureSubject("vehicle", "beta"))
    assert (report.drives, report.rows, report.files_rewritten) == (3, 600, 3)
    assert coefficients(warehouse) == coefficients(without)
    assert with_all != coefficients(without)
    for query in ("SELECT * EXCLUDE file FROM grams ORDER BY ALL", "FROM log_counts ORDER BY ALL"):
        assert ask(warehouse.root, query) == ask(without.root, query)


def test_with_now_no_byte_below_the_root_names_the_car_not_even_in_older_versions(
    tmp_path: Path,
) -> None:
    warehouse = fill(tmp_path, *CARS)
    compact(warehouse)  # older versions now have the car in other files
    report = forget(warehouse, ErasureSubject("vehicle", "beta"))
    assert report.old_files_left > 0
    assert mentions(tmp_path, "beta")
    again = forget(warehouse, ErasureSubject("vehicle", "beta"), now=True)
    assert (again.drives, again.old_files_left) == (0, 0)
    assert again.old_files_deleted == report.old_files_left
    assert not mentions(tmp_path, "beta")
    assert mentions(tmp_path, "gamma")


def test_leftovers_of_a_killed_job_are_erased_and_files_of_other_cars_stay(
    tmp_path: Path,
) -> None:
    warehouse = fill(tmp_path, "alfa", "beta")
    refused = [{"drive_id": "beta-7"}, {"vehicle_id": "beta"}]  # of the first, the log alone tells
    leftovers = [warehouse.logs.write_file("left", drive("beta", 7), date(2024, 5, 1))]
    for number, row in enumerate(reversed(refused)):
        table = pa.Table.from_pylist([row], schema=warehouse.quarantine.schema)
        leftovers.append(warehouse.quarantine.write_file(f"left{number}", table))
    warehouse.quarantine.fence()
    other = warehouse.logs.write_file("other", drive("alfa", 7), date(2024, 5, 1))
    assert not forget(warehouse, ErasureSubject("vehicle", "beta"), now=True).pending
    assert not mentions(tmp_path, "beta"), leftovers
    os.utime(tmp_path / "logs" / other.path, (0, 0))  # where clocks differ, a job may be writing it
    assert not forget(warehouse, ErasureSubject("vehicle", "beta"), now=True).pending
    assert (tmp_path / "logs" / other.path).exists()
    assert vacuum(warehouse).files
    assert not (tmp_path / "logs" / other.path).exists()


@pytest.mark.parametrize("old", [True, False])
@pytest.mark.parametrize("table", ["logs", "grams"])
def test_a_lost_delta_log_prevents_deletion(tmp_path: Path, table: str, old: bool) -> None:
    warehouse = fill(tmp_path, "alfa", "beta")
    shutil.rmtree(tmp_path / table / "_delta_log")
    files = sorted(tmp_path.rglob("*.parquet"))
    for file in files if old else ():
        os.utime(file, (0, 0))
    with pytest.raises(StorageError, match="files without a Delta log"):
        forget(warehouse, ErasureSubject("vehicle", "beta"), now=True)
    assert sorted(tmp_path.rglob("*.parquet")) == files


def test_the_record_names_nobody_and_can_be_asked(tmp_path: Path) -> None:
    warehouse = fill(tmp_path, *CARS)
    erasure_log = ErasureLog(LocalFolder(tmp_path))
    forget(warehouse, ErasureSubject("drive", "beta-1"))
    assert [entry["event"] for entry in erasure_log.entries()] == ["begun", "done"]
    assert "beta" not in json.dumps(erasure_log.entries())
    assert erasure_log.state(ErasureSubject("drive", "beta-1")) == "done"
    assert erasure_log.state(ErasureSubject("vehicle", "beta-1")) is None
    assert not forget(warehouse, ErasureSubject("drive", "beta-1"), now=True).drives
    with pytest.raises(QuestionError, match="no drive has vehicle_id 'delta'"):
        forget(warehouse, ErasureSubject("vehicle", "delta"))


def test_the_record_names_the_first_of_two_erasures_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    erasure_log = ErasureLog(LocalFolder(tmp_path))
    first, other = (ErasureSubject("vehicle", name) for name in ("alfa", "beta"))
    erasure_log.begin(first, 1, [])
    with monkeypatch.context() as patch:
        patch.setattr(ErasureLog, "entries", lambda _: [])  # as they were a moment ago
        erasure_log.begin(other, 2, ["m@1"])
    assert [erasure_log.state(subject) for subject in (first, other)] == ["begun"] * 2
    erasure_log.end(other)
    assert [erasure_log.state(subject) for subject in (first, other)] == ["begun", "done"]
    assert erasure_log.models_of(other) == ["m@1"]


def test_a_gram_job_under_way_does_not_bring_a_forgotten_drive_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its file is removed when no Gram row of it has landed, so that there is none to drop."""
    warehouse = fill(tmp_path, "alfa")
    land(warehouse, "new", drive("beta", 1))

    def overtaken(*arguments: Any) -> list[pa.Table]:
        rows = list(compute_grams(*arguments))
        monkeypatch.undo()
        forget(warehouse, ErasureSubject("vehicle", "beta"))
        return rows

    monkeypatch.setattr(update, "compute_grams", overtaken)
    update_grams(warehouse)
    assert ask(warehouse.root, "SELECT DISTINCT vehicle_id FROM grams") == [("alfa",)]


@pytest.mark.parametrize("subject", ["vehicle", "drive"])
def test_a_car_all_of_whose_rows_were_refused_goes_too(tmp_path: Path, subject: Any) -> None:
    columns = {name: values * 2 for name, values in good_columns(50).items()}
    columns["car"] = ["sound"] * 50 + ["secretive"] * 50
    columns["ax"][50:] = ["777.125"] * 50
    file = tmp_path / "x.csv"
    file.write_text(csv_text(columns))
    warehouse = Warehouse(LocalFolder(tmp_path / "data"))
    mapping = a_mapping(drive={"vehicle_id": {"column": "car"}})
    assert ingest_file(warehouse, file, mapping).counts.drives == 1
    update_grams(warehouse)
    (path,) = warehouse.quarantine.snapshot().paths
    (name,) = pq.read_table(path)["drive_id"].unique().to_pylist()
    chosen = ErasureSubject(subject, name if subject == "drive" else "secretive")
    before = warehouse.logs.snapshot()
    report = forget(warehouse, chosen, now=True)
    assert (report.drives, report.rows) == (1, 0)
    assert warehouse.logs.snapshot().files == before.files
    assert not warehouse.quarantine.snapshot().files
    remaining = mentions(tmp_path / "data", "secretive") + mentions(tmp_path / "data", "777.125")
    assert not remaining
    assert not forget(warehouse, chosen).changed


def test_retention_forgets_by_age_and_refuses_to_leave_nothing(tmp_path: Path) -> None:
    warehouse = Warehouse(LocalFolder(tmp_path))
    for month in (1, 2, 3):
        day = date(2024, month, 1)
        land(warehouse, f"m{month}", drive("alfa", month, day), day=day)
    update_grams(warehouse)
    retention = Retention(drives_days=45, replaced_files_hours=24)
    ahead = Retention(drives_days=60, replaced_files_hours=24, max_days_without_drives=7)
    with pytest.raises(RefusedError, match="10 days before the date of the clock, 2024-03-11"):
        retain(warehouse, ahead, date(2024, 3, 11))
    with pytest.raises(RefusedError, match="Check the clock"):
        retain(warehouse, retention, date(2034, 3, 2))
    report = retain(warehouse, retention, date(2024, 3, 2))
    assert (report.before, report.forgotten.drives) == (date(2024, 1, 17), 1)
    assert not retain(warehouse, retention, date(2024, 3, 2)).forgotten.changed
    days = ask(warehouse.root, "SELECT DISTINCT day FROM grams ORDER BY ALL")
    assert days == [(date(2024, 2, 1),), (date(2024, 3, 1),)]


def test_retention_keeps_drives_of_implausible_days_and_reports_them(tmp_path: Path) -> None:
    warehouse = Warehouse(LocalFolder(tmp_path))
    today = date.today()
    rolled_over, future = today - timedelta(weeks=1024), today + timedelta(days=400)
    implausible = [date(1980, 1, 6), rolled_over, future]
    for number, day in enumerate([*implausible, date(2012, 3, 1), today]):
        land(warehouse, f"n{number}", drive("alfa", number, day), day=day)
    update_grams(warehouse)
    for erased in (1, 0):
        report = retain(warehouse, Retention(drives_days=3650, replaced_files_hours=24), today)
        assert report.forgotten.drives == erased
        assert [text.partition(",")[0] for text in report.implausible_days] == [
            str(day) for day in implausible
        ]
        assert isinstance(report.problem, AlarmError)
    days = ask(warehouse.root, "SELECT DISTINCT day FROM grams ORDER BY ALL")
    assert days == [(day,) for day in sorted([*implausible, today])]


def test_a_drive_of_a_future_day_does_not_prove_the_clock(tmp_path: Path) -> None:
    warehouse = Warehouse(LocalFolder(tmp_path))
    today = date.today()
    for number, days in enumerate((-400, -100, 400)):
        day = today + timedelta(days=days)
        land(warehouse, f"n{number}", drive("alfa", number, day), day=day)
    with pytest.raises(RefusedError, match="100 days before the date of the clock"):
        retain(warehouse, Retention(drives_days=365, replaced_files_hours=24), today)


def test_models_are_marked_and_run_trains_again_without_bringing_the_drive_back(
    run_command: RunCommand, smoke_copy: Path
) -> None:
    predicate = "day = '2024-05-02'"
    short = ("--models", "table1")
    run_command("publish", "other", "--cohort", predicate, *short, "--force")  # of few drives
    report = run_command("forget", "--drive", "smoke-2024-05-01-0001", "--now", "--json").json
    assert report["models"] == ["smoke@1"]
    marks = {
        f"{row['name']}@{row['version']}": row["trained_on_forgotten"]
        for row in run_command("models", "--json").json
    }
    assert marks == {"smoke@1": True, "other@1": False}
    assert not run_command("simulate", "smoke", "--json").json["batches_written"]
    again = run_command("run", "--campaign", "smoke", *short, "--json").json
    assert (again["publish"]["version"], again["publish"]["new"]) == (2, True)
    query = "SELECT count(*) AS n FROM drives WHERE drive_id = 'smoke-2024-05-01-0001'"
    assert run_command("sql", query, "--json").json == [{"n": 0}]
    assert run_command("verify", "--full").exit_code == 0
    assert run_command("forget").exit_code == 2


CLOCKS_S = [-60, -2 * 86_400, 600]
"""How far the clock of an erasure is ahead of the clock that dated the files."""


@pytest.mark.parametrize("shift_s", CLOCKS_S)
def test_erasure_does_not_depend_on_the_clock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shift_s: int
) -> None:
    warehouse = fill(tmp_path, *CARS)
    compact(warehouse)  # older versions have the car in other files
    warehouse.logs.write_file("left", drive("beta", 7), date(2024, 5, 1))
    set_clock(monkeypatch, shift_s)
    report = forget(warehouse, ErasureSubject("vehicle", "beta"), now=True)
    assert not report.pending
    assert not mentions(tmp_path, "beta")
    assert ask(warehouse.root, "SELECT DISTINCT vehicle_id FROM grams ORDER BY 1") == [
        ("alfa",),
        ("gamma",),
    ]
    assert not forget(warehouse, ErasureSubject("vehicle", "beta"), now=True).changed
    monkeypatch.undo()
    assert not verify(warehouse, full=True).damage


def set_clock(monkeypatch: pytest.MonkeyPatch, shift_s: int) -> None:
    """Put the clock of this process ahead; the Delta library keeps its own."""
    now, now_ns = time.time, time.time_ns
    monkeypatch.setattr(time, "time", lambda: now() + shift_s)
    monkeypatch.setattr(time, "time_ns", lambda: now_ns() + shift_s * 10**9)


@pytest.mark.parametrize("folder", ["logs/day=2024-05-01/.tmp-half", ".spill-0/duckdb_temp"])
@pytest.mark.parametrize("age_s", [-3600, 1800])
def test_temporary_files_of_killed_jobs_go_at_any_age_and_those_of_a_run_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str, age_s: int
) -> None:
    warehouse = fill(tmp_path, "alfa", "beta")
    half = tmp_path / folder
    half.parent.mkdir(exist_ok=True)
    half.write_bytes(b"beta, half a file")
    os.utime(half, (time.time() - age_s,) * 2)
    with monkeypatch.context() as patch:
        patch.setattr("fleet_slip.operations.forget.runs_under_way", lambda _: ["night"])
        report = forget(warehouse, ErasureSubject("vehicle", "beta"), now=True)
    assert report.pending == (folder, "the run night")
    assert not forget(warehouse, ErasureSubject("vehicle", "beta"), now=True).pending
    assert not mentions(tmp_path, "beta")


def test_an_unreadable_or_undeletable_file_is_no_success(
    tmp_path: Path, run_command: RunCommand, monkeypatch: pytest.MonkeyPatch
) -> None:
    warehouse = fill(tmp_path / "data", "alfa", "beta")
    action = warehouse.logs.write_file("left", drive("beta", 7), date(2024, 5, 1))
    leftover = tmp_path / "data" / "logs" / action.path
    leftover.write_bytes(b"beta, and damaged")
    words = ("forget", "--vehicle", "beta", "--now")
    done = run_command(*words)
    assert done.exit_code == 12
    assert f"logs/{action.path} (unreadable)" in done.stderr
    assert "fleet-slip verify" in done.stderr
    leftover.unlink()
    action = warehouse.logs.write_file("left", drive("beta", 8), date(2024, 5, 1))
    with monkeypatch.context() as patch:
        patch.setattr(LocalFolder, "remove", lambda *_: False)
        assert run_command(*words, "--json").json["pending"] == [f"logs/{action.path}"]
    assert run_command(*words).exit_code == 0


def test_an_erasure_that_left_rows_in_a_table_is_not_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    warehouse = fill(tmp_path, "alfa", "beta")
    beta = ErasureSubject("vehicle", "beta")
    with monkeypatch.context() as patch:
        patch.setattr("fleet_slip.operations.forget.reconcile", lambda _: [])
        assert forget(warehouse, beta, now=True).pending == ("grams",)
    assert ErasureLog(warehouse.root).state(beta) == "begun"
    assert not forget(warehouse, beta, now=True).pending
    assert ErasureLog(warehouse.root).state(beta) == "done"


def test_files_that_a_clock_ahead_has_replaced_go_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ahead_s = 2 * 86_400
    warehouse = fill(tmp_path, *CARS)
    with monkeypatch.context() as patch:
        set_clock(patch, ahead_s)  # then the commits, too, are dated otherwise
        compact(warehouse)
        forget(warehouse, ErasureSubject("vehicle", "beta"))
    for file in tmp_path.rglob("*.parquet"):
        moment = time.time() + ahead_s
        os.utime(file, (moment, moment))
    report = forget(warehouse, ErasureSubject("vehicle", "beta"), now=True)
    assert not report.pending
    assert report.old_files_deleted
    assert not mentions(tmp_path, "beta")
