"""From physical values to integer counts, for simulated sensors and measured logs alike."""

from collections.abc import Mapping, Sequence
from hashlib import blake2b
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.catalog.signals import COUNT_MAX, Signal

BLOCK = 2**14
"""Values per block, so that intermediate results stay in the processor's cache."""

EVENTFUL_CHANGES = 256
"""Minimum number of changing counts to identify a drive by them alone."""


def valid_values(values: FloatArray, signal: Signal) -> FloatArray:
    """Return values in SI units, NaN where the count is beyond the signal's valid range.

    -32768 is invalid: on board, that count means missing.
    """
    counts = np.rint(values / float(signal.scale))
    beyond = (counts < max(signal.min_count, -COUNT_MAX)) | (counts > signal.max_count)
    return np.where(beyond, np.nan, values) if beyond.any() else values


def round_chunks(chunks: Sequence[FloatArray], signal: Signal) -> pa.Array:
    """Return `values / scale` of concatenated arrays as int16 counts, null where NaN.

    Halves round to even. Values beyond the signal's valid range are clipped.
    """
    counts = np.empty(sum(chunk.size for chunk in chunks), dtype=np.int16)
    scaled, scale = np.empty(min(counts.size, BLOCK)), float(signal.scale)
    low, high = float(signal.min_count), float(signal.max_count)
    mask, end = None, 0
    for chunk in chunks:
        for start in range(0, chunk.size, BLOCK):
            values = chunk[start : start + BLOCK]
            span = slice(end, end := end + values.size)
            block = np.divide(values, scale, out=scaled[: values.size])
            np.clip(np.rint(block, out=block), low, high, out=block)
            if np.isnan(block.sum()):  # the counts are finite, and a NaN stays one
                mask = np.zeros(counts.size, dtype=np.bool_) if mask is None else mask
                mask[span] = np.isnan(block)
                block[mask[span]] = 0
            counts[span] = block
    return as_arrow(counts, mask)


def as_arrow(numbers: NDArray[Any], absent: BoolArray | None = None) -> pa.Array:
    """Return numbers as an Arrow array that shares their memory, null where they are absent.

    `pa.array` copies, and imports pandas if that is installed.
    """
    valid = None
    if absent is not None:
        valid = pa.py_buffer(np.packbits(~absent, bitorder="little"))
    kind = pa.from_numpy_dtype(numbers.dtype)
    return pa.Array.from_buffers(kind, numbers.size, [valid, pa.py_buffer(numbers)])


def as_floats(counts: pa.Array) -> FloatArray:
    """Return counts as float64, NaN where they are null. Arrow's own conversion loads pandas."""
    import polars as pl  # noqa: PLC0415 - takes a while

    column = pl.Series(counts)
    column = column.cast(pl.Float64).fill_null(np.nan) if column.null_count() else column
    return np.asarray(column.to_numpy(), dtype=np.float64)


def digest_counts(
    vehicle_id: str, day: str, ticks: NDArray[np.int32], counts: Mapping[str, pa.Array]
) -> str:
    """Return 16 characters that identify a drive by its counts.

    If few counts change, as in a standing car, the digest includes car and day.
    """
    import polars as pl  # noqa: PLC0415 - takes a while

    digest, changes = blake2b((ticks - ticks[:1]).tobytes(), digest_size=8), 0
    for name, column in sorted(counts.items()):
        if column.null_count == len(column):
            continue
        # No count is -32768. Arrow's own conversion would load pandas.
        present = pl.Series(column)
        values = (present.fill_null(-COUNT_MAX - 1) if column.null_count else present).to_numpy()
        digest.update(f"\n{name}\n".encode())
        digest.update(np.ascontiguousarray(values).data)
        if changes < EVENTFUL_CHANGES:
            changes += int(np.count_nonzero(values[1:] != values[:-1]))
    if changes < EVENTFUL_CHANGES:
        digest.update(f"\n{vehicle_id}\n{day}\n".encode())
    return digest.hexdigest()
