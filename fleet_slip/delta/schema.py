"""Which signals and scales a stored table has, beside those of the catalogue.

A count means nothing without its scale, so the schema in the Delta log records each. It changes in
the commit that exchanges the files (`fleet_slip.maintenance.migration`).
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from decimal import Decimal

import pyarrow as pa
from deltalake import DeltaTable
from deltalake.exceptions import DeltaError

from fleet_slip.errors import RefusedError, StorageError
from fleet_slip.files.folder import Folder

SCALE = "scale"
"""Key of a field's metadata: the physical value of one count, as in the catalogue."""

TARGET = "migrating_to"
"""Key of a field's metadata: the new scale while a migration is under way, else empty or absent."""


@dataclass(frozen=True)
class Evolution:
    """How a stored table and the catalogue differ.

    Attributes:
        added, retired: columns of the catalogue alone, and of the table alone.
        rescaled: old and new scale of the signals whose counts mean something else.
        unrecorded: signals whose scale the table does not record, and which is taken to be ours.
        migrating: a migration was begun and has not ended.
    """

    added: tuple[str, ...]
    retired: tuple[str, ...]
    rescaled: Mapping[str, tuple[Decimal, Decimal]]
    unrecorded: tuple[str, ...]
    migrating: bool

    @property
    def pending(self) -> bool:
        """Whether there is anything to migrate. A retired signal needs nothing."""
        return bool(self.added or self.rescaled or self.unrecorded or self.migrating)


def compare_schemas(schema: pa.Schema, delta: DeltaTable) -> Evolution:
    """Compare the schema of the catalogue with that of a stored table."""
    try:
        stored = {field.name: field.metadata for field in delta.schema().fields}
    except DeltaError as error:
        raise StorageError(f"{delta.table_uri}: its schema cannot be read: {error}") from None
    scales = {name: scale for name, scale in scales_of(schema).items() if name in stored}
    return Evolution(
        added=tuple(name for name in schema.names if name not in stored),
        retired=tuple(name for name in stored if name not in schema.names),
        rescaled={
            name: (Decimal(stored[name][SCALE]), scale)
            for name, scale in scales.items()
            if SCALE in stored[name] and Decimal(stored[name][SCALE]) != scale
        },
        unrecorded=tuple(name for name in scales if SCALE not in stored[name]),
        migrating=any(metadata.get(TARGET) for metadata in stored.values()),
    )


def scales_of(schema: pa.Schema) -> dict[str, Decimal]:
    """Return the scales that a schema records, by column."""
    key = SCALE.encode()
    return {
        field.name: Decimal(field.metadata[key].decode())
        for field in schema
        if field.metadata and key in field.metadata
    }


def require_readable(folder: Folder, schema: pa.Schema, delta: DeltaTable) -> None:
    """Raise `RefusedError` if a table's counts are in other scales than the catalogue's."""
    found = compare_schemas(schema, delta)
    if found.rescaled:
        changes = ", ".join(f"{n} {old} -> {new}" for n, (old, new) in found.rescaled.items())
        raise RefusedError(
            f"{folder}: the counts are in other scales than those of the signal catalogue "
            f"({changes}). Use the catalogue that the data was written with, or convert the data: "
            "fleet-slip migrate"
        )


def require_writable(
    folder: Folder, schema: pa.Schema, delta: DeltaTable, unneeded: Collection[str] = ()
) -> None:
    """Raise `RefusedError` if a table is being migrated, or lacks other than `unneeded` columns."""
    found = compare_schemas(schema, delta)
    if found.migrating:
        raise RefusedError(
            f"{folder}: a migration to other scales is under way, or was interrupted. Wait for it, "
            "or run it again: fleet-slip migrate"
        )
    if needed := [name for name in found.added if name not in unneeded]:
        raise RefusedError(
            f"{folder}: the signal catalogue has columns that the table has not: "
            f"{', '.join(needed)}. Add them with: fleet-slip migrate"
        )
