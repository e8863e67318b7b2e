"""An executor whose tasks run on the workers of a Dask cluster.

Dask runs a task again where its worker died. Added here: tasks are checked where they run
(`fleet_slip.compute.cluster_worker`), sent again after the scheduler restarted, and nobody waits
for ever.
"""

import asyncio
import contextlib
import logging
import time
import uuid
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, InvalidStateError
from contextvars import copy_context
from dataclasses import dataclass, field
from functools import partial
from threading import Event, Thread
from typing import Any, TypeVar

import dask
from dask.utils import parse_timedelta
from distributed import Client
from distributed.client import ClosedClientError
from distributed.comm.addressing import resolve_address
from distributed.scheduler import KilledWorker
from distributed.versions import VersionMismatchWarning

from fleet_slip.compute.cluster_worker import (
    PACKAGES,
    Marker,
    environment,
    pickled,
    require_same,
    versions,
    work,
)
from fleet_slip.compute.tasks import LostTaskError
from fleet_slip.errors import ClusterError, StorageError
from fleet_slip.storage.folder import Folder
from fleet_slip.storage.runs import log_event

IN_FLIGHT_MIN = 8
"""Tasks that may be under way however few workers there are: more of them may be on their way."""

POLL_S = 1.0
PATIENCE_S = 120.0
"""How long a cluster may be without workers: so long may a container take to start."""

CONNECT_ATTEMPTS = 5
FIRST_S = 10.0
"""How long a scheduler may take to answer at first; later, as long as Dask's own settings allow."""

ANSWER_S = 20.0
CLOSE_S = 5.0
MARKER_FOLDER = ".cluster"
MARKER_AGE_MAX_H = 7 * 24
"""A marker that is older was left by a killed command."""

Connected = TypeVar("Connected")


