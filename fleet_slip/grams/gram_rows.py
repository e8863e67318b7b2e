"""Gram rows as they are read, turned into arrays: by which signals they have."""

from collections.abc import Iterator
from hashlib import sha256

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from fleet_slip.arrays import BoolArray, IntArray
from fleet_slip.catalogue.facts import RECEIVED_FILES
from fleet_slip.regression.gram import GramTable, packed_size

Hashes = NDArray[np.uint64]
"""Hashes of drives or cars: what tells one from others, in 8 bytes."""


def by_signals(batch: pa.RecordBatch) -> Iterator[tuple[str, pa.RecordBatch, BoolArray]]:
    """Yield each set of signals in a batch of Gram rows, its rows, and which those are."""
    names = batch["signals"].unique().to_pylist()
    if len(names) == 1:
        yield names[0], batch, np.ones(len(batch), dtype=np.bool_)
        return
    for signals in names:
        mask = pc.equal(batch["signals"], signals)
        yield signals, batch.filter(mask), mask.to_numpy(zero_copy_only=False)


def gram_table(signals: str, rows: pa.Table | pa.RecordBatch) -> GramTable:
    """Return Gram rows, all of the same signals, as arrays."""
    names = tuple(signals.split(","))
    k = len(names)
    return GramTable(
        names,
        rows["n"].to_numpy(),
        _matrix(rows["sums"], k),
        _matrix(rows["products"], packed_size(k)),
    )


def _matrix(lists: pa.ChunkedArray | pa.ListArray, width: int) -> IntArray:
    chunks = lists.chunks if isinstance(lists, pa.ChunkedArray) else [lists]
    parts = [chunk.flatten().to_numpy() for chunk in chunks]
    values: IntArray = parts[0] if len(parts) == 1 else np.concatenate(parts)
    return values.reshape(-1, width)


def is_received(rows: pa.Table) -> pa.ChunkedArray:
    """Return which rows of `grams` came without a log."""
    return pc.starts_with(rows["file"].cast(pa.string()), RECEIVED_FILES)


def hash_numbers(ids: pa.Array | pa.ChunkedArray) -> Hashes:
    """Return the hash of each id of a drive or a car, see `Hashes`."""
    first = b"".join([sha256(one.encode("utf-8")).digest()[:8] for one in ids.to_pylist()])
    return np.frombuffer(first, dtype=">u8").astype(np.uint64)
