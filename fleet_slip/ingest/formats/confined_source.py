"""A measured file that another process reads, which can do no harm (`confined_reader`).

It is trusted with nothing: what it answers is JSON and Arrow, checked, and a reader that takes too
long is ended. The process that forks readers is started once, and ends with this one.
"""

import atexit
import json
import os
import pickle
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock
from typing import Any

import polars as pl
import pyarrow as pa

from fleet_slip import errors
from fleet_slip.errors import FleetSlipError, InputError
from fleet_slip.ingest.formats.can import CanBus
from fleet_slip.ingest.formats.confined_reader import SIZES, Job
from fleet_slip.ingest.formats.source import Base, Budget, Channel, ClockSource

_SERVE = (
    "import sys; sys.path[:] = sys.argv[2:]; "
    "from fleet_slip.ingest.formats.confined_reader import serve; serve(int(sys.argv[1]))"
)
_ENVIRONMENT = {
    "POLARS_MAX_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "ARROW_DEFAULT_MEMORY_POOL": "system",
    "MALLOC_MMAP_THRESHOLD_": "1000000000",
    "MALLOC_TRIM_THRESHOLD_": "1000000000",
}
"""Else libraries reserve memory for threads that a reader does not need."""
_KEPT = ("TZ", "LD_LIBRARY_PATH")
_LARGEST_TEXT = 2**26
_ONE_AT_A_TIME = Lock()


