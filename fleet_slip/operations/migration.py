"""Brings the table `logs` to the signal catalogue: new columns, other scales.

Quarantine and Gram rows get later columns, too, and dictionaries lose names of other files. A new
column touches no file: null where it lacks. For another scale every count is rewritten:

1. The table's schema announces it: Delta refuses commits begun before, and we later ones;
   readers with the old catalogue go on reading the old files.
2. The files are rewritten, with counts rounded to the nearest (halves to even) count.
3. One commit exchanges all files and the schema's scales. Until then nothing old is gone.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pyarrow as pa
from deltalake import CommitProperties, DeltaTable, Field
from deltalake.schema import Schema
from deltalake.transaction import AddAction
from numpy.typing import NDArray

from fleet_slip.arrays import IntArray
from fleet_slip.base import Progress, no_progress
from fleet_slip.catalogue.signals import COUNT_MAX
from fleet_slip.errors import ConflictError, RefusedError, StorageError
from fleet_slip.grams.job import land_ahead
from fleet_slip.operations.rewriting import drop_unused_names, read_kept_drives
from fleet_slip.storage.commits import NOTE, checked_note
from fleet_slip.storage.table import (
    ALL_STATISTICS,
    SCALE,
    TARGET,
    Evolution,
    Snapshot,
    Table,
    TableFile,
    compare_schemas,
    scales_of,
)
from fleet_slip.warehouse.tables import Warehouse


@dataclass(frozen=True)
class MigrationReport:
    """What a migration did."""

    added: tuple[str, ...]
    retired: tuple[str, ...]
    rescaled: Mapping[str, tuple[Decimal, Decimal]]
    files_rewritten: int
    rows_rewritten: int
    logs_version: int | None
    files_without_names: int = 0
    """Files that were written anew because they had names that none of their rows has."""

    @property
    def changed(self) -> bool:
        """Whether there was anything to do but to record scales."""
        return bool(self.added or self.rescaled or self.files_without_names)


def migrate(warehouse: Warehouse, progress: Progress = no_progress) -> MigrationReport:
    """Make the logs agree with the catalogue; `progress` counts rows. Again, it does nothing.

    Raises `RefusedError` if counts would not fit int16: then only the announcement is there, until
    a migration back; and `ConflictError`.
    """
    warehouse.require()
    for other in (warehouse.quarantine, warehouse.grams):  # columns that came later
        known = other.open_delta()
        if known is not None and (change := compare_schemas(other.schema, known)).added:
            _add_columns(other, known, change)
    table = warehouse.logs
    delta = table.open_delta()
    if delta is None:
        return MigrationReport((), (), {}, 0, 0, None)
    found = compare_schemas(table.schema, delta)
    files = 0
    rows = 0
    if found.pending:
        _add_columns(table, delta, found)
    if found.rescaled:
        _announce(table, found)
        files, rows = _rescale(warehouse, found, progress)
    elif found.migrating:
        _settle(table)
    cleaned = drop_unused_names(warehouse)
    version = _now(table).version()
    return MigrationReport(
        found.added, found.retired, found.rescaled, files, rows, version, cleaned
    )


def rescale_counts(counts: NDArray[np.int16], ratio: Fraction) -> IntArray:
    """Return counts times a ratio, rounded to the nearest integer, halves to even."""
    scaled = 2 * counts.astype(np.int64) * ratio.numerator + ratio.denominator
    nearest = scaled // (2 * ratio.denominator)
    tie = scaled % (2 * ratio.denominator) == 0
    return np.asarray(nearest - (tie & (nearest % 2 == 1)), dtype=np.int64)


def _add_columns(table: Table, delta: DeltaTable, found: Evolution) -> None:
    fields = {field.name: field for field in Schema.from_arrow(table.schema).fields}
    scales = scales_of(table.schema)
    with table.committing():
        if found.added:
            delta.alter.set_table_properties(ALL_STATISTICS)
            delta.alter.add_columns([_with_scale(fields[n], scales) for n in found.added])
        for name in found.unrecorded:
            delta.alter.set_column_metadata(name, {SCALE: str(scales[name])})


def _with_scale(field: Field, scales: Mapping[str, Decimal]) -> Field:
    metadata = {SCALE: str(scales[field.name])} if field.name in scales else {}
    return Field(field.name, field.type, nullable=True, metadata=metadata)


def _announce(table: Table, found: Evolution) -> None:
    with table.committing():
        delta = _now(table)
        for name, (old, new) in found.rescaled.items():
            delta.alter.set_column_metadata(name, {SCALE: str(old), TARGET: str(new)})


def _settle(table: Table) -> None:
    """Take back the announcement of a migration: the scales are those of the catalogue again."""
    with table.committing():
        delta = _now(table)
        for field in delta.schema().fields:
            if field.metadata.get(TARGET):
                # Keys can be set, not removed.
                delta.alter.set_column_metadata(field.name, {TARGET: ""})


def _rescale(warehouse: Warehouse, found: Evolution, progress: Progress) -> tuple[int, int]:
    table = warehouse.logs
    delta = _now(table)
    before = Snapshot(table, delta)
    ratios = {n: Fraction(old) / Fraction(new) for n, (old, new) in found.rescaled.items()}
    actions: list[AddAction] = []
    try:
        for file in before.files:
            actions.append(_rewrite(table, file, ratios))
            progress(file.rows, before.rows)
        land_ahead(warehouse, actions, before.files)
        with table.committing():
            delta.create_write_transaction(
                list(actions),
                mode="overwrite",
                schema=table.schema,
                partition_by=list(table.partition_by),
                commit_properties=CommitProperties(
                    custom_metadata={NOTE: checked_note({"job": "migrate"}, actions, {})}
                ),
            )
    except (ConflictError, RefusedError):
        table.discard(actions)
        raise
    return len(actions), before.rows


def _rewrite(table: Table, file: TableFile, ratios: Mapping[str, Fraction]) -> AddAction:
    rows = read_kept_drives(table, [file])
    for name, ratio in ratios.items():
        column = rows[name].combine_chunks()
        absent = column.is_null().to_numpy(zero_copy_only=False)
        counts = rescale_counts(column.fill_null(0).to_numpy(), ratio)
        if len(counts) and np.abs(counts).max() > COUNT_MAX:
            raise RefusedError(
                f"{file.path}: counts of {name} up to {np.abs(counts).max():,} in the new scale "
                f"do not fit 16 bits. Choose a wider scale."
            )
        stored = pa.array(counts.astype(np.int16), mask=absent)
        rows = rows.set_column(rows.schema.get_field_index(name), name, stored)
    stem = re.sub(r"(-[0-9a-f]+)?\.parquet$", "", file.path.rpartition("/")[2])
    return table.write_file(stem, rows, file.day)


def _now(table: Table) -> DeltaTable:
    delta = table.open_delta()
    if delta is None:
        raise StorageError(f"{table.folder}: the table is gone. Restore it from a backup.")
    return delta
