"""An executor on the workers of a Dask cluster.

Dask repeats a task whose worker died. In addition, a worker compares its versions with the sender's
before unpickling a task, and checks that it sees the data root; and all waits are bounded.
"""

import contextlib
import logging
import os
import pickle
import platform
import socket
import time
import uuid
import warnings
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import CancelledError, Executor, Future
from functools import cache, partial
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any

import dask
from dask.utils import parse_timedelta
from distributed import Client
from distributed.client import ClosedClientError
from distributed.comm.addressing import resolve_address
from distributed.scheduler import KilledWorker
from distributed.versions import VersionMismatchWarning

from fleet_slip.compute.tasks import POLL_S
from fleet_slip.errors import ClusterError, FleetSlipError, RefusedError, StorageError
from fleet_slip.resources import folder
from fleet_slip.storage.folder import Folder

PACKAGES = (
    "fleet-slip",
    "numpy",
    "numba",
    "llvmlite",
    "pyarrow",
    "duckdb",
    "deltalake",
    "polars",
    "distributed",
)
"""Packages whose versions must be the same on coordinator and workers."""

SOURCES = "files of fleet-slip"
SHIPPED = (".py", ".sql", ".toml")

IN_FLIGHT_MIN = 8
"""Minimum number of concurrent tasks: more workers may be starting."""

LOST = "the connection to the Dask scheduler was lost"
PATIENCE_S = 120.0
"""Maximum time without workers, in s: a container may take that long to start."""

CONNECT_ATTEMPTS = 5
FIRST_S = 10.0
"""Maximum time to connect to a scheduler, in s; Dask's own setting if shorter."""

CLOSE_S = 5.0
MARKER_FOLDER = ".cluster"

Marker = tuple[Folder, str]
"""Folder and name of a file by which a worker checks that it sees the same data root."""


