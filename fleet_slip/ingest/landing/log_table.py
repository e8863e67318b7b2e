"""Makes the Arrow table of drives that `logs` is written from."""

from collections.abc import Sequence
from itertools import groupby
from operator import itemgetter
from typing import Any

import polars as pl
import pyarrow as pa

from fleet_slip.catalogue.counts import as_arrow
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.ingest.drives.measured_drives import MeasuredDrive
from fleet_slip.ingest.mapping.mapping import Mapping

SHARED_ROWS = 2**14
"""Rows of a drive that share the memory of what is the same in all of them."""
_POLARS_TYPES: dict[pa.DataType, type[pl.DataType] | pl.DataType] = {
    pa.string(): pl.String,
    pa.float64(): pl.Float64,
    pa.int64(): pl.Int64,
    pa.int32(): pl.Int32,
    pa.date32(): pl.Date,
    pa.timestamp("us", tz="UTC"): pl.Datetime("us", "UTC"),
}


def log_table(drives: Sequence[MeasuredDrive], mapping: Mapping) -> pa.Table:
    """Return the rows of `logs` for these drives; strings are dictionary-encoded."""
    sizes = [drive.ticks.size for drive in drives]
    columns = {}
    for field in catalogue().log_schema:
        if field.name == "tick":
            columns[field.name] = pa.chunked_array(
                [as_arrow(drive.ticks) for drive in drives], field.type
            )
        elif field.name in mapping.signals:
            columns[field.name] = pa.chunked_array([drive.counts[field.name] for drive in drives])
        elif field.name in catalogue().extras:
            continue
        elif field.name in catalogue().signals:
            absent = _shared(pa.nulls(SHARED_ROWS, field.type), sum(sizes))
            columns[field.name] = pa.chunked_array(absent, field.type)
        else:
            values = [drive.metadata.get(field.name) for drive in drives]
            columns[field.name] = _repeat(values, field.type, sizes)
    return pa.table(columns)


def _repeat(values: Sequence[Any], kind: pa.DataType, times: Sequence[int]) -> pa.ChunkedArray:
    """Return each value as often as it is told; texts as codes of a dictionary."""
    if pa.types.is_string(kind):
        texts = list(dict.fromkeys(text for text in values if text is not None))
        codes = {text: i for i, text in enumerate(texts)}
        repeated = _repeat([codes.get(text) for text in values], pa.int32(), times)
        named = _as_arrow(texts, kind)
        return pa.chunked_array(
            [pa.DictionaryArray.from_arrays(chunk, named, safe=False) for chunk in repeated.chunks],
            pa.dictionary(pa.int32(), kind),
        )
    runs = [
        (value, sum(number for _, number in run))
        for value, run in groupby(zip(values, times, strict=True), key=itemgetter(0))
    ]
    scalars = zip(_as_arrow([value for value, _ in runs], kind), runs, strict=True)
    chunks = [
        chunk
        for scalar, (_, number) in scalars
        for chunk in _shared(pa.repeat(scalar, min(number, SHARED_ROWS)), number)
    ]
    repeated = pa.chunked_array(chunks, kind)
    many_short_runs = len(runs) * SHARED_ROWS > sum(times)
    return pa.chunked_array([repeated.combine_chunks()]) if many_short_runs else repeated


def _shared(rows: pa.Array, number: int) -> list[pa.Array]:
    """Return so many rows that are all the same, in chunks of some that share their memory."""
    return [
        rows.slice(0, min(SHARED_ROWS, number - start)) for start in range(0, number, SHARED_ROWS)
    ]


def _as_arrow(values: Sequence[Any], kind: pa.DataType) -> pa.Array:
    """Return values as Arrow has them; not by `pa.array`, which imports pandas if it is there."""
    return pl.Series(values, dtype=_POLARS_TYPES[kind]).to_arrow().cast(kind)
