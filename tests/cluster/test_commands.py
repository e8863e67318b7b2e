"""The commands on a cluster: the same bits as on one machine, or clear words."""

import os
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from distributed import Client

from fleet_slip.compute.cluster import cluster_executor, environment, pickled, work
from fleet_slip.compute.tasks import LocalThreads, run_tasks
from fleet_slip.errors import RefusedError, StorageError
from fleet_slip.storage.data_files import checksum_in
from fleet_slip.storage.local import LocalFolder
from tests.support.commands import RunCommand, finish, run, start_on, until
from tests.support.dask_processes import DaskProcesses, Order, dask_processes, obey
from tests.support.measured import MAPPING_TEXT, csv_text, good_columns

pytestmark = pytest.mark.long

UNTIL_ALL_HAD_ONE = 1000
"""Enough tasks that every worker gets one, even a late one on a busy machine."""


@pytest.fixture(scope="module")
def dask(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DaskProcesses]:
    with dask_processes(tmp_path_factory.mktemp("dask"), workers=2) as address:
        address.wait_for_workers(2)
        yield address


def stored(root: Path) -> dict[str, bytes]:
    """Names of data files, which tell their bytes, and model versions as they are."""
    names = dict.fromkeys((str(f.relative_to(root)) for f in root.rglob("*.parquet")), b"")
    return names | {str(f.relative_to(root)): f.read_bytes() for f in root.rglob("versions/*.json")}


def run_orders(dask: DaskProcesses, folder: Path, number: int, seconds: float) -> int:
    with cluster_executor(dask.address, LocalFolder(folder)) as executor:
        return len(list(run_tasks(executor, obey, orders(folder, number, seconds), str)))


def orders(folder: Path, number: int, seconds: float) -> Iterator[Order]:
    return (Order(f"task-{i}", folder, seconds) for i in range(number))


def test_every_command_gives_the_same_bits_as_on_one_machine(
    dask: DaskProcesses, run_command: RunCommand, tmp_path: Path
) -> None:
    (tmp_path / "test.toml").write_text(MAPPING_TEXT)
    for n in range(3):
        rows = good_columns(30 + n)
        rows["ax"][3] = "broken"
        (tmp_path / f"{n}.csv").write_text(csv_text(rows))
    ingest = ["ingest", "0.csv", "1.csv", "2.csv", "--mapping", "test.toml", "--json"]
    local, remote = tmp_path / "local", tmp_path / "there"
    cluster = ["--cluster", dask.address]
    for root, options in ((local, []), (remote, cluster)):
        windows = ["gram", "--features", "windows"]
        for command in (ingest, windows, ["run", "--campaign", "smoke"]):
            done = run_command(*command, *options, root=root)
            assert done.exit_code == 0, done.stderr
            assert "distributed" not in done.stderr
            if command is ingest:
                assert [(r["new"], r["rows_quarantined"]) for r in done.json] == [(True, 1)] * 3
    assert stored(remote) == stored(local)

    by_variable = {"env": os.environ | {"DASK_SCHEDULER_ADDRESS": dask.address}}
    again = run_command("run", "--campaign", "smoke", root=remote, **by_variable)
    assert "nothing to do" in again.stderr
    verified = run_command("verify", "--full", "--json", *cluster, root=remote)
    assert verified.exit_code == 0, verified.stderr
    assert verified.json == run_command("verify", "--full", "--json", root=local).json
    assert (verified.json["damage"], verified.json["remarks"]) == ([], [])

    damaged = min((remote / "logs").rglob("*.parquet"))
    damaged.write_bytes(damaged.read_bytes()[:-1] + b"?")
    verification = run_command("verify", *cluster, root=remote)
    assert verification.exit_code == 9
    assert damaged.name in verification.stdout + verification.stderr


