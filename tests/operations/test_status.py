"""The health of a warehouse, as a monitor asks for it."""

import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from fleet_slip.errors import (
    ExtraError,
    FleetSlipError,
    QuestionError,
    RefusedError,
    StorageError,
    UsageError,
)
from fleet_slip.grams.update import update_grams
from fleet_slip.operations.status import status_of
from fleet_slip.storage.local import LocalFolder
from fleet_slip.storage.runs import recording
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.commands import RunCommand, run
from tests.support.logs import DAY, land, log_rows, path_of, random_counts


def test_freshness_backlog_and_age(warehouse: Warehouse) -> None:
    land(warehouse, "a", log_rows("a", random_counts(np.random.default_rng(1), 50)))
    update_grams(warehouse)
    land(warehouse, "b", log_rows("b", random_counts(np.random.default_rng(2), 70)))
    status = status_of(warehouse, max_age_hours=1)
    assert (status.newest_day, status.tables["logs"].rows, status.tables["grams"].rows) == (
        DAY,
        120,
        1,
    )
    assert (status.backlog_files, status.backlog_rows) == (1, 70)
    assert status.problems == ()
    later = status_of(warehouse, 1, now=datetime.now(UTC) + timedelta(hours=3))
    assert [text.partition(" for ")[0] for text in later.problems] == [
        "no data has been committed",
        "a log file has had no Gram rows",
    ]
    assert later.data_age_hours == pytest.approx(3, abs=0.1)
    assert status_of(warehouse, None, now=datetime.now(UTC) + timedelta(hours=3)).problems == ()


def test_the_last_run_of_each_command_counts(warehouse: Warehouse) -> None:
    path_of(warehouse.root).mkdir()
    with pytest.raises(StorageError), recording(warehouse.root, "gram", []):
        raise StorageError("the disk is full")
    assert "gram" in status_of(warehouse).problems[0]
    assert "exit code 6: the disk is full" in status_of(warehouse).problems[0]
    with recording(warehouse.root, "gram", []):
        (running,) = (r for r in status_of(warehouse).last_runs if r["state"] == "running")
        assert running["command"] == "gram"
        assert status_of(warehouse).problems == ()
    assert status_of(warehouse).problems == ()


def fail(warehouse: Warehouse, error: FleetSlipError, *arguments: str) -> None:
    with pytest.raises(type(error)), recording(warehouse.root, "publish", arguments):
        raise error


@pytest.mark.parametrize("mistake", [UsageError, ExtraError])
def test_wrong_usage_and_refusals_are_no_failures_of_the_night(
    warehouse: Warehouse, mistake: type[FleetSlipError]
) -> None:
    path_of(warehouse.root).mkdir()
    fail(warehouse, mistake("no drive satisfies it"), "beta", "--cohort", "typo")
    assert status_of(warehouse).problems == ()
    with recording(warehouse.root, "publish", ["beta"]):
        pass
    fail(warehouse, mistake("no drive satisfies it"), "beta", "--cohort", "typo")
    (last,) = status_of(warehouse).last_runs
    assert last["state"] == "done"


@pytest.mark.parametrize(
    ("failures", "ending"),
    [
        (
            [(RefusedError("the champion is better"), "beta")],
            "failed with exit code 7: the champion is better",
        ),
        (
            [(StorageError("car.csv: cannot be read"), "car.csv")],
            "***.csv: cannot be read (***: a name that is not recorded)",
        ),
        (
            [
                (StorageError("the disk is full"), "beta"),
                (QuestionError("no such column"), "beta", "--cohort", "typo"),
            ],
            "the disk is full",
        ),
    ],
    ids=["refused after a success", "a hidden name", "a typo after a failure"],
)
def test_a_failure_is_one_problem(
    warehouse: Warehouse, failures: list[tuple[FleetSlipError, str]], ending: str
) -> None:
    path_of(warehouse.root).mkdir()
    with recording(warehouse.root, "publish", ["beta"]):
        pass
    for failure in failures:
        fail(warehouse, *failure)
    (problem,) = status_of(warehouse).problems
    assert problem.endswith(ending)


def test_a_killed_run_is_known(warehouse: Warehouse) -> None:
    path_of(warehouse.root).mkdir()
    code = (
        "import os, signal, sys\nfrom pathlib import Path\n"
        "from fleet_slip.storage.local import LocalFolder\n"
        "from fleet_slip.storage.runs import recording\n"
        "with recording(LocalFolder(Path(sys.argv[1])), 'run', []):\n"
        "    os.kill(os.getpid(), signal.SIGKILL)"
    )
    assert run([sys.executable, "-c", code, str(warehouse.root)]).exit_code == -9
    (problem,) = status_of(warehouse).problems
    assert problem.startswith("run of ")
    assert problem.endswith(" was killed")


def test_a_changed_line_of_the_history_is_a_problem_and_all_else_is_told(
    warehouse: Warehouse,
) -> None:
    land(warehouse, "a", log_rows("a", random_counts(np.random.default_rng(1), 50)))
    with recording(warehouse.root, "gram", []):
        pass
    (history,) = (path_of(warehouse.root) / "runs").iterdir()
    history.write_text(history.read_text().replace('"done"', '"gone"'))
    status = status_of(warehouse)
    assert status.problems == (f"runs/{history.name}: line 4 was changed or torn",)
    assert (status.last_runs, status.tables["logs"].rows) == ((), 50)


def test_the_command_tells_a_monitor(run_command: RunCommand, tmp_path: Path) -> None:
    run_command("run", "--campaign", "smoke", "--days", "1", "--models", "table1")
    fine = run_command("status", "--max-age-hours", "1", "--json")
    assert fine.exit_code == 0
    (champion,) = fine.json["champions"]
    assert (champion["model"], champion["version"], champion["logs_behind"]) == ("smoke", 1, 0)
    assert champion["age_hours"] < 1
    run_command("simulate", "smoke")
    assert run_command("status", "--json").json["champions"][0]["logs_behind"] > 0
    manifest = tmp_path / "data" / "models" / "smoke" / "versions" / "1.json"
    manifest.write_text(manifest.read_text().replace('"name": "smoke"', '"name": "smoky"'))
    bad = run_command("status")
    assert bad.exit_code == 10
    assert "does not match its SHA-256" in bad.stderr
    assert "last runs" in bad.stdout


def test_an_unfit_folder_is_reported(warehouse: Warehouse, monkeypatch: pytest.MonkeyPatch) -> None:
    land(warehouse, "a", log_rows("a", random_counts(np.random.default_rng(1), 50)))
    root = path_of(warehouse.root)
    before = sorted(root.rglob("*"))
    monkeypatch.setattr(LocalFolder, "free_bytes", lambda self: None)
    assert status_of(warehouse).problems == ()
    assert sorted(root.rglob("*")) == before
    monkeypatch.setattr(LocalFolder, "create", lambda *arguments: True)
    (store,) = status_of(warehouse).problems
    assert "creates files twice" in store
