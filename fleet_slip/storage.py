"""The tables of a data root: Delta tables of Parquet files that we encode ourselves.

A file is written as a whole, durably; only then is it committed to the table's Delta log. So a
reader sees whole files of whole commits, or nothing.

A file's name ends in the checksum of its bytes. The name is the one thing about a file that the
Delta log, its checkpoints, Gram rows and a listing of the folder all keep, so that damage can be
told years later; the same rows are always the same file; and a file that is made again from its
source takes its place without a commit.
"""

import hashlib
import json
import random
import re
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date
from functools import cached_property
from typing import Any, TypeVar

import pyarrow as pa
import pyarrow.parquet as pq
from deltalake import CommitProperties, DeltaTable, Transaction
from deltalake.exceptions import CommitFailedError, TableNotFoundError
from deltalake.transaction import AddAction, RemoveAction

from fleet_slip.errors import ConflictError, StorageError
from fleet_slip.evolution import require_readable, require_writable
from fleet_slip.folder import Folder
from fleet_slip.sealing import NOTE, sealed
from fleet_slip.storage_errors import first_line, storage_errors

ROW_GROUP_ROWS = 2**17
WRITE_BATCH_ROWS = 2**14
"""Rows that the encoder takes at once: 16 times its default is a sixth faster."""

_DATA_FILE = re.compile(r"[\w.=-][\w.=/-]*\.parquet", re.ASCII)
"""Path of a data file below its table: relative, and without characters that could be a pattern."""

CHECKSUM_DIGITS = 32
"""Hexadecimal digits of a file's SHA-256 in its name: damage passes unseen once in 2^128 times."""

ATTEMPTS = 12
FIRST_WAIT_S = 0.02
LONGEST_WAIT_S = 5.0

Result = TypeVar("Result")


def retried(attempt: Callable[[], Result]) -> Result:
    """Call until it raises no `ConflictError`, waiting ever longer between, at random.

    The last conflict is raised. "Full jitter": processes that met once do not meet again.
    """
    for number in range(ATTEMPTS - 1):
        try:
            return attempt()
        except ConflictError:
            longest = min(FIRST_WAIT_S * 2**number, LONGEST_WAIT_S)
            time.sleep(random.uniform(0, longest))  # noqa: S311 - not a secret
    return attempt()


@dataclass(frozen=True)
class Encoding:
    """How the columns of a table become Parquet."""

    dictionary: tuple[str, ...] = ()
    delta_packed: tuple[str, ...] = ()
    compression: str = "none"

    def options(self) -> dict[str, Any]:
        """Return the arguments of `pyarrow.parquet.write_table`."""
        return {
            "use_dictionary": list(self.dictionary),
            "column_encoding": dict.fromkeys(self.delta_packed, "DELTA_BINARY_PACKED"),
            "compression": self.compression,
        }


@dataclass(frozen=True)
class TableFile:
    """One active file of a table, as the Delta log has it."""

    path: str
    rows: int
    size_bytes: int
    null_counts: Mapping[str, int]
    day: date | None = None


def absent_columns(files: Iterable[TableFile], names: Iterable[str]) -> tuple[str, ...]:
    """Return the columns that none of the files has: they came to the table later."""
    absent = dict.fromkeys(names)
    for file in files:
        if not absent:
            break
        for name in [name for name in absent if name in file.null_counts]:
            del absent[name]
    return tuple(absent)


@dataclass(frozen=True)
class Unit:
    """A piece of work that lands exactly once: its name, and a number that its content determines.

    Recorded as a Delta transaction identifier in the commit that lands it. Two processes that land
    the same unit at once conflict, and one of them is told.
    """

    name: str
    version: int


@dataclass(frozen=True)
class Change:
    """What one commit does to a table.

    `data_change` is false where rows only move between files.
    """

    add: Sequence[AddAction] = ()
    remove: Sequence[TableFile] = ()
    units: Sequence[Unit] = ()
    note: Mapping[str, Any] = field(default_factory=dict)
    data_change: bool = True


@dataclass(frozen=True)
class Encoded:
    """The content of a Parquet file, its checksum, and its statistics for the Delta log."""

    content: pa.Buffer
    checksum: str
    statistics: str


