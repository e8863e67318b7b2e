"""Opens measured files of any format: tables here, all others through a process of their own.

What a file is, its first bytes say; only what is text goes by the mapping and the name. The process
that forks readers (`confined_reader`) is started once, and ends with this one.
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
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock
from typing import Any

import polars as pl
import pyarrow as pa

from fleet_slip import errors
from fleet_slip.base import shown
from fleet_slip.errors import FleetSlipError, InputError
from fleet_slip.ingest.formats.can import CanBus
from fleet_slip.ingest.formats.confined_reader import FORMATS, SIZES, Job
from fleet_slip.ingest.formats.csv import CsvFormat, CsvSource, PlainNumbers
from fleet_slip.ingest.formats.source import Budget, Channel, Source, unreadable
from fleet_slip.ingest.formats.tables import PARQUET_MAGIC, open_parquet
from fleet_slip.ingest.formats.vbo import VBO_BEGINS, VboSource
from fleet_slip.ingest.log_files import StrayLink

[_HDF5], _HDF5_AT = FORMATS["mat73"].begins, 512
"""A MATLAB file of version 7.3 becomes HDF5 there: MATLAB's own header is before it."""
_ARCHIVES = {b"PK\x03\x04": "unzip", b"7z\xbc\xaf": "7z x", b"Rar!": "unrar x"}
_BINARY = {
    (".parquet", ".pq"): "a Parquet file",
    (".mf4", ".mdf"): "an MDF file",
    (".mat", ".h5", ".hdf5"): "a MATLAB file of version 5 or 7.3",
    (".mcap",): "an MCAP file",
    (".tdms", ".tdms_index"): "a TDMS file",
}


@dataclass(frozen=True)
class FileFormats:
    """What must be known of a file's format beside the file.

    Attributes:
        csv: separator and decimal sign of text.
        can: the database of a CAN trace.
        name: the mapping that says it, for messages.
        plain_numbers: which columns of text are numbers, wherever they are used.
    """

    csv: CsvFormat = field(default_factory=CsvFormat)
    can: CanBus | None = None
    name: str = "mapping suggest"
    plain_numbers: PlainNumbers = field(default_factory=PlainNumbers)


@contextmanager
def require_unchanged_log(log: Path) -> Iterator[None]:
    """Raise `InputError` if a log is no regular file of its folder, or changes while it is read."""
    if isinstance(log, StrayLink):
        raise InputError(
            f"{shown(log)}: a symbolic link out of its folder, not followed. Give the file by its "
            "own path."
        )
    if not log.is_file():
        what = "is not a regular file" if log.exists() else "no such file"
        raise InputError(f"{shown(log)}: {what}. Give the path of a file.")
    before = _size_and_time(log)
    yield
    if _size_and_time(log) != before:
        raise InputError(f"{shown(log)}: it changed while it was read. Wait until it is complete.")


def _size_and_time(file: Path) -> tuple[int, int]:
    with file_errors(file):
        return file.stat().st_size, file.stat().st_mtime_ns


def open_source(file: Path, formats: FileFormats) -> AbstractContextManager[Source]:
    """Open a file, in the format that its first bytes say. Raises `InputError`.

    Each format makes sure that the file stands for itself: that no value of it is to be fetched
    from another file, or computed, and that it is not far more than its `Budget` once decoded.
    """
    budget = Budget.of(file)
    with file.open("rb") as stream:
        start = stream.read(_HDF5_AT + len(_HDF5))
    for magic, program in _ARCHIVES.items():
        if start.startswith(magic):
            raise InputError(
                f"{shown(file)}: it is an archive. Unpack it with {program} and give the files."
            )
    suffix = file.suffix.lower()
    begun = start[_HDF5_AT:] if start.endswith(_HDF5) else start
    name = next((name for name, of in FORMATS.items() if begun.startswith(of.begins)), "")
    if formats.can is not None:
        name = "mdf_bus" if name == "mdf" else name or "can_trace"
    elif suffix in {".blf", ".asc"}:
        name = name or "can_trace"
    if start.startswith(PARQUET_MAGIC):
        return open_parquet(budget)
    if name == "can_trace" and formats.can is None:
        raise InputError(
            f'{shown(file)}: this format needs [can] with database = "….dbc" in the mapping '
            f"{formats.name!r}."
        )
    if name:
        bus = formats.can if name in {"can_trace", "mdf_bus"} else None
        return open_confined(name, bus, budget)
    for suffixes, kind in _BINARY.items():
        if suffix in suffixes:
            raise InputError(
                f"{shown(file)}: not {kind}, despite its suffix. Export it again, or correct the "
                "suffix."
            )
    if VBO_BEGINS.match(start) and formats.csv == CsvFormat():
        return nullcontext(VboSource(budget, formats.plain_numbers))
    return nullcontext(CsvSource(budget, formats.csv, formats.plain_numbers))


