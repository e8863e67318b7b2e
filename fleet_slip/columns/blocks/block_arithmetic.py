"""Compiled loops of integer arithmetic on the rows of a block.

A missing value is NaN, which every operation passes on. Integers of 2^53 and more are int64, which
has no NaN: what they are made of says which rows have a value.
"""

from typing import Any

import numpy as np

from fleet_slip.catalogue.definitions import WEIGHT
from fleet_slip.columns.blocks.block_operations import (
    ABSOLUTE,
    ABSOLUTE_INTEGERS,
    ADD,
    ADD_INTEGERS,
    CLIP,
    COPY,
    DIVIDE,
    FACT,
    FILL,
    FILL_INTEGERS,
    GUARD,
    MULTIPLY,
    MULTIPLY_BY,
    MULTIPLY_INTEGERS,
    MULTIPLY_INTEGERS_BY,
    NEAREST,
    NEAREST_INTEGERS,
    SIGN,
    SIGN_INTEGERS,
    SUBTRACT,
    SUBTRACT_INTEGERS,
    TO_BINARY64,
    TO_INTEGERS,
    WEIGH,
)
from fleet_slip.columns.blocks.quotients import clip, nearest, nearest_integer, truncated, weight
from fleet_slip.compiling import inner_loop


@inner_loop
def compute(  # noqa: PLR0912 - one loop for each operation
    operation: int,
    memory: Any,
    places: Any,
    size: int,
    numerator: float,
    divisor: float,
    limit: float,
) -> None:
    """Do an operation that writes binary64.

    `places` are where what is written and read begins: out, a, b and c. The first rows of the
    memory count what is clipped.
    """
    at, of_a, of_b, of_c = places
    out, a = memory[at : at + size], memory[of_a : of_a + size]
    b, c = memory[of_b : of_b + size], memory[of_c : of_c + size]
    if operation == COPY:
        for i in range(size):
            out[i] = a[i]
    elif operation == ADD:
        for i in range(size):
            out[i] = a[i] + b[i]
    elif operation == SUBTRACT:
        for i in range(size):
            out[i] = a[i] - b[i]
    elif operation == MULTIPLY:
        for i in range(size):
            out[i] = a[i] * b[i]
    elif operation == MULTIPLY_BY:
        for i in range(size):
            out[i] = a[i] * numerator
    elif operation == ABSOLUTE:
        for i in range(size):
            out[i] = abs(a[i])
    elif operation == SIGN:
        for i in range(size):
            out[i] = 1.0 if a[i] > 0.0 else (-1.0 if a[i] < 0.0 else a[i])
    elif operation == DIVIDE:
        for i in range(size):
            out[i] = np.trunc(a[i] / b[i])
    elif operation == NEAREST:
        for i in range(size):
            out[i] = nearest(a[i], 1.0, b[i])
    elif operation == FILL:
        for i in range(size):
            out[i] = numerator
    elif operation == TO_BINARY64:
        whole = memory.view(np.int64)[of_a : of_a + size]
        for i in range(size):
            out[i] = np.float64(whole[i]) + c[i]
    elif operation == GUARD:
        for i in range(size):
            out[i] = 0.0 if a[i] >= numerator else np.nan
    elif operation == CLIP:
        outside = 0
        for i in range(size):
            outside += 1 if abs(a[i]) > limit else 0
            out[i] = clip(a[i], limit)
        if outside:
            for i in range(size):
                memory[i] += 1.0 if abs(a[i]) > limit else 0.0
    elif operation == WEIGH:
        for i in range(size):
            out[i] = nearest(a[i], weight(b[i], numerator, divisor, limit), WEIGHT)
    else:
        factor = b[0] if operation == FACT else 1.0
        outside = 0
        for i in range(size):
            value = nearest(a[i] * factor, numerator, divisor)
            outside += 1 if abs(value) > limit else 0
            out[i] = clip(value, limit)
        if outside:
            for i in range(size):
                value = nearest(a[i] * factor, numerator, divisor)
                memory[i] += 1.0 if abs(value) > limit else 0.0


@inner_loop
def compute_integers(  # noqa: PLR0912 - one loop for each operation
    operation: int, memory: Any, places: Any, size: int, number: int
) -> None:
    """Do an operation that writes int64."""
    at, of_a, of_b, of_c = places
    whole = memory.view(np.int64)
    out, a, b = whole[at : at + size], whole[of_a : of_a + size], whole[of_b : of_b + size]
    valid = memory[of_c : of_c + size]
    if operation == TO_INTEGERS:
        for i in range(size):
            out[i] = np.int64(valid[i] if valid[i] == valid[i] else 0.0)
    elif operation == ADD_INTEGERS:
        for i in range(size):
            out[i] = a[i] + b[i]
    elif operation == SUBTRACT_INTEGERS:
        for i in range(size):
            out[i] = a[i] - b[i]
    elif operation == MULTIPLY_INTEGERS:
        for i in range(size):
            out[i] = a[i] * b[i]
    elif operation == MULTIPLY_INTEGERS_BY:
        for i in range(size):
            out[i] = a[i] * number
    elif operation == ABSOLUTE_INTEGERS:
        for i in range(size):
            out[i] = abs(a[i])
    elif operation == SIGN_INTEGERS:
        for i in range(size):
            out[i] = (1 if a[i] > 0 else 0) - (1 if a[i] < 0 else 0)
    elif operation == FILL_INTEGERS:
        for i in range(size):
            out[i] = number
    else:
        rounds = operation == NEAREST_INTEGERS
        for i in range(size):
            divisor = max(b[i], 1)
            out[i] = nearest_integer(a[i], divisor) if rounds else truncated(a[i], divisor)
