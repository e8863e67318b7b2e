"""How quotients of integers are rounded, and counts clipped, in compiled loops.

Integers below 2^53 are exact in binary64, and so are their sums, products and comparisons. A
quotient that IEEE 754 rounds once and that is then rounded down is the exact quotient rounded down:
where it is no integer it is at least 1 / divisor away from one, and the error is smaller.
"""

from typing import Any

import numpy as np

from fleet_slip.compiling import equation


@equation
def nearest(value: float, numerator: float, divisor: float) -> Any:
    """Return value * numerator / divisor to the nearest integer, halves away from zero.

    All are integers, the divisor positive, and 2 |value| numerator + divisor below 2^53.
    """
    size = np.floor((2.0 * abs(value) * numerator + divisor) / (2.0 * divisor))
    return -size if value < 0.0 else size


@equation
def nearest_integer(value: int, divisor: int) -> Any:
    """Return value / divisor to the nearest, halves away from zero, where twice that is int64."""
    size = (2 * abs(value) + divisor) // (2 * divisor)
    return -size if value < 0 else size


@equation
def truncated(value: int, divisor: int) -> Any:
    """Return value / divisor, truncated, of int64."""
    size = abs(value) // divisor
    return -size if value < 0 else size


@equation
def clip(value: float, limit: float) -> Any:
    """Return a value clipped to +-limit; NaN stays."""
    # No `min` and `max`: with NaN, theirs depends on the order of operands.
    below = limit if value > limit else value
    return -limit if below < -limit else below
