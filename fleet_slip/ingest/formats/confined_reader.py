"""Reads a stranger's file in a process of its own, which can do no harm, for `confined_source`.

A server, started once, imports what formats need and forks one reader for each file. A reader
confines itself, opens the file, and answers what it is asked: lines of JSON on a socket. An answer
is two sizes and JSON; rows are an Arrow stream in memory of both processes.
"""

import contextlib
import errno
import importlib
import json
import os
import pickle
import signal
import socket
import struct
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import astuple, dataclass
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import polars as pl

from fleet_slip.base import shown
from fleet_slip.errors import FleetSlipError, is_lack_of_memory
from fleet_slip.ingest.formats.can import CanBus
from fleet_slip.ingest.formats.source import Base, Budget, ClockSource, Meter, Source

FORMATS = {
    "mdf": ("mdf", "asammdf"),
    "mdf_bus": ("mdf", "asammdf", "cantools"),
    "mcap": ("mcap", "mcap.stream_reader", "mcap_ros2.decoder"),
    "tdms": ("tdms", "nptdms"),
    "mat": ("matlab",),
    "mat73": ("matlab", "h5py"),
    "can_trace": ("can_files", "can", "cantools"),
}
"""By format the module that has `open_FORMAT`, and what that imports of other people's."""
SIZES = struct.Struct("<QQ")


@dataclass(frozen=True)
class Job:
    """What a reader is to read, and what it may take for it."""

    format: str
    file: str
    size: int
    bus: CanBus | None
    cwd: str
    folder: str
    """For its temporary files."""
    limits: tuple[int, int, int]
    """Bytes of memory and of a temporary file, and seconds of a processor."""
    is_watched: bool


def open_here(name: str, bus: CanBus | None, budget: Budget) -> AbstractContextManager[Source]:
    """Open a file of a format in this process. Raises `InputError`."""
    module = importlib.import_module(f"{__package__}.{FORMATS[name][0]}")
    given = [budget] if bus is None else [bus, budget]
    source: AbstractContextManager[Source] = getattr(module, f"open_{name}")(*given)
    return source


def serve(control: int) -> None:
    """Fork a reader for each socket that comes, until nobody is left who sends one."""
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    own = os.getpid()
    with socket.socket(fileno=control) as asking:
        while True:
            name, given, *_ = socket.recv_fds(asking, 100, 2)
            if not given:
                return
            module, *packages = FORMATS[name.decode()]
            importlib.import_module(f"{__package__}.{module}")
            for package in packages:
                with contextlib.suppress(ImportError):  # who reads says which one is missing
                    importlib.import_module(package)
            reader = os.fork()
            if not reader:
                asking.close()
                try:
                    with (
                        socket.socket(fileno=given[0]) as channel,
                        os.fdopen(given[1], "wb") as rows,
                    ):
                        _read(_Asker(channel, rows), own)
                finally:
                    os._exit(0)
            for one in given:
                os.close(one)
            handle = os.pidfd_open(reader)
            socket.send_fds(asking, [b"."], [handle])
            os.close(handle)


class _Asker:
    """Who asks, and where rows are put for it."""

    def __init__(self, channel: socket.socket, rows: BinaryIO) -> None:
        self.channel, self._rows = channel, rows

    def tell(self, told: Any, frame: pl.DataFrame | None = None) -> None:
        """Send an answer, and rows with it."""
        self._rows.seek(0)
        if frame is not None:
            frame.write_ipc_stream(self._rows, compat_level=pl.CompatLevel.oldest())
            self._rows.flush()
        line = json.dumps(told).encode()
        self.channel.sendall(SIZES.pack(len(line), self._rows.tell()) + line)


def _read(asker: _Asker, parent: int) -> None:
    """Answer what is asked of a file, confined to it."""
    from fleet_slip.ingest.formats.confining import confine  # noqa: PLC0415 - Linux alone

    with asker.channel.makefile("rb") as asked:
        job: Job = pickle.load(asked)  # noqa: S301 - of our own parent
        os.chdir(job.cwd)
        tempfile.tempdir = job.folder
        confine(parent, job.file, job.folder, *job.limits)
        with contextlib.ExitStack() as opened:
            reader = _answer(asker, job.file, partial(_Reader, asker, job, opened))
            for line in asked if reader else ():
                name, *arguments = json.loads(line)
                _answer(asker, job.file, partial(getattr(reader, name), *arguments))


def _answer(asker: _Asker, file: str, find: Callable[[], Any]) -> Any:
    """Send what is found, or what is wrong."""
    try:
        found = find()
        if isinstance(found, pl.DataFrame):
            names = {name: str(place) for place, name in enumerate(found.columns)}
            asker.tell({"found": [*names]}, found.rename(names))  # Arrow cuts names at a NUL
        else:
            asker.tell({"found": found.told if isinstance(found, _Reader) else found})
    except Exception as error:
        kind, text = type(error).__name__, str(error)
        if is_lack_of_memory(error) or getattr(error, "errno", 0) == errno.EFBIG:
            kind = "MemoryError"
        elif not isinstance(error, FleetSlipError):
            reason = shown(text.strip().split("\n")[0][:200]) or kind
            text = f"{shown(file)}: cannot be read: {reason}. Is it complete? Copy it again."
        asker.tell({"error": kind, "text": text})
        return None
    return found


class _FarMeter(Meter):
    """Lets the meter of the other process know."""

    def __init__(self, asker: _Asker, is_watched: bool) -> None:
        super().__init__()
        self._asker, self.is_watched = asker, is_watched

    def pass_over(self, at: int, size: int) -> None:
        if self.is_watched:
            self._asker.tell({"passed": [at, size]})


class _Reader:
    """An open file, and what of it is being read."""

    def __init__(self, asker: _Asker, job: Job, opened: contextlib.ExitStack) -> None:
        budget = Budget(Path(job.file), job.size, _FarMeter(asker, job.is_watched))
        self._source = opened.enter_context(open_here(job.format, job.bus, budget))
        self._bases: list[Base] = []
        self._batches: list[Iterator[pl.DataFrame]] = []
        self.told = isinstance(self._source, ClockSource)

    def channels(self) -> list[tuple[str, ...]]:
        """Return all that can be read."""
        return [astuple(one) for one in self._source.channels()]

    def expected_rows(self, columns: Sequence[str]) -> int:
        """Return about how many rows come."""
        return self._source.expected_rows(columns)

    def bases(self, columns: Sequence[str]) -> list[tuple[int, str, int]]:
        """Return the number, the name and the rows of time bases."""
        first, source = len(self._bases), self._source
        self._bases += source.bases(columns) if isinstance(source, ClockSource) else []
        coming = enumerate(self._bases[first:], first)
        return [(number, base.name, base.count_rows()) for number, base in coming]

    def batches(self, columns: Sequence[str]) -> int:
        """Begin to read columns; return the number by which rows are asked for."""
        self._batches.append(self._source.batches(columns))
        return len(self._batches) - 1

    def base(self, number: int) -> int:
        """Begin to read a time base; return the same."""
        self._batches.append(self._bases[number].read())
        return len(self._batches) - 1

    def rows(self, number: int) -> pl.DataFrame | None:
        """Return the next rows, None if there are no more."""
        return next(self._batches[number], None)
