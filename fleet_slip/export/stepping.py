"""Runs steps for one tick, compiled: a row of whole numbers for each.

A row is an operation, the place in memory that it writes, and operands, which are places in memory
or plain numbers. Memory is int64; `MISSING` is a value that is not there.
"""

from typing import Any

import numpy as np

from fleet_slip.compiling import inner_loop, kernel

MISSING = -(2**63)

(
    ADD, SUBTRACT, MULTIPLY, DIVIDE, NEAREST, LEAST, MOST, NEGATIVE, ABSOLUTE, SIGN, CLIP,
    AT_LEAST, WHERE,  # so far missing where an operand is
    ELSE, SIGNAL, AGO, SLIDE, KEEP, TERM,
) = range(19)  # fmt: skip
"""What a tick does; `SLIDE` is the sums and the values of a window."""

CODES = {
    **{"+": ADD, "-": SUBTRACT, "*": MULTIPLY, "//": DIVIDE, "nearest": NEAREST, "min": LEAST},
    **{"max": MOST, "negative": NEGATIVE, "abs": ABSOLUTE, "sign": SIGN, "clip": CLIP},
    **{"at_least": AT_LEAST, "where": WHERE, "else": ELSE},
}
"""Operations of steps that are computed from values of the same tick."""

ROW = 8
"""Whole numbers of an operation."""


@kernel
def run_tick(rows: Any, memory: Any, values: Any, intercept: float) -> Any:
    """Return the angle in rad of the next tick; NaN if there is none.

    `values` has the given physical values of the signals first, then constants.
    """
    estimate = intercept
    for n in range(len(rows)):
        operation, out, a, b = rows[n, 0], rows[n, 1], rows[n, 2], rows[n, 3]
        if operation < ELSE:
            memory[out] = _calculate(operation, memory[a], memory[b])
        elif operation == ELSE:
            memory[out] = memory[b] if memory[a] == MISSING else memory[a]
        elif operation == SIGNAL:
            memory[out] = _count(values[a], values[b], rows[n, 4], rows[n, 5])
        elif operation == TERM:
            column = memory[a]
            term = np.nan if column == MISSING else column * values[rows[n, 4]]
            estimate += values[b] * term
        else:
            _remember(operation, memory, out, a, b, rows[n, 4], rows[n, 5], rows[n, 6], rows[n, 7])
    return estimate


@inner_loop
def _calculate(operation: int, a: int, b: int) -> Any:
    """Return what a step computes of two values; of one, both are the same."""
    found = a
    if MISSING in (a, b):
        found = MISSING
    elif operation == ADD:
        found = a + b
    elif operation == SUBTRACT:
        found = a - b
    elif operation == MULTIPLY:
        found = a * b
    elif operation in (DIVIDE, NEAREST):
        found = _quotient(a, b, operation == NEAREST)
    elif operation == LEAST:
        found = min(a, b)
    elif operation == MOST:
        found = max(a, b)
    elif operation == NEGATIVE:
        found = -a
    elif operation == ABSOLUTE:
        found = abs(a)
    elif operation == SIGN:
        found = (1 if a > 0 else 0) - (1 if a < 0 else 0)
    elif operation == CLIP:
        found = max(-b, min(a, b))
    elif operation == AT_LEAST and a < b:
        found = MISSING
    return found


@inner_loop
def _quotient(a: int, b: int, rounds: bool) -> Any:
    if b <= 0:
        return MISSING
    size = (2 * abs(a) + b) // (2 * b) if rounds else abs(a) // b
    return -size if a < 0 else size


@inner_loop
def _count(value: float, scale: float, least: int, most: int) -> Any:
    """Return a physical value in counts, as the sensors round it: half to even."""
    count = np.rint(value / scale)
    inside = np.float64(least) <= count <= np.float64(most)
    return np.int64(count) if inside else MISSING


@inner_loop
def _remember(
    operation: int, memory: Any, out: int, a: int, b: int, c: int, d: int, e: int, f: int
) -> None:
    """Read or write a ring of `c` values at `b`, whose next place stands at `d`; or bring a sum
    and its number of values, at `out` and `f`, to this tick."""
    if operation == KEEP:
        memory[b + memory[d]] = memory[a]
        memory[d] = 0 if memory[d] + 1 == c else memory[d] + 1
        return
    if operation == AGO:
        memory[out] = _ago(memory, b, c, memory[d], e)
        return
    oldest = _ago(memory, b, c, memory[d], e) if c else MISSING
    if oldest != MISSING:
        memory[out] -= oldest
        memory[f] -= 1
    # Without a ring, `e` is how many values are taken at most.
    if memory[a] != MISSING and (c or memory[f] < e):
        memory[out] += memory[a]
        memory[f] += 1


@inner_loop
def _ago(memory: Any, ring: int, length: int, at: int, ticks: int) -> Any:
    place = at - ticks
    return memory[ring + (place if place >= 0 else place + length)]
