"""Folders of a file system: atomic, durable writes.

Files are flushed under a temporary name, then renamed. Hard links create files exclusively.
"""

import contextlib
import errno
import fcntl
import os
import re
import shutil
import stat
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Self

from fleet_slip.base import require_extra
from fleet_slip.errors import StorageError
from fleet_slip.storage.data_files import check_local_files
from fleet_slip.storage.folder import TEMPORARY_PREFIX, Content, Folder, StoredFile, storage_errors

if TYPE_CHECKING:
    import pyarrow as pa


@dataclass(frozen=True)
class LocalFolder(Folder):
    """A folder of a file system; see `fleet_slip.storage.folder.Folder`."""

    path: Path
    is_local = True

    def __str__(self) -> str:
        return str(self.path)

    @property
    def spill(self) -> Path:
        return self.path

    def __truediv__(self, name: str) -> Self:
        return type(self)(self.path / name)

    def exists(self) -> bool:
        with storage_errors(self):
            return self.path.is_dir()

    def names(self) -> list[str]:
        with storage_errors(self):
            return sorted(e.name for e in self.path.iterdir()) if self.path.is_dir() else []

    def files(self) -> list[StoredFile]:
        with storage_errors(self):
            walked = os.walk(self.path, onerror=_ignore_unreadable)
            paths = sorted(Path(folder) / name for folder, _, names in walked for name in names)
            return [file for file in map(self._stored_file, filter(Path.is_file, paths)) if file]

    def stamp(self, path: str) -> object:
        try:
            status = (self.path / path).stat()
        except OSError:
            return None
        return status.st_ino, status.st_mtime_ns, status.st_size

    def read(self, path: str) -> bytes:
        with (
            _regular_file(self.path / path, os.O_RDONLY) as descriptor,
            open(descriptor, "rb", closefd=False) as file,
        ):
            return file.read()

    def read_many(self, paths: Sequence[str]) -> list[bytes | None]:
        return [self._read_or_none(path) for path in paths]

    def check(self, path: str) -> None:
        check_local_files([str(self.path / path)])

    def open(self, path: str) -> "pa.NativeFile":
        import pyarrow as pa

        with storage_errors(self.path / path):
            if not (self.path / path).is_file():  # opening a pipe would wait
                raise FileNotFoundError(errno.ENOENT, "there is no such file")
            return pa.OSFile(str(self.path / path), "rb")

    def put(self, path: str, content: Content) -> None:
        target = self.path / path
        with _written_aside(target, content) as temporary:
            temporary.replace(target)

    def create(self, path: str, content: Content) -> bool:
        target = self.path / path
        with _written_aside(target, content) as temporary:
            try:
                target.hardlink_to(temporary)
            except FileExistsError:
                return False
        return True

    def append(self, path: str, content: bytes) -> None:
        file = self.path / path
        with storage_errors(file):
            file.parent.mkdir(exist_ok=True)
        with _regular_file(file, os.O_WRONLY | os.O_APPEND | os.O_CREAT) as descriptor:
            os.write(descriptor, content)
            os.fsync(descriptor)

    def remove(self, file: StoredFile) -> bool:
        path = self.path / file.path
        with storage_errors(path):
            if self._stored_file(path) != file:
                return False
            path.unlink(missing_ok=True)
        return True

    def delete(self, path: str) -> None:
        with storage_errors(self.path / path):
            (self.path / path).unlink(missing_ok=True)

    def settle_commits(self, before: int | None) -> None:
        folder = self.path / "_delta_log"
        with contextlib.suppress(FileNotFoundError):
            for version in count(0 if before is None else before + 1):
                with (folder / f"{version:020}.json").open("rb") as file:
                    os.fsync(file.fileno())
        _flush(folder)

    def free_bytes(self) -> tuple[int, int] | None:
        with storage_errors(self):
            disk = shutil.disk_usage(self.path)
        return disk.free, disk.total

    @contextlib.contextmanager
    def exclusive(self, name: str, waiting: Callable[[], None]) -> Iterator[None]:
        """Hold a lock among the processes of this machine; a killed process releases it.

        Calls `waiting` once if another process holds it. A read-only file system needs no lock.
        """
        lock = self.path / name
        with storage_errors(lock):
            try:
                lock.parent.mkdir(parents=True, exist_ok=True)
                lock.touch()
            except OSError as error:
                if error.errno != errno.EROFS:
                    raise
                yield
                return
        with _regular_file(lock, os.O_WRONLY) as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                waiting()
                fcntl.flock(file, fcntl.LOCK_EX)
            yield

    def _read_or_none(self, path: str) -> bytes | None:
        file = self.path / path
        if file.is_symlink():  # it may lead anywhere
            return b""
        return self.read(path) if file.is_file() else None

    def _stored_file(self, path: Path) -> StoredFile | None:
        try:
            status = path.stat(follow_symlinks=False)
        except FileNotFoundError:
            return None
        return StoredFile(
            self,
            path.relative_to(self.path).as_posix(),
            status.st_size,
            status.st_mtime_ns,
            str(status.st_ino),
        )


