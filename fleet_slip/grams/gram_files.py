"""The files of the table `grams`: what is written, and which are written again.

A file holds the Gram rows of one feature set, so that reading one set reads no other.
"""

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from itertools import accumulate

import pyarrow as pa
import pyarrow.compute as pc
from deltalake.transaction import AddAction

from fleet_slip.delta import (
    Snapshot,
    TableFile,
)
from fleet_slip.warehouse.tables import Warehouse

FILE_ROWS = 100_000
"""Gram rows of a file, some 700 bytes each; a file with fewer is small. Rewriting takes the memory
of a few files, however many Gram rows there are."""

SMALL_FILES_MAX = 32
"""So many small Gram files may stand side by side before a commit merges some."""


def write_rows(warehouse: Warehouse, parts: Iterable[pa.Table]) -> list[AddAction]:
    """Write Gram rows as files that no commit names yet; return what adds them."""
    actions: list[AddAction] = []
    waiting: list[pa.Table] = []
    for part in parts:
        for first in range(0, part.num_rows, FILE_ROWS):
            waiting.append(part.slice(first, FILE_ROWS))
            if sum(rows.num_rows for rows in waiting) >= FILE_ROWS:
                actions += _write_files(warehouse, pa.concat_tables(waiting))
                waiting.clear()
    return actions + (_write_files(warehouse, pa.concat_tables(waiting)) if waiting else [])


def _write_files(warehouse: Warehouse, rows: pa.Table) -> list[AddAction]:
    """Write one file for each feature set, so that reading one set reads no other."""
    actions = []
    for identity in sorted(rows["feature_set"].unique().to_pylist()):
        part = rows.filter(pc.equal(rows["feature_set"], identity))
        actions.append(warehouse.grams.write_file(f"{identity}-{_content_digest(part)}", part))
    return actions


def files_to_rewrite(grams: Snapshot, stale: frozenset[str]) -> list[TableFile]:
    """Return the Gram files with rows of stale log files, and small ones that are to be merged."""
    merged = _files_to_merge(grams)
    return [
        file
        for file in grams.files
        if file.path in merged or (stale and not stale.isdisjoint(_log_files_of(grams, file)))
    ]


def _files_to_merge(grams: Snapshot) -> set[str]:
    """Return the smallest files, enough for one file of the usual size, where too many are small.

    Each night merges a few, so that none has to merge all.
    """
    small = sorted((file.rows, file.path) for file in grams.files if file.rows < FILE_ROWS)
    if len(small) <= SMALL_FILES_MAX:
        return set()
    rows = list(accumulate(rows for rows, _ in small))
    return {path for (_, path), so_far in zip(small, rows, strict=True) if so_far <= 2 * FILE_ROWS}


def _log_files_of(grams: Snapshot, file: TableFile) -> set[str]:
    return set(grams.table.read(file.path, ["file"])["file"].unique().to_pylist())


def rows_to_keep(
    grams: Snapshot, files: Sequence[TableFile], stale: frozenset[str]
) -> Iterator[pa.Table]:
    """Yield the Gram rows of files, without those of stale log files."""
    dropped = pa.array(sorted(stale), pa.string())
    for file in files:
        schema = grams.table.schema
        rows = grams.table.read(file.path).select(schema.names).cast(schema)
        yield rows.filter(pc.invert(pc.is_in(rows["file"], dropped)))


def _content_digest(rows: pa.Table) -> str:
    """Name a Gram file by its content, so that a repeated run writes the same file again."""
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, rows.schema) as writer:
        writer.write_table(rows.combine_chunks())
    return hashlib.sha256(sink.getvalue()).hexdigest()[:16]
