"""Delta tables of a data root: snapshots, atomic commits, data files."""

from __future__ import annotations

import contextlib
import functools
import json
import random
import re
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, date, datetime
from decimal import Decimal
from functools import cached_property
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

from fleet_slip.errors import ConflictError, RefusedError, StorageError
from fleet_slip.storage.commits import (
    LATEST,
    LOG,
    NOTE,
    checked_note,
    read_removals,
    read_transactions,
)
from fleet_slip.storage.data_files import Encoded, Encoding, read_names
from fleet_slip.storage.folder import Folder, first_line, storage_errors

# pyarrow and the Delta library are imported by the functions that use them: together they take
# longer to start than a command that only reads documents.
if TYPE_CHECKING:
    import pyarrow as pa
    from deltalake import DeltaTable
    from deltalake.transaction import AddAction, RemoveAction

_DATA_FILE = re.compile(r"[\w.=-][\w.=/-]*-x[0-9a-f]{16}-[0-9a-f]{32}\.parquet", re.ASCII)
"""Path of a data file below its table: relative, without pattern characters, with checksums."""

_NULLS = "null_count."
"""Prefix of a column's null count in the log; null if the file lacks the column."""


@dataclass(frozen=True)
class TableFile:
    """An active file of a table, from the Delta log; `days` are its first and last day."""

    path: str
    rows: int
    size_bytes: int
    null_counts: Mapping[str, int]
    day: date | None = None
    days: tuple[date, date] | None = None


def absent_columns(files: Iterable[TableFile], names: Iterable[str]) -> tuple[str, ...]:
    """Return the columns that no file has, as they were added to the table later."""
    absent = dict.fromkeys(names)
    for file in files:
        if not absent:
            break
        for name in [name for name in absent if name in file.null_counts]:
            del absent[name]
    return tuple(absent)


class _NullCounts(Mapping[str, int]):
    """Null counts of a file, read on access: few jobs need those of 100,000 files."""

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
        """Pickle the counts of this file only."""
        return dict, (dict(self),)


def _table_files(actions: pa.Table, where: object) -> Iterator[TableFile]:
    """Yield the active files. Raises `StorageError` if the log names one wrongly."""
    nulls = {
        name.removeprefix(_NULLS): actions[name]
        for name in actions.column_names
        if name.startswith(_NULLS)
    }
    unknown = [None] * actions.num_rows
    columns = (
        actions[name].to_pylist() if name in actions.column_names else unknown
        for name in ("path", "num_records", "size_bytes", "partition.day", "min.day", "max.day")
    )
    for row, (path, rows, size_bytes, day, first, last) in enumerate(zip(*columns, strict=True)):
        if not _DATA_FILE.fullmatch(path) or not {".", ".."}.isdisjoint(path.split("/")):
            raise StorageError(
                f"{where}: the Delta log names the file {path[:200]!r}, which is "
                "not one of this table. Restore the log from a backup."
            )
        if rows is None or rows < 0 or size_bytes is None or size_bytes < 0:
            raise StorageError(
                f"{where}: the Delta log does not say how large {path} is. "
                "Another program wrote it, or it was damaged: restore the log from a backup."
            )
        days = (first, last) if first and last else None
        yield TableFile(path, rows, size_bytes, _NullCounts(nulls, row), day, days)


@dataclass(frozen=True)
class AppTransaction:
    """A Delta transaction identifier: a commit that has it is made exactly once.

    Two processes that commit it at once are in conflict. The content determines the version.
    """

    name: str
    version: int


@dataclass(frozen=True)
class Change:
    """Content of a commit. A file that is both added and removed remains in the table.

    `data_change` is False if rows only move between files.
    """

    add: Sequence[AddAction] = ()
    remove: Sequence[TableFile] = ()
    transactions: Sequence[AppTransaction] = ()
    note: Mapping[str, Any] = field(default_factory=dict)
    data_change: bool = True

    def actions(self) -> list[AddAction | RemoveAction]:
        """Return the actions for the Delta log, with the current time."""
        from deltalake.transaction import RemoveAction

        both = {action.path for action in self.add} & {file.path for file in self.remove}
        return [
            *(action for action in self.add if action.path not in both),
            *(
                RemoveAction(
                    path=file.path,
                    data_change=self.data_change,
                    deletion_timestamp=_now_ms(),
                    size=file.size_bytes,
                    partition_values=_partition(file.day),
                )
                for file in self.remove
                if file.path not in both
            ),
        ]


