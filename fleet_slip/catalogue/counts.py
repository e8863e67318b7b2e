"""From physical values to counts, as the cars' sensors and measured logs make them."""

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.signals import Signal


def round_to_counts(values: FloatArray, signal: Signal) -> pa.Array:
    """Return `values / scale` as int16 counts, null where a value is NaN.

    Halves round to even. A value beyond the signal's valid range takes the range's end.
    """
    absent = np.isnan(values)
    counts = np.rint(values / float(signal.scale)).clip(signal.min_count, signal.max_count)
    return pa.array(np.where(absent, 0, counts).astype(np.int16), mask=absent)
