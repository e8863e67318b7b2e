"""Compiled loops of windows over one drive: running sums, each quotient rounded and clipped.

Values and sums are integers below 2^53 in binary64, so that additions are exact. A quotient x / y
of such integers, rounded once by IEEE 754 and then down, is the exact quotient rounded down: where
it is no integer it is at least 1 / y away from one, and the rounding error is smaller.
"""

from typing import Any

import numpy as np

from fleet_slip.compiling import equation, kernel


@equation
def nearest(value: float, numerator: float, divisor: float) -> Any:
    """Return value * numerator / divisor to the nearest integer, halves away from zero.

    All are integers, the divisor positive, and 2 |value| numerator + divisor below 2^53.
    """
    size = np.floor((2.0 * abs(value) * numerator + divisor) / (2.0 * divisor))
    return -size if value < 0.0 else size


@equation
def clip(value: float, limit: float) -> float:
    """Return a value clipped to +-limit."""
    return min(max(value, -limit), limit)


@kernel
def quotients_of_whole(
    sums: Any,
    first: int,
    ticks: int,
    numerator: float,
    fixed: float,
    each: float,
    limit: float,
    out: Any,
    clipped: Any,
) -> None:
    """Write the quotients of the last `ticks` rows of a drive without holes or missing values.

    `sums` (rows + 1,) are those of the values before each row; `out` and `clipped` (block,) are of
    the rows from `first`. A sum is divided by fixed + each * number of rows.
    """
    begins = min(max(ticks - 1 - first, 0), len(out))
    for i in range(begins):
        size = first + i + 1
        value = nearest(sums[size], numerator, fixed + each * size)
        clipped[i] += 1.0 if abs(value) > limit else 0.0
        out[i] = clip(value, limit)
    # Slices of one length and a count of integers: then the loop is vectorised.
    rows = len(out) - begins
    until = first + begins + 1
    newest, oldest = sums[until : until + rows], sums[until - ticks : until - ticks + rows]
    written = out[begins:]
    divisor = fixed + each * ticks
    outside = 0
    for i in range(rows):
        value = nearest(newest[i] - oldest[i], numerator, divisor)
        outside += 1 if abs(value) > limit else 0
        written[i] = clip(value, limit)
    if outside:
        for i in range(rows):
            value = nearest(newest[i] - oldest[i], numerator, divisor)
            clipped[begins + i] += 1.0 if abs(value) > limit else 0.0


@kernel
def quotients(
    sums: Any,
    counts: Any,
    begin: Any,
    first: int,
    numerator: float,
    fixed: float,
    each: float,
    limit: float,
    out: Any,
    clipped: Any,
) -> None:
    """Write the same of any drive: the values of the rows begin[t] to t.

    `counts` (rows + 1,) is how many values there are before each row. A row without a value of its
    own gets NaN.
    """
    for t in range(first, first + len(out)):
        if counts[t + 1] == counts[t]:
            out[t - first] = np.nan
            continue
        divisor = fixed + each * (counts[t + 1] - counts[begin[t]])
        value = nearest(sums[t + 1] - sums[begin[t]], numerator, divisor)
        clipped[t - first] += 1.0 if abs(value) > limit else 0.0
        out[t - first] = clip(value, limit)


@kernel
def scaled(
    values: Any, numerator: float, denominator: float, limit: float, out: Any, clipped: Any
) -> None:
    """Write values times a ratio, rounded and clipped; NaN stays. All have shape (block,)."""
    for t in range(len(out)):
        if np.isnan(values[t]):
            out[t] = np.nan
            continue
        value = nearest(values[t], numerator, denominator)
        clipped[t] += 1.0 if abs(value) > limit else 0.0
        out[t] = clip(value, limit)