@dataclass(frozen=True)
class Table:
    """A Delta table below a data root."""

    folder: Folder
    schema: pa.Schema
    encoding: Encoding
    partition_by: tuple[str, ...] = ()
    description: str = ""

    def snapshot(self, version: int | None = None) -> "Snapshot":
        """Return the table as it is now; a table that nobody has written yet is empty.

        An earlier version can be asked for; `StorageError` is raised if it is no longer known.
        """
        delta = self.open_delta(version)
        if delta is not None and version is None:
            require_readable(self.folder, self.schema, delta)
        return Snapshot(self, delta)

    def open_delta(self, version: int | None = None) -> DeltaTable | None:
        """Return the Delta table as it is now, or was; None if nobody has written it yet."""
        with storage_errors(self.folder):
            try:
                return DeltaTable(
                    self.folder.uri, version=version, storage_options=self.folder.delta_options
                )
            except TableNotFoundError:
                return None

    def uri(self, path: str) -> str:
        """Return where one of the table's files is, as DuckDB knows it."""
        return f"{self.folder.uri}/{path}"

    def read(self, path: str, columns: Sequence[str] | None = None) -> pa.Table:
        """Return the rows of one of the table's files, or some columns of them."""
        with storage_errors(f"{self.folder}/{path}"), self.folder.open(path) as file:
            wanted = None if columns is None else list(columns)
            return pq.read_table(file, columns=wanted, partitioning=None)

    def read_metadata(self, path: str) -> pq.FileMetaData:
        """Return the footer of one of the table's files."""
        with storage_errors(f"{self.folder}/{path}"), self.folder.open(path) as file:
            return pq.read_metadata(file)

    def write_file(self, name: str, rows: pa.Table, day: date | None = None) -> AddAction:
        """Write rows to the file NAME-CHECKSUM.parquet, durably; see `put`."""
        return self.put(name, self.encode(rows), day)

    def put(self, name: str, encoded: Encoded, day: date | None = None) -> AddAction:
        """Write a file's content to the file NAME-CHECKSUM.parquet, durably.

        Returns the action that adds it to the table; it is not part of the table before that is
        committed. Where an interrupted run left a file of that name, it is replaced, or the new one
        gets a longer name.
        """
        content = encoded.content
        path = _file_path(name, encoded, day)
        if self.folder.reuses_names:
            self.folder.put(path, content)
        else:
            while not self.folder.create(path, content):
                path = _file_path(f"{name}-{uuid.uuid4().hex[:8]}", encoded, day)
        return AddAction(
            path=path,
            size=len(content),
            partition_values={"day": day.isoformat()} if day else {},
            modification_time=_now_ms(),
            data_change=True,
            stats=encoded.statistics,
        )

    def restore_file(self, file: TableFile, rows: pa.Table) -> bool:
        """Write a file again if rows make the very bytes that its name tells; False if not."""
        encoded = self.encode(rows)
        if encoded.checksum != checksum_in(file.path):
            return False
        self.folder.put(file.path, encoded.content)
        return True

    def encode(self, rows: pa.Table) -> Encoded:
        """Return the content of a file with these rows."""
        stored = rows.drop_columns(
            [name for name in self.partition_by if name in rows.schema.names]
        )
        sink = pa.BufferOutputStream()
        pq.write_table(
            _required(stored),
            sink,
            row_group_size=ROW_GROUP_ROWS,
            write_batch_size=WRITE_BATCH_ROWS,
            **self.encoding.options(),
        )
        content = sink.getvalue()
        return Encoded(content, checksum_of(content), json.dumps(_statistics(rows)))


@dataclass(frozen=True)
class Snapshot:
    """One version of a table. Reading it is not disturbed by later commits."""

    table: Table
    delta: DeltaTable | None

    @property
    def version(self) -> int | None:
        """Version of the Delta table; None before the first commit."""
        return None if self.delta is None else self.delta.version()

    @cached_property
    def files(self) -> tuple[TableFile, ...]:
        """Active files, sorted by path."""
        if self.delta is None:
            return ()
        with storage_errors(self.table.folder):
            # pa.table() would import pandas, which takes half a second.
            stream = self.delta.get_add_actions(flatten=True)
            actions = pa.RecordBatchReader.from_stream(stream).read_all().combine_chunks()
        files = sorted(_table_files(actions), key=lambda file: file.path)
        for file in files:
            self._require_sound(file)
        return tuple(files)

    def _require_sound(self, file: TableFile) -> None:
        """Raise `StorageError` if the log names a file as this program never does."""
        parts = file.path.split("/")
        if not _DATA_FILE.fullmatch(file.path) or ".." in parts or "." in parts:
            raise StorageError(
                f"{self.table.folder}: the Delta log names the file {file.path[:200]!r}, which is "
                "not one of this table. Restore the log from a backup."
            )
        if file.rows is None or file.rows < 0 or file.size_bytes is None or file.size_bytes < 0:
            raise StorageError(
                f"{self.table.folder}: the Delta log does not say how large {file.path} is. "
                "Another program wrote it, or it was damaged: restore the log from a backup."
            )

    @property
    def paths(self) -> list[str]:
        """Where the active files are, as DuckDB knows it, sorted."""
        return [self.table.uri(file.path) for file in self.files]

    @property
    def rows(self) -> int:
        """Number of rows of all active files."""
        return sum(file.rows for file in self.files)

    @property
    def size_bytes(self) -> int:
        """Size of all active files."""
        return sum(file.size_bytes for file in self.files)

    def landed(self, unit_name: str) -> int | None:
        """Return the version of a unit of work that has landed, or None."""
        if self.delta is None:
            return None
        return self.delta.transaction_version(unit_name)

    def commit(self, change: Change) -> None:
        """Apply a change in one atomic commit on top of this snapshot.

        A file that is both added and removed stays. Raises `ConflictError` if another process
        landed one of the same units meanwhile, or removed a file; and `StorageError` if the log
        cannot be written.
        """
        both = {action.path for action in change.add} & {file.path for file in change.remove}
        with storage_errors(self.table.folder):
            actions: list[AddAction | RemoveAction] = [
                *(action for action in change.add if action.path not in both),
                *(
                    _remove_action(file, data_change=change.data_change)
                    for file in change.remove
                    if file.path not in both
                ),
            ]
            note = sealed(change.note, actions, {u.name: u.version for u in change.units})
            try:
                delta = self.delta or self._created()
                require_writable(self.table.folder, self.table.schema, delta)
                delta.create_write_transaction(
                    actions,
                    mode="append",
                    schema=self.table.schema,
                    partition_by=list(self.table.partition_by),
                    commit_properties=CommitProperties(
                        custom_metadata={NOTE: note},
                        app_transactions=[Transaction(u.name, u.version) for u in change.units],
                    ),
                )
            except CommitFailedError as error:
                if not _CONFLICT.search(str(error)):
                    raise
                raise ConflictError(
                    f"{self.table.folder}: another process changed the table at the same moment "
                    f"({first_line(error)}). Run the same command again."
                ) from None
            self.table.folder.settle_commits(self.version)

    def _created(self) -> DeltaTable:
        """Make the table, and return it as it was made, even if others have written to it since.

        So a commit on top of it meets theirs, and is told of a unit that has landed in one.
        """
        delta = _create(self.table)
        return (self.table.open_delta(version=0) if delta.version() else delta) or delta


