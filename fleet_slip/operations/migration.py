"""Brings the tables of a data root to this program and to the signal catalogue, step by step.

1. Every table gets the columns that came later. No file is touched: there they are null.
2. Files whose dictionaries have names that none of their rows has are written again.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from decimal import Decimal

from deltalake import DeltaTable, Field
from deltalake.schema import Schema

from fleet_slip.base import number_of
from fleet_slip.operations.rewriting import drop_unused_names
from fleet_slip.rendering import Answer, Part, Remark
from fleet_slip.storage.table import ALL_STATISTICS, SCALE, Evolution, Table, scales_of
from fleet_slip.warehouse.tables import Warehouse


@dataclass(frozen=True)
class MigrationReport(Answer):
    """What a migration did, and the columns of the logs that the catalogue has no longer."""

    added: tuple[str, ...]
    retired: tuple[str, ...]
    logs_version: int | None
    files_without_names: int = 0
    """Files that were written anew because they had names that none of their rows has."""

    @property
    def changed(self) -> bool:
        """Whether there was anything to do."""
        return bool(self.added or self.files_without_names)

    def parts(self) -> Iterator[Part]:
        """Return remarks: what was added and written anew."""
        if not self.changed:
            yield Remark("migrate: nothing to do, the logs agree with the signal catalogue")
        if self.added:
            yield Remark(f"added: {', '.join(self.added)}; null in the files that are there")
        if self.files_without_names:
            files = number_of(self.files_without_names, "file")
            yield Remark(f"{files} written anew, without names that none of their rows has")


def migrate(warehouse: Warehouse) -> MigrationReport:
    """Make the tables agree with program and catalogue. Again, it does nothing.

    Raises `RefusedError` if the counts are in other scales, and `ConflictError`.
    """
    warehouse.require()
    found: Evolution | None = None
    for table in (warehouse.quarantine, warehouse.grams, warehouse.logs):
        delta = table.open_delta()
        found = None
        if delta is not None:
            found = table.require_readable(delta)
            _add_columns(table, delta, found)
    if found is None:
        return MigrationReport((), (), None)
    cleaned = drop_unused_names(warehouse)
    version = warehouse.logs.snapshot().version
    return MigrationReport(found.added, found.retired, version, cleaned)


def _add_columns(table: Table, delta: DeltaTable, found: Evolution) -> None:
    fields = {field.name: field for field in Schema.from_arrow(table.schema).fields}
    scales = scales_of(table.schema)
    if not found.added:
        return
    with table.committing():
        delta.alter.set_table_properties(ALL_STATISTICS)
        delta.alter.add_columns([_with_scale(fields[n], scales) for n in found.added])


def _with_scale(field: Field, scales: Mapping[str, Decimal]) -> Field:
    metadata = {SCALE: str(scales[field.name])} if field.name in scales else {}
    return Field(field.name, field.type, nullable=True, metadata=metadata)