def rows_in(action: AddAction) -> int:
    """Return the number of rows of a file that an action adds."""
    return int(json.loads(action.stats)["numRecords"])


def _partition(day: date | None) -> dict[str, str | None]:
    return {"day": day.isoformat()} if day else {}


def _now_ms() -> int:
    return int(time.time() * 1000)


ATTEMPTS = 12
FIRST_WAIT_S = 0.02
LONGEST_WAIT_S = 5.0
MAX_STALE_READS = 8
"""Attempts to read tables that keep changing."""

_CONFLICT = re.compile(
    r"concurrent|changed since last commit|existing table version|already exists|"
    r"exceeded maximum commit attempts|^Failed to commit transaction: \d+$",
    re.IGNORECASE,
)
"""Messages of the Delta library about a concurrent commit; others are faults."""

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def retry_if_stale(
    tables: Sequence[Table],
    look: Callable[[], Result],
    is_damage: Callable[[Result], bool] = lambda _: False,
) -> Result:
    """Return the result of `look`; repeat it if the tables changed and it reports damage.

    The files may have been removed by a newer version. Damage or a `StorageError` counts only if
    the tables did not change meanwhile, or after `MAX_STALE_READS` attempts.
    """
    for _ in range(MAX_STALE_READS):
        before = _versions(tables)
        try:
            result = look()
            if not is_damage(result) or _versions(tables) == before:
                return result
        except StorageError:
            if _versions(tables) == before:
                raise
    return look()


def _versions(tables: Sequence[Table]) -> list[int | None]:
    versions: list[int | None] = []
    for table in tables:
        try:
            delta = table.open_delta()
        except StorageError:
            delta = None
        versions.append(None if delta is None else delta.version())
    return versions


def retry_conflicts(attempt: Callable[[], Result]) -> Result:
    """Call until it raises no `ConflictError`, with random, growing waits."""
    for number in range(ATTEMPTS - 1):
        try:
            return attempt()
        except ConflictError:
            longest = min(FIRST_WAIT_S * 2**number, LONGEST_WAIT_S)
            time.sleep(random.uniform(0, longest))  # noqa: S311 - not a secret
    return attempt()


