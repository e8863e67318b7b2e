"""Folders of object stores: S3 and compatible ones, Google Cloud Storage, Azure.

Puts are atomic. `If-None-Match: *` makes a put fail if the object exists, so that several machines
can write without temporary names or links.
"""

import contextlib
import functools
import io
import os
import threading
import time
import uuid
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any, Self

import duckdb
import fsspec
import obstore
import pyarrow as pa
from obstore.exceptions import AlreadyExistsError
from obstore.store import from_url

from fleet_slip.storage.data_files import require_content
from fleet_slip.storage.folder import Content, Folder, NoSuchObjectError, StoredFile, object_errors

if TYPE_CHECKING:
    from obstore.store import ObjectStore


# Clients of buckets: time limits and retries. Credentials come from the environment or the machine.

HTTP_VARIABLE = "AWS_ALLOW_HTTP"
"""Environment variable, which the Delta library reads too: true permits http endpoints."""

TIMEOUT_S = 60
"""Maximum pause of a response, and maximum time to send up to 40 MB."""

LONGEST_S = 3600
"""Maximum time of a whole response."""

CONNECT_TIMEOUT_S = 5
RETRIES = 5
RETRY_S = 60
"""Maximum time between the first and the last attempt."""


@functools.cache
def client(bucket: str) -> "ObjectStore":
    """Return the client of a bucket, created on first use."""
    with object_errors(bucket):
        return from_url(
            bucket,
            client_options={
                "allow_http": os.environ.get(HTTP_VARIABLE, "").lower() in ("1", "true"),
                "timeout": timedelta(seconds=LONGEST_S),
                "read_timeout": timedelta(seconds=TIMEOUT_S),
                "connect_timeout": timedelta(seconds=CONNECT_TIMEOUT_S),
            },
            retry_config={"max_retries": RETRIES, "retry_timeout": timedelta(seconds=RETRY_S)},
        )


# Objects as seekable files for DuckDB and pyarrow. Data files never change: each is fetched whole
# and compared with the checksum in its name.

PART_BYTES = 2**22
"""Size of the blocks of a response."""

KEPT_BYTES = 2**27
"""Maximum size of the cache of fetched objects."""


def _bytes_of(store: "ObjectStore", key: str, where: str) -> bytes:
    """Return the content of an object; `where` names it in errors.

    The library resumes a broken response if the object is unchanged. Raises `StorageError`, also
    after a pause of `TIMEOUT_S`.
    """
    with object_errors(where):
        parts = obstore.get(store, key).stream(min_chunk_size=PART_BYTES)
        return b"".join(bytes(part) for part in parts)


def _fetch(store: "ObjectStore", key: str, where: str) -> bytes:
    """Return a checked object. The last ones are cached, as DuckDB opens a file twice."""
    with _fetching:
        if where in _fetched:
            return _fetched[where]
    content = _bytes_of(store, key, where)
    require_content(key, content, where)
    with _fetching:
        _fetched[where] = content
        while len(_fetched) > 1 and sum(map(len, _fetched.values())) > KEPT_BYTES:
            del _fetched[next(iter(_fetched))]
    return content


_fetched: dict[str, bytes] = {}
"""Contents by URL."""
_fetching = threading.Lock()


class ObjectFilesystem(fsspec.AbstractFileSystem):  # type: ignore[misc]
    """The objects of one bucket for DuckDB. fsspec converts the arguments to text."""

    cachable = False

    def __init__(self, bucket: str, store: "Callable[[], ObjectStore]") -> None:
        super().__init__()
        self.protocol, _, self._name = bucket.partition("://")
        self._store = store()
        self._sizes: dict[str, int] = {}

    def info(self, path: str, **_options: Any) -> dict[str, Any]:
        return {"name": path, "type": "file", "size": self._size(path)}

    def modified(self, path: str) -> datetime:  # noqa: ARG002 - they never change
        return datetime.fromtimestamp(0, UTC)

    def glob(self, path: str, **_options: Any) -> list[str]:
        return [path]  # names of data files contain no patterns

    def exists(self, path: str, **_options: Any) -> bool:
        return bool(path)  # reading fails for a missing file

    def open(self, path: str, mode: str = "rb", **_options: Any) -> io.BytesIO:
        if mode != "rb":
            raise PermissionError(f"{path}: SQL only reads a warehouse")
        return io.BytesIO(_fetch(self._store, *self._key(path)))

    def _key(self, path: str) -> tuple[str, str]:
        key = path.removeprefix(f"{self.protocol}://").removeprefix(f"{self._name}/")
        return key, f"{self.protocol}://{self._name}/{key}"

    def _size(self, path: str) -> int:
        key, where = self._key(path)
        if key not in self._sizes:
            with object_errors(where):
                self._sizes[key] = obstore.head(self._store, key)["size"]
        return self._sizes[key]


