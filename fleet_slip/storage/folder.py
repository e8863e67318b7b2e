"""The protocol of folders below a data root.

Files are written whole: no directories, no partial writes. `fleet_slip.storage.local` implements it
for file systems, `fleet_slip.storage.objects` for object stores.
"""

import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, Self, TypeAlias

if TYPE_CHECKING:
    import duckdb
    import pyarrow as pa


TEMPORARY_PREFIX = ".tmp-"
"""Prefix of an unfinished file."""

SPILL_PREFIX = ".spill-"
"""Prefix of a folder for the rows of a query that exceed its memory."""

Content: TypeAlias = "bytes | pa.Buffer"


@dataclass(frozen=True)
class StoredFile:
    """A listed file of `folder`. A file that replaces it has another `identity`."""

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
    """A folder below a data root; it need not exist. `str` returns its path.

    All methods raise `StorageError`. `path` is relative to the folder, with slashes.
    """

    @property
    def name(self) -> str:
        """The last part of the folder's path."""
        return str(self).rpartition("/")[2]

    @property
    def uri(self) -> str:
        """Location of the folder for DuckDB and the Delta library."""
        return str(self)

    @property
    def delta_options(self) -> dict[str, str] | None:
        """Options of the Delta library for tables below this folder."""
        return None

    @property
    def spill(self) -> Path:
        """A local folder for rows of queries that exceed the memory."""
        return Path(tempfile.gettempdir())

    is_local: bool = False
    """True for a file system of this machine."""

    def __truediv__(self, name: str) -> Self:
        """Return a folder below this one."""

    def exists(self) -> bool:
        """Return True if the folder exists."""

    def names(self) -> list[str]:
        """Return the names of files and folders directly below, sorted."""

    def files(self) -> list[StoredFile]:
        """Return all files below, at any depth, sorted by path."""

    def stamp(self, path: str) -> object:
        """Return a value that changes when the file is replaced; None without a file or support."""
        return None

    def read(self, path: str) -> bytes:
        """Return the content of a file."""

    def read_many(self, paths: Sequence[str]) -> list[bytes | None]:
        """Return the contents of files: None for a missing file, empty for a link."""

    def check(self, path: str) -> None:
        """Raise `StorageError` for a damaged data file, unless `open` does."""
        return

    def open(self, path: str) -> "pa.NativeFile":
        """Open a file for reading anywhere in it."""

    def put(self, path: str, content: Content) -> None:
        """Write a file atomically and durably; replace an existing one."""

    def create(self, path: str, content: Content) -> bool:
        """Write a new file atomically and durably; return False if it exists."""

    def append(self, path: str, content: bytes) -> None:
        """Append durably in one write. An object store writes an object with this prefix."""

    def remove(self, file: StoredFile) -> bool:
        """Delete exactly the listed file; return False if it is gone or was replaced."""

    def delete(self, path: str) -> None:
        """Delete a file that no other process writes; do nothing if it is gone."""

    def settle_commits(self, before: int | None) -> None:
        """Make the commits after a version durable, if the folder is a Delta table."""
        return

    def free_bytes(self) -> tuple[int, int] | None:
        """Return free and total bytes; None for an object store."""
        return None

    def exclusive(self, name: str, waiting: Callable[[], None]) -> AbstractContextManager[None]:
        """Hold a lock among the processes of this machine; a killed process releases it."""
        return nullcontext()

    def enable_reading(self, database: "duckdb.DuckDBPyConnection") -> None:
        """Prepare a DuckDB connection for files below this folder."""
        return
