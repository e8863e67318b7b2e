"""Commands that are killed in mid-work, a full disk, a read-only one, and files that go bad."""

import json
import multiprocessing
import os
import shutil
import sys
import time
from collections import Counter
from functools import partial
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fleet_slip
from fleet_slip.grams.update import update_grams
from fleet_slip.operations.rewriting import compact, vacuum
from fleet_slip.operations.verify import verify
from fleet_slip.storage.folder import TEMPORARY_PREFIX
from fleet_slip.storage.local import LocalFolder
from fleet_slip.storage.table import AppTransaction, Change, retry_conflicts
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import SIGNALS
from tests.support.commands import PATIENCE_S, RunCommand, finish, run, start_on
from tests.support.logs import DAY, log_rows, state
from tests.support.measured import MAPPING_TEXT, csv_text, good_columns
from tests.support.model_lists import nested, write_list

pytestmark = pytest.mark.long

JOB = ["run", "--campaign", "smoke", "--threads", "1"]
KILLS = 40
"""Two or three of each command."""


@pytest.mark.timeout(7200)
def test_commands_that_are_killed_and_repeated_end_in_the_same_bits() -> None:
    """`python -m benchmarks.crash` in a new process, because it forks."""
    command = [sys.executable, "-m", "benchmarks.crash", "--kills", str(KILLS)]
    done = run(command, patience_s=7000, cwd=Path(__file__).parents[2])
    assert done.exit_code == 0, done.stderr
    assert f"{KILLS} kills survived" in done.stdout


@pytest.fixture
def simulated(smoke_root: Path, tmp_path: Path) -> Path:
    """A data root after `simulate smoke`, and no more."""
    root = tmp_path / "data"
    shutil.copytree(smoke_root, root, ignore=shutil.ignore_patterns("grams", "models", "runs"))
    return root


def test_leftovers_of_a_kill_are_not_part_of_any_table(
    run_command: RunCommand, simulated: Path
) -> None:
    rows = run_command("sql", "SELECT count(*) AS n FROM log", "--json").json
    day = simulated / "logs" / "day=2024-05-01"
    (day / f"{TEMPORARY_PREFIX}0.parquet").write_bytes(b"half a file")
    (day / "smoke-9999-uncommitted.parquet").write_bytes(b"written, not committed")
    assert run_command("sql", "SELECT count(*) AS n FROM log", "--json").json == rows
    assert run_command("gram", "--json").json["rows_read"] == rows[0]["n"]


@pytest.fixture
def small_disk(tmp_path: Path) -> Any:
    """Return a function that mounts a small disk; skip where that is not allowed."""
    folder = tmp_path / "disk"
    folder.mkdir()

    def mount(options: str) -> Path:
        command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)]
        if run(command).exit_code:
            pytest.skip("this machine does not allow to mount a file system")
        return folder / "data"

    yield mount
    run(["umount", str(folder)])


def test_a_full_disk_is_told_and_the_same_command_goes_on_after_it(
    run_command: RunCommand, small_disk: Any, smoke_root: Path
) -> None:
    root = small_disk("size=300k")
    full = run_command(*JOB, root=root)
    assert full.exit_code == 6
    assert "the disk is full. Free some space" in full.stderr
    assert not list(root.rglob(f"{TEMPORARY_PREFIX}*"))
    assert not run(["mount", "-o", "remount,size=20m", str(root.parent)]).exit_code
    assert run_command(*JOB, root=root).exit_code == 0
    assert meaning(root) == meaning(smoke_root)


def meaning(root: Path) -> dict[str, Any]:
    """Return the content of a data root, without the names of its files.

    A file that was written when the disk was full, and not committed, is left alone: the next has
    a longer name.
    """
    stored = state(root)
    logs = [digest for path, digest in stored.pop("files").items() if path.parts[0] == "logs"]
    with fleet_slip.connect(root) as database:
        grams = database.execute("SELECT * EXCLUDE (file) FROM grams ORDER BY ALL").fetchall()
    return {**stored, "logs": sorted(logs), "grams": grams}


def test_a_read_only_root_is_told_and_can_be_queried(
    run_command: RunCommand, small_disk: Any, smoke_root: Path
) -> None:
    root = small_disk("size=20m")
    shutil.copytree(smoke_root, root)
    assert not run(["mount", "-o", "remount,ro", str(root.parent)]).exit_code
    for command in (["simulate", "waterford", "--days", "1"], ["publish", "other"]):
        refused = run_command(*command, root=root)
        assert refused.exit_code == 6
        assert "read-only. Choose a writable folder" in refused.stderr
    assert run_command("select", "--json", root=root).exit_code == 0
    assert run_command(*JOB, "--json", root=root).json["changed"] is False


