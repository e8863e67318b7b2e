"""What a worker of a cluster does with a task: it makes sure of its ground, then works.

It must have the sender's versions, before it unpickles, and see the file that the command just made
in the data root.
"""

import os
import pickle
import platform
import socket
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from importlib.metadata import PackageNotFoundError, version
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from fleet_slip.errors import FleetSlipError, RefusedError, StorageError
from fleet_slip.resources import folder, own_configs
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
"""Packages whose versions must be the same on coordinator, scheduler and workers."""

SOURCES = "files of fleet-slip"

SHIPPED = (".py", ".sql", ".toml")


@dataclass(frozen=True)
class Marker:
    """A file by which a worker knows that it sees the data root that the command sees."""

    folder: Folder
    name: str

    def require_seen(self, where: str) -> None:
        """Raise `StorageError` if the file is not there."""
        try:
            self.folder.read(self.name)
        except StorageError as error:
            raise StorageError(
                f"{where} does not see the data root of this command ({error}). Use a file system "
                "that all machines share, mounted at the same path, or an object store that all "
                "may use."
            ) from None


def pickled(marker: Marker, function: Callable[[Any], Any], item: Any) -> bytes:
    """Return a marker, a function of this package and its argument, as `work` takes them."""
    return pickle.dumps((marker, function, item), protocol=5)


def work(expected: Mapping[str, str], task: bytes) -> Any:
    """Do a task and return its result; expected errors get the worker's name.

    Raises `RefusedError` for other versions, `StorageError` where the marker is not seen.
    """
    here = f"worker {socket.gethostname()}:{os.getpid()}"
    require_same(here, expected, environment())
    marker, function, item = pickle.loads(task)  # noqa: S301 - from the scheduler, which is trusted
    marker.require_seen(here)
    try:
        return function(item)
    except FleetSlipError as error:
        raise type(error)(f"{error} [{here}]") from None


def require_same(where: str, expected: Mapping[str, str], found: Mapping[str, str]) -> None:
    """Raise `RefusedError` if versions differ, telling which."""
    different = [
        f"{name} {found.get(name, 'none')} instead of {wanted}"
        for name, wanted in expected.items()
        if found.get(name) != wanted
    ]
    if different:
        raise RefusedError(
            f"{where} has {', '.join(different)}. Results would not be the same everywhere: "
            "install one set of versions (pip install --constraint constraints.txt), or start all "
            "from one container image."
        )


@cache
def environment() -> dict[str, str]:
    """Return what the result of a task may depend on: versions, and the sources' checksum."""
    return {**versions(), SOURCES: _sources_digest()}


def versions() -> dict[str, str]:
    """Return the versions of Python and of `PACKAGES`."""
    return {"python": platform.python_version(), **{name: _version(name) for name in PACKAGES}}


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "none"


def _sources_digest() -> str:
    """Return a checksum of programs, statements and configs: a checkout may have been edited."""
    digest = sha256()
    package: Traversable = Path(__file__).parent.parent
    own = own_configs()
    shipped = (folder("configs"), folder("jobs"), folder("warehouse"))
    for entry in (package, *shipped, *([own] if own else [])):
        for file in _shipped(entry):
            digest.update(f"{file.name}\n".encode())
            digest.update(file.read_bytes())
    return digest.hexdigest()[:12]


def _shipped(entry: Traversable) -> Iterator[Traversable]:
    if entry.is_dir():
        for inner in sorted(entry.iterdir(), key=lambda inner: inner.name):
            if inner.name != "_data":  # configs, jobs and warehouse of a wheel, which come after
                yield from _shipped(inner)
    elif entry.name.endswith(SHIPPED):
        yield entry
