"""Whether this machine, a data root and a cluster are fit for the work."""

import contextlib
import os
import re
import resource
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, metadata, version
from typing import Any

from fleet_slip.errors import FleetSlipError, StorageError
from fleet_slip.files.folder import TEMPORARY_PREFIX, Folder
from fleet_slip.limits import OPEN_FILES, memory_bytes
from fleet_slip.words import number_of

MEMORY_BYTES = 2**30
"""The largest command that was measured, `verify` of files of a million rows, takes 828 MiB."""
FILES_WISHED = 1024
NAME = re.compile(r"[\w.-]+")
"""Of a package, with which a requirement begins."""
DISK_BYTES = 10**9
CLOCK_S = 60.0
"""A clock that is so far from the store's makes files younger or older than they are."""


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at: what was found, and what to do if it is not fit."""

    subject: str
    found: str
    advice: str = ""

    @property
    def fit(self) -> bool:
        """Whether nothing has to be done."""
        return not self.advice


@dataclass(frozen=True)
class Fitness:
    """All that was looked at."""

    examined: tuple[Finding, ...]

    @property
    def problems(self) -> tuple[str, ...]:
        """What is not fit, with what to do about it."""
        return tuple(f"{one.subject}: {one.advice}" for one in self.examined if not one.fit)

    def as_dict(self) -> dict[str, Any]:
        """Return what `doctor --json` prints."""
        return {"examined": [{**vars(one), "fit": one.fit} for one in self.examined]}


def examine_fitness(root: Folder, count_workers: Callable[[], int] | None = None) -> Fitness:
    """Look at the machine, at the data root and, where one is asked for, at a cluster.

    A probe of a few bytes is written to the root and deleted again. What fails is a finding;
    nothing is raised.
    """
    found = [*_machine(), _compiled_code(), *_root(root)]
    if count_workers is not None:
        found.append(_cluster(count_workers))
    return Fitness((*found, *_extras()))


def _machine() -> Iterator[Finding]:
    yield Finding("Python", ".".join(map(str, sys.version_info[:3])))
    yield Finding("processors", str(len(os.sched_getaffinity(0))))
    memory = memory_bytes()
    yield Finding(
        "memory",
        f"{memory / 2**30:.1f} GiB",
        "" if memory >= MEMORY_BYTES else "give the process 1 GiB, which large commands take.",
    )
    files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    few = files != resource.RLIM_INFINITY and files < FILES_WISHED
    yield Finding(
        "open files",
        f"{files:,}" if files != resource.RLIM_INFINITY else "no limit",
        f"{OPEN_FILES} are needed; raise the limit: ulimit -n {FILES_WISHED}" if few else "",
    )


def _compiled_code() -> Finding:
    subject = "folder of compiled code"
    try:
        from fleet_slip.kept_code import find_folder  # noqa: PLC0415 - of the extra
    except ModuleNotFoundError:
        return Finding(subject, "nothing is compiled: the extra `compiled` is not installed")
    folder = find_folder()
    if folder is None:
        return Finding(
            subject,
            "none",
            "every process compiles anew, for seconds. Set NUMBA_CACHE_DIR to a folder that this "
            "user alone can write.",
        )
    return Finding(subject, folder)


def _root(root: Folder) -> Iterator[Finding]:
    subject = f"data root {root}"
    try:
        skew = _probe(root)
    except FleetSlipError as error:
        yield Finding(subject, "not usable", str(error))
        return
    yield Finding(subject, "files can be made once, read, listed and deleted")
    yield Finding(
        "clock",
        f"{abs(skew):.0f} s from that of the data root",
        "" if abs(skew) <= CLOCK_S else "set the clock of this machine, or of the store.",
    )
    disk = root.free_bytes()
    if disk is not None:
        free, size = disk
        yield Finding(
            "disk",
            f"{free / 1e9:,.1f} of {size / 1e9:,.1f} GB are free",
            "" if free >= DISK_BYTES else "make room: a full disk stops every job.",
        )


def _probe(root: Folder) -> float:
    """Do what jobs do; return how far this machine's clock is before the root's, s."""
    path, content = f"{TEMPORARY_PREFIX}doctor-{uuid.uuid4().hex}", os.urandom(64)
    began = time.time()
    try:
        if not root.create(path, content) or root.create(path, b"other"):
            raise StorageError("it does not keep a file from being made twice: commits get lost.")
        if root.read(path) != content:
            raise StorageError("what was written is not what is read.")
        mine = [file for file in root.files() if file.path == path]
        if not mine:
            raise StorageError("a file that was written is not listed.")
    finally:
        with contextlib.suppress(FleetSlipError):
            root.delete(path)
    return began - mine[0].modified_ns / 1e9


def _cluster(count_workers: Callable[[], int]) -> Finding:
    try:
        workers = count_workers()
    except FleetSlipError as error:
        return Finding("cluster", "not usable", str(error))
    none = "start workers: docs/cluster.md"
    return Finding(
        "cluster", f"{number_of(workers, 'worker')}, of this version", "" if workers else none
    )


def _extras() -> Iterator[Finding]:
    """Yield which optional parts are installed; that one is missing is no problem."""
    about = metadata("fleet-slip")
    for extra in about.get_all("Provides-Extra") or ():
        packages = [
            NAME.match(line)[0]  # type: ignore[index]
            for line in about.get_all("Requires-Dist") or ()
            if f"extra == '{extra}'" in line
        ]
        absent = [name for name in packages if not _is_installed(name)]
        found = "installed" if not absent else f"not installed: {', '.join(absent)}"
        yield Finding(f"extra {extra}", found)


def _is_installed(package: str) -> bool:
    try:
        version(package)
    except PackageNotFoundError:
        return False
    return True
