"""Objects as files that can be read anywhere in them: for DuckDB and for pyarrow.

They never change. One whose name tells its checksum is fetched whole, compared and read from those
bytes. Large ones come in parts within a request's time limit, retried smaller.
"""

import io
import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import fsspec
import obstore
from obstore.exceptions import BaseError

from fleet_slip.files.checksums import checksum_in, require_content
from fleet_slip.files.storage_errors import is_timeout, object_errors

if TYPE_CHECKING:
    from collections.abc import Callable

    from obstore.store import ObjectStore


FIRST_BYTES, MOST_BYTES, LEAST_BYTES = 2**20, 2**23, 2**15
"""Bytes that a request asks for: at first, and within what limits it adapts to the network."""

QUICK_S = 2.0
"""After a request that took less the next asks for twice as much."""

KEPT_BYTES = 2**27
"""Of the objects that were fetched last, so many bytes are kept."""


def fetch_parts(store: "ObjectStore", key: str, where: str) -> Iterator[tuple[Any, bytes]]:
    """Yield an object's parts in order, each with what the store says of it.

    `where` names it in errors. Raises `StorageError`, as when not even `LEAST_BYTES` come in time.
    """
    position, length = 0, FIRST_BYTES
    with object_errors(where):
        whole = obstore.get(store, key)
        size = whole.meta["size"]
        if size <= length and (content := _in_time(whole)) is not None:
            yield whole.meta, content
            return
        while position < size:
            begun = time.monotonic()
            end = min(position + length, size)
            part = obstore.get(store, key, options={"range": (position, end)})
            content = _in_time(part, may_fail=length > LEAST_BYTES)
            if content is None:
                length //= 4
                continue
            yield part.meta, content
            position += len(content)
            if time.monotonic() - begun < QUICK_S:
                length = min(2 * length, MOST_BYTES)


def _in_time(answer: Any, *, may_fail: bool = True) -> bytes | None:
    """Return what an answer brings; None if it does not come within the time limit."""
    try:
        return bytes(answer.bytes())
    except (BaseError, OSError) as error:
        if may_fail and is_timeout(error):
            return None
        raise


class ObjectReader(io.RawIOBase):
    """An object as a file, a request a call.

    obstore's reader returns less at the ends of its buffer, which DuckDB takes for damage.
    """

    def __init__(self, store: "ObjectStore", key: str, where: str, size: int | None = None) -> None:
        self._store, self._key, self._where, self._position = store, key, where, 0
        if size is None:
            with object_errors(where):
                size = obstore.head(store, key)["size"]
        self._size = size

    def readable(self) -> bool:
        """Return True."""
        return True

    def seekable(self) -> bool:
        """Return True."""
        return True

    def tell(self) -> int:
        """Return where the next read begins."""
        return self._position

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Move to where the next read begins."""
        begin = {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: self._size}[whence]
        self._position = begin + offset
        return self._position

    def read(self, size: int = -1) -> bytes:
        """Read so many bytes, or all that are left."""
        left = max(self._size - self._position, 0)
        length = left if size is None or size < 0 else min(size, left)
        if not length:
            return b""
        with object_errors(self._where):
            part = obstore.get_range(self._store, self._key, start=self._position, length=length)
        self._position += length
        return bytes(part)


def open_object(
    store: "ObjectStore", key: str, where: str, size: int | None = None
) -> io.RawIOBase | io.BytesIO:
    """Open an object. Raises `StorageError` if it is not what its name says."""
    if checksum_in(key) is None:
        return ObjectReader(store, key, where, size)
    return io.BytesIO(_fetch(store, key, where))


def _fetch(store: "ObjectStore", key: str, where: str) -> bytes:
    """Return a whole object, compared with its name. DuckDB opens a file twice: some are kept."""
    with _fetching:
        if where in _fetched:
            return _fetched[where]
    content = b"".join(part for _, part in fetch_parts(store, key, where))
    require_content(key, content, where)
    with _fetching:
        _fetched[where] = content
        while len(_fetched) > 1 and sum(map(len, _fetched.values())) > KEPT_BYTES:
            del _fetched[next(iter(_fetched))]
    return content


_fetched: dict[str, bytes] = {}
"""By URL: what a name with a checksum holds is the same wherever it is."""
_fetching = threading.Lock()


class _ReadOnlyFilesystem(fsspec.AbstractFileSystem):  # type: ignore[misc]
    """Files that never change, for DuckDB. fsspec makes text of all that one is made with."""

    cachable = False

    def info(self, path: str, **_options: Any) -> dict[str, Any]:
        """Return the name, type and size of a file."""
        return {"name": path, "type": "file", "size": self._size(path)}

    def modified(self, path: str) -> datetime:  # noqa: ARG002 - they never change
        """Return one moment for all files."""
        return datetime.fromtimestamp(0, UTC)

    def glob(self, path: str, **_options: Any) -> list[str]:
        """Return the path: names of data files are no patterns."""
        return [path]

    def exists(self, path: str, **_options: Any) -> bool:
        """Return True; that it is not there shows when it is read."""
        return bool(path)

    def open(self, path: str, mode: str = "rb", **_options: Any) -> io.RawIOBase | io.BytesIO:
        """Open a file for reading. Raises `PermissionError` for any other mode."""
        if mode != "rb":
            raise PermissionError(f"{path}: a warehouse is only read through SQL")
        reader: io.RawIOBase | io.BytesIO = self._reader(path)
        return reader


class ObjectFilesystem(_ReadOnlyFilesystem):
    """The objects of one bucket."""

    def __init__(self, bucket: str, store: "Callable[[], ObjectStore]") -> None:
        super().__init__()
        self.protocol, _, self._name = bucket.partition("://")
        self._store = store()
        self._sizes: dict[str, int] = {}

    def _key(self, path: str) -> tuple[str, str]:
        key = path.removeprefix(f"{self.protocol}://").removeprefix(f"{self._name}/")
        return key, f"{self.protocol}://{self._name}/{key}"

    def _size(self, path: str) -> int:
        key, where = self._key(path)
        if key not in self._sizes:
            with object_errors(where):
                self._sizes[key] = obstore.head(self._store, key)["size"]
        return self._sizes[key]

    def _reader(self, path: str) -> io.RawIOBase | io.BytesIO:
        return open_object(self._store, *self._key(path), self._size(path))


class LentFile(_ReadOnlyFilesystem):
    """A file in memory, for a connection that it is registered with."""

    protocol = "lent"
    uri = "lent://file"

    def __init__(self, content: memoryview) -> None:
        super().__init__()
        self._content = content

    def _size(self, _path: str) -> int:
        return len(self._content)

    def _reader(self, _path: str) -> io.BytesIO:
        return io.BytesIO(self._content)
