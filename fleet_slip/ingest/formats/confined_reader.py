"""Reads an untrusted file in a confined process, for `reading`.

A server, started once, imports the libraries of formats and forks one reader for each file. A
reader confines itself, opens the file, and answers questions: lines of JSON on a socket. An answer
is two sizes, JSON, and rows as an Arrow stream. The caller limits the sum of temporary files.

A reader can read that file, a folder for its temporary files, and the installed code, which
libraries import late. It cannot connect, start programs or processes, or signal, slow or limit
others. Without Landlock (a kernel before 5.13, or disabled) other files stay readable.
"""

import contextlib
import ctypes
import errno
import importlib
import io
import json
import os
import pickle
import platform
import resource
import signal
import socket
import struct
import sysconfig
import tempfile
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import astuple, dataclass
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import polars as pl

from fleet_slip.errors import FleetSlipError, is_lack_of_memory
from fleet_slip.ingest.formats.file_formats import FileFormats
from fleet_slip.ingest.formats.source import Budget, Source, unreadable

HDF5 = b"\x89HDF\r\n\x1a\n"


class Format(NamedTuple):
    """A binary format: first bytes and suffixes of its files, its module, and its packages."""

    name: str
    begins: tuple[bytes, ...]
    suffixes: tuple[str, ...]
    module: str
    packages: tuple[str, ...]


FORMATS = {
    "mdf": Format("an MDF file", (b"MDF     ", b"UnFinMF "), (".mf4", ".mdf"), "mdf", ("asammdf",)),
    "mdf_bus": Format("bus logging", (), (), "mdf", ("asammdf", "cantools")),
    "mcap": Format("an MCAP file", (b"\x89MCAP0\r\n",), (".mcap",), "mcap", ("mcap_ros2.decoder",)),
    "tdms": Format("a TDMS file", (b"TDSm",), (".tdms", ".tdms_index"), "tdms", ("nptdms",)),
    "mat": Format(
        "a MATLAB file of version 5 or 7.3",
        (b"MATLAB 5.0 MAT-file", HDF5),
        (".mat", ".h5", ".hdf5"),
        "matlab",
        ("scipy.io", "h5py"),
    ),
    "can_trace": Format("a BLF file", (b"LOGG",), (".blf",), "can", ("can", "cantools")),
}
"""Each has `open_FORMAT` in its module."""
SIZES, ROWS = struct.Struct("<QQ"), b'["rows", '
"""Header of an answer, and beginning of the question for rows."""


@dataclass(frozen=True)
class Job:
    """The task of a reader: a file and its limits."""

    format: str
    budget: Budget
    formats: FileFormats
    cwd: str
    folder: str
    """For its temporary files."""


def open_here(name: str, budget: Budget, formats: FileFormats) -> AbstractContextManager[Source]:
    """Open a file of a format in this process. Raises `InputError`."""
    module = importlib.import_module(f"{__package__}.{FORMATS[name].module}")
    source: AbstractContextManager[Source] = getattr(module, f"open_{name}")(budget, formats)
    return source


def serve(control: int) -> None:
    """Fork a reader for each socket that is received, until the parent closes the connection."""
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    parent = os.getpid()
    with socket.socket(fileno=control) as asking:
        while True:
            name, descriptors, *_ = socket.recv_fds(asking, 100, 1)
            if not descriptors:
                return
            file_format = FORMATS[name.decode()]
            importlib.import_module(f"{__package__}.{file_format.module}")
            for package in file_format.packages:
                with contextlib.suppress(ImportError):  # the reader reports the missing package
                    importlib.import_module(package)
            reader = os.fork()
            if not reader:
                asking.close()
                try:
                    with socket.socket(fileno=descriptors[0]) as channel:
                        _answer_questions(channel, parent)
                finally:
                    os._exit(0)
            os.close(descriptors[0])
            handle = os.pidfd_open(reader)
            socket.send_fds(asking, [b"."], [handle])
            os.close(handle)


