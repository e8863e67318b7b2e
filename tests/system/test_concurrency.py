"""Writers, a job that rearranges, and readers at once; and commands at once on one root."""

import multiprocessing
import time
from collections import Counter
from functools import partial
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.grams.job import update_grams
from fleet_slip.operations.find_drives import vacuum
from fleet_slip.operations.rewriting import compact
from fleet_slip.operations.verify import verify
from fleet_slip.storage.local import LocalFolder
from fleet_slip.storage.table import Change, Unit, retry_conflicts
from fleet_slip.warehouse.tables import Warehouse
from tests.support.commands import PATIENCE_S, RunCommand, finish, start_on
from tests.support.logs import DAY, log_rows
from tests.support.measured import MAPPING_TEXT, csv_text, good_columns
from tests.support.state import state

pytestmark = pytest.mark.long

WRITERS, COMMITS, FILES, ROWS = 3, 5, 2, 20
"""Files of a commit, and rows of a file, which is a drive."""


def write(root: Path, writer: int) -> None:
    """Land commits; every second writer's clock is a day slow."""
    if writer % 2:
        real = time.time
        time.time = lambda: real() - 86_400
    logs = Warehouse(LocalFolder(root)).logs
    counts = {name: np.arange(ROWS) for name in catalogue().signals}
    for number in range(COMMITS):
        name = f"car{writer}-{number}"
        drives = [log_rows(f"{name}-{part}", counts) for part in range(FILES)]
        added = [logs.write_file(name, rows, DAY) for rows in drives]
        change = Change(add=added, units=[Unit(f"write/{name}", 1)])

        def land(change: Change = change) -> None:
            snapshot = logs.snapshot()
            if snapshot.landed(change.units[0].name) is None:
                snapshot.commit(change)

        retry_conflicts(land)


def rearrange(root: Path, stop: Event) -> None:
    """Compact, aggregate and vacuum all the while."""
    warehouse = Warehouse(LocalFolder(root))
    while not stop.is_set():
        update_grams(warehouse)
        compact(warehouse, target_rows=400)
        vacuum(warehouse, 1)


def read(root: Path, stop: Event) -> None:
    """Look at snapshots all the while: no version is older, and no commit is there in part."""
    newest = -1
    while not stop.is_set():
        logs = Warehouse(LocalFolder(root)).logs
        snapshot = logs.snapshot()
        if snapshot.version is None:
            continue
        assert snapshot.version >= newest
        newest = snapshot.version
        parts = [logs.read(file.path, ["drive_id"])["drive_id"] for file in snapshot.files]
        seen = Counter(drive for part in parts for drive in part.to_pylist())
        assert set(seen.values()) <= {ROWS}
        assert set(Counter(drive.rpartition("-")[0] for drive in seen).values()) <= {FILES}


def test_writers_lose_nothing_and_readers_see_whole_commits_in_order(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    process_of = partial(context.Process, daemon=True)  # ends with the test at the latest
    stop = context.Event()
    writing = [process_of(target=write, args=(tmp_path, writer)) for writer in range(WRITERS)]
    beside = [process_of(target=work, args=(tmp_path, stop)) for work in (rearrange, read, read)]
    for process in (*writing, *beside):
        process.start()
    for process in writing:
        process.join(PATIENCE_S)
    stop.set()
    for process in (*writing, *beside):
        process.join(PATIENCE_S)
        assert process.exitcode == 0
    warehouse = Warehouse(LocalFolder(tmp_path))
    compact(warehouse)
    update_grams(warehouse)
    assert warehouse.logs.snapshot().rows == WRITERS * COMMITS * FILES * ROWS
    assert warehouse.grams.snapshot().rows == WRITERS * COMMITS * FILES
    assert not verify(warehouse, full=True).damage


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
    mapping.write_text(MAPPING_TEXT)
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
