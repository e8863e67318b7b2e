"""Workers and schedulers that die, stop, come late or have other versions."""

import os
import signal
from collections.abc import Iterator, Sequence
from pathlib import Path
from threading import Timer

import pytest
from dask.config import set as dask_config

from fleet_slip.compute import cluster as cluster_module
from fleet_slip.compute.cluster import ClusterExecutor, cluster_executor
from fleet_slip.compute.tasks import run_tasks
from fleet_slip.errors import ClusterError
from fleet_slip.storage.local import LocalFolder
from tests.support.commands import until
from tests.support.dask_processes import DaskProcesses, Order, dask_processes, obey

pytestmark = pytest.mark.long


@pytest.fixture
def dask(tmp_path: Path) -> Iterator[DaskProcesses]:
    """A scheduler and two workers; a task that kills its worker once is given up."""
    settings = {"scheduler__allowed_failures": "0", "comm__timeouts__connect": "20s"}
    with dask_processes(tmp_path, workers=2, **settings) as address:
        yield address


def orders(folder: Path, number: int, seconds: float = 0.0, deadly: str = "") -> list[Order]:
    names = [f"task-{i}" for i in range(number)]
    return [Order(name, folder, seconds, deadly=name == deadly) for name in names]


def results(executor: ClusterExecutor, items: Sequence[Order]) -> dict[str, str]:
    return {
        order.name: result
        for order, result in run_tasks(executor, obey, items, lambda order: order.name)
    }


def begun_by(items: Sequence[Order]) -> set[int]:
    """Processes that began one of the tasks."""
    return {pid for order in items for pid in order.started_in}


def test_workers_that_stop_or_die_delay_but_lose_nothing(
    dask: DaskProcesses, tmp_path: Path
) -> None:
    """One worker is stopped for a while, then another is killed in the middle of a task."""
    dask.start_worker()
    dask.wait_for_workers(3)
    items = orders(tmp_path, 10, seconds=0.5)
    with cluster_executor(dask.address, LocalFolder(tmp_path)) as executor:
        running = run_tasks(executor, obey, items, lambda order: order.name)
        first, result = next(running)
        until(lambda: len(begun_by(items)) > 1)
        stopped, killed, *_ = begun_by(items)
        os.kill(stopped, signal.SIGSTOP)
        os.kill(killed, signal.SIGKILL)
        Timer(2.0, os.kill, (stopped, signal.SIGCONT)).start()
        done = {first.name: result} | {order.name: result for order, result in running}
    assert done == {order.name: order.name.upper() for order in items}


def test_a_task_that_kills_every_worker_is_named_and_the_rest_is_done(
    dask: DaskProcesses, tmp_path: Path
) -> None:
    dask.start_worker("--nanny")
    dask.wait_for_workers(3)
    items = orders(tmp_path, 8, seconds=0.1, deadly="task-1")
    done = {}
    with (
        cluster_executor(dask.address, LocalFolder(tmp_path)) as executor,
        pytest.raises(ClusterError, match=r"^task-1: every worker that tried it died") as caught,
    ):
        for order, result in run_tasks(executor, obey, items, lambda order: order.name):
            done[order.name] = result
    assert caught.value.exit_code == 11
    assert done == {order.name: order.name.upper() for order in items if not order.deadly}
    assert len(items[1].started_in) == 2  # among others, and alone


def test_a_scheduler_that_is_restarted_ends_the_command(
    dask: DaskProcesses, tmp_path: Path
) -> None:
    items = orders(tmp_path, 6, seconds=0.4)
    with (
        cluster_executor(dask.address, LocalFolder(tmp_path)) as executor,
        pytest.raises(ClusterError, match="connection to the Dask scheduler was lost"),
    ):
        running = run_tasks(executor, obey, items, lambda order: order.name)
        next(running)
        dask.close()
        dask.start_scheduler()
        dask.start_worker()
        list(running)


def test_a_scheduler_or_workers_that_do_not_come_back_are_told(
    dask: DaskProcesses, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scheduler, *workers = dask.processes
    items = orders(tmp_path, 3, seconds=0.1)
    with cluster_executor(dask.address, LocalFolder(tmp_path)) as executor:
        assert len(results(executor, items)) == 3
        for worker in workers:
            dask.kill(worker)
        with monkeypatch.context() as patch:
            patch.setattr(cluster_module, "PATIENCE_S", 2.0)
            with pytest.raises(ClusterError, match="has had no worker for"):
                results(executor, items)
    with cluster_executor(dask.address, LocalFolder(tmp_path)) as executor:
        monkeypatch.setattr(executor._client, "_timeout", 1.0)  # as the setting below, but later
        dask.kill(scheduler)
        with pytest.raises(ClusterError, match="connection to the Dask scheduler was lost"):
            results(executor, items)
    with (
        dask_config({"distributed.comm.timeouts.connect": "1s"}),
        pytest.raises(ClusterError, match="no Dask scheduler can be reached"),
        cluster_executor(dask.address, LocalFolder(tmp_path)),
    ):
        pass
