"""Runs a program for one tick, compiled: a row of whole numbers for each operation.

A row is an operation, the place in memory that it writes, and up to eight operands, which are
places in memory or constants. Memory is int64; `MISSING` is a value that is not there.
"""

from typing import Any

import numpy as np

from fleet_slip.catalogue.columns import WEIGHT
from fleet_slip.compiling import inner_loop, kernel

MISSING = -(2**63)

ADD, SUBTRACT, MULTIPLY, DIVIDE, NEGATIVE, ABSOLUTE, SIGN = 0, 1, 2, 3, 4, 5, 6
SIGNAL, SOURCE, SLIDE, GATHER, KEEP = 10, 11, 12, 13, 14
VALUE, LAG, SUM, MEAN, FACTOR, GATE, NUMBER, TERM = 20, 21, 22, 23, 24, 25, 26, 27

ROW = 9
"""Whole numbers of an operation."""


@kernel
def run_tick(steps: Any, memory: Any, values: Any, intercept: float) -> Any:
    """Return the angle in rad of the next tick; NaN if there is none.

    `values` has the given physical values of the signals first, then constants.
    """
    estimate = intercept
    for n in range(len(steps)):
        operation, out, a, b = steps[n, 0], steps[n, 1], steps[n, 2], steps[n, 3]
        c, d, e = steps[n, 4], steps[n, 5], steps[n, 6]
        if operation <= SIGN:
            memory[out] = _calculate(operation, memory[a], memory[b])
        elif operation == SIGNAL:
            memory[out] = _count(values[a], values[b], c, d)
        elif operation == TERM:
            column = memory[a]
            term = np.nan if column == MISSING else column * values[c]
            estimate += values[b] * term
        elif operation <= KEEP:
            _remember(operation, memory, out, a, b, c, d, e)
        elif operation <= MEAN:
            memory[out] = _window(operation, memory, a, b, c, d, e, steps[n, 7], steps[n, 8])
        else:
            memory[out] = _times(operation, memory, a, b, c, d, e, steps[n, 7])
    return estimate


@inner_loop
def _calculate(operation: int, a: int, b: int) -> Any:
    """Return what a step of a feature computes."""
    found = a
    if MISSING in (a, b) or (operation == DIVIDE and b <= 0):
        found = MISSING
    elif operation == ADD:
        found = a + b
    elif operation == SUBTRACT:
        found = a - b
    elif operation == MULTIPLY:
        found = a * b
    elif operation == DIVIDE:
        found = a // b if a >= 0 else -(-a // b)
    elif operation == NEGATIVE:
        found = -a
    elif operation == ABSOLUTE:
        found = abs(a)
    else:
        found = (1 if a > 0 else 0) - (1 if a < 0 else 0)
    return found


@inner_loop
def _count(value: float, scale: float, least: int, most: int) -> Any:
    """Return a physical value in counts, as the sensors round it: half to even, then clipped."""
    if not np.isfinite(value):
        return MISSING
    count = np.rint(value / scale)
    return np.int64(min(max(count, np.float64(least)), np.float64(most)))


@inner_loop
def _remember(
    operation: int, memory: Any, out: int, a: int, b: int, c: int, d: int, at: int
) -> None:
    """Write a source, bring a sum to this tick, or write a source into its ring."""
    value = memory[a]
    if operation == SOURCE:
        if b >= 0 and memory[b] < c:
            value = MISSING
        memory[out] = value if value == MISSING else min(max(value, -d), d)
    elif operation == SLIDE:
        oldest = _ago(memory, b, c, memory[at], d)
        if oldest != MISSING:
            memory[out] -= oldest
            memory[out + 1] -= 1
        if value != MISSING:
            memory[out] += value
            memory[out + 1] += 1
    elif operation == GATHER:
        if value != MISSING and memory[out + 1] < b:
            memory[out] += value
            memory[out + 1] += 1
    else:
        place = memory[at]
        memory[b + place] = value
        memory[at] = 0 if place + 1 == c else place + 1


@inner_loop
def _ago(memory: Any, ring: int, length: int, at: int, ticks: int) -> Any:
    place = at - ticks
    return memory[ring + (place if place >= 0 else place + length)]


@inner_loop
def _nearest(value: int, numerator: int, divisor: int, limit: int) -> Any:
    """Return a quotient to the nearest, halves away from zero, clipped."""
    size = min((2 * abs(value) * numerator + divisor) // (2 * divisor), limit)
    return -size if value < 0 else size


@inner_loop
def _window(
    operation: int,
    memory: Any,
    a: int,
    numerator: int,
    denominator: int,
    limit: int,
    b: int,
    at: int,
    ticks: int,
) -> Any:
    """Return what looks back on a source `a`, whose sum is at `b`; or on a ring `a`, so long."""
    now = _ago(memory, a, b, memory[at], ticks) if operation == LAG else memory[a]
    if now == MISSING:
        return MISSING
    total, divisor = now, denominator
    if operation in (SUM, MEAN):
        total = memory[b]
    if operation == MEAN:
        divisor *= memory[b + 1]
    return _nearest(total, numerator, divisor, limit)


@inner_loop
def _times(operation: int, memory: Any, a: int, b: int, c: int, d: int, e: int, less: int) -> Any:
    """Return a column `a` times a fact, a gate's weight or a number of the car."""
    now = memory[a]
    if operation == GATE:
        by = memory[b]
        missing = MISSING in (now, by)
        return MISSING if missing else _nearest(now * _weight(by, c, d, e), 1, WEIGHT, 2**62)
    known = memory[e]
    if operation == FACTOR:
        missing = MISSING in (now, known)
        return MISSING if missing else _nearest(now * (known - less), b, c, d)
    factor = known - less
    if known == MISSING:
        factor = memory[b] if b >= 0 else 0
    if MISSING in (now, factor):
        return MISSING
    return factor if c else now * factor


@inner_loop
def _weight(at: int, low: int, peak: int, high: int) -> Any:
    """Return how far a gate is open; `high` is missing where it stays open."""
    if at <= low:
        return 0
    if at < peak:
        return (at - low) * WEIGHT // (peak - low)
    if high == MISSING:
        return WEIGHT
    return WEIGHT - (at - peak) * WEIGHT // (high - peak) if at < high else 0