@contextmanager
def file_errors(file: Path) -> Iterator[None]:
    """Turn what the operating system, Polars and pyarrow raise into an `InputError`."""
    try:
        yield
    except (
        OSError,
        ValueError,
        MemoryError,
        pa.ArrowException,
        pl.exceptions.PolarsError,
        pl.exceptions.PanicException,
    ) as error:
        raise unreadable(file, error) from None


# A file that another process reads.

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


def _fork_reader(name: str, budget: Budget) -> tuple[socket.socket, int]:
    """Return what a reader is asked through, and a handle by which it is ended."""
    ours, theirs = socket.socketpair()
    handles: list[int] = []
    with _ONE_AT_A_TIME, theirs:
        for _ in range(2):  # the server may have ended since the last file: then another forks
            process, control = _server(os.getpid())
            with suppress(OSError):
                socket.send_fds(control, [name.encode()], [theirs.fileno()])
                _, handles, *_ = socket.recv_fds(control, 1, 1)
            if handles:
                break
            _server.cache_clear()
            _end(process, control)
    if not handles:
        ours.close()
        raise budget.crashed()
    return ours, handles[0]


class ConfinedSource(Source):
    """A file that another process reads. It is trusted with nothing: its answers are checked."""

    def __init__(self, channel: socket.socket, budget: Budget) -> None:
        """Take what a reader is asked through, and what its answers may become."""
        self._channel, self._budget = channel, budget
        self.has_clock = bool(self._receive()[0])

    def channels(self) -> list[Channel]:
        """Return all that can be read, in the file's order."""
        return [Channel(*map(str, one)) for one in self._ask("channels")[0]]

    def bases(self, columns: Sequence[str]) -> list[Iterator[pl.DataFrame]]:
        """Return the rows of each time base that has one of the columns. Raises `InputError`."""
        return [self._read(number) for number in self._ask("bases", list(columns))[0]]

    def _read(self, base: int) -> Iterator[pl.DataFrame]:
        while True:
            names, content = self._ask("rows", base)
            if names is None:
                return
            try:
                table = pa.ipc.open_stream(content).read_all()
                table.validate(full=True)
                frame = pl.DataFrame(table)
                frame.columns = [str(name) for name in names]
            except (pa.ArrowException, pl.exceptions.PolarsError, OSError, ValueError):
                raise self._budget.crashed() from None
            yield frame

    def _ask(self, *question: Any) -> tuple[Any, bytearray]:
        """Return what the reader answers, and rows. Raises `InputError`."""
        with suppress(OSError):  # then nothing comes back
            self._channel.sendall(json.dumps(question).encode() + b"\n")
        return self._receive()

    def _receive(self) -> tuple[Any, bytearray]:
        """Return what the reader says, and rows."""
        until_s = time.monotonic() + self._budget.seconds
        text, size = SIZES.unpack(self._take(SIZES.size, until_s))
        if text > _LARGEST_TEXT or size > self._budget.memory:
            raise self._budget.crashed()
        try:
            said = json.loads(self._take(text, until_s))
        except (ValueError, RecursionError):
            raise self._budget.crashed() from None
        return self._found(said), self._take(size, until_s)

    def _found(self, said: Any) -> Any:
        if not isinstance(said, dict) or not {"found", "error"} & said.keys():
            raise self._budget.crashed()
        if "found" in said:
            return said["found"]
        if said["error"] == "MemoryError":
            raise self._budget.over_memory()
        kind = getattr(errors, str(said["error"]), InputError)
        is_ours = isinstance(kind, type) and issubclass(kind, FleetSlipError)
        raise (kind if is_ours else InputError)(str(said.get("text")))

    def _take(self, size: int, until_s: float) -> bytearray:
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
        return taken


@contextmanager
def open_confined(name: str, bus: CanBus | None, budget: Budget) -> Iterator[Source]:
    """Open a file of a format for reading by another process. Raises `InputError`."""
    with TemporaryDirectory(prefix="fleet-slip-", ignore_cleanup_errors=True) as folder:
        channel, handle = _fork_reader(name, budget)
        try:
            job = Job(
                *(name, os.fspath(budget.file), budget.size, bus, str(Path.cwd()), folder),
                limits=(budget.memory, budget.unfolded, int(10 * budget.seconds) + 1),
            )
            channel.sendall(pickle.dumps(job))
            yield ConfinedSource(channel, budget)
        finally:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(handle, signal.SIGKILL)
            select.select([handle], [], [])  # until it is gone, and its locks
            os.close(handle)
            channel.close()
