"""Types of numpy arrays, by their content."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pyarrow as pa


FloatArray = NDArray[np.float64]

IntArray = NDArray[np.int64]

BoolArray = NDArray[np.bool_]


Hashes = NDArray[np.uint64]
"""The first 8 bytes of SHA-256 hashes of names."""


def is_finite(values: FloatArray) -> bool:
    """Return True if all values are finite.

    Tests the sum only, so an overflowing sum of finite values also returns False.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(np.isfinite(values.sum()))


def float_column(rows: "pa.Table", name: str) -> FloatArray:
    """Return a column of rows in float64, NaN where null."""
    values: FloatArray = rows[name].to_numpy().astype(np.float64)
    return values