def retrying(commit: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Decorate a committing function: repeat it after conflicts, as `retry_conflicts` does."""

    @functools.wraps(commit)
    def retried(*arguments: Parameters.args, **named: Parameters.kwargs) -> Result:
        return retry_conflicts(lambda: commit(*arguments, **named))

    return retried


# The schema in the Delta log records the scale of each column of counts.

SCALE = "scale"
"""Key of a field's metadata: the physical value of one count."""


@dataclass(frozen=True)
class Evolution:
    """Difference between the schemas of a stored table and the catalog.

    Attributes
    ----------
    added, retired
        Columns of the catalog alone, and of the table alone.
    rescaled
        Old and new scale, by column.
    """

    added: tuple[str, ...]
    retired: tuple[str, ...]
    rescaled: Mapping[str, tuple[Decimal, Decimal]]


def compare_schemas(schema: pa.Schema, delta: DeltaTable) -> Evolution:
    """Compare the catalog's schema with the stored table's."""
    with storage_errors(delta.table_uri):
        stored = {field.name: field.metadata for field in delta.schema().fields}
    scales = {name: scale for name, scale in scales_of(schema).items() if name in stored}
    return Evolution(
        added=tuple(name for name in schema.names if name not in stored),
        retired=tuple(name for name in stored if name not in schema.names),
        rescaled={
            name: (Decimal(stored[name][SCALE]), scale)
            for name, scale in scales.items()
            if SCALE in stored[name] and Decimal(stored[name][SCALE]) != scale
        },
    )


def scales_of(schema: pa.Schema) -> dict[str, Decimal]:
    """Return the scales that a schema records, by column."""
    key = SCALE.encode()
    return {
        field.name: Decimal(field.metadata[key].decode())
        for field in schema
        if field.metadata and key in field.metadata
    }


WITHDRAWN = -1
"""Version of a transaction whose rows were removed: it may be committed again."""


@dataclass(frozen=True)
class Snapshot:
    """One version of a table. Later commits do not affect it."""

    table: Table
    delta: DeltaTable | None
    without: frozenset[str] = frozenset()
    """Paths of files to ignore."""

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
            files = sorted(_table_files(self._actions, self.table.folder), key=lambda f: f.path)
        return tuple(file for file in files if file.path not in self.without)

    def commit_days(self) -> dict[str, date]:
        """Return the day of the commit that added each active file, by path."""
        if self.delta is None:
            return {}
        with storage_errors(self.table.folder):
            paths, times = (self._actions[name] for name in ("path", "modification_time"))
            days = (datetime.fromtimestamp(1e-3 * ms, UTC).date() for ms in times.to_pylist())
            return dict(zip(paths.to_pylist(), days, strict=True))

    @property
    def has_same_columns(self) -> bool:
        """True if all active files have the same columns."""
        with storage_errors(self.table.folder):
            names = {f"{_NULLS}{name}" for name in self.table.schema.names}
            counts = [self._actions[name] for name in names & {*self._actions.column_names}]
        return all(column.null_count in (0, len(column)) for column in counts)

    @cached_property
    def _actions(self) -> pa.Table:
        """The add actions of the log, one row per active file."""
        import pyarrow as pa

        if self.delta is None:
            return pa.Table.from_pylist([])
        # pa.table() would import pandas, which takes half a second.
        stream = self.delta.get_add_actions(flatten=True)
        return pa.RecordBatchReader.from_stream(stream).read_all().combine_chunks()

    @property
    def paths(self) -> list[str]:
        """Paths of the active files for DuckDB, sorted."""
        return [self.table.uri(file.path) for file in self.files]

    @property
    def rows(self) -> int:
        """Number of rows of all active files."""
        return sum(file.rows for file in self.files)

    @property
    def size_bytes(self) -> int:
        """Size of all active files."""
        return sum(file.size_bytes for file in self.files)

    def refresh(self) -> Snapshot:
        """Return the newest version: this snapshot if nobody committed."""
        newest = self.table.snapshot()
        return self if newest.version == self.version else newest

    @cached_property
    def removals(self) -> Mapping[str, int]:
        """Files removed in at least the last week, with the removal time in ms since 1970."""
        if self.version is None:
            return {}
        with storage_errors(self.table.folder):
            return read_removals(self.table.folder, self.version)

    def transaction_version(self, name: str) -> int | None:
        """Return the version of a committed transaction; None without one."""
        return self.transactions.get(name)

    def has_committed(self, name: str) -> bool:
        """Return True if a transaction was committed and not withdrawn."""
        return self.transactions.get(name, WITHDRAWN) != WITHDRAWN

    @cached_property
    def transactions(self) -> Mapping[str, int]:
        """Versions of all committed transactions by name, including `WITHDRAWN` ones."""
        if self.version is None:
            return {}
        with storage_errors(self.table.folder):
            return read_transactions(self.table.folder, self.version)

    def commit_or_discard(self, change: Change) -> None:
        """Apply a change like `commit`; after a conflict delete the files that it adds."""
        try:
            self.commit(change)
        except ConflictError:
            self.table.discard(change.add)
            raise

    def commit(self, change: Change) -> None:
        """Apply a change in one atomic commit. Raises `ConflictError` and `StorageError`."""
        from deltalake import CommitProperties, Transaction

        table, actions = self.table, change.actions()
        versions = {transaction.name: transaction.version for transaction in change.transactions}
        note = checked_note(change.note, actions, versions)
        with table.committing():
            delta = self.delta or table.create()
            added = (json.loads(action.stats)["nullCount"] for action in change.add)
            table.require_writable({name for columns in added for name in columns}, delta)
            delta.create_write_transaction(
                actions,
                mode="append",
                schema=table.schema,
                partition_by=list(table.partition_by),
                commit_properties=CommitProperties(
                    custom_metadata={NOTE: note},
                    app_transactions=[
                        Transaction(transaction.name, transaction.version)
                        for transaction in change.transactions
                    ],
                ),
            )
            table.folder.settle_commits(self.version)


def _stamp(snapshot: Snapshot) -> object:
    """Return a value that identifies the log up to a snapshot; None after a newer commit."""
    log, version = snapshot.table.folder / LOG, snapshot.version
    if version is None or log.stamp(f"{version + 1:020}.json") is not None:
        return None
    commit = log.stamp(f"{version:020}.json")
    return None if commit is None else (commit, log.stamp(LATEST))


FENCE = "fleet_slip.fence"
"""Table property whose change makes pending commits conflict."""

ALL_STATISTICS = {"delta.dataSkippingNumIndexedCols": "-1"}
"""Table property: statistics of all columns. By default Delta reads those of 32."""


@dataclass(frozen=True)
class Table:
    """A Delta table below a data root."""

    folder: Folder
    schema: pa.Schema
    encoding: Encoding
    partition_by: tuple[str, ...] = ()
    description: str = ""
    optional: tuple[str, ...] = ()
    """Columns that a file has only if they have values."""
    _newest: dict[object, Snapshot] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )
    """The newest snapshot by its stamp. Opening a snapshot takes longer than testing the stamp."""

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle without the newest snapshot."""
        fields = (self.folder, self.schema, self.encoding, self.partition_by)
        return Table, (*fields, self.description, self.optional)

    @property
    def usual_schema(self) -> pa.Schema:
        """The schema without the optional columns."""
        import pyarrow as pa

        return pa.schema([field for field in self.schema if field.name not in self.optional])

    def snapshot(self, version: int | None = None, *, reload: bool = False) -> Snapshot:
        """Return the newest version, or a given one; empty if unwritten. Raises `StorageError`.

        Returns the same snapshot while nobody commits. `reload` reads the whole log instead, which
        detects later damage.
        """
        if version is not None:
            return Snapshot(self, self.open_delta(version))
        for stamp, opened in list(self._newest.items()):
            if not reload and _stamp(opened) == stamp:
                return opened
        delta = self.open_delta()
        if delta is not None:
            self.require_readable(delta)
        snapshot = Snapshot(self, delta)
        self._newest.clear()
        if (stamp := _stamp(snapshot)) is not None:
            self._newest[stamp] = snapshot
        return snapshot

    def open_delta(self, version: int | None = None) -> DeltaTable | None:
        """Return the newest Delta table, or a version; None if unwritten."""
        from deltalake import DeltaTable
        from deltalake.exceptions import TableNotFoundError

        with storage_errors(self.folder):
            try:
                return DeltaTable(
                    self.folder.uri, version=version, storage_options=self.folder.delta_options
                )
            except TableNotFoundError:
                return None

    def uri(self, path: str) -> str:
        """Return the path of a file for DuckDB."""
        return f"{self.folder.uri}/{path}"

    def read(self, path: str, columns: Sequence[str] | None = None) -> pa.Table:
        """Return the rows of a file, or some columns. Raises `StorageError` for a damaged file."""
        import pyarrow.parquet as pq

        self.folder.check(path)
        with storage_errors(f"{self.folder}/{path}"), self.folder.open(path) as file:
            names = None if columns is None else list(columns)
            # Not `read_table`: it imports pyarrow.dataset, and with it pandas if that is installed.
            with pq.ParquetFile(file, pre_buffer=True) as parquet:
                rows = parquet.read(columns=names)
        if absent := set(names or ()).difference(rows.column_names):
            raise StorageError(f"{self.folder}/{path}: no column {min(absent)}.")
        return rows

    def read_combinations(self, path: str, columns: Sequence[str]) -> pa.Table:
        """Return the distinct combinations of text columns in a file. Raises `StorageError`."""
        import pyarrow as pa

        rows = self.read(path, columns).unify_dictionaries()
        combinations = rows.group_by(list(columns), use_threads=False).aggregate([])
        return combinations.cast(pa.schema([(name, pa.string()) for name in columns]))

    def read_names(self, path: str) -> dict[str, frozenset[str]]:
        """Return the names that rows of one of the table's files have, by column."""
        with storage_errors(f"{self.folder}/{path}"), self.folder.open(path) as file:
            return read_names(file, self.encoding.dictionary)

    def write_file(self, name: str, rows: pa.Table, day: date | None = None) -> AddAction:
        """Write rows durably to the file NAME-CHECKSUMS.parquet; see `put`."""
        return self.put(name, self.encode(rows), day)

    def put(self, name: str, encoded: Encoded, day: date | None = None) -> AddAction:
        """Write a content durably to the file NAME-CHECKSUMS.parquet; return its add action.

        The file is part of the table after the commit. If the name exists, the new file gets a
        longer one, so that its writer can delete it after a conflict.
        """
        from deltalake.transaction import AddAction

        path = encoded.path(name, day)
        while not self.folder.create(path, encoded.content):
            path = encoded.path(f"{name}-{uuid.uuid4().hex[:8]}", day)
        return AddAction(
            path=path,
            size=len(encoded.content),
            partition_values=_partition(day),
            modification_time=_now_ms(),
            data_change=True,
            stats=encoded.statistics,
        )

    def discard(self, actions: Iterable[AddAction]) -> None:
        """Delete files that this process wrote and could not commit.

        Reads the log first: if the response to a commit was lost, its repetition is a conflict, but
        the files are committed.
        """
        committed = {file.path for file in Snapshot(self, self.open_delta()).files}
        for action in actions:
            if action.path not in committed:
                self.folder.delete(action.path)

    def encode(self, rows: pa.Table) -> Encoded:
        """Return the content of a file with these rows, and the scales of its fields."""
        import pyarrow as pa

        metadata = {field.name: field.metadata for field in self.schema}
        fields = [field.with_metadata(metadata.get(field.name)) for field in rows.schema]
        rows = pa.Table.from_arrays(rows.columns, schema=pa.schema(fields))
        return self.encoding.encode(rows, self.partition_by)

    def require_readable(self, delta: DeltaTable) -> Evolution:
        """Return the differences to the catalog. Raises `RefusedError` for other scales."""
        evolution = compare_schemas(self.schema, delta)
        if evolution.rescaled:
            changes = ", ".join(
                f"{n} {old} -> {new}" for n, (old, new) in evolution.rescaled.items()
            )
            raise RefusedError(
                f"{self.folder}: the stored counts have other scales than the signal catalog "
                f"({changes}). Use the catalog that the data was written with, or ingest the "
                "logs into another data root."
            )
        return evolution

    def require_writable(self, columns: Iterable[str], delta: DeltaTable | None = None) -> None:
        """Raise `RefusedError` if the table lacks one of these columns."""
        delta = delta or self.open_delta()
        added = compare_schemas(self.schema, delta).added if delta else ()
        unneeded = frozenset(self.optional).difference(columns)
        if needed := [name for name in added if name not in unneeded]:
            raise RefusedError(
                f"{self.folder}: the table lacks columns of the signal catalog: "
                f"{', '.join(needed)}. Add them with: fleet-slip migrate"
            )

    def fence(self) -> None:
        """Make every pending commit conflict.

        Delta refuses commits that began before a change of metadata, here of a property. Raises
        `ConflictError` if others keep changing the table.
        """
        from deltalake import CommitProperties

        note = CommitProperties(custom_metadata={NOTE: checked_note({"job": "fence"}, [], {})})

        def attempt() -> None:
            with self.committing():
                delta = self.open_delta() or self.create()
                delta.alter.set_table_properties(
                    {FENCE: uuid.uuid4().hex}, raise_if_not_exists=False, commit_properties=note
                )
                self.folder.settle_commits(delta.version() - 1)

        retry_conflicts(attempt)

    @contextlib.contextmanager
    def committing(self) -> Iterator[None]:
        """Translate a commit's failures to `ConflictError` or `StorageError`."""
        from deltalake.exceptions import CommitFailedError

        with storage_errors(self.folder):
            try:
                yield
            except CommitFailedError as error:
                if not _CONFLICT.search(str(error)):
                    raise
                raise ConflictError(
                    f"{self.folder}: another process changed the table at the same moment "
                    f"({first_line(error)}). Run the same command again."
                ) from None

    def create(self) -> DeltaTable:
        """Create the table; return version 0, so that a commit on it conflicts with others'."""
        from deltalake import CommitProperties, DeltaTable

        delta = DeltaTable.create(
            self.folder.uri,
            schema=self.schema,
            mode="ignore",
            partition_by=list(self.partition_by),
            name=self.folder.name,
            description=self.description,
            configuration=ALL_STATISTICS,
            storage_options=self.folder.delta_options,
            commit_properties=CommitProperties(custom_metadata={NOTE: checked_note({}, [], {})}),
        )
        return (self.open_delta(version=0) if delta.version() else delta) or delta