class _Reader:
    """Answers questions on a file, each a method."""

    def __init__(self, job: Job, opened: contextlib.ExitStack) -> None:
        self._job, self._opened = job, opened
        self._source: Source
        self._batches: list[Iterator[pl.DataFrame]] = []

    def answer(self, question: bytes) -> bytes:
        """Return sizes, JSON and rows: the result of a method, or its error."""
        rows = io.BytesIO()
        name, *arguments = json.loads(question)
        try:
            result = getattr(self, name)(*arguments)
            if isinstance(result, pl.DataFrame):
                names = {name: str(place) for place, name in enumerate(result.columns)}
                frame, result = result.rename(names), [*names]  # Arrow cuts names at a NUL
                frame.write_ipc_stream(rows, compat_level=pl.CompatLevel.oldest())
            content = {"found": result}
        except Exception as error:
            kind, text = type(error).__name__, str(error)
            if is_lack_of_memory(error) or getattr(error, "errno", 0) == errno.EFBIG:
                kind = "MemoryError"
            elif not isinstance(error, FleetSlipError):
                text = str(unreadable(self._job.budget.file, error))
            content = {"error": kind, "text": text}
        line = json.dumps(content).encode()
        return SIZES.pack(len(line), rows.tell()) + line + rows.getbuffer()

    def open(self) -> bool:
        """Open the file. Returns True if it has clocks."""
        source = open_here(self._job.format, self._job.budget, self._job.formats)
        self._source = self._opened.enter_context(source)
        return self._source.has_clock

    def channels(self) -> list[tuple[str, ...]]:
        """Return all that can be read."""
        return [astuple(channel) for channel in self._source.channels()]

    def unreadable(self) -> list[str]:
        """Return why parts of the file are not read."""
        return self._source.unreadable()

    def bases(self, columns: Sequence[str]) -> list[int]:
        """Return the numbers of time bases, by which their rows are asked for."""
        first = len(self._batches)
        self._batches += self._source.bases(columns)
        return list(range(first, len(self._batches)))

    def rows(self, number: int) -> pl.DataFrame | None:
        """Return the next rows of a time base, None if there are no more."""
        return next(self._batches[number], None)


def _answer_questions(channel: socket.socket, parent: int) -> None:
    """Confine this process to a file and answer questions on it.

    The next rows are read while the other process handles the last ones.
    """
    with channel.makefile("rb") as questions, contextlib.ExitStack() as opened:
        job: Job = pickle.load(questions)  # noqa: S301 - of our own parent
        os.chdir(job.cwd)
        tempfile.tempdir = job.folder
        confine(parent, job)
        reader, ahead = _Reader(job, opened), dict[bytes, bytes]()
        for question in questions:
            channel.sendall(ahead.pop(question, b"") or reader.answer(question))
            if question.startswith(ROWS):
                ahead[question] = reader.answer(question)


# Restrictions of a reader by the kernel.

