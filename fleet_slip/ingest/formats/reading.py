"""Opens measured files of any format: text and Parquet here, others by a confined process.

The first bytes identify the format; for text also the mapping and the file's suffix. The process
that forks readers (`confined_reader`) is started once, and ends with this one. A reader is not
trusted: its answers are checked.
"""

import atexit
import json
import os
import pickle
import select
import signal
import socket
import stat
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from functools import cache
from pathlib import Path, PosixPath
from tempfile import TemporaryDirectory
from threading import Lock
from typing import Any

import polars as pl
import pyarrow as pa

from fleet_slip import errors
from fleet_slip.base import quote_name
from fleet_slip.errors import FleetSlipError, InputError
from fleet_slip.ingest.formats.confined_reader import FORMATS, HDF5, SIZES, Format, Job
from fleet_slip.ingest.formats.csv import CsvSource
from fleet_slip.ingest.formats.file_formats import CsvFormat, FileFormats
from fleet_slip.ingest.formats.source import Budget, Channel, Source, unreadable
from fleet_slip.ingest.formats.tables import MAGIC, open_parquet
from fleet_slip.ingest.formats.vbo import VBO_BEGINS, VboSource

_PARQUET = Format("a Parquet file", (MAGIC,), (".parquet", ".pq"), "tables", ())
SUFFIXES = (
    *(".csv", ".csv.gz", ".csv.zst", ".vbo", ".asc", ".log", ".trc"),
    *(suffix for kind in (_PARQUET, *FORMATS.values()) for suffix in kind.suffixes),
)
"""How the names of logs end."""
BEGINNINGS = (MAGIC, *(start for kind in FORMATS.values() for start in kind.begins))
"""First bytes of binary logs, whatever their suffix: INCA calls MDF files `.dat`."""
_HDF5_AT = 512
"""Offset of HDF5 in a MATLAB file of version 7.3, after MATLAB's own header."""
_ARCHIVES = {b"PK\x03\x04": "unzip", b"7z\xbc\xaf": "7z x", b"Rar!": "unrar x"}


class StrayLink(PosixPath):
    """A file or folder behind a link out of its folder, which is refused."""


@contextmanager
def require_unchanged_log(log: Path) -> Iterator[None]:
    """Raise `InputError` if a log is no regular file of its folder, or changes while it is read."""
    if isinstance(log, StrayLink):
        problem = "a symbolic link out of its folder, not followed. Give the file by its own path."
    elif not log.exists():
        problem = "no such file. Give the path of a file."
    elif not log.is_file():
        problem = "is not a regular file. Give the path of a file."
    else:
        before = log.stat()
        yield
        with file_errors(log):
            after = log.stat()
        if (after.st_size, after.st_mtime_ns) == (before.st_size, before.st_mtime_ns):
            return
        problem = "it changed while it was read. Wait until it is complete."
    raise InputError(f"{quote_name(log)}: {problem}")


def open_source(file: Path, formats: FileFormats) -> AbstractContextManager[Source]:
    """Open a file in the format that its first bytes identify. Raises `InputError`.

    Each format ensures that the file needs no other file, that no value is a program, and that the
    decoded file does not exceed its `Budget`.
    """
    budget = Budget.for_file(file)
    with file.open("rb") as stream:
        start = stream.read(_HDF5_AT + len(HDF5))
    for magic, program in _ARCHIVES.items():
        if start.startswith(magic):
            raise budget.error(f"it is an archive. Unpack it with {program}.")
    if start.startswith(MAGIC):
        return open_parquet(budget)
    suffix = file.suffix.lower()
    start = start[_HDF5_AT:] if start.endswith(HDF5) else start
    name = next((name for name, kind in FORMATS.items() if start.startswith(kind.begins)), "")
    if formats.can is not None:
        name = "mdf_bus" if name == "mdf" else name or "can_trace"
    elif suffix in {".blf", ".asc"}:
        name = name or "can_trace"
    if name:
        return open_confined(name, budget, formats)
    for kind in (_PARQUET, *FORMATS.values()):
        if suffix in kind.suffixes:
            raise budget.error(
                f"not {kind.name}, despite its suffix. Export it again, or correct the suffix."
            )
    if VBO_BEGINS.match(start) and formats.csv == CsvFormat():
        return nullcontext(VboSource(budget))
    return nullcontext(CsvSource(budget, formats.csv, formats.plain_numbers))


@contextmanager
def file_errors(file: Path) -> Iterator[None]:
    """Convert errors of the operating system, Polars and pyarrow to an `InputError`."""
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


# Readers of binary formats, each a process that the kernel confines to its file.

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
    "TZ": "UTC",
}
"""Limits the memory that libraries reserve for threads. Clocks without a zone are in UTC, so that
the result does not depend on the zone of this machine."""
_INHERITED = ("LD_LIBRARY_PATH",)
_POLL_S = 0.1
"""Interval in s at which the sum of a reader's temporary files is measured."""
_MAX_TEXT_BYTES = 2**26
_ONE_AT_A_TIME = Lock()


