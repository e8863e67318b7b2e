"""Compiled loops of integer arithmetic on the rows of a block.

Missing is NaN, which operations pass on; from 2^53 on int64, with validity from the operands.
"""

from typing import Any

import numpy as np

from fleet_slip.columns.blocks import block_operations as op
from fleet_slip.compiling import equation, inner_loop


@inner_loop
def _calculate(  # noqa: PLR0912 - one loop for each operation
    operation: int, out: Any, a: Any, b: Any
) -> None:
    """Do an operation that is the same for binary64 and int64."""
    size = len(out)
    if operation == op.COPY:
        for i in range(size):
            out[i] = a[i]
    elif operation == op.ADD:
        for i in range(size):
            out[i] = a[i] + b[i]
    elif operation == op.SUBTRACT:
        for i in range(size):
            out[i] = a[i] - b[i]
    elif operation == op.MULTIPLY:
        for i in range(size):
            out[i] = a[i] * b[i]
    elif operation == op.NEGATE:
        for i in range(size):
            out[i] = -a[i]
    elif operation == op.ABSOLUTE:
        for i in range(size):
            out[i] = abs(a[i])
    else:
        for i in range(size):  # NaN stays
            out[i] = 1 if a[i] > 0 else (-1 if a[i] < 0 else a[i])


@inner_loop
def compute(  # noqa: PLR0912 - one loop for each operation
    operation: int,
    memory: Any,
    places: Any,
    size: int,
    numerator: float,
    divisor: float,
    limit: float,
    times: float,
) -> None:
    """Do an operation that writes binary64; `places` are where out, a and b begin.

    What is clipped counts so many `times` in the first rows of the memory.
    """
    at, of_a, of_b = places
    out, a = memory[at : at + size], memory[of_a : of_a + size]
    b = memory[of_b : of_b + size]
    if operation <= op.SIGN:
        _calculate(operation, out, a, b)
    elif operation == op.DIVIDE:
        for i in range(size):
            out[i] = np.trunc(a[i] / b[i])
    elif operation == op.NEAREST:
        for i in range(size):
            out[i] = nearest(a[i], 1.0, b[i])
    elif operation == op.FILL:
        for i in range(size):
            out[i] = numerator
    elif operation == op.BROADCAST:
        for i in range(size):
            out[i] = a[0]
    elif operation == op.LEAST:  # missing where one is: no `min`, which takes the other
        for i in range(size):
            out[i] = a[i] if a[i] <= b[i] else (b[i] if b[i] < a[i] else np.nan)
    elif operation == op.MOST:
        for i in range(size):
            out[i] = a[i] if a[i] >= b[i] else (b[i] if b[i] > a[i] else np.nan)
    elif operation == op.AT_LEAST:
        for i in range(size):
            out[i] = a[i] if a[i] >= b[i] else np.nan
    elif operation == op.WHERE:
        for i in range(size):
            out[i] = a[i] if b[i] == b[i] else np.nan
    elif operation == op.ELSE:
        for i in range(size):
            out[i] = a[i] if a[i] == a[i] else b[i]
    elif operation == op.TO_BINARY64:
        whole = memory.view(np.int64)[of_a : of_a + size]
        for i in range(size):
            out[i] = np.float64(whole[i])
    elif operation == op.CLIP:
        outside = 0
        for i in range(size):
            outside += 1 if abs(a[i]) > limit else 0
            out[i] = clip(a[i], limit)
        if outside:
            for i in range(size):
                memory[i] += times if abs(a[i]) > limit else 0.0
    elif operation == op.SHARE:
        for i in range(size):
            out[i] = nearest(a[i] * b[i], 1.0, divisor)
    else:
        outside = 0
        for i in range(size):
            value = nearest(a[i], numerator, divisor)
            outside += 1 if abs(value) > limit else 0
            out[i] = clip(value, limit)
        if outside:
            for i in range(size):
                value = nearest(a[i], numerator, divisor)
                memory[i] += times if abs(value) > limit else 0.0


@inner_loop
def compute_integers(operation: int, memory: Any, places: Any, size: int, number: int) -> None:
    """Do an operation that writes int64; `COPY` is from binary64."""
    at, of_a, of_b = places
    whole = memory.view(np.int64)
    out, a, b = whole[at : at + size], whole[of_a : of_a + size], whole[of_b : of_b + size]
    given = memory[of_a : of_a + size]
    if operation == op.COPY:
        for i in range(size):
            out[i] = np.int64(given[i] if given[i] == given[i] else 0.0)
    elif operation <= op.SIGN:
        _calculate(operation, out, a, b)
    elif operation == op.FILL:
        for i in range(size):
            out[i] = number
    else:
        rounds = operation == op.NEAREST
        for i in range(size):
            divisor = max(b[i], 1)
            out[i] = nearest_integer(a[i], divisor) if rounds else truncated(a[i], divisor)


@equation
def nearest(value: float, numerator: float, divisor: float) -> Any:
    """Return value * numerator / divisor to the nearest integer, halves away from zero.

    Integers; the divisor is positive, and 2 |value| numerator + divisor below 2^53.
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