@cache
def _server(_pid: int) -> tuple["subprocess.Popen[bytes]", socket.socket]:
    """Start what forks readers, for this process and not for one that it was forked from."""
    ours, theirs = socket.socketpair()
    kept = {name: os.environ[name] for name in _KEPT if name in os.environ}
    with theirs:
        process = subprocess.Popen(  # noqa: S603 - our own interpreter
            [sys.executable, "-I", "-X", "utf8", "-c", _SERVE, str(theirs.fileno())]
            + [str(Path(place).absolute()) for place in sys.path],
            env=_ENVIRONMENT | kept,
            pass_fds=[theirs.fileno()],
            start_new_session=True,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
    atexit.register(_end, process, ours)
    return process, ours


def _end(process: "subprocess.Popen[bytes]", control: socket.socket) -> None:
    control.close()
    process.kill()
    process.wait()


def _fork_reader(name: str, rows: int, budget: Budget) -> tuple[socket.socket, int]:
    """Return what a reader is asked through, and a handle by which it is ended."""
    ours, theirs = socket.socketpair()
    handles: list[int] = []
    with _ONE_AT_A_TIME, theirs:
        for _ in range(2):  # the server may have ended since the last file: then another forks
            process, control = _server(os.getpid())
            with suppress(OSError):
                socket.send_fds(control, [name.encode()], [theirs.fileno(), rows])
                _, handles, *_ = socket.recv_fds(control, 1, 1)
            if handles:
                break
            _server.cache_clear()
            _end(process, control)
    if not handles:
        ours.close()
        raise budget.crashed()
    return ours, handles[0]


class ConfinedSource:
    """A file without a clock of its own."""

    has_clock = False

    def __init__(self, channel: socket.socket, rows: int, budget: Budget) -> None:
        """Take what a reader is asked through, where it puts rows, and what these may become."""
        self._channel, self._rows, self._budget = channel, rows, budget
        self._asked: int | None = None
        self._ready: dict[int, tuple[Any, pa.Buffer]] = {}

    def channels(self) -> list[Channel]:
        """Return all that can be read, in the file's order."""
        return [Channel(*map(str, one)) for one in self.ask("channels")]

    def expected_rows(self, columns: Sequence[str]) -> int:
        """Return about how many rows `batches` yields."""
        return int(self.ask("expected_rows", list(columns)))

    def batches(self, columns: Sequence[str]) -> Iterator[pl.DataFrame]:
        """Yield rows that have the named columns. Raises `InputError`."""
        yield from self._batches(self.ask("batches", list(columns)))

    def ask(self, *question: Any) -> Any:
        """Return what the reader answers. Raises `InputError`."""
        self._send(*question)
        return self.answer()[0]

    def answer(self) -> tuple[Any, pa.Buffer]:
        """Return what the reader says, and rows. Raises `InputError`."""
        return self._found(*self._receive())

    def _batches(self, number: int) -> Iterator[pl.DataFrame]:
        """Yield rows; behind the first ones the reader looks for more meanwhile."""
        frames = 0
        while True:
            if number not in self._ready:
                self._look_for(number)
                self._settle()
            names, content = self._found(*self._ready.pop(number))
            if names is None:
                return
            frames += 1
            if frames > 1:  # many want the first alone
                self._look_for(number)
            yield self._frame(names, content)

    def _look_for(self, number: int) -> None:
        """Ask for the next rows."""
        if self._asked != number:
            self._send("rows", number)
            self._asked = number

    def _frame(self, names: Any, content: pa.Buffer) -> pl.DataFrame:
        try:
            table = pa.ipc.open_stream(content).read_all()
            table.validate(full=True)
            frame = pl.DataFrame(table)
            frame.columns = [str(name) for name in names]
        except (pa.ArrowException, pl.exceptions.PolarsError, OSError, ValueError):
            raise self._budget.crashed() from None
        return frame

    def _send(self, *question: Any) -> None:
        self._settle()
        with suppress(OSError):  # then nothing comes back
            self._channel.sendall(json.dumps(question).encode() + b"\n")

    def _settle(self) -> None:
        """Receive what was asked for before."""
        if self._asked is not None:
            number, self._asked = self._asked, None
            self._ready[number] = self._receive()

    def _found(self, told: Any, content: pa.Buffer) -> tuple[Any, pa.Buffer]:
        if not isinstance(told, dict) or not {"found", "error"} & told.keys():
            raise self._budget.crashed()
        if "found" in told:
            return told["found"], content
        if told["error"] == "MemoryError":
            raise self._budget.over_memory()
        kind = getattr(errors, str(told["error"]), InputError)
        is_ours = isinstance(kind, type) and issubclass(kind, FleetSlipError)
        raise (kind if is_ours else InputError)(str(told.get("text")))

    def _receive(self) -> tuple[Any, pa.Buffer]:
        """Return what the reader says, and rows; how far it is, the meter is told."""
        until_s = time.monotonic() + self._budget.seconds
        while True:
            text, rows = SIZES.unpack(self._take(SIZES.size, until_s))
            if text > _LARGEST_TEXT or rows > self._budget.memory:
                raise self._budget.crashed()
            try:
                found = json.loads(self._take(text, until_s))
            except (ValueError, RecursionError):
                raise self._budget.crashed() from None
            if not (isinstance(found, dict) and "passed" in found):
                return found, self._copy(rows)
            at, size = map(int, found["passed"])
            self._budget.meter.pass_over(at, size)

    def _copy(self, size: int) -> pa.Buffer:
        """Return rows: not the memory itself, which the reader could still change."""
        copied = pa.allocate_buffer(size)
        if size and os.preadv(self._rows, [memoryview(copied)], 0) != size:
            raise self._budget.crashed()
        return copied

    def _take(self, size: int, until_s: float) -> bytes:
        """Receive so many bytes. Raises `InputError` if they do not come in time."""
        taken = bytearray(size)
        left = memoryview(taken)
        while left:
            self._channel.settimeout(max(until_s - time.monotonic(), 1e-3))
            try:
                came = self._channel.recv_into(left)
            except TimeoutError:
                raise self._budget.over_time() from None
            except OSError:
                came = 0
            if not came:
                raise self._budget.crashed()
            left = left[came:]
        return bytes(taken)


class ConfinedClock(ConfinedSource, ClockSource):
    """A file that says when each sample was taken."""

    has_clock = True

    def bases(self, columns: Sequence[str]) -> list[Base]:
        """Return the time bases that have one of the columns. Raises `InputError`."""
        return [
            Base(str(name), partial(int, rows), partial(self._read_base, number))
            for number, name, rows in self.ask("bases", list(columns))
        ]

    def _read_base(self, number: int) -> Iterator[pl.DataFrame]:
        yield from self._batches(self.ask("base", number))


@contextmanager
def open_confined(name: str, bus: CanBus | None, budget: Budget) -> Iterator[ConfinedSource]:
    """Open a file of a format for reading by another process. Raises `InputError`."""
    with TemporaryDirectory(prefix="fleet-slip-", ignore_cleanup_errors=True) as folder:
        rows = os.memfd_create("rows")
        with os.fdopen(rows, "rb"):
            channel, handle = _fork_reader(name, rows, budget)
            try:
                job = Job(
                    *(name, os.fspath(budget.file), budget.size, bus, str(Path.cwd()), folder),
                    limits=(budget.memory, budget.unfolded, int(10 * budget.seconds) + 1),
                    is_watched=budget.meter.is_watched,
                )
                channel.sendall(pickle.dumps(job))
                source = ConfinedSource(channel, rows, budget)
                has_clock = source.answer()[0]
                yield ConfinedClock(channel, rows, budget) if has_clock else source
            finally:
                with suppress(ProcessLookupError):
                    signal.pidfd_send_signal(handle, signal.SIGKILL)
                select.select([handle], [], [])  # until it is gone, and its locks
                os.close(handle)
                channel.close()
