"""Checksums in the names of data files, and their verification.

    NAME-x0123456789abcdef-0123456789abcdef0123456789abcdef.parquet

The last is the SHA-256, which `verify` computes. The one after the x is the XXH3, so fast that
every job checks every byte.
"""

import functools
import hashlib
import os
import re
import stat
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import xxhash

from fleet_slip.errors import StorageError
from fleet_slip.storage.storage_errors import storage_errors

if TYPE_CHECKING:
    import pyarrow as pa

CHECKSUM_DIGITS = 32
"""Hexadecimal digits of a file's SHA-256 in its name: damage passes unseen once in 2^128 times."""

FAST_DIGITS = 16
"""Hexadecimal digits of a file's XXH3: damage passes unseen once in 2^64 times."""

CHUNK_BYTES = 2**20

MAX_CACHED_FILES = 2**17

_CHECKSUM = re.compile(rf"-([0-9a-f]{{{CHECKSUM_DIGITS}}})\.parquet$")

_FAST = re.compile(rf"-x([0-9a-f]{{{FAST_DIGITS}}})-[0-9a-f]{{{CHECKSUM_DIGITS}}}\.parquet$")


def checksum_of(content: "pa.Buffer | bytes") -> str:
    """Return the checksum of a content for the end of the file's name."""
    return hashlib.sha256(content).hexdigest()[:CHECKSUM_DIGITS]


def fast_checksum_of(content: "pa.Buffer | bytes") -> str:
    """Return the fast checksum of a content for the file's name."""
    return xxhash.xxh3_64_hexdigest(memoryview(content))


def checksum_in(path: str) -> str | None:
    """Return the checksum in a data file's name; None for other names."""
    match = _CHECKSUM.search(path)
    return match[1] if match else None


def require_content(path: str, content: "pa.Buffer | bytes", where: object) -> None:
    """Raise `StorageError` if a content does not match the checksum in the name."""
    _require(path, (content,), where)


def check_local_files(paths: Iterable[str]) -> None:
    """Raise `StorageError` for a data file that does not match its name. Reads each once."""
    named = [path for path in paths if _FAST.search(path)]
    if len(named) == 1:
        _check_local(named[0])
    elif named:
        with ThreadPoolExecutor(os.cpu_count() or 1) as executor:
            list(executor.map(_check_local, named))


def missing_file_error(path: str) -> StorageError:
    """Return the error of a data file that disappeared after its table was opened."""
    return StorageError(
        f"{path} is gone. If forget --now or compact deleted it meanwhile, run the same command "
        "again; otherwise restore it from a backup."
    )


def _check_local(path: str) -> None:
    with storage_errors(path):
        try:
            status = Path(path).stat()
        except FileNotFoundError:
            raise missing_file_error(path) from None
    if not stat.S_ISREG(status.st_mode):  # opening a pipe would wait for a writer
        raise StorageError(f"{path}: not a regular file. Restore it from a backup.")
    _check_once(path, status.st_size, status.st_mtime_ns, status.st_ino)


@functools.lru_cache(maxsize=MAX_CACHED_FILES)
def _check_once(path: str, _size: int, _modified_ns: int, _inode: int) -> None:
    with storage_errors(path), Path(path).open("rb", buffering=0) as file:
        buffer = memoryview(bytearray(CHUNK_BYTES))
        _require(path, iter(lambda: buffer[: file.readinto(buffer) or 0], b""), path)


def _require(path: str, chunks: "Iterable[Any]", where: object) -> None:
    hashed, named = xxhash.xxh3_64(), _FAST.search(path)
    if named is None:  # not a data file
        return
    for chunk in chunks:
        hashed.update(chunk)
    if hashed.hexdigest() != named[1]:
        raise StorageError(
            f"{where}: its bytes do not match the checksum in its name: it was damaged. See what "
            "can be repaired with: fleet-slip verify --repair; or restore it from a backup."
        )