@contextlib.contextmanager
def cluster_executor(address: str, root: Folder) -> Iterator["ClusterExecutor"]:
    """Connect to the Dask scheduler at an address, such as `tcp://10.0.0.1:8786`.

    Workers must see `root` too. Raises `ClusterError` without a scheduler in 10 s (or Dask's own
    limit), and `RefusedError` for other versions.
    """
    _route_logs()
    try:
        resolve_address(address)
        _require_same_versions(_connected(lambda: asyncio.run(_versions(address))))
        client: Client = _connected(lambda: _Client(address))
    except (OSError, ValueError, TypeError, ImportError, RuntimeError, AssertionError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ClusterError(
            f"{address}: no Dask scheduler can be reached there ({reason}). Start one with: dask "
            "scheduler; or name no cluster, and unset DASK_SCHEDULER_ADDRESS, to work on this "
            "machine."
        ) from None
    try:
        with _marker(root) as marker, ClusterExecutor(client, address, marker) as executor:
            yield executor
    finally:
        with contextlib.suppress(OSError, AssertionError):
            client.close(timeout=CLOSE_S)


class _Client(Client):
    """A client that leaves no thread behind where it cannot begin."""

    def __init__(self, address: str) -> None:
        Client.__init__(self, address, set_as_default=False, name="fleet-slip")

    def start(self, **options: Any) -> None:
        """Connect."""
        try:
            Client.start(self, **options)
        except AssertionError:
            Client.close(self, timeout=CLOSE_S)
            raise


def _connected(connect: Callable[[], Connected]) -> Connected:
    """Connect, again if Dask takes two first messages that came together for a fault."""
    for _ in range(CONNECT_ATTEMPTS - 1):
        with contextlib.suppress(AssertionError):
            return connect()
    return connect()


async def _versions(address: str) -> dict[str, Any]:
    """Return the versions of scheduler and workers; of none, if one of them does not answer.

    By a client of its own: one that cannot connect leaves a thread behind unless it is a coroutine.
    """
    usual_s = float(parse_timedelta(dask.config.get("distributed.comm.timeouts.connect")))
    first_s = min(FIRST_S, usual_s)
    async with Client(address, asynchronous=True, set_as_default=False, timeout=first_s) as client:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(ANSWER_S):
                found: Any = await client.get_versions(packages=PACKAGES)
                return {"the scheduler": found["scheduler"], **found["workers"]}
    return {}


def _require_same_versions(found: dict[str, Any]) -> None:
    """Refuse other versions before any work; a worker that comes later is told by its tasks."""
    for where, theirs in found.items():
        packages = {name: theirs["packages"].get(name) or "none" for name in PACKAGES}
        python = ".".join(theirs["packages"]["python"].split(".")[:3])
        require_same(where, versions(), {"python": python, **packages})


@contextlib.contextmanager
def _marker(root: Folder) -> Iterator[Marker]:
    """Make a file in the data root by which a worker knows that it sees the same root."""
    marker = Marker(root / MARKER_FOLDER, uuid.uuid4().hex)
    marker.folder.create(marker.name, b"")
    try:
        yield marker
    finally:
        with contextlib.suppress(StorageError):
            for file in marker.folder.files():
                if file.path == marker.name or file.age_hours > MARKER_AGE_MAX_H:
                    marker.folder.remove(file)


@dataclass(eq=False)
class _Task:
    content: bytes
    future: Future[Any] = field(default_factory=Future)
    sent_by: object = None
    """The connection by which it was sent; None if it has to be sent."""


class ClusterExecutor(Executor):
    """Runs tasks on a Dask cluster. A future raises `LostTaskError` if its workers died.

    After a lost connection a thread sends all tasks again, which are idempotent. If no scheduler or
    worker comes back, all futures raise `ClusterError`.
    """

    def __init__(self, client: Client, address: str, marker: Marker) -> None:
        self.workers = 0
        self._threads = 0
        self._client, self._address, self._marker = client, address, marker
        self._dask = client.get_executor(pure=False)
        self._tasks: set[_Task] = set()
        self._last_seen_s = time.monotonic()
        self._closing = Event()
        self._count_workers()
        self._watcher = Thread(target=copy_context().run, args=(self._watch,), daemon=True)
        self._watcher.start()

    @property
    def in_flight(self) -> int:
        """How many tasks keep the workers busy."""
        return max(IN_FLIGHT_MIN, 2 * self._threads)

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run a function of one argument on a worker."""
        if kwargs or len(args) != 1:
            raise TypeError("a task on a cluster is a function and its one argument")
        task = _Task(pickled(self._marker, function, args[0]))
        self._tasks.add(task)
        self._send(task)
        return task.future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:  # noqa: ARG002
        """Forget what is under way: whoever leaves without waiting for it has failed."""
        self._closing.set()
        self._watcher.join()
        for task in list(self._tasks):
            task.future.cancel()

    def _send(self, task: _Task) -> None:
        if self._client.status != "running":
            return  # the watcher sends it
        task.sent_by = self._client.scheduler_comm
        try:
            future = self._dask.submit(work, environment(), task.content)
        except ClosedClientError:
            return  # the watcher tells it
        future.add_done_callback(partial(self._settle, task))
        task.future.add_done_callback(lambda ours: ours.cancelled() and future.cancel())

    def _settle(self, task: _Task, future: Future[Any]) -> None:
        if future.cancelled():
            task.sent_by = None
            return
        self._tasks.discard(task)
        error = future.exception()
        with contextlib.suppress(InvalidStateError):  # another sending of it was faster
            if isinstance(error, KilledWorker):
                log_event("task lost", logging.WARNING, reason=str(error))
                task.future.set_exception(LostTaskError(str(error)))
            elif error is not None:
                task.future.set_exception(error)
            else:
                task.future.set_result(future.result())

    def _watch(self) -> None:
        while not self._closing.wait(POLL_S):
            status = self._client.status
            if status == "closed":
                self._fail("the connection to the Dask scheduler was lost, and none came back")
            elif status == "running":
                self._send_again()
                self._count_workers()
            waited_s = time.monotonic() - self._last_seen_s
            if self._tasks and waited_s > PATIENCE_S:
                self._fail(f"the cluster has had no worker for {waited_s:.0f} s")

    def _send_again(self) -> None:
        connection = self._client.scheduler_comm
        self._tasks.difference_update([task for task in list(self._tasks) if task.future.done()])
        lost = [task for task in list(self._tasks) if task.sent_by is not connection]
        if lost:
            log_event("tasks sent again", logging.WARNING, tasks=len(lost))
        for task in lost:
            self._send(task)

    def _count_workers(self) -> None:
        try:
            threads = self._client.nthreads()
        except (OSError, TimeoutError):
            return  # the client connects again, or closes
        if (len(threads), sum(threads.values())) != (self.workers, self._threads):
            log_event("workers", workers=len(threads), threads=sum(threads.values()))
        self.workers, self._threads = len(threads), sum(threads.values())
        if threads:
            self._last_seen_s = time.monotonic()

    def _fail(self, reason: str) -> None:
        error = ClusterError(
            f"{self._address}: {reason}. What is done is kept: look after the cluster, and run the "
            "same command again."
        )
        for task in list(self._tasks):
            self._tasks.discard(task)
            with contextlib.suppress(InvalidStateError):
                task.future.set_exception(error)


class _Forwarder(logging.Handler):
    """Hands what Dask logs to our log, where machines read it and people are not disturbed."""

    def emit(self, record: logging.LogRecord) -> None:
        """Hand on what is no mere remark."""
        if record.levelno >= logging.WARNING:
            message = " ".join(record.getMessage().split())
            log_event("dask", record.levelno, logger=record.name, message=message)


def _route_logs() -> None:
    """Undo what Dask does to the logging of the process when it is imported."""
    for name in ("distributed", "tornado", "asyncio"):
        logger = logging.getLogger(name)
        logger.handlers[:] = [_Forwarder()]
        logger.propagate = False
    for name in list(logging.root.manager.loggerDict):
        if name.startswith(("distributed.", "tornado.")):
            logger = logging.getLogger(name)
            logger.handlers.clear()
            logger.propagate = True
    warnings.filterwarnings("ignore", category=VersionMismatchWarning)
    # A client that could not even begin to connect complains of itself when it is collected.
    warnings.filterwarnings("ignore", r"coroutine '(Client\._close|wait_for)' was never awaited")