_PDEATHSIG, _NO_NEW_PRIVS, _SECCOMP, _FILTER = 1, 38, 22, 2
_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446
_ASK_VERSION, _BENEATH = 1, 1
_RIGHTS = {1: 13, 2: 14, 3: 15, 4: 15}
"""Number of rights on files by version of Landlock; later versions have 16."""
_READ_FILE, _READ = 1 << 2, 1 << 2 | 1 << 3
_EVERYTHING_HERE = (1 << 13) - 1
_READABLE = (
    *(sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")),
    *(str(Path(__file__).parents[2]), "/usr/share/zoneinfo"),
)
"""Folders of code and time zones, which contain no private data."""

_COMMANDS = {
    "fcntl": (8, 10, 15),  # F_SETOWN, F_SETSIG, F_SETOWN_EX
    "ioctl": (0x5412, 0x8901, 0x8902),  # TIOCSTI, FIOSETOWN, SIOCSPGRP
}
"""By system call the second arguments that let the kernel signal, or type for, other processes."""
_CLONE3, _CLONE_THREAD = 435, 0x10000
_LOAD, _EQUAL, _AT_LEAST, _ANY_BIT, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x06
_ALLOW, _REFUSE, _KILL = 0x7FFF0000, 0x00050000, 0x80000000
_PERM, _NOSYS = 1, 38

_LIBC = ctypes.CDLL(None, use_errno=True)


def confine(parent: int, job: Job) -> None:
    """Confine this process, a child of `parent`, to a file and a folder; it cannot be undone.

    The process ends with its parent; if the machine runs out of memory, the kernel kills it first.
    """
    _call(_LIBC.prctl(_PDEATHSIG, signal.SIGKILL, 0, 0, 0))
    if os.getppid() != parent:
        os._exit(1)
    Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    limits = {
        resource.RLIMIT_AS: pages * resource.getpagesize() + job.budget.memory,
        resource.RLIMIT_FSIZE: job.budget.unfolded,
        resource.RLIMIT_CPU: int(10 * job.budget.seconds) + 1,
        resource.RLIMIT_CORE: 0,
    }
    for kind, limit in limits.items():
        hard = resource.getrlimit(kind)[1]
        both = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
        resource.setrlimit(kind, (both, both))
    _call(_LIBC.prctl(_NO_NEW_PRIVS, 1, 0, 0, 0))
    _close_files(os.fspath(job.budget.file), job.folder)
    _forbid_calls()


def _close_files(file: str, folder: str) -> None:
    """Let Landlock open no other files than these and the installed code."""
    version = _LIBC.syscall(_CREATE_RULESET, None, 0, _ASK_VERSION)
    if version < 1:
        return
    handled = (1 << _RIGHTS.get(version, 16)) - 1
    ports, beyond = 3 if version >= 4 else 0, 3 if version >= 6 else 0
    attributes = struct.pack("QQQ", handled, ports, beyond)
    rules = _call(_LIBC.syscall(_CREATE_RULESET, attributes, len(attributes), 0))
    allowed = dict.fromkeys(_READABLE, _READ)
    # For the folder: all rights of the first version, and truncating files.
    allowed |= {file: _READ_FILE, folder: (_EVERYTHING_HERE | 1 << 14) & handled}
    for place, rights in allowed.items():
        try:
            opened = os.open(place, os.O_PATH | os.O_CLOEXEC)
        except OSError:
            continue  # the reader reports the problem
        rule = struct.pack("=Qi", rights, opened)
        _call(_LIBC.syscall(_ADD_RULE, rules, _BENEATH, rule, 0))
        os.close(opened)
    _call(_LIBC.syscall(_RESTRICT_SELF, rules, 0))
    os.close(rules)


def _forbid_calls() -> None:
    """Let the kernel refuse system calls that no reader makes (seccomp)."""
    text = (files(__package__) / "system_calls.toml").read_text(encoding="utf-8")
    calls = tomllib.loads(text).get(platform.machine())
    if calls is None:
        return
    steps = [
        (_LOAD, 0, 0, 4), (_EQUAL, 1, 0, calls["audit"]), (_RETURN, 0, 0, _KILL),
        (_LOAD, 0, 0, 0),
        (_EQUAL, 0, 1, _CLONE3), (_RETURN, 0, 0, _REFUSE | _NOSYS),  # then libc takes clone
        (_EQUAL, 0, 4, calls["clone"]),
        (_LOAD, 0, 0, 16), (_ANY_BIT, 1, 0, _CLONE_THREAD), (_RETURN, 0, 0, _REFUSE | _PERM),
        (_RETURN, 0, 0, _ALLOW),
        (_AT_LEAST, 0, 1, 0x40000000), (_RETURN, 0, 0, _KILL),  # numbers of 32-bit programs
        (_EQUAL, 0, 4, calls["prlimit"]),  # of the process itself, which is 0
        (_LOAD, 0, 0, 16), (_EQUAL, 1, 0, 0), (_RETURN, 0, 0, _REFUSE | _PERM),
        (_RETURN, 0, 0, _ALLOW),
    ]  # fmt: skip
    for name, commands in _COMMANDS.items():
        steps += [(_EQUAL, 0, 2 + 2 * len(commands), calls[name]), (_LOAD, 0, 0, 24)]
        for command in commands:
            steps += [(_EQUAL, 0, 1, command), (_RETURN, 0, 0, _REFUSE | _PERM)]
        steps.append((_RETURN, 0, 0, _ALLOW))
    for kind, answer in (("forbidden", _REFUSE | _PERM), ("passed_by", _REFUSE)):
        for number in calls[kind].values():
            steps += [(_EQUAL, 0, 1, number), (_RETURN, 0, 0, answer)]
    steps.append((_RETURN, 0, 0, _ALLOW))
    program = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *step) for step in steps))
    filters = struct.pack("HxxxxxxP", len(steps), ctypes.addressof(program))
    _call(_LIBC.prctl(_SECCOMP, _FILTER, filters, 0, 0))


def _call(result: int) -> int:
    if result < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return result