def test_a_killed_command_is_finished_by_the_next(
    dask: DaskProcesses, run_command: RunCommand, tmp_path: Path
) -> None:
    local, remote = tmp_path / "local", tmp_path / "there"
    assert run_command("simulate", "smoke", root=local).exit_code == 0
    command = ["simulate", "smoke", "--cluster", dask.address]
    killed = start_on(remote, *command)
    until(lambda: list(remote.glob("logs/_delta_log/*.json")) or killed.poll() is not None)
    killed.kill()
    finish(killed)
    assert run_command(*command, root=remote).exit_code == 0
    # Files that the killed command wrote and did not commit remain until `compact`.
    assert {checksum_in(name) for name in stored(remote)} == {
        checksum_in(name) for name in stored(local)
    }
    rows = ["sql", "--json", "SELECT * FROM log_counts ORDER BY drive_id, tick"]
    assert run_command(*rows, root=remote).json == run_command(*rows, root=local).json


def test_a_worker_of_other_versions_is_refused(dask: DaskProcesses, tmp_path: Path) -> None:
    other = tmp_path / "site" / "numba-0.1.dist-info"
    other.mkdir(parents=True)
    (other / "METADATA").write_text("Metadata-Version: 2.1\nName: numba\nVersion: 0.1\n")
    path = os.pathsep.join([str(other.parent), os.environ.get("PYTHONPATH", "")])
    with cluster_executor(dask.address, LocalFolder(tmp_path)) as executor:
        worker = dask.start_worker(environment={"PYTHONPATH": path})
        try:
            dask.wait_for_workers(3)
            with pytest.raises(RefusedError, match=r"^worker .* has numba 0\.1 instead of "):
                list(run_tasks(executor, obey, orders(tmp_path, UNTIL_ALL_HAD_ONE, 0.2), str))
        finally:
            dask.kill(worker)


def test_a_worker_that_does_not_see_the_data_root_writes_nothing(
    dask: DaskProcesses, tmp_path: Path
) -> None:
    own_mounts = ["unshare", "--mount"]
    if run([*own_mounts, "true"]).exit_code:
        pytest.skip("not permitted to hide a folder from a process")
    hide = f'mount -t tmpfs none {shlex.quote(str(tmp_path))} && exec "$0" "$@"'
    blind = dask.start_worker("--name", "blind", before=(*own_mounts, "sh", "-c", hide))
    try:
        dask.wait_for_workers(3)
        with pytest.raises(StorageError, match="does not see the data root of this command"):
            run_orders(dask, tmp_path, UNTIL_ALL_HAD_ONE, 0.2)
    finally:
        dask.kill(blind)
    assert run_orders(dask, tmp_path, 4, 0) == 4


def test_a_scheduler_that_tells_other_news_at_once_is_asked_again(
    dask: DaskProcesses, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As Dask's client fails where a task of another command is given up at that moment."""
    faults = iter([True, True, False])
    connect: Any = Client._ensure_connected

    async def disturbed(client: Client, timeout: float | None = None) -> None:
        await connect(client, timeout)
        assert not next(faults)

    monkeypatch.setattr(Client, "_ensure_connected", disturbed)
    assert run_orders(dask, tmp_path, 3, 0) == 3
    assert list(faults) == []


def test_a_task_makes_sure_of_its_ground(tmp_path: Path) -> None:
    task = pickled((LocalFolder(tmp_path), "marker"), obey, Order("a", tmp_path))
    with pytest.raises(StorageError, match="does not see the data root"):
        work(environment(), task)
    (tmp_path / "marker").touch()
    assert work(environment(), task) == "A"
    with pytest.raises(RefusedError, match=r"fleet-slip .* instead of 9"):
        work({**environment(), "fleet-slip": "9"}, b"is not even unpickled")


def test_an_unreachable_scheduler_is_told_in_bounded_time(run_command: RunCommand) -> None:
    hasty = {"env": os.environ | {"DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "1s"}}
    for address in ("tcp://127.0.0.1:9", "nonsense://x:1"):
        done = run_command("gram", "--cluster", address, **hasty)
        assert done.exit_code == 11
        assert f"{address}: no Dask scheduler can be reached there" in done.stderr
        assert len(done.stderr.splitlines()) == 1


def test_a_bounded_number_of_tasks_is_under_way() -> None:
    taken: list[int] = []

    def items() -> Iterator[int]:
        for i in range(50):
            taken.append(i)
            yield i

    with LocalThreads(2) as threads:
        done = []
        for item, result in run_tasks(threads, lambda i: i * i, items(), str):
            done.append((item, result))
            assert len(taken) - len(done) < threads.in_flight
    assert sorted(done) == [(i, i * i) for i in range(50)]
