"""Data files of tables: encoding of rows as Parquet, with statistics and checksums in the name.

    NAME-x0123456789abcdef-0123456789abcdef0123456789abcdef.parquet

The last is the SHA-256, which `verify` computes. The one after the x is the XXH3, so fast that
every job checks every byte.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import re
import stat
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any

import xxhash

from fleet_slip.errors import StorageError
from fleet_slip.storage.folder import storage_errors

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


def checksum_of(content: pa.Buffer | bytes) -> str:
    """Return the checksum of a content for the end of the file's name."""
    return hashlib.sha256(content).hexdigest()[:CHECKSUM_DIGITS]


def fast_checksum_of(content: pa.Buffer | bytes) -> str:
    """Return the fast checksum of a content for the file's name."""
    return xxhash.xxh3_64_hexdigest(memoryview(content))


def checksum_in(path: str) -> str | None:
    """Return the checksum in a data file's name; None for other names."""
    match = _CHECKSUM.search(path)
    return match[1] if match else None


def require_content(path: str, content: pa.Buffer | bytes, where: object) -> None:
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


def _require(path: str, chunks: Iterable[Any], where: object) -> None:
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


DAY = "day"
"""The column whose minimum and maximum are in the Delta log."""

ROW_GROUP_ROWS = 2**17
WRITE_BATCH_ROWS = 2**14
"""Rows per call of the encoder: 16 times its default is a sixth faster."""


@dataclass(frozen=True)
class Encoded:
    """The content of a Parquet file, its checksums, and its statistics for the Delta log."""

    content: pa.Buffer
    checksum: str
    fast_checksum: str
    statistics: str

    def path(self, name: str, day: date | None) -> str:
        """Return the path below the table: in the folder of the day, if given."""
        folder = f"day={day.isoformat()}/" if day else ""
        return f"{folder}{name}-x{self.fast_checksum}-{self.checksum}.parquet"


@dataclass(frozen=True)
class Encoding:
    """Parquet encoding of the columns of a table."""

    dictionary: tuple[str, ...] = ()
    delta_packed: tuple[str, ...] = ()
    compression: str = "none"

    def options(self) -> dict[str, Any]:
        """Return the arguments of `pyarrow.parquet.ParquetWriter`."""
        return {
            "use_dictionary": list(self.dictionary),
            "column_encoding": dict.fromkeys(self.delta_packed, "DELTA_BINARY_PACKED"),
            "compression": self.compression,
        }

    def encode(self, rows: pa.Table, omitted: Sequence[str] = ()) -> Encoded:
        """Encode rows, without the `omitted` columns."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        stored_rows = rows.drop_columns([name for name in omitted if name in rows.schema.names])
        # Parquet stores a dictionary unchanged: one shared with another file, or with rows of an
        # erased drive, would write their names too.
        columns = [_only_used_values(column) for column in stored_rows.columns]
        # Columns declared without nulls have no validity levels, an eighth of the writing time.
        fields = [f.with_nullable(stored_rows[f.name].null_count > 0) for f in stored_rows.schema]
        stored = pa.Table.from_arrays(columns, schema=pa.schema(fields))
        sink = pa.BufferOutputStream(_memory_pool())
        with pq.ParquetWriter(
            sink,
            stored.schema,
            memory_pool=_memory_pool(),
            write_batch_size=WRITE_BATCH_ROWS,
            **self.options(),
        ) as writer:
            writer.write_table(stored, row_group_size=ROW_GROUP_ROWS)
        content = sink.getvalue()
        statistics = json.dumps(_statistics(rows, stored.column_names))
        return Encoded(content, checksum_of(content), fast_checksum_of(content), statistics)


@functools.cache
def _memory_pool() -> pa.MemoryPool:
    """Return the allocator of encoded columns: by jemalloc an ingest takes a tenth less time.

    Builds of Arrow for 64-bit ARM have none.
    """
    import pyarrow as pa

    has_jemalloc = "jemalloc" in pa.supported_memory_backends()
    return pa.jemalloc_memory_pool() if has_jemalloc else pa.default_memory_pool()


def _statistics(rows: pa.Table, stored: Sequence[str]) -> dict[str, Any]:
    nulls = {name: rows[name].null_count for name in rows.schema.names}
    statistics: dict[str, Any] = {"numRecords": rows.num_rows, "nullCount": nulls}
    if DAY in stored:
        import pyarrow.compute as pc

        limits = pc.min_max(rows[DAY]).as_py()
        if limits["min"] is not None:
            statistics["minValues"] = {DAY: limits["min"].isoformat()}
            statistics["maxValues"] = {DAY: limits["max"].isoformat()}
    return statistics


def _only_used_values(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Return a column whose dictionary contains only used values, in order of appearance."""
    import pyarrow as pa

    if not pa.types.is_dictionary(column.type):
        return column
    array = column.combine_chunks()
    if len(array.dictionary) == 1 and array.null_count < len(array):
        return column
    if array.indices.unique().drop_null().to_pylist() == list(range(len(array.dictionary))):
        return column
    codes = array.indices.dictionary_encode()
    values = array.dictionary.take(codes.dictionary)
    return pa.chunked_array([pa.DictionaryArray.from_arrays(codes.indices, values)])


def read_names(file: pa.NativeFile, columns: Sequence[str]) -> dict[str, frozenset[str]]:
    """Return the names in a Parquet file, by text column."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    with pq.ParquetFile(file) as parquet:
        schema = parquet.schema_arrow
        stored = [name for name in columns if name in schema.names]
        rows = parquet.read([n for n in stored if not pa.types.is_primitive(schema.field(n).type)])
    names = rows.unify_dictionaries()
    return {n: frozenset(names[n].unique().drop_null().to_pylist()) for n in names.column_names}
