"""The protocol of folders below a data root, and their errors.

Files are written whole: no directories, no partial writes. `fleet_slip.storage.local` implements it
for file systems, `fleet_slip.storage.objects` for object stores.
"""

import contextlib
import errno
import re
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, Self, TypeAlias

from fleet_slip.errors import FleetSlipError, StorageError

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


# Failures of files, object stores, Delta and Parquet become `StorageError`.

_VARIABLES = (
    "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, "
    "GOOGLE_APPLICATION_CREDENTIALS, or AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY"
)

_STORE_ERRORS = {
    r"169\.254\.169\.254|metadata\.google|Account must be specified|no providers in chain": (
        f"there are no credentials. Set {_VARIABLES}."
    ),
    r"NoSuchBucket|ContainerNotFound|[Tt]he specified bucket does not exist": (
        "there is no such bucket. Make it, or choose another data root."
    ),
    r"InvalidAccessKeyId|SignatureDoesNotMatch|ExpiredToken|AuthenticationFailed|"
    r"RequestTimeTooSkewed|401 Unauthorized": (
        f"the store refuses the credentials. Check {_VARIABLES}, and the clock."
    ),
    r"AccessDenied|AuthorizationPermissionMismatch|403 Forbidden": (
        "the credentials do not permit this. Reading needs the right to get and list objects, "
        "writing to put them, and compact and forget to delete them."
    ),
    r"scheme is not allowed|BadScheme": (
        "the endpoint is http, not https. Where that is meant: export AWS_ALLOW_HTTP=true"
    ),
    r"501 Not Implemented|NotImplemented": (
        "the store does not know conditional writes (If-None-Match). Use a store that does."
    ),
    r"(?:429|50[0-9]) [A-Z]|SlowDown|InternalError": (
        "the store answers with errors, after several attempts. Run the same command again."
    ),
    r"timed out|TimedOut": (
        "the store does not answer in time. Check the network, and run the same command again."
    ),
    r"dns error|error sending request|[Cc]onnection|HTTP error": (
        "the store cannot be reached. Check the network and the endpoint (AWS_ENDPOINT_URL)."
    ),
    r"NoSuchKey|404 Not Found|not found": "there is no such object.",
}
"""Meanings of answers by pattern; the first that matches counts."""

_FILE_ERRORS = {
    errno.ENOSPC: "the disk is full. Free some space and run the same command again.",
    errno.EDQUOT: "the disk quota is used up. Free some space and run the command again.",
    errno.EACCES: "permission denied. Check the owner of the folder, or choose another.",
    errno.EROFS: "the file system is read-only. Choose a writable folder.",
    errno.EISDIR: "a folder, not a file. Name a file.",
    **dict.fromkeys(
        (errno.EEXIST, errno.ENOTDIR, errno.ELOOP, errno.ENAMETOOLONG),
        "the path is too long, or has a file or a broken link in it. Choose another path.",
    ),
    errno.EMFILE: "this process may have no more files open. Raise the limit: ulimit -n 1024",
    errno.EIO: "the disk cannot be read or written (I/O error). Have it examined, then restore "
    "what is damaged from a backup: fleet-slip verify",
}


class NoSuchObjectError(StorageError):
    """An object does not exist."""


def store_error(error: BaseException) -> str:
    """Return the meaning of a failure of an object store, without its text, which has secrets."""
    unknown = f"the store cannot be used ({type(error).__name__}). Run the same command again."
    meanings = (text for pattern, text in _STORE_ERRORS.items() if re.search(pattern, str(error)))
    return next(meanings, unknown)


@contextlib.contextmanager
def object_errors(where: str) -> Iterator[None]:
    """Translate the failures of an object store to `StorageError`."""
    from obstore.exceptions import BaseError

    try:
        yield
    except FileNotFoundError as error:
        raise NoSuchObjectError(f"{where}: {store_error(error)}") from None
    except (BaseError, OSError, ValueError) as error:
        raise StorageError(f"{where}: {store_error(error)}") from None


@contextlib.contextmanager
def storage_errors(path: object) -> Iterator[None]:
    """Translate failures of files, object stores, Delta and Parquet; `path` begins the message."""
    try:
        yield
    except FleetSlipError:
        raise
    except Exception as error:
        reason = _reason(error, is_store="://" in str(path))
        if reason is None:
            raise
        raise StorageError(f"{path}: {reason}") from None


def _reason(error: Exception, *, is_store: bool) -> str | None:
    """Return the reason of a failure of a file or library; None of any other."""
    import pyarrow as pa
    from deltalake.exceptions import DeltaError

    if isinstance(error, OSError | DeltaError) and is_store:
        return store_error(error)
    if isinstance(error, OSError):
        # The Delta library has the number in its message only.
        stated = re.search(r"\(os error (\d+)\)", str(error))
        number = error.errno or (int(stated[1]) if stated else 0)
        return _FILE_ERRORS.get(number) or " ".join(str(error).split())
    if isinstance(error, DeltaError):
        return f"the Delta log cannot be used: {first_line(error)}"
    if isinstance(error, pa.ArrowException):
        return f"not readable as Parquet: {first_line(error)}"
    return None


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message."""
    return str(error).strip().partition("\n")[0]
