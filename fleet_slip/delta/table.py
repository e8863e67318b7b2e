"""A Delta table of a data root: its files, and what it takes to open and make it."""

import uuid
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import date

import pyarrow as pa
import pyarrow.parquet as pq
from deltalake import CommitProperties, DeltaTable
from deltalake.exceptions import CommitFailedError, TableNotFoundError
from deltalake.transaction import AddAction

from fleet_slip.delta.change import TableFile, addition, columns_in
from fleet_slip.delta.commits import NOTE, checked_note
from fleet_slip.delta.conflicts import is_conflict, retry_conflicts
from fleet_slip.delta.encoding import Encoded, Encoding, Names, read_names
from fleet_slip.delta.log_check import require_sound_log
from fleet_slip.delta.schema import require_readable, require_writable
from fleet_slip.delta.snapshot import Snapshot
from fleet_slip.errors import ConflictError, StorageError
from fleet_slip.files.checksums import checksum_in
from fleet_slip.files.folder import Folder
from fleet_slip.files.storage_errors import first_line, storage_errors

FENCE = "fleet_slip.fence"
"""Property of a table that is changed so that commits under way are in conflict."""

ALL_STATISTICS = {"delta.dataSkippingNumIndexedCols": "-1"}
"""Property of a table of which all columns have statistics: as a rule Delta reads those of 32."""


@dataclass(frozen=True)
class Table:
    """A Delta table below a data root."""

    folder: Folder
    schema: pa.Schema
    encoding: Encoding
    partition_by: tuple[str, ...] = ()
    description: str = ""
    optional: tuple[str, ...] = ()
    """Columns that a file has only where it has values of them."""

    @property
    def usual_schema(self) -> pa.Schema:
        """The schema without the optional columns."""
        return pa.schema([field for field in self.schema if field.name not in self.optional])

    def snapshot(self, version: int | None = None) -> Snapshot:
        """Return the table as it is, or at a version; empty if unwritten. Raises `StorageError`."""
        delta = self.open_delta(version)
        if delta is not None:
            require_sound_log(self.folder, delta.version())
        if delta is not None and version is None:
            require_readable(self.folder, self.schema, delta)
        return Snapshot(self, delta)

    def unchecked_snapshot(self) -> Snapshot:
        """Return the table as it is now, though its log may be damaged: to look for damage."""
        delta = self.open_delta()
        if delta is not None:
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
        """Return the rows of a file, or some columns. Raises `StorageError` if it is damaged."""
        self.folder.check(path)
        with storage_errors(f"{self.folder}/{path}"), self.folder.open(path) as file:
            wanted = None if columns is None else list(columns)
            # Not `read_table`: it imports pyarrow.dataset, and with it pandas if that is installed.
            with pq.ParquetFile(file, pre_buffer=True) as parquet:
                rows = parquet.read(columns=wanted)
        if absent := set(wanted or ()).difference(rows.column_names):
            raise StorageError(f"{self.folder}/{path}: no column {min(absent)}.")
        return rows

    def read_combinations(self, path: str, columns: Sequence[str]) -> pa.Table:
        """Return each combination of the texts of some columns in a file, once, from dictionaries.

        That takes a third of the time of reading the columns. Raises `StorageError` as `read`.
        """
        self.folder.check(path)
        names = list(columns)
        with (
            storage_errors(f"{self.folder}/{path}"),
            self.folder.open(path) as file,
            pq.ParquetFile(file, read_dictionary=names, pre_buffer=True) as parquet,
        ):
            rows = parquet.read(columns=names).unify_dictionaries()
        found = rows.group_by(names, use_threads=False).aggregate([])
        return found.cast(pa.schema([(name, pa.string()) for name in found.column_names]))

    def read_metadata(self, path: str) -> pq.FileMetaData:
        """Return the footer of one of the table's files."""
        with storage_errors(f"{self.folder}/{path}"), self.folder.open(path) as file:
            return pq.read_metadata(file)

    def read_names(self, path: str) -> dict[str, Names]:
        """Return the names in the dictionaries of one of the table's files, by column."""
        with storage_errors(f"{self.folder}/{path}"), self.folder.open(path) as file:
            return read_names(file, self.encoding.dictionary)

    def has_unused_names(self, path: str) -> bool:
        """Whether a dictionary of one of the table's files has names that none of its rows has."""
        return any(names.unused for names in self.read_names(path).values())

    def write_file(self, name: str, rows: pa.Table, day: date | None = None) -> AddAction:
        """Write rows to the file NAME-CHECKSUMS.parquet, durably; see `put`."""
        return self.put(name, self.encode(rows), day)

    def put(self, name: str, encoded: Encoded, day: date | None = None) -> AddAction:
        """Write a content to the file NAME-CHECKSUMS.parquet, durably; return its add action.

        It is in the table once committed. Where that name is taken, the new file gets a longer one:
        what is not committed is its writer's alone, to delete.
        """
        path = encoded.path(name, day)
        while not self.folder.create(path, encoded.content):
            path = encoded.path(f"{name}-{uuid.uuid4().hex[:8]}", day)
        return addition(path, encoded, day)

    def discard(self, actions: Iterable[AddAction]) -> None:
        """Delete files that this process wrote and its conflict left uncommitted.

        The log is asked first: a commit whose answer was lost conflicts with itself.
        """
        landed = {file.path for file in Snapshot(self, self.open_delta()).files}
        for action in actions:
            if action.path not in landed:
                self.folder.delete(action.path)

    def restore_file(self, file: TableFile, rows: pa.Table) -> bool:
        """Write a file again if rows make the very bytes that its name tells; False if not."""
        encoded = self.encode(rows)
        if encoded.checksum != checksum_in(file.path):
            return False
        self.folder.put(file.path, encoded.content)
        return True

    def encode(self, rows: pa.Table) -> Encoded:
        """Return the content of a file with these rows."""
        return self.encoding.encode(rows, self.partition_by)

    def require_writable(self, columns: Iterable[str]) -> None:
        """Raise `RefusedError` if rows with some of the optional columns cannot be committed."""
        delta = self.open_delta()
        if delta is not None:
            without = frozenset(self.optional).difference(columns)
            require_writable(self.folder, self.schema, delta, without)

    def unneeded(self, added: Iterable[AddAction]) -> frozenset[str]:
        """Return the optional columns that none of some new files has."""
        return frozenset(self.optional).difference(*map(columns_in, added))

    def fence(self) -> None:
        """Make a conflict of every commit that began before now and has not landed.

        Delta refuses commits that began before a change of metadata, here of a property. Raises
        `ConflictError` if others keep changing the table.
        """
        note = CommitProperties(custom_metadata={NOTE: checked_note({"job": "fence"}, [], {})})

        def attempt() -> None:
            with storage_errors(self.folder):
                try:
                    delta = self.open_delta() or self.create()
                    delta.alter.set_table_properties(
                        {FENCE: uuid.uuid4().hex}, raise_if_not_exists=False, commit_properties=note
                    )
                except CommitFailedError as error:
                    raise self.conflict_of(error) from None
                self.folder.settle_commits(delta.version() - 1)

        retry_conflicts(attempt)

    def conflict_of(self, error: CommitFailedError) -> Exception:
        """Return what a failed commit is to be raised as: a conflict, or the fault that it is."""
        if not is_conflict(error):
            return error
        return ConflictError(
            f"{self.folder}: another process changed the table at the same moment "
            f"({first_line(error)}). Run the same command again."
        )

    def create(self) -> DeltaTable:
        """Make the table, and return it as made, so that a commit on it meets those of others."""
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
