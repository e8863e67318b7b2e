"""Folders of an object store: S3 and what speaks like it, Google Cloud Storage, Azure.

Puts are whole or nothing, and fail under `If-None-Match: *` where there is one: no temporary names
or links, and several machines can write.
"""

import contextlib
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import duckdb
import obstore
import pyarrow as pa
from obstore.exceptions import AlreadyExistsError

from fleet_slip.errors import StorageError
from fleet_slip.files.folder import Content, StoredFile
from fleet_slip.files.object_client import client, delta_options
from fleet_slip.files.object_files import LentFile, ObjectFilesystem, fetch_parts, open_object
from fleet_slip.files.storage_errors import object_errors

if TYPE_CHECKING:
    from obstore.store import ObjectStore

READS_AT_ONCE = 32
LISTINGS = 20
"""So often files are listed again that were replaced before they were read."""


@dataclass(frozen=True)
class ObjectFolder:
    """A folder `s3://BUCKET`, `gs://`, `az://` + `prefix`; see `fleet_slip.files.folder.Folder`."""

    bucket: str
    prefix: str

    def __str__(self) -> str:
        return f"{self.bucket}/{self.prefix}".rstrip("/")

    @property
    def name(self) -> str:
        return self.prefix.rpartition("/")[2]

    @property
    def uri(self) -> str:
        return str(self)

    @property
    def is_local(self) -> bool:
        return False

    @property
    def delta_options(self) -> dict[str, str] | None:
        """Options of the Delta library; credentials it finds where we do."""
        return delta_options(self.bucket)

    @property
    def spill(self) -> Path:
        return Path(tempfile.gettempdir())

    def __truediv__(self, name: str) -> Self:
        return replace(self, prefix=self._key(name))

    def exists(self) -> bool:
        with object_errors(str(self)):
            pages = obstore.list(self._store, self.prefix or None, chunk_size=1)
            return any(len(page) for page in pages)

    def names(self) -> list[str]:
        with object_errors(str(self)):
            found = obstore.list_with_delimiter(self._store, self.prefix or None)
        paths = [*found["common_prefixes"], *(meta["path"] for meta in found["objects"])]
        return sorted(path.rpartition("/")[2] for path in paths)

    def files(self) -> list[StoredFile]:
        with object_errors(str(self)):
            pages = list(obstore.list(self._store, self.prefix or None))
        found = [self.found(meta) for page in pages for meta in page]
        return sorted(found, key=lambda file: file.path)

    def read(self, path: str, longest: int | None = None) -> bytes:
        where = f"{self}/{path}"
        if longest is None:
            return b"".join(part for _, part in fetch_parts(self._store, self._key(path), where))
        with object_errors(where):
            answer = obstore.get(self._store, self._key(path))
            if answer.meta["size"] > longest:
                return bytes(
                    obstore.get_range(self._store, self._key(path), start=0, length=longest)
                )
            return bytes(answer.bytes())

    def read_many(self, paths: Sequence[str]) -> list[bytes | None]:
        """Return the content of files, None for one that is gone. Many are asked for at once."""
        with ThreadPoolExecutor(READS_AT_ONCE) as executor:
            return list(executor.map(self._read_or_none, paths))

    def check(self, path: str) -> None:
        """Do nothing: what is opened is looked at."""

    def open(self, path: str) -> pa.NativeFile:
        """Open a file; raises `StorageError` if the answer is not what the name says."""
        file = open_object(self._store, self._key(path), f"{self}/{path}")
        return pa.PythonFile(file, "r")

    def put(self, path: str, content: Content) -> None:
        self._put(path, content, "overwrite")

    def create(self, path: str, content: Content) -> bool:
        """Write a file, unless there is one; after a lost answer that is the one it has made."""
        return self._put(path, content, "create")

    def append(self, path: str, content: bytes) -> None:
        """Add to a history: an object of its own, whose name goes on with the time."""
        self.put(f"{path}/{time.time_ns():020d}-{uuid.uuid4().hex[:8]}.jsonl", content)

    def remove(self, file: StoredFile) -> bool:
        """Delete the very file that a listing found; False if it is gone or was replaced.

        What is written between look and deletion would go: no name is used twice (`Table.put`).
        """
        with object_errors(str(file)):
            try:
                meta = obstore.head(self._store, self._key(file.path))
            except FileNotFoundError:
                return False
            if self.found(meta) != file:
                return False
            obstore.delete(self._store, self._key(file.path))
        return True

    def delete(self, path: str) -> None:
        with object_errors(f"{self}/{path}"), contextlib.suppress(FileNotFoundError):
            obstore.delete(self._store, self._key(path))

    def settle_commits(self, before: int | None) -> None:
        """Make commits durable, as they are."""

    def free_bytes(self) -> tuple[int, int] | None:
        return None

    @contextlib.contextmanager
    def exclusive(self, name: str, waiting: Callable[[], None]) -> Iterator[None]:  # noqa: ARG002
        """Hold no lock, for a killed process may keep it: what is done twice at once lands once."""
        yield

    def let_read(self, database: duckdb.DuckDBPyConnection) -> None:
        database.register_filesystem(ObjectFilesystem(self.bucket, lambda: self._store))

    def lend(self, database: duckdb.DuckDBPyConnection, wanted: Callable[[str], bool]) -> list[str]:
        """Read the files whose paths are wanted into memory, as one; return its URI.

        DuckDB would ask one by one. Raises `StorageError` if they are replaced as fast as listed.
        """
        for _ in range(LISTINGS):
            paths = [file.path for file in self.files() if wanted(file.path)]
            contents = self.read_many(paths)
            if None not in contents:
                break
        else:
            raise StorageError(f"{self}: other processes keep changing it. Run the command again.")
        if not paths:
            return []
        lent = LentFile(memoryview(b"".join(content for content in contents if content)))
        database.register_filesystem(lent)
        return [lent.uri]

    @property
    def _store(self) -> "ObjectStore":
        return client(self.bucket)

    def _read_or_none(self, path: str) -> bytes | None:
        with object_errors(f"{self}/{path}"):
            try:
                return bytes(obstore.get(self._store, self._key(path)).bytes())
            except FileNotFoundError:
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

    def found(self, meta: Any) -> StoredFile:
        """Return an object as the library tells of it."""
        # Of one object some stores list milliseconds, or a tag without quotes, and tell seconds
        # and quotes when they are asked for it alone.
        return StoredFile(
            self,
            meta["path"].removeprefix(f"{self.prefix}/") if self.prefix else meta["path"],
            meta["size"],
            int(meta["last_modified"].timestamp()) * 10**9,
            (meta["e_tag"] or "").strip('"'),
        )
