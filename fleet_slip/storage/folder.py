"""A folder of files below a data root: the few operations that the rest of the program needs.

Files are written whole, once: no locks, no directories. `fleet_slip.files.local_folder` is one of a
file system, `fleet_slip.files.object_folder` one of an object store.
"""

import functools
import hashlib
import os
import re
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Self, TypeAlias

import pyarrow as pa
import xxhash

from fleet_slip.errors import StorageError

if TYPE_CHECKING:
    import duckdb
from fleet_slip.storage.storage_errors import storage_errors

TEMPORARY_PREFIX = ".tmp-"
"""Beginning of the name of a file that is not whole yet."""

Content: TypeAlias = "bytes | pa.Buffer"


@dataclass(frozen=True)
class StoredFile:
    """A file as a listing of `folder` found it; another in its place has another `identity`."""

    folder: "Folder"
    path: str
    size_bytes: int
    modified_ns: int
    identity: str

    def __str__(self) -> str:
        return f"{self.folder}/{self.path}"

    @property
    def name(self) -> str:
        """The last part of the path."""
        return self.path.rpartition("/")[2]

    @property
    def age_hours(self) -> float:
        """Hours since it was written."""
        return (time.time_ns() - self.modified_ns) / 3.6e12


class Folder(Protocol):
    """A folder below a data root; it need not exist. As text it is its path.

    It is a value, and touches nothing by itself. All methods raise `StorageError`. `path` is a
    file's below the folder, with slashes.
    """

    @property
    def name(self) -> str:
        """The last part of the folder's path."""

    @property
    def uri(self) -> str:
        """The folder as DuckDB and the Delta library know it."""

    @property
    def delta_options(self) -> dict[str, str] | None:
        """Options of the Delta library for tables below this folder."""

    @property
    def spill(self) -> Path:
        """A folder of this machine for what a query cannot hold in memory."""

    @property
    def is_local(self) -> bool:
        """Whether its files are in a file system of this machine: read twice, they are the same."""

    def __truediv__(self, name: str) -> Self:
        """Return a folder below this one."""

    def exists(self) -> bool:
        """Whether there is such a folder."""

    def names(self) -> list[str]:
        """Return the names of files and folders directly below, sorted."""

    def files(self) -> list[StoredFile]:
        """Return all files below, at any depth, sorted by path."""

    def read(self, path: str, longest: int | None = None) -> bytes:
        """Return the content of a file, or only its first bytes."""

    def read_many(self, paths: Sequence[str]) -> list[bytes | None]:
        """Return the content of files; None for one that is gone, nothing of a link."""

    def check(self, path: str) -> None:
        """Raise `StorageError` for a changed data file, if `open` would not."""

    def open(self, path: str) -> "pa.NativeFile":
        """Open a file for reading anywhere in it."""

    def put(self, path: str, content: Content) -> None:
        """Write a file as a whole, durably. A file of that name is replaced."""

    def create(self, path: str, content: Content) -> bool:
        """Write a file as a whole, durably; False, and no change, if there is one of that name."""

    def append(self, path: str, content: bytes) -> None:
        """Add to a history in one write, durably. Its parts are files whose names begin so."""

    def remove(self, file: StoredFile) -> bool:
        """Delete the very file that a listing found; False if it is gone or was replaced."""

    def delete(self, path: str) -> None:
        """Delete a file of a name that no other process writes; nothing if it is gone."""

    def settle_commits(self, before: int | None) -> None:
        """Make the commits after a version durable, if the folder is a Delta table."""

    def free_bytes(self) -> tuple[int, int] | None:
        """Return how much is free and how much there is in all; None where that has no meaning."""

    def exclusive(self, name: str, waiting: Callable[[], None]) -> AbstractContextManager[None]:
        """Hold a lock among the processes of this machine, where the folder can have one."""

    def let_read(self, database: "duckdb.DuckDBPyConnection") -> None:
        """Enable a connection to read files below this folder."""


# Checksums in the names of data files, and whether a file is still what its name says.
#
#     NAME-x0123456789abcdef-0123456789abcdef0123456789abcdef.parquet
#
# The last is of its SHA-256, which `verify` computes; that with an x of its XXH3, so fast that
# every job looks at every byte. Earlier names have the last only, or none.

CHECKSUM_DIGITS = 32
"""Hexadecimal digits of a file's SHA-256 in its name: damage passes unseen once in 2^128 times."""

FAST_DIGITS = 16
"""Hexadecimal digits of a file's XXH3: damage passes unseen once in 2^64 times."""

CHUNK_BYTES = 2**20
REMEMBERED_FILES = 2**17

_CHECKSUM = re.compile(rf"-([0-9a-f]{{{CHECKSUM_DIGITS}}})\.parquet$")
_FAST = re.compile(rf"-x([0-9a-f]{{{FAST_DIGITS}}})-[0-9a-f]{{{CHECKSUM_DIGITS}}}\.parquet$")


class _Hash(Protocol):
    def update(self, data: Any, /) -> None: ...
    def hexdigest(self) -> str: ...


def checksum_of(content: "pa.Buffer | bytes") -> str:
    """Return the checksum of a file's bytes as it stands at the end of the file's name."""
    return hashlib.sha256(content).hexdigest()[:CHECKSUM_DIGITS]


def fast_checksum_of(content: "pa.Buffer | bytes") -> str:
    """Return the fast checksum of a file's bytes as it stands in the file's name."""
    return xxhash.xxh3_64_hexdigest(memoryview(content))


def checksum_in(path: str) -> str | None:
    """Return the checksum in a file's name; None for a file of a version that wrote none."""
    found = _CHECKSUM.search(path)
    return found[1] if found else None


def require_content(path: str, content: "pa.Buffer | bytes", where: object) -> None:
    """Raise `StorageError` if bytes are not those that the name of their file tells."""
    _require(path, (content,), where)


def check_local_files(paths: Iterable[str]) -> None:
    """Raise `StorageError` for a file that is not what its name says; each is read once."""
    named = [path for path in paths if checksum_in(path)]
    if len(named) == 1:
        _check_local(named[0])
    elif named:
        with ThreadPoolExecutor(os.cpu_count() or 1) as executor:
            list(executor.map(_check_local, named))


def _check_local(path: str) -> None:
    with storage_errors(path):
        status = Path(path).stat()
    _check_once(path, status.st_size, status.st_mtime_ns, status.st_ino)


@functools.lru_cache(maxsize=REMEMBERED_FILES)
def _check_once(path: str, _size: int, _modified_ns: int, _inode: int) -> None:
    with storage_errors(path), Path(path).open("rb", buffering=0) as file:
        buffer = memoryview(bytearray(CHUNK_BYTES))
        _require(path, iter(lambda: buffer[: file.readinto(buffer) or 0], b""), path)


def _require(path: str, chunks: "Iterable[Any]", where: object) -> None:
    fast = _FAST.search(path)
    expected = fast[1] if fast else checksum_in(path)
    if expected is None:
        return
    hashed: _Hash = xxhash.xxh3_64() if fast else hashlib.sha256()
    for chunk in chunks:
        hashed.update(chunk)
    if hashed.hexdigest()[: len(expected)] != expected:
        raise StorageError(
            f"{where}: its bytes do not match the checksum in its name: it was damaged. See what "
            "can be repaired with: fleet-slip verify --repair; or restore it from a backup."
        )
