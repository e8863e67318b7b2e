"""Commands that are killed in mid-work, a full disk, a read-only one, and files that go bad."""

import json
import os
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

import fleet_slip
from fleet_slip.storage.folder import TEMPORARY_PREFIX
from tests.support.commands import RunCommand, run
from tests.support.state import state

pytestmark = pytest.mark.long

JOB = ["run", "--campaign", "smoke", "--threads", "1"]
KILLS = 40
"""Ten of each command."""


@pytest.mark.timeout(7200)
def test_commands_that_are_killed_and_repeated_end_in_the_same_bits() -> None:
    """What `python -m benchmarks.crash` does; a new process, because it forks."""
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
    """What a data root holds, whatever its files are called.

    A file that was written when the disk was full, and not committed, is left alone: the next has
    a longer name.
    """
    known = state(root)
    logs = [digest for path, digest in known.pop("files").items() if path.parts[0] == "logs"]
    with fleet_slip.connect(root) as database:
        grams = database.execute("SELECT * EXCLUDE (file) FROM grams ORDER BY ALL").fetchall()
    return {**known, "logs": sorted(logs), "grams": grams}


def test_a_read_only_root_is_told_and_can_be_queried(
    run_command: RunCommand, small_disk: Any, smoke_root: Path
) -> None:
    root = small_disk("size=20m")
    shutil.copytree(smoke_root, root)
    assert not run(["mount", "-o", "remount,ro", str(root.parent)]).exit_code
    for command in (["simulate", "waterford", "--days", "1"], ["publish", "other"]):
        refused = run_command(*command, root=root)
        assert refused.exit_code == 6
        assert "read-only. Choose a writable data root" in refused.stderr
    assert run_command("select", "--json", root=root).exit_code == 0
    assert run_command(*JOB, "--json", root=root).json["changed"] is False


def test_a_damaged_log_file_is_named(run_command: RunCommand, simulated: Path) -> None:
    file = next((simulated / "logs").rglob("smoke-0000*.parquet"))
    whole = file.read_bytes()
    for damaged in (whole[:1000], b"", b"x" * len(whole)):
        file.write_bytes(damaged)
        told = run_command("gram")
        assert told.exit_code == 6
        assert file.name in told.stderr
    file.unlink()
    for command in (["gram"], ["sql", "SELECT max(ax_mps2) FROM log"]):
        told = run_command(*command)
        assert told.exit_code == 6
        assert file.name in told.stderr
    file.write_bytes(whole)
    assert json.loads(run_command("gram", "--json").stdout)["files_read"] == 4


@pytest.fixture
def failing_disk(tmp_path: Path) -> dict[str, str]:
    """The environment in which reads of files with `FAILING_PATH` in their path fail with EIO."""
    library = tmp_path / "eio.so"
    source = Path(__file__).with_name("eio.c")
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("this machine has no C compiler to make a disk fail with")
    made = run([compiler, "-shared", "-fPIC", "-o", library, source, "-ldl"])
    assert made.exit_code == 0, made.stderr
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
