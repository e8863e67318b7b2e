"""Writes rows of the logs again, for compaction and forgetting, as they were written first.

A file holds whole drives in the order of their names, each in the order of its ticks, and a
dictionary holds only values that occur. So the bytes of a file follow from its drives alone: what
was compacted or rewritten can be simulated again and is the same file.
"""

from collections.abc import Collection, Sequence

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.arrays import IntArray
from fleet_slip.delta import Table, TableFile


def read_drives(
    table: Table, files: Sequence[TableFile], without: Collection[str] = ()
) -> pa.Table:
    """Return the rows of log files, but for some drives, in the order and types of a new file.

    Columns that the catalogue no longer has are kept, after the others.
    """
    parts = [_read(table, file, without) for file in files]
    rows = pa.concat_tables(parts, promote_options="default").combine_chunks()
    order = _order(rows)
    if (np.diff(order) != 1).any():
        rows = rows.take(order)
    return pa.table({name: _compact(rows[name].combine_chunks()) for name in rows.column_names})


def _read(table: Table, file: TableFile, without: Collection[str]) -> pa.Table:
    stored = table.read(file.path)
    columns = {}
    for field in table.schema:
        if field.name in table.partition_by:
            continue
        if field.name not in stored.schema.names:
            column = pa.chunked_array([pa.nulls(stored.num_rows, field.type)])
        else:
            column = stored[field.name]
        if pa.types.is_string(field.type):
            columns[field.name] = pc.dictionary_encode(column).unify_dictionaries()
        else:
            columns[field.name] = column.cast(field.type)
    retired = [name for name in stored.schema.names if name not in table.schema.names]
    rows = pa.table(columns | {name: stored[name] for name in retired})
    ids = rows["drive_id"].combine_chunks()
    unwanted = pc.is_in(ids.dictionary, pa.array(sorted(without), ids.dictionary.type))
    return rows.filter(pc.invert(unwanted.take(ids.indices)))


def _order(rows: pa.Table) -> IntArray:
    """Return the order by drive, then tick."""
    ids = rows["drive_id"].combine_chunks()
    rank = np.argsort(np.argsort(np.array(ids.dictionary.to_pylist(), dtype=object)))
    drive = rank[ids.indices.to_numpy()] if len(rank) else np.empty(0, dtype=np.int64)
    return np.lexsort((rows["tick"].to_numpy(), drive))


def _compact(column: pa.Array) -> pa.Array:
    """Return a dictionary column with the values that occur only, in the order they occur in."""
    if not pa.types.is_dictionary(column.type):
        return column
    codes = column.indices.dictionary_encode()
    return pa.DictionaryArray.from_arrays(codes.indices, column.dictionary.take(codes.dictionary))
