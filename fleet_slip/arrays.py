"""Types of numpy arrays, by what they hold."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
ObjectArray = NDArray[np.object_]
"""Python objects, such as integers that never overflow."""


def is_finite(values: FloatArray) -> bool:
    """Whether neither NaN nor infinity is among values, nor their sum, by which it is told."""
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(np.isfinite(values.sum()))