@contextlib.contextmanager
def _regular_file(file: Path, flags: int) -> Iterator[int]:
    """Open a regular file, no link or pipe; yield its descriptor. Raises `StorageError`."""
    refused = StorageError(
        f"{file}: a link, a folder or a pipe instead of a regular file. Find out who put it "
        "there and remove it, or restore the file from a backup."
    )
    safe = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    with storage_errors(file):
        if file.is_symlink() or file.is_fifo():
            raise refused
        descriptor = os.open(file, flags | safe, 0o666)
        try:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise refused
            yield descriptor
        finally:
            os.close(descriptor)


@contextlib.contextmanager
def _written_aside(target: Path, content: Content) -> Iterator[Path]:
    """Write a temporary sibling of a file; make durable what the caller does with it."""
    temporary = target.with_name(f"{TEMPORARY_PREFIX}{uuid.uuid4().hex}")
    with storage_errors(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            with temporary.open("xb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            yield temporary
        finally:
            temporary.unlink(missing_ok=True)
        _flush(target.parent)


def _ignore_unreadable(error: OSError) -> None:
    """Ignore folders that are missing or unreadable; raise any other error."""
    if not isinstance(error, FileNotFoundError | NotADirectoryError | PermissionError):
        raise error


def _flush(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


# The location of a data root: a folder of a file system, or the URL of an object store.

DEFAULT_ROOT = Path("data")
_UNFIT = re.compile(r"[\\*?\[]|%[0-9A-Fa-f]{2}|[\x00-\x1f\x7f-\x9f\ud800-\udfff\u2028\u2029]")
"""The backslash becomes a slash in Delta, and escapes their characters; others are patterns to
DuckDB, or cannot be printed."""

_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://")
_OBJECT_URL = re.compile(
    r"(?P<bucket>(?:s3|gs|az)://[a-z0-9][a-z0-9._-]{1,62})(?P<path>(?:/[A-Za-z0-9_=+-][\w.=+-]*)*)/?",
    re.ASCII,
)


def data_root(root: Folder | Path | str | None = None) -> Folder:
    """Return the data root: the argument, else ./data.

    With `://` it is a URL: `s3://BUCKET/PATH`, `gs://BUCKET/PATH`, `az://CONTAINER/PATH`.
    Raises `StorageError` for another, for what Delta or DuckDB misread, inside a table, and where
    the clock is before 1970, which Delta cannot write.
    """
    if time.time() < 0:
        raise StorageError("the clock of this machine is before 1970. Set it, and repeat.")
    if root is not None and not isinstance(root, Path | str):
        return root
    where = root or DEFAULT_ROOT
    if isinstance(where, str) and _SCHEME.match(where):
        return _at_url(where)
    return _local(Path(where))


def _local(path: Path) -> Folder:
    if match := _UNFIT.search(str(path.absolute())):
        raise StorageError(
            f"{path}: a data root cannot have {match[0]!r} in its full path. Choose another."
        )
    for folder in (place := Path(os.path.realpath(path)), *place.parents):
        # Vacuum removes all files in a table that are not part of it.
        if os.access(folder / "_delta_log", os.F_OK):
            raise StorageError(
                f"{path}: it is inside the table {folder}. Choose the folder that the table is in, "
                "or another."
            )

    return LocalFolder(path)


def _at_url(url: str) -> Folder:
    # A refused URL is not shown, as it may contain a password.
    match = _OBJECT_URL.fullmatch(url)
    if match is None:
        raise StorageError(
            "a data root on an object store is written as s3://BUCKET/PATH, gs://BUCKET/PATH "
            "or az://CONTAINER/PATH, with letters, digits and any of _ . = + - in the path. "
            "Credentials are not part of it: they come from the environment."
        )
    with require_extra("objects", "a data root on an object store"):
        from fleet_slip.storage.objects import ObjectFolder
    return ObjectFolder(match["bucket"], match["path"].strip("/"))
