"""The names in the dictionaries of a data file: those that its rows have, and others.

Files of this program have no others. Earlier versions wrote dictionaries as they were given, with
the names of rows that were in another file, or forgotten.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import pyarrow as pa
import pyarrow.parquet as pq


@dataclass(frozen=True)
class Names:
    """The values of one column's dictionary that rows have, and those that none has."""

    used: frozenset[str]
    unused: frozenset[str]


def read_names(file: pa.NativeFile, columns: Sequence[str]) -> dict[str, Names]:
    """Return the names in each dictionary of a Parquet file, of the columns with texts."""
    metadata = pq.read_metadata(file)
    stored = [name for name in columns if name in metadata.schema.names]
    with pq.ParquetFile(file, metadata=metadata, read_dictionary=stored) as parquet:
        schema = parquet.schema_arrow
        there = [n for n in schema.names if pa.types.is_dictionary(schema.field(n).type)]
        groups = [parquet.read_row_group(i, there) for i in range(parquet.num_row_groups)]
    return {n: _names([part for rows in groups for part in rows[n].chunks]) for n in there}


def _names(parts: Sequence[pa.DictionaryArray]) -> Names:
    every: set[str] = set()
    used: set[str] = set()
    for part in parts:
        every.update(part.dictionary.to_pylist())
        used.update(part.dictionary.take(part.indices.unique().drop_null()).to_pylist())
    return Names(frozenset(used), frozenset(every - used))
