"""One version of a Delta table: its files, what has landed in it, and committing on top of it."""

import hashlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import pyarrow as pa
from deltalake import CommitProperties, DeltaTable, Transaction
from deltalake.exceptions import CommitFailedError

from fleet_slip.delta.change import Change, TableFile, active_files, have_same_columns, read_actions
from fleet_slip.delta.checkpoints import keep_checksum_of_new
from fleet_slip.delta.commits import NOTE, checked_note, read_landed_units
from fleet_slip.delta.schema import require_writable
from fleet_slip.errors import ConflictError, StorageError
from fleet_slip.files.storage_errors import storage_errors

if TYPE_CHECKING:
    from fleet_slip.delta.table import Table

MANY_UNITS = 8
"""So many units of work are not asked for one by one."""

WITHDRAWN = -1
"""Number of a unit whose rows were taken out again: it may land anew."""


@dataclass(frozen=True)
class Snapshot:
    """One version of a table. Reading it is not disturbed by later commits."""

    table: "Table"
    delta: DeltaTable | None
    without: frozenset[str] = frozenset()
    """Paths of files that are left out."""

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
            every = active_files(self._actions, self.table.folder)
        return tuple(file for file in every if file.path not in self.without)

    @property
    def has_same_columns(self) -> bool:
        """Whether all active files have the same ones of the table's columns."""
        with storage_errors(self.table.folder):
            return have_same_columns(self._actions, self.table.schema.names)

    @cached_property
    def _actions(self) -> pa.Table:
        return read_actions(self.delta)

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

    def renewed(self) -> "Snapshot":
        """Return the newest version: this snapshot, or another, which takes its place."""
        if self.delta is None:
            return self.table.snapshot()
        version = self.version
        with storage_errors(self.table.folder):
            self.delta.update_incremental()
        return self if self.version == version else self.table.snapshot()

    def removed(self, before_hours: float = 0) -> set[str]:
        """Return the paths of files removed so many hours ago or earlier; of a week at least."""
        if self.delta is None:
            return set()
        with storage_errors(self.table.folder):
            found = self.delta.vacuum(
                math.ceil(before_hours), dry_run=True, enforce_retention_duration=False, full=False
            )
        return set(found)

    def landed(self, unit_name: str) -> int | None:
        """Return the version of a unit of work that has landed, or None."""
        if self.delta is None:
            return None
        with storage_errors(self.table.folder):
            return self.delta.transaction_version(unit_name)

    def landed_among(self, number: int) -> Callable[[str], bool]:
        """Return what tells whether a unit has landed; for many questions it reads the log once."""
        if self.version is None or number < MANY_UNITS:
            return lambda name: self.landed(name) not in {None, WITHDRAWN}
        return lambda name: self.units.get(name, WITHDRAWN) != WITHDRAWN

    @cached_property
    def units(self) -> Mapping[str, int]:
        """The numbers of all units that have landed, `WITHDRAWN` ones among them."""
        if self.version is None:
            return {}
        with storage_errors(self.table.folder):
            return read_landed_units(self.table.folder, self.version)

    def moment(self, version: int) -> str | None:
        """Return the digest of a version's commit, which also stands for all before it, or None."""
        if self.version is None or version > self.version:
            return None
        try:
            content = (self.table.folder / "_delta_log").read(f"{version:020}.json")
        except StorageError:
            return None
        return hashlib.sha256(content).hexdigest()

    def commit_or_discard(self, change: Change) -> None:
        """Apply a change like `commit`; after a conflict delete the files that it was to add."""
        try:
            self.commit(change)
        except ConflictError:
            self.table.discard(change.add)
            raise

    def commit(self, change: Change) -> None:
        """Apply a change in one atomic commit. Raises `ConflictError` and `StorageError`."""
        table, actions = self.table, change.actions()
        note = checked_note(change.note, actions, {u.name: u.version for u in change.units})
        with storage_errors(table.folder):
            try:
                delta = self.delta or table.create()
                require_writable(table.folder, table.schema, delta, table.unneeded(change.add))
                delta.create_write_transaction(
                    actions,
                    mode="append",
                    schema=table.schema,
                    partition_by=list(table.partition_by),
                    commit_properties=CommitProperties(
                        custom_metadata={NOTE: note},
                        app_transactions=[Transaction(u.name, u.version) for u in change.units],
                    ),
                )
            except CommitFailedError as error:
                raise table.conflict_of(error) from None
            table.folder.settle_commits(self.version)
            keep_checksum_of_new(table.folder, self.version)
