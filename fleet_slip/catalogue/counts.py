"""From physical values to counts, as the cars' sensors and measured logs make them."""

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.signals import Signal

BLOCK = 2**14
"""Values that are rounded at once: what is made on the way stays in the processor's cache."""


def round_to_counts(values: FloatArray, signal: Signal) -> pa.Array:
    """Return `values / scale` as int16 counts, null where a value is NaN.

    Halves round to even. A value beyond the signal's valid range takes the range's end.
    """
    counts = np.empty(values.size, dtype=np.int16)
    scaled = np.empty(min(values.size, BLOCK))
    mask = None
    for start in range(0, values.size, BLOCK):
        here = slice(start, start + BLOCK)
        block = np.divide(values[here], float(signal.scale), out=scaled[: counts[here].size])
        np.rint(block, out=block).clip(signal.min_count, signal.max_count, out=block)
        absent = np.isnan(block)
        if absent.any():
            mask = np.zeros(values.size, dtype=np.bool_) if mask is None else mask
            mask[here] = absent
            block[absent] = 0
        counts[here] = block
    return pa.array(counts, mask=mask)
