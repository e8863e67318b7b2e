"""Types of numpy arrays, by their content."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

IntArray = NDArray[np.int64]

BoolArray = NDArray[np.bool_]


Hashes = NDArray[np.uint64]
"""The first 8 bytes of SHA-256 hashes of names."""
