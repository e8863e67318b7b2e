"""A folder of files below a data root: the few operations that the rest of the program needs.

Files are written whole, once: no locks, no directories. `fleet_slip.storage.local` is one of a file
system, `fleet_slip.storage.objects` one of an object store.
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
"""Beginning of the name of a file that is not whole yet."""

SPILL_PREFIX = ".spill-"
"""Beginning of the name of a folder for the rows of a query that exceed its memory."""

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
        return str(self).rpartition("/")[2]

    @property
    def uri(self) -> str:
        """The folder as DuckDB and the Delta library know it."""
        return str(self)

    @property
    def delta_options(self) -> dict[str, str] | None:
        """Options of the Delta library for tables below this folder."""
        return None

    @property
    def spill(self) -> Path:
        """A folder of this machine for what a query cannot hold in memory."""
        return Path(tempfile.gettempdir())

    is_local: bool = False
    """Whether its files are in a file system of this machine: read twice, they are the same."""

    def __truediv__(self, name: str) -> Self:
        """Return a folder below this one."""

    def exists(self) -> bool:
        """Whether there is such a folder."""

    def names(self) -> list[str]:
        """Return the names of files and folders directly below, sorted."""

    def files(self) -> list[StoredFile]:
        """Return all files below, at any depth, sorted by path."""

    def stamp(self, path: str) -> object:
        """Return what another file in its place differs in; None without one, and of a store."""
        return None  # where to look costs what opening costs

    def read(self, path: str) -> bytes:
        """Return the content of a file."""

    def read_many(self, paths: Sequence[str]) -> list[bytes | None]:
        """Return the content of files; None for one that is gone, nothing of a link."""

    def check(self, path: str) -> None:
        """Raise `StorageError` for a changed data file, if `open` would not."""
        return

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
        return

    def free_bytes(self) -> tuple[int, int] | None:
        """Return how much is free and how much there is in all; None where that has no meaning."""
        return None

    def exclusive(self, name: str, waiting: Callable[[], None]) -> AbstractContextManager[None]:
        """Hold a lock among the processes of this machine, where a killed one releases it."""
        return nullcontext()

    def let_read(self, database: "duckdb.DuckDBPyConnection") -> None:
        """Enable a connection to read files below this folder."""
        return