@cache
def _server(_pid: int) -> tuple["subprocess.Popen[bytes]", socket.socket]:
    """Start the server that forks readers. A forked process starts its own."""
    ours, theirs = socket.socketpair()
    inherited = {name: os.environ[name] for name in _INHERITED if name in os.environ}
    with theirs:
        process = subprocess.Popen(  # noqa: S603 - our own interpreter
            [sys.executable, "-I", "-X", "utf8", "-c", _SERVE, str(theirs.fileno())]
            + [str(Path(place).absolute()) for place in sys.path],
            env=_ENVIRONMENT | inherited,
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
    """Return the socket of a new reader, and the handle to kill it."""
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
    """A file read by another process, whose answers are checked."""

    def __init__(self, channel: socket.socket, budget: Budget, folder: Path, handle: int) -> None:
        """Take the reader's socket, the file's limits, the reader's folder and its handle."""
        self._channel, self._budget = channel, budget
        self._folder, self._handle = folder, handle
        channel.settimeout(_POLL_S)
        self.has_clock = bool(self._ask("open")[0])

    def channels(self) -> list[Channel]:
        """Return all that can be read, in the file's order."""
        return [Channel(*map(str, fields)) for fields in self._ask("channels")[0]]

    def unreadable(self) -> list[str]:
        """Return why parts of the file are not read."""
        return [str(text) for text in self._ask("unreadable")[0]]

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
        """Send a question; return the reader's answer and rows. Raises `InputError`."""
        with suppress(OSError):  # then nothing comes back
            self._channel.sendall(json.dumps(question).encode() + b"\n")
        until_s = time.monotonic() + self._budget.seconds
        self._require_disk()
        text_size, rows_size = SIZES.unpack(self._receive(SIZES.size, until_s))
        if text_size > _MAX_TEXT_BYTES or rows_size > self._budget.memory:
            raise self._budget.crashed()
        answer: Any = None
        with suppress(ValueError, RecursionError):
            answer = json.loads(self._receive(text_size, until_s))
        if not isinstance(answer, dict) or not {"found", "error"} & answer.keys():
            raise self._budget.crashed()
        if "found" in answer:
            return answer["found"], self._receive(rows_size, until_s)
        if answer["error"] == "MemoryError":
            raise self._budget.crashed()
        kind = getattr(errors, str(answer["error"]), InputError)
        is_ours = isinstance(kind, type) and issubclass(kind, FleetSlipError)
        raise (kind if is_ours else InputError)(str(answer.get("text")))

    def _receive(self, size: int, until_s: float) -> bytearray:
        """Receive `size` bytes. Raises `InputError` if they do not arrive in time."""
        received = bytearray(size)
        remaining = memoryview(received)
        while remaining:
            if time.monotonic() > until_s:
                raise self._budget.over_time()
            try:
                count = self._channel.recv_into(remaining)
            except TimeoutError:
                self._require_disk()
                continue
            except OSError:
                count = 0
            if not count:
                raise self._budget.crashed()
            remaining = remaining[count:]
        return received

    def _require_disk(self) -> None:
        """Raise `InputError` if the reader's temporary files together exceed the limit of one file.

        A deleted file that it holds open counts too.
        """
        if _written_bytes(self._folder, self._handle) > self._budget.unfolded:
            raise self._budget.crashed()


def _written_bytes(folder: Path, handle: int) -> int:
    """Return the disk space of the files in a reader's folder, and of those that it holds open."""
    device, files = folder.stat().st_dev, list(folder.rglob("*"))
    with suppress(OSError, StopIteration):  # the reader may have ended
        lines = Path(f"/proc/self/fdinfo/{handle}").read_text(encoding="ascii").splitlines()
        reader = next(line.split()[1] for line in lines if line.startswith("Pid:"))
        files += Path(f"/proc/{reader}/fd").iterdir()
    sizes: dict[int, int] = {}
    for file in files:
        with suppress(OSError):
            status = file.stat()
            is_held = file.parent.name == "fd" and status.st_nlink
            if status.st_dev == device and stat.S_ISREG(status.st_mode) and not is_held:
                sizes[status.st_ino] = 512 * status.st_blocks
    return sum(sizes.values())


@contextmanager
def open_confined(name: str, budget: Budget, formats: FileFormats) -> Iterator[Source]:
    """Open a file of a format for reading by another process. Raises `InputError`."""
    with TemporaryDirectory(prefix="fleet-slip-", ignore_cleanup_errors=True) as folder:
        channel, handle = _fork_reader(name, budget)
        try:
            channel.sendall(pickle.dumps(Job(name, budget, formats, str(Path.cwd()), folder)))
            yield ConfinedSource(channel, budget, Path(folder), handle)
        finally:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(handle, signal.SIGKILL)
            select.select([handle], [], [])  # until it has ended and released its locks
            os.close(handle)
            channel.close()
