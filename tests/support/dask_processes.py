"""A Dask cluster of real processes on this machine, for tests and benchmarks."""

import contextlib
import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from distributed import Client

DASK = str(Path(sys.executable).with_name("dask"))
REPOSITORY = Path(__file__).parents[2]
START_S = 300.0

Process = subprocess.Popen[bytes]


class DaskProcesses:
    """A scheduler and workers; what they say goes to files in a folder."""

    def __init__(self, folder: Path, host: str = "127.0.0.1", **settings: str) -> None:
        """Take Dask's settings, such as `scheduler__allowed_failures="0"`."""
        self.folder, self.host, self.port = folder, host, _free_port()
        self.settings = {f"DASK_DISTRIBUTED__{k.upper()}": v for k, v in settings.items()}
        self.processes: list[Process] = []

    @property
    def address(self) -> str:
        """The address of the scheduler."""
        return f"tcp://{self.host}:{self.port}"

    def start_scheduler(self, *before: str) -> Process:
        """Start a scheduler, always at the same address."""
        return self._start(
            [*before, DASK, "scheduler", "--host", self.host, "--port", str(self.port)], {}
        )

    def start_worker(
        self, *options: str, before: tuple[str, ...] = (), environment: Mapping[str, str] = {}
    ) -> Process:
        """Start a worker of one thread; a nanny watches it only with the option --nanny."""
        if "--nanny" not in options:
            options = ("--no-nanny", *options)
        scratch = str(self.folder / "scratch")
        command = [*before, DASK, "worker", self.address, "--nthreads", "1"]
        return self._start([*command, "--local-directory", scratch, *options], environment)

    def wait_for_workers(self, number: int) -> None:
        """Wait until so many workers have joined."""
        with Client(self.address, set_as_default=False, timeout=START_S) as client:
            client.wait_for_workers(number, timeout=START_S)

    def kill(self, process: Process) -> None:
        """Kill a process, and whatever it started."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()

    def close(self) -> None:
        """Kill all processes."""
        for process in self.processes:
            self.kill(process)

    def _start(self, command: list[str], environment: Mapping[str, str]) -> Process:
        with (self.folder / f"dask-{len(self.processes)}.log").open("wb") as log:
            process = subprocess.Popen(
                [*command, "--no-dashboard"],
                stdout=log,
                stderr=log,
                cwd=REPOSITORY,
                env=os.environ | self.settings | dict(environment),
                start_new_session=True,
            )
        self.processes.append(process)
        return process


@contextmanager
def dask_processes(folder: Path, workers: int = 2, **settings: str) -> Iterator[DaskProcesses]:
    """Run a scheduler and some workers for as long as the context lasts."""
    cluster = DaskProcesses(folder, **settings)
    try:
        cluster.start_scheduler()
        for _ in range(workers):
            cluster.start_worker()
        yield cluster
    finally:
        cluster.close()


def _free_port() -> int:
    """Return a port that nobody uses, from below those that the kernel gives away by itself.

    The scheduler takes it only later, and once more when it is started again.
    """
    while True:
        port = random.SystemRandom().randrange(10_000, 32_768)
        with contextlib.suppress(OSError), socket.socket() as probe:
            probe.bind(("127.0.0.1", port))
            return port


@dataclass(frozen=True)
class Order:
    """One task: it leaves a file with the number of its process, waits, and gives its name back."""

    name: str
    folder: Path
    seconds: float = 0.0
    deadly: bool = False

    @property
    def started_in(self) -> list[int]:
        """Processes that began it."""
        return [int(f.suffix[1:]) for f in self.folder.glob(f"{self.name}.*")]


def obey(order: Order) -> str:
    (order.folder / f"{order.name}.{os.getpid()}").touch()
    if order.deadly:
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(order.seconds)
    return order.name.upper()