READS_AT_ONCE = 32


@dataclass(frozen=True)
class ObjectFolder(Folder):
    """A folder `s3://BUCKET`, `gs://`, `az://` + `prefix`; see `storage.folder.Folder`."""

    bucket: str
    prefix: str

    def __str__(self) -> str:
        return f"{self.bucket}/{self.prefix}".rstrip("/")

    @property
    def name(self) -> str:
        return self.prefix.rpartition("/")[2]

    @property
    def delta_options(self) -> dict[str, str] | None:
        return {
            "timeout": f"{TIMEOUT_S}s",
            "connect_timeout": f"{CONNECT_TIMEOUT_S}s",
            "max_retries": f"{RETRIES}",
            "retry_timeout": f"{RETRY_S}s",
            "conditional_put": "etag",
        }

    def __truediv__(self, name: str) -> Self:
        return replace(self, prefix=self._key(name))

    def exists(self) -> bool:
        with object_errors(str(self)):
            pages = obstore.list(self._store, self.prefix or None, chunk_size=1)
            return any(len(page) for page in pages)

    def names(self) -> list[str]:
        with object_errors(str(self)):
            listing = obstore.list_with_delimiter(self._store, self.prefix or None)
        paths = [*listing["common_prefixes"], *(meta["path"] for meta in listing["objects"])]
        return sorted(path.rpartition("/")[2] for path in paths)

    def files(self) -> list[StoredFile]:
        with object_errors(str(self)):
            pages = list(obstore.list(self._store, self.prefix or None))
        files = [self.stored_file(meta) for page in pages for meta in page]
        return sorted(files, key=lambda file: file.path)

    def read(self, path: str) -> bytes:
        return _bytes_of(self._store, self._key(path), f"{self}/{path}")

    def read_many(self, paths: Sequence[str]) -> list[bytes | None]:
        """Return the contents of files, read concurrently; None for a missing file."""
        with ThreadPoolExecutor(READS_AT_ONCE) as executor:
            return list(executor.map(self._read_or_none, paths))

    def open(self, path: str) -> pa.NativeFile:
        """Open a file. Raises `StorageError` if it does not match its checksum."""
        return pa.BufferReader(_fetch(self._store, self._key(path), f"{self}/{path}"))

    def put(self, path: str, content: Content) -> None:
        self._put(path, content, "overwrite")

    def create(self, path: str, content: Content) -> bool:
        """Write a new file. After a lost response, an earlier attempt counts as existing."""
        return self._put(path, content, "create")

    def append(self, path: str, content: bytes) -> None:
        """Append to a history: write an object whose name contains the time."""
        self.put(f"{path}/{time.time_ns():020d}-{uuid.uuid4().hex[:8]}.jsonl", content)

    def remove(self, file: StoredFile) -> bool:
        """Delete exactly the listed file; return False if it is gone or was replaced.

        A write between check and deletion would be lost, but no name is used twice (`Table.put`).
        """
        with object_errors(str(file)):
            try:
                meta = obstore.head(self._store, self._key(file.path))
            except FileNotFoundError:
                return False
            if self.stored_file(meta) != file:
                return False
            obstore.delete(self._store, self._key(file.path))
        return True

    def delete(self, path: str) -> None:
        with object_errors(f"{self}/{path}"), contextlib.suppress(FileNotFoundError):
            obstore.delete(self._store, self._key(path))

    def enable_reading(self, database: duckdb.DuckDBPyConnection) -> None:
        database.register_filesystem(ObjectFilesystem(self.bucket, lambda: self._store))

    @property
    def _store(self) -> "ObjectStore":
        return client(self.bucket)

    def _read_or_none(self, path: str) -> bytes | None:
        with contextlib.suppress(NoSuchObjectError):
            return self.read(path)
        return None

    def _key(self, path: str) -> str:
        return f"{self.prefix}/{path}" if self.prefix else path

    def _put(self, path: str, content: Content, mode: Any) -> bool:
        data = memoryview(content).cast("B")
        with object_errors(f"{self}/{path}"):
            try:
                obstore.put(self._store, self._key(path), data, mode=mode, use_multipart=False)
            except AlreadyExistsError:
                return False
        return True

    def stored_file(self, meta: Any) -> StoredFile:
        # Some stores list milliseconds, or tags without quotes, but return seconds and quotes for
        # a single object.
        return StoredFile(
            self,
            meta["path"].removeprefix(f"{self.prefix}/") if self.prefix else meta["path"],
            meta["size"],
            int(meta["last_modified"].timestamp()) * 10**9,
            (meta["e_tag"] or "").strip('"'),
        )
