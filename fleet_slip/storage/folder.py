"""A folder of files below a data root: the few operations that the rest of the program needs.

Files are written whole, once: no locks, no directories. `fleet_slip.files.local_folder` is one of a
file system, `fleet_slip.files.object_folder` one of an object store.
"""

import contextlib
import errno
import functools
import hashlib
import os
import re
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Self, TypeAlias

import pyarrow as pa
import xxhash
from deltalake.exceptions import DeltaError

from fleet_slip.errors import StorageError

if TYPE_CHECKING:
    import duckdb

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


# Turns what fails below a data root into `StorageError`, with the next thing to do.
#
# Of the libraries' text, which has the server's whole answer and names of keys, none is shown.

_CREDENTIALS = (
    "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY or AWS_PROFILE, "
    "GOOGLE_APPLICATION_CREDENTIALS, or AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY"
)

_TIMEOUT = r"timed out|TimedOut|kind: Timeout"

_MEANINGS: tuple[tuple[str, str], ...] = (
    (
        r"169\.254\.169\.254|computeMetadata|metadata\.google|Account must be specified|"
        r"CredentialsNotLoaded|no providers in chain|no credentials found in chain",
        f"there are no credentials. Set {_CREDENTIALS}.",
    ),
    (
        r"NoSuchBucket|ContainerNotFound|[Tt]he specified bucket does not exist",
        "there is no such bucket. Make it, or choose another data root.",
    ),
    (
        r"InvalidAccessKeyId|SignatureDoesNotMatch|ExpiredToken|InvalidToken|InvalidSecurity|"
        r"AuthenticationFailed|RequestTimeTooSkewed|InvalidClientTokenId|401 Unauthorized",
        f"the store refuses the credentials. Check {_CREDENTIALS}, and the clock.",
    ),
    (
        r"AccessDenied|AuthorizationFailure|AuthorizationPermissionMismatch|403 Forbidden",
        "the credentials do not permit this. Reading needs the right to get and list objects, "
        "writing to put them, and compact and forget to delete them.",
    ),
    (
        r"scheme is not allowed|BadScheme",
        "the endpoint is http, not https. Where that is meant: export AWS_ALLOW_HTTP=true",
    ),
    (
        r"501 Not Implemented|NotImplemented",
        "the store does not know conditional writes (If-None-Match), without which several "
        "writers are not safe. Use a store that does.",
    ),
    (
        r"(?:429|50[0-9]) [A-Z]|SlowDown|InternalError",
        "the store answers with errors, after several attempts. Run the same command again.",
    ),
    (
        r"InvalidPath",
        "the name of an object there is no path: a part of it is empty, `.` or `..`. Rename it.",
    ),
    (
        _TIMEOUT,
        "the store does not answer in time, after several attempts. Check the network, and run "
        "the same command again.",
    ),
    (
        r"dns error|error sending request|[Cc]onnection|connect error|HTTP error",
        "the store cannot be reached. Check the network and the endpoint (AWS_ENDPOINT_URL).",
    ),
    (r"NoSuchKey|BlobNotFound|404 Not Found|not found", "there is no such object."),
)

_COLOUR = re.compile(r"\x1b\[[0-9;]*m")


def known_meaning(error: BaseException) -> str | None:
    """Return what a failure of an object store means, in one line; None if it is not known."""
    text = str(error)
    return next((meaning for pattern, meaning in _MEANINGS if re.search(pattern, text)), None)


def is_timeout(error: BaseException) -> bool:
    """Whether a request was given up because an answer did not come in time."""
    return re.search(_TIMEOUT, str(error)) is not None


def meaning_of(error: BaseException) -> str:
    """Return what a failure of an object store means, in one line."""
    unknown = f"the store cannot be used ({type(error).__name__}). Run the same command again."
    return known_meaning(error) or unknown


class NoSuchObjectError(StorageError):
    """An object is not there, or is gone."""


@contextlib.contextmanager
def object_errors(where: str) -> Iterator[None]:
    """Turn the failures of an object store into `StorageError`."""
    from obstore.exceptions import BaseError  # noqa: PLC0415 - the library is optional

    try:
        yield
    except FileNotFoundError as error:
        raise NoSuchObjectError(f"{where}: {meaning_of(error)}") from None
    except (BaseError, OSError, ValueError) as error:
        raise StorageError(f"{where}: {meaning_of(error)}") from None


@contextlib.contextmanager
def storage_errors(path: object) -> Iterator[None]:
    """Turn failures of files, object stores and Delta into `StorageError`; `path` says where."""
    try:
        yield
    except OSError as error:
        reason = meaning_of(error) if "://" in str(path) else _reason(error)
        raise StorageError(f"{path}: {reason}") from None
    except DeltaError as error:
        known = known_meaning(error) if "://" in str(path) else None
        reason = known or f"the Delta log cannot be used: {first_line(error)}"
        raise StorageError(f"{path}: {reason}") from None
    except pa.ArrowException as error:
        raise StorageError(f"{path}: not readable as Parquet: {first_line(error)}") from None


def _reason(error: OSError) -> str:
    advice = {
        errno.ENOSPC: "the disk is full. Free some space and run the same command again.",
        errno.EDQUOT: "the disk quota is used up. Free some space and run the command again.",
        errno.EACCES: "permission denied. Check the owner of the data root, or choose another.",
        errno.EPERM: "not permitted. Check the owner of the data root, or choose another.",
        errno.EROFS: "the file system is read-only. Choose a writable data root.",
        errno.ENOTDIR: "a part of the path is a file, not a folder. Choose another data root.",
        errno.EMFILE: "this process may have no more files open. Raise the limit: ulimit -n 1024",
        errno.EEXIST: "a file, or a link to nothing, is where a folder must be. Choose another "
        "data root.",
        errno.ELOOP: "the path is a loop of links. Choose another data root.",
        errno.ENAMETOOLONG: "the path is too long. Choose another data root.",
        errno.EIO: "the disk cannot be read or written (I/O error). Have it examined, then restore "
        "what is damaged from a backup: fleet-slip verify",
    }
    # The Delta library tells the number in its text only.
    stated = re.search(r"\(os error (\d+)\)", str(error))
    number = error.errno or (int(stated[1]) if stated else 0)
    return advice.get(number, _on_one_line(error))


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message."""
    return str(error).strip().partition("\n")[0]


def _on_one_line(error: BaseException) -> str:
    text = _COLOUR.sub("", str(error)).replace("\N{DOWNWARDS ARROW WITH TIP RIGHTWARDS}", ":")
    return " ".join(text.split()).replace(" : ", ": ")


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
