"""The command line on an object store: the same bits as in a folder, and nothing told of keys."""

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from fleet_slip.storage.data_files import checksum_in
from fleet_slip.storage.folder import Folder
from fleet_slip.storage.local import LocalFolder, data_root
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.commands import finish, start_on
from tests.support.dask_processes import dask_processes
from tests.support.s3_server import SECRET_KEY, ServerApart, command_on

pytestmark = pytest.mark.long

DAMAGE, STORAGE = 9, 6


def stored(root: Folder) -> dict[str, bytes]:
    """Names of data files, which tell their bytes, and model versions as they are."""
    files = [file.path for file in root.files()]
    data = {path: b"" for path in files if path.endswith(".parquet")}
    return data | {path: root.read(path) for path in files if "/versions/" in path}


def contents_of_logs(files: dict[str, bytes]) -> set[str | None]:
    """Checksums of the log files: of two that were written at once one has a longer name."""
    return {checksum_in(path) for path in files if path.startswith("logs/day=")}


@pytest.fixture(scope="module")
def server() -> Iterator[ServerApart]:
    """A server of a process of its own, where it is known to all of this module."""
    started = ServerApart()
    with pytest.MonkeyPatch.context() as patch:
        for name, value in started.environment.items():
            patch.setenv(name, value)
        yield started
    started.stop()


@pytest.fixture(scope="module")
def local(smoke_root: Path) -> Folder:
    """The files that the commands write in a folder."""
    return LocalFolder(smoke_root)


@pytest.fixture(scope="module")
def filled(server: ServerApart) -> Folder:
    """The same on an object store."""
    root = data_root(f"{server.bucket()}/some/data")
    done = command_on(root, "run", "--campaign", "smoke")
    assert done.exit_code == 0, done.stderr
    return root


@pytest.fixture
def copied(server: ServerApart, filled: Folder) -> Folder:
    """A copy of that, to be changed."""
    root = data_root(f"{server.bucket()}/data")
    for file in filled.files():
        root.put(file.path, filled.read(file.path))
    return root


def test_a_run_gives_the_same_bits_and_a_second_does_nothing(filled: Folder, local: Folder) -> None:
    assert stored(filled) == stored(local)
    assert "nothing to do" in command_on(filled, "run", "--campaign", "smoke").stderr
    assert stored(filled) == stored(local)
    for history in (file.path for file in filled.files() if file.path.startswith("runs/")):
        assert SECRET_KEY.encode() not in filled.read(history)


def test_questions_are_answered_as_in_a_folder(filled: Folder, local: Folder) -> None:
    for question in (
        ["sql", "--json", "SELECT * FROM log ORDER BY drive_id, time_s LIMIT 3"],
        ["sql", "--json", "SELECT command, outcome FROM runs WHERE rows > 0"],
        ["select", "--json"],
        ["verify", "--full", "--json"],
    ):
        remote, in_folder = (command_on(root, *question) for root in (filled, local))
        assert (remote.exit_code, remote.stdout) == (in_folder.exit_code, in_folder.stdout), (
            remote.stderr
        )
    scores = [command_on(root, "score", "smoke", "--json").json for root in (filled, local)]
    assert scores[0] == pytest.approx(scores[1])  # sums of float64 differ in the last digits
    status = command_on(filled, "status", "--json").json
    assert [table["rows"] for table in status["tables"].values()] == [55957, 16, 0]


def test_a_damaged_file_is_detected(copied: Folder) -> None:
    root = copied
    victim = next(file for file in root.files() if file.path.startswith("logs/day="))
    content = root.read(victim.path)
    root.put(victim.path, content[:-1] + b"?")
    verification = command_on(root, "verify")
    assert verification.exit_code == DAMAGE
    assert victim.path in verification.stdout
    root.put(victim.path, content)
    assert command_on(root, "verify").exit_code == 0


def test_a_car_is_forgotten_and_its_files_are_gone(copied: Folder) -> None:
    root = copied
    before = stored(root)
    drive = command_on(root, "sql", "--json", "SELECT min(drive_id) AS d FROM drives").json[0]["d"]
    assert command_on(root, "forget", "--drive", drive, "--now").exit_code == 0
    after = stored(root)
    assert len(before.keys() - after.keys()) == 3  # a log file, and the Gram rows of both sets
    query = f"SELECT count(*) AS n FROM log WHERE drive_id = '{drive}'"
    assert command_on(root, "sql", "--json", query).json == [{"n": 0}]
    assert command_on(root, "compact").exit_code == 0
    assert command_on(root, "verify", "--full").exit_code == 0


@pytest.mark.parametrize("shift_s", [-60, -2 * 86_400, 600])
def test_erasure_does_not_depend_on_the_clock_of_the_store(
    copied: Folder, monkeypatch: pytest.MonkeyPatch, shift_s: int
) -> None:
    drive = "smoke-2024-05-01-0001"
    before = stored(copied)
    now, now_ns = time.time, time.time_ns
    monkeypatch.setattr(time, "time", lambda: now() + shift_s)
    monkeypatch.setattr(time, "time_ns", lambda: now_ns() + shift_s * 10**9)
    done = command_on(copied, "forget", "--drive", drive, "--now", "--json")
    assert (done.exit_code, done.json["pending"]) == (0, [])
    assert len(before.keys() - stored(copied).keys()) == 3
    remaining = [file for file in copied.files() if file.path.endswith(".parquet")]
    warehouse = Warehouse(copied)
    active = {f"{t.folder.name}/{f.path}" for t in warehouse.tables for f in t.snapshot().files}
    assert {file.path for file in remaining if "/versions/" not in file.path} == active


def test_processes_at_once_lose_and_double_nothing(server: ServerApart, local: Folder) -> None:
    root = data_root(f"{server.bucket()}/data")
    with server.misbehaving(failing=0.03, slow_s=0.02):
        run = ["run", "--campaign", "smoke", "--models", "table1"]
        jobs = (run, run, ["simulate", "smoke"])
        for done in finish(*(start_on(root, *job) for job in jobs)):
            assert done.exit_code == 0, done.stderr
    rows = command_on(root, "sql", "--json", "SELECT count(*) AS n FROM log").json
    assert rows == [{"n": 55957}]
    actual, expected = stored(root), stored(local)
    versions = [path for path in actual if path.startswith("models/") and "/versions/" in path]
    assert [path for path in versions if path.endswith(".json")] == ["models/smoke/versions/1.json"]
    assert len(versions) == 2  # and the drives that it was trained on
    assert contents_of_logs(actual) == contents_of_logs(expected)
    assert command_on(root, "verify", "--full").exit_code == 0


def test_workers_of_a_cluster_write_to_it(
    server: ServerApart, local: Folder, tmp_path: Path
) -> None:
    root = data_root(f"{server.bucket()}/data")
    with dask_processes(tmp_path, workers=2) as dask:
        done = command_on(root, "run", "--campaign", "smoke", "--cluster", dask.address)
        assert done.exit_code == 0, done.stderr
    assert stored(root) == stored(local)


def test_a_store_that_refuses_writes_is_left_as_it_was(server: ServerApart, filled: Folder) -> None:
    before = stored(filled)
    with server.misbehaving(refuse=("PUT", "POST", "DELETE")):
        done = command_on(filled, "simulate", "fleet", "--days", "1")
        assert done.exit_code == STORAGE
        assert "the credentials do not permit this" in done.stderr
        assert command_on(filled, "select").exit_code == 0
    assert stored(filled) == before