_CONFLICT = re.compile(
    r"concurrent|changed since last commit|existing table version|already exists|"
    r"exceeded maximum commit attempts|^Failed to commit transaction: \d+$",
    re.IGNORECASE,
)
"""What the Delta library says when another commit was faster; anything else is a fault."""


def checksum_of(content: pa.Buffer | bytes) -> str:
    """Return the checksum of a file's bytes as it stands in the file's name."""
    return hashlib.sha256(content).hexdigest()[:CHECKSUM_DIGITS]


def checksum_in(path: str) -> str | None:
    """Return the checksum in a file's name; None for a file of a version that wrote none."""
    found = re.search(rf"-([0-9a-f]{{{CHECKSUM_DIGITS}}})\.parquet$", path)
    return found[1] if found else None


def _file_path(name: str, encoded: Encoded, day: date | None) -> str:
    folder = f"day={day.isoformat()}/" if day else ""
    return f"{folder}{name}-{encoded.checksum}.parquet"


def _create(table: Table) -> DeltaTable:
    return DeltaTable.create(
        table.folder.uri,
        schema=table.schema,
        mode="ignore",
        partition_by=list(table.partition_by),
        name=table.folder.name,
        description=table.description,
        storage_options=table.folder.delta_options,
        commit_properties=CommitProperties(custom_metadata={NOTE: sealed({}, [], {})}),
    )


def _required(rows: pa.Table) -> pa.Table:
    """Return the rows with columns without a null declared so.

    The file then has no list of which values are null, which takes an eighth of the time to write.
    """
    fields = [field.with_nullable(rows[field.name].null_count > 0) for field in rows.schema]
    return pa.Table.from_arrays(rows.columns, schema=pa.schema(fields))


def _statistics(rows: pa.Table) -> dict[str, Any]:
    nulls = {name: rows[name].null_count for name in rows.schema.names}
    return {"numRecords": rows.num_rows, "nullCount": nulls}


class _NullCounts(Mapping[str, int]):
    """The null counts of one file, looked up among those of all files when they are asked for.

    A table may have 100,000 files, and few jobs ask for more than a few of them.
    """

    def __init__(self, columns: Mapping[str, pa.ChunkedArray], row: int) -> None:
        self._columns = columns
        self._row = row

    def __getitem__(self, name: str) -> int:
        count: int | None = self._columns[name][self._row].as_py()
        if count is None:
            raise KeyError(name)
        return count

    def __iter__(self) -> Iterator[str]:
        return (name for name in self._columns if name in self)

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __reduce__(self) -> tuple[type[dict[str, int]], tuple[dict[str, int]]]:
        """Send another process what is of this file only."""
        return dict, (dict(self),)


def _table_files(actions: pa.Table) -> Iterator[TableFile]:
    prefix = "null_count."
    nulls = {
        name.removeprefix(prefix): actions[name]
        for name in actions.column_names
        if name.startswith(prefix)
    }
    unknown = [None] * actions.num_rows
    columns = (
        actions[name].to_pylist() if name in actions.column_names else unknown
        for name in ("path", "num_records", "size_bytes", "partition.day")
    )
    for row, (path, rows, size_bytes, day) in enumerate(zip(*columns, strict=True)):
        yield TableFile(path, rows, size_bytes, _NullCounts(nulls, row), day)


def _remove_action(file: TableFile, *, data_change: bool) -> RemoveAction:
    return RemoveAction(
        path=file.path,
        data_change=data_change,
        deletion_timestamp=_now_ms(),
        size=file.size_bytes,
        partition_values={"day": file.day.isoformat()} if file.day else {},
    )


def _now_ms() -> int:
    return int(time.time() * 1000)
