"""Writers, a job that rearranges, and readers at once; and commands at once on one root."""

from pathlib import Path
from typing import Any

import pytest

from fleet_slip.storage.local import LocalFolder
from tests.support.commands import PATIENCE_S, RunCommand, finish, start_on
from tests.support.measured import csv_text, good_columns
from tests.support.state import state
from tests.support.writers import concurrency

pytestmark = pytest.mark.long

MAPPING = """
name = "test"
time = { column = "t", unit = "s" }
drive = { day = 2024-05-31, vehicle_id = "car", vehicle_model = "sedan" }
signals.ax = { column = "ax", unit = "m/s^2" }
signals.sideslip = { column = "beta", unit = "deg" }
"""


def test_writers_lose_nothing_and_readers_see_whole_commits_in_order() -> None:
    said = concurrency(writers=3, commits=5, patience_s=PATIENCE_S)
    assert "nothing lost or doubled" in said


def at_once(root: Path, *commands: list[str]) -> list[tuple[int, str]]:
    """Run commands in processes of their own at the same time; return exit codes and stderr."""
    running = [start_on(root, *command) for command in commands]
    return [(done.exit_code, done.stderr) for done in finish(*running)]


def contents(run_command: RunCommand, root: Path) -> list[Any]:
    """Every row of logs, Gram rows and quarantine, whatever files they lie in."""
    queries = (
        "SELECT count(*) AS n, sum(hash(l)) AS h FROM log_counts AS l",
        "SELECT * EXCLUDE (file) FROM grams ORDER BY ALL",
        "SELECT * FROM quarantine ORDER BY ALL",
    )
    return [run_command("sql", query, "--json", root=root).json for query in queries]


def test_commands_at_once_leave_what_they_leave_one_after_the_other(
    run_command: RunCommand, tmp_path: Path
) -> None:
    mapping = tmp_path / "mapping.toml"
    mapping.write_text(MAPPING)
    files = []
    for number in range(2):
        columns = good_columns(60)
        columns["ax"][number] = "soft"
        files.append(tmp_path / f"{number}.csv")
        files[-1].write_text(csv_text(columns))
    jobs = [["ingest", str(file), "--mapping", str(mapping)] for file in files]
    jobs.append(["simulate", "smoke", "--threads", "1"])
    serial, parallel = tmp_path / "serial", tmp_path / "parallel"
    for job in [*jobs, ["gram"]]:
        assert run_command(*job, root=serial).exit_code == 0
    assert [code for code, _ in at_once(parallel, *jobs, *jobs, ["gram"], ["gram"])] == [0] * 8
    run_command("gram", root=parallel)
    assert contents(run_command, parallel) == contents(run_command, serial)
    publishing = ["publish", "m", "--nested", "ay,steering_wheel", "--cohort", "campaign = 'smoke'"]
    for code, text in at_once(parallel, publishing, publishing, publishing):
        assert code == 0, text
    versions = run_command("models", "m", "--json", root=parallel).json
    assert len({row["sha256"] for row in versions}) == 1
    assert "champion" in versions[-1]["aliases"]
    assert run_command("verify", "--full", root=parallel).exit_code == 0


def test_the_second_run_of_a_campaign_waits_and_has_nothing_to_do(
    tmp_path: Path, smoke_root: Path
) -> None:
    job = ["run", "--campaign", "smoke", "--threads", "1"]
    root = tmp_path / "data"
    with LocalFolder(root).exclusive(".run-smoke.lock", lambda: None):
        running = [start_on(root, *job) for _ in range(2)]
        for process in running:
            assert process.stderr
            assert process.stderr.readline() == "smoke: waiting for another run\n"
    done = finish(*running)
    assert [one.exit_code for one in done] == [0, 0]
    assert sum("nothing to do, smoke@1 is up to date" in one.stderr for one in done) == 1
    both, one = state(tmp_path / "data"), state(smoke_root)
    assert (both["versions"], both["moves"]) == (one["versions"], one["moves"])
    assert both["files"].keys() == one["files"].keys()