def test_a_damaged_log_file_is_named(run_command: RunCommand, simulated: Path) -> None:
    file = next((simulated / "logs").rglob("smoke-0000*.parquet"))
    content = file.read_bytes()
    for damaged in (content[:1000], b"", b"x" * len(content)):
        file.write_bytes(damaged)
        result = run_command("gram")
        assert result.exit_code == 6
        assert file.name in result.stderr
    file.unlink()
    for command in (["gram"], ["sql", "SELECT max(ax_mps2) FROM log"]):
        result = run_command(*command)
        assert result.exit_code == 6
        assert file.name in result.stderr
    file.write_bytes(content)
    assert json.loads(run_command("gram", "--json").stdout)["files_read"] == 4
    table = run_command("verify", "--grams").stdout.splitlines()
    assert "SQL against the kernel                    8    yes" in table


@pytest.fixture
def failing_disk(tmp_path: Path) -> dict[str, str]:
    """The environment in which reads of files with `FAILING_PATH` in their path fail with EIO."""
    library = tmp_path / "eio.so"
    source = Path(__file__).with_name("eio.c")
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("this machine has no C compiler to make a disk fail with")
    build = run([compiler, "-shared", "-fPIC", "-o", library, source, "-ldl"])
    assert build.exit_code == 0, build.stderr
    return {**os.environ, "LD_PRELOAD": str(library)}


def digest(root: Path) -> Any:
    """Number and hash of the rows of the logs."""
    with fleet_slip.connect(root) as database:
        query = "SELECT count(*), bit_xor(hash(l)) FROM log_counts l"
        return database.execute(query).fetchone()


@pytest.mark.parametrize("failing", ["smoke-0000", "signals-", "00000000000000000001.json"])
def test_a_read_error_is_told_and_loses_nothing(
    run_command: RunCommand,
    tmp_path: Path,
    smoke_root: Path,
    failing_disk: dict[str, str],
    failing: str,
) -> None:
    shutil.copytree(smoke_root, tmp_path / "data")
    before = digest(tmp_path / "data")
    environment = {**failing_disk, "FAILING_PATH": failing}
    compacted = run_command("compact", env=environment)
    assert compacted.exit_code == 6
    assert ("I/O error" if failing.startswith("s") else "Input/output error") in compacted.stderr
    verified = run_command("verify", "--json", env=environment)
    assert verified.exit_code == 9
    assert verified.json["damage"]
    assert run_command("compact").exit_code == 0
    assert digest(tmp_path / "data") == before
    assert run_command("verify", "--full").exit_code == 0


WRITERS, COMMITS, FILES, ROWS = 3, 5, 2, 20
"""Files of a commit, and rows of a file, which is a drive."""


def write(root: Path, writer: int) -> None:
    """Land commits; every second writer's clock is a day slow."""
    if writer % 2:
        real = time.time
        time.time = lambda: real() - 86_400
    logs = Warehouse(LocalFolder(root)).logs
    counts = {name: np.arange(ROWS) for name in SIGNALS.signals}
    for number in range(COMMITS):
        name = f"car{writer}-{number}"
        drives = [log_rows(f"{name}-{part}", counts) for part in range(FILES)]
        added = [logs.write_file(name, rows, DAY) for rows in drives]
        change = Change(add=added, transactions=[AppTransaction(f"write/{name}", 1)])

        def land(change: Change = change) -> None:
            snapshot = logs.snapshot()
            if snapshot.transaction_version(change.transactions[0].name) is None:
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
    list_path = write_list(tmp_path / "own.toml", *nested("ay,steering_wheel"))
    publishing = ["publish", "m", "--models", list_path, "--cohort", "campaign = 'smoke'"]
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
            assert process.stderr.readline() == "smoke: waiting for another fleet-slip run\n"
    done = finish(*running)
    assert [result.exit_code for result in done] == [0, 0]
    assert sum("nothing to do, smoke@1 is up to date" in result.stderr for result in done) == 1
    concurrent, single = state(tmp_path / "data"), state(smoke_root)
    assert (concurrent["versions"], concurrent["moves"]) == (single["versions"], single["moves"])
    assert concurrent["files"].keys() == single["files"].keys()