@contextlib.contextmanager
def cluster_executor(address: str, root: Folder) -> Iterator["ClusterExecutor"]:
    """Connect to the Dask scheduler at an address, such as `tcp://10.0.0.1:8786`.

    Workers must see `root` too. Raises `ClusterError` without a scheduler in 10 s (or Dask's own
    limit).
    """
    _silence_dask()
    try:
        resolve_address(address)
        client = _connect(address)
    except (OSError, ValueError, TypeError, ImportError, RuntimeError, AssertionError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ClusterError(
            f"{address}: no Dask scheduler can be reached there ({reason}). Start one with: dask "
            "scheduler; or name no cluster, and unset DASK_SCHEDULER_ADDRESS, to work on this "
            "machine."
        ) from None
    markers, name = root / MARKER_FOLDER, uuid.uuid4().hex
    try:
        markers.create(name, b"")
        yield ClusterExecutor(client, address, (markers, name))
    finally:
        with contextlib.suppress(StorageError):
            markers.delete(name)
        with contextlib.suppress(OSError, AssertionError):
            client.close(timeout=CLOSE_S)


def _connect(address: str) -> Client:
    """Connect; retry if Dask rejects two initial messages that arrive together."""
    usual_s = float(parse_timedelta(dask.config.get("distributed.comm.timeouts.connect")))
    connect: Callable[[], Client] = partial(
        Client, address, timeout=min(FIRST_S, usual_s), set_as_default=False, name="fleet-slip"
    )
    for _ in range(CONNECT_ATTEMPTS - 1):
        with contextlib.suppress(AssertionError):
            return connect()
    return connect()


class ClusterExecutor(Executor):
    """Runs tasks on a Dask cluster."""

    lost_task = KilledWorker
    """Error of a task whose workers died."""

    def __init__(self, client: Client, address: str, marker: Marker) -> None:
        self._client, self._address, self._marker = client, address, marker
        self._dask = client.get_executor(pure=False)
        self._threads, self._looked_s, self._last_seen_s = 0, 0.0, time.monotonic()

    @property
    def in_flight(self) -> int:
        """Number of concurrent tasks that keeps the workers busy; counted once a second.

        Raises `ClusterError` if the scheduler is lost, or no worker comes.
        """
        now = time.monotonic()
        if now - self._looked_s < POLL_S:
            return max(IN_FLIGHT_MIN, 2 * self._threads)
        self._looked_s = now
        if self._client.status == "closed":
            raise self._error(LOST)
        if self._client.status == "running":
            with contextlib.suppress(OSError, TimeoutError):  # the client connects again, or closes
                self._threads = sum(self._client.nthreads().values())
                self._last_seen_s = now if self._threads else self._last_seen_s
        if now - self._last_seen_s > PATIENCE_S:
            raise self._error(f"the cluster has had no worker for {now - self._last_seen_s:.0f} s")
        return max(IN_FLIGHT_MIN, 2 * self._threads)

    def submit(self, function: Callable[..., Any], /, *args: Any, **_: Any) -> Future[Any]:
        """Run a function of one argument on a worker."""
        (item,) = args
        try:
            task = pickled(self._marker, function, item)
            future: Future[Any] = self._dask.submit(work, environment(), task)
        except ClosedClientError:
            raise self._error(LOST) from None
        return future

    def result(self, future: Future[Any]) -> Any:
        """Return the result of a task. Raises `ClusterError` if the scheduler is lost."""
        try:
            return future.result()
        except CancelledError:
            raise self._error(LOST) from None

    def _error(self, reason: str) -> ClusterError:
        return ClusterError(
            f"{self._address}: {reason}. Finished work is kept: check the cluster, and run the "
            "same command again."
        )


def pickled(marker: Marker, function: Callable[[Any], Any], item: Any) -> bytes:
    """Return the argument of `work`: a pickled marker, function and item."""
    return pickle.dumps((marker, function, item), protocol=5)


def work(expected: Mapping[str, str], task: bytes) -> Any:
    """Run a task and return its result; add the worker's name to expected errors.

    Raises `RefusedError` for other versions and `StorageError` for an invisible marker.
    """
    this_worker = f"worker {socket.gethostname()}:{os.getpid()}"
    _require_same(this_worker, expected, environment())
    (markers, name), function, item = pickle.loads(task)  # noqa: S301 - the scheduler is trusted
    try:
        markers.read(name)
    except StorageError as error:
        raise StorageError(
            f"{this_worker} does not see the data root of this command ({error}). Use a file "
            "system that all machines share, mounted at the same path, or an object store that all "
            "may use."
        ) from None
    try:
        return function(item)
    except FleetSlipError as error:
        raise type(error)(f"{error} [{this_worker}]") from None


def _require_same(where: str, expected: Mapping[str, str], actual: Mapping[str, str]) -> None:
    different = [
        f"{name} {actual.get(name, 'none')} instead of {version}"
        for name, version in expected.items()
        if actual.get(name) != version
    ]
    if different:
        raise RefusedError(
            f"{where} has {', '.join(different)}. Results would not be the same everywhere: "
            "install one set of versions (pip install --constraint constraints.txt), or start all "
            "from one container image."
        )


@cache
def environment() -> dict[str, str]:
    """Return the versions of packages and the checksum of the sources."""
    versions = {name: version(name) for name in PACKAGES}
    return {"python": platform.python_version(), **versions, SOURCES: _sources_digest()}


def _sources_digest() -> str:
    """Return a checksum of the package, SQL and shipped configs: a checkout may be edited.

    Tasks contain the catalog of their warehouse, so workers need no folder of configs.
    """
    shipped = (folder("configs"), folder("jobs"), folder("warehouse"))
    folders = [Path(__file__).parent.parent, *(Path(str(place)) for place in shipped)]
    files = (file for place in folders for file in place.rglob("*") if file.suffix in SHIPPED)
    digest = sha256()
    for name, content in sorted({(file.name, file.read_bytes()) for file in files}):
        digest.update(f"{name}\n".encode() + content)
    return digest.hexdigest()[:12]


def _silence_dask() -> None:
    """Undo the changes to logging that importing Dask makes, and ignore its warnings."""
    for name, logger in logging.root.manager.loggerDict.items():
        is_dask = name.partition(".")[0] in ("distributed", "tornado", "asyncio")
        if is_dask and isinstance(logger, logging.Logger):
            logger.handlers[:] = [logging.NullHandler()]
            logger.propagate = False
    warnings.filterwarnings("ignore", category=VersionMismatchWarning)
    # A client that could not start to connect warns when it is collected.
    warnings.filterwarnings("ignore", r"coroutine '(Client\._close|wait_for)' was never awaited")
