"""Runs a program of vector operations over the rows of a drive, block by block, compiled."""

from typing import Any

import numpy as np

from fleet_slip.columns import block_program as op
from fleet_slip.columns.block_program import EACH, FIXED, LIMIT, NUMERATOR
from fleet_slip.columns.recursion import run_recursion
from fleet_slip.compiling import equation, inner_loop, kernel

# Compiled loops of integer arithmetic on the rows of a block.
#
# Missing is NaN, which operations pass on; from 2^53 on int64, with validity from the operands.


@inner_loop
def _calculate(  # noqa: PLR0912 - one loop for each operation
    operation: int, out: Any, a: Any, b: Any
) -> None:
    """Execute an operation that is the same for binary64 and int64."""
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
    """Execute an operation that writes binary64; `places` are the begins of out, a and b.

    Clipped values add `times` to the first rows of the memory.
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
    elif operation == op.POWER:
        for i in range(size):
            out[i] = 1.0 + 0.0 * a[i]  # NaN stays
            while a[i] > b[i] * out[i]:
                out[i] *= 2.0
    elif operation == op.WHERE:
        for i in range(size):
            out[i] = a[i] if b[i] == b[i] else np.nan
    elif operation == op.ELSE:
        for i in range(size):
            out[i] = a[i] if a[i] == a[i] else b[i]
    elif operation == op.TO_BINARY64:
        integers = memory.view(np.int64)[of_a : of_a + size]
        for i in range(size):
            out[i] = np.float64(integers[i])
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
    """Execute an operation that writes int64; `COPY` reads binary64."""
    at, of_a, of_b = places
    integers = memory.view(np.int64)
    out, a, b = integers[at : at + size], integers[of_a : of_a + size], integers[of_b : of_b + size]
    floats = memory[of_a : of_a + size]
    if operation == op.COPY:
        for i in range(size):
            out[i] = np.int64(floats[i] if floats[i] == floats[i] else 0.0)
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


# Compiled loops of windows over the rows of a block: running sums, quotients, values of before.
#
# Sums, counts, values, begins and ticks are of all rows of a drive; sums and counts are of the rows
# before, one more. Sums are integers below 2^53, exact in binary64.


@inner_loop
def add_up(
    memory: Any, values: int, sums: int, counts: int, first: int, size: int, gaps: Any
) -> Any:
    """Write running sums of a block; return True after gaps, which counts account for."""
    a, out = memory[values : values + size], memory[sums + first : sums + first + size + 1]
    count = memory[counts : counts + first + size + 1]
    total = out[0] if first else 0.0
    out[0] = total
    if not gaps:
        for i in range(size):
            total += a[i]
            out[i + 1] = total
        if not np.isnan(total):
            return False
        total = out[0]
        for i in range(first):
            count[i] = i
    present = float(first) if not gaps else (count[first] if first else 0.0)
    count[first] = present
    for i in range(size):
        if not np.isnan(a[i]):
            total += a[i]
            present += 1.0
        out[i + 1], count[first + i + 1] = total, present
    return True


@inner_loop
def divide_sums(
    memory: Any,
    places: Any,
    first: int,
    size: int,
    ticks: int,
    ratio: Any,
    times: float,
    gaps: Any,
) -> None:
    """Write the rounded quotients of a window, clipped; count it `times` in the first rows.

    `places`: out, sums, counts, begins, values. 0 ticks are all rows since the start. A row without
    a value gets NaN. For the ratio see `operations`.
    """
    at, of_sums, of_counts, of_begins, of_values = places
    out, clipped = memory[at : at + size], memory[0:size]
    numerator, fixed, per_value, limit = ratio[NUMERATOR], ratio[FIXED], ratio[EACH], ratio[LIMIT]
    sums, counts = memory[of_sums:], memory[of_counts:]
    begins, values = memory[of_begins + first :], memory[of_values : of_values + size]
    # The rows before `single` are divided one by one, the others by the same number.
    single = size
    if not gaps and ticks:
        single = min(max(ticks - 1 - first, 0), size)
    for i in range(single):
        t = first + i
        begin = int(begins[i]) if gaps else (max(t + 1 - ticks, 0) if ticks else 0)
        count = counts[t + 1] - counts[begin] if gaps else float(t + 1 - begin)
        divisor = fixed + per_value * count
        value = nearest(sums[t + 1] - sums[begin], numerator, divisor)
        if np.isnan(values[i]):
            value = np.nan
        clipped[i] += times if abs(value) > limit else 0.0
        out[i] = clip(value, limit)
    # Slices of one length and a count of integers: then the loop is vectorised.
    rows, until = size - single, first + single + 1
    newest, oldest = sums[until : until + rows], sums[until - ticks : until - ticks + rows]
    written, divisor = out[single:], fixed + per_value * ticks
    outside = 0
    for i in range(rows):
        value = nearest(newest[i] - oldest[i], numerator, divisor)
        outside += 1 if abs(value) > limit else 0
        written[i] = clip(value, limit)
    if outside:
        for i in range(rows):
            value = nearest(newest[i] - oldest[i], numerator, divisor)
            clipped[single + i] += times if abs(value) > limit else 0.0


@inner_loop
def values_ago(memory: Any, places: Any, first: int, size: int, ticks: int) -> None:
    """Write values of so many ticks before, or NaN; `places`: out, values, ticks, begins."""
    at, of_values, of_ticks, of_begins = places
    for i in range(size):
        begin = int(memory[of_begins + first + i])
        is_logged = memory[of_ticks + begin] == memory[of_ticks + first + i] - ticks
        memory[at + i] = memory[of_values + begin] if is_logged else np.nan


@inner_loop
def find_begins(memory: Any, of_ticks: int, rows: int, ticks: int, begins: int) -> None:
    """Write the first row within `ticks` before each; 0 ticks reach back to the start."""
    at = 0
    for t in range(rows):
        while ticks and memory[of_ticks + at] <= memory[of_ticks + t] - ticks:
            at += 1
        memory[begins + t] = at


GAPS, FOUND = 0, 1
"""Rows of `flags`: a sum has had gaps; the begins of a window length are computed."""


@kernel
def run(
    steps: Any,
    ratios: Any,
    memory: Any,
    flags: Any,
    rows: int,
    ticks: int,
    first: int,
    recursion: Any,
    words: Any,
    outputs: Any,
) -> None:
    """Compute the block of rows that begins with `first`.

    `steps` and `ratios` are a program, `memory` its registers, `flags` the state of sums and
    windows, and `ticks` the place of the ticks in the memory. `recursion` has the recursive steps,
    `words` their memory and `outputs` the places that others read.
    """
    size = min(op.BLOCK_ROWS, rows - first)
    memory[:size] = 0.0
    for number in range(len(steps)):
        step = steps[number]
        if step[op.OPERATION] == op.RECUR:
            at, inputs = step[op.B], step[op.NUMBER]
            run_recursion(recursion, words, outputs, memory, at, op.STRIDE, inputs, size)
        else:
            _do(step, ratios[number], memory, flags, rows, ticks, first, size)


@inner_loop
def _do(
    step: Any, ratio: Any, memory: Any, flags: Any, rows: int, ticks: int, first: int, size: int
) -> None:
    operation, slot, kind = step[op.OPERATION], step[op.SLOT], step[op.KIND]
    out = step[op.OUT] + step[op.ADVANCE + op.OUT] * first
    a, b = (
        step[op.A] + step[op.ADVANCE + op.A] * first,
        step[op.B] + step[op.ADVANCE + op.B] * first,
    )
    c, d = (
        step[op.C] + step[op.ADVANCE + op.C] * first,
        step[op.D] + step[op.ADVANCE + op.D] * first,
    )
    if operation >= op.INTEGERS:
        compute_integers(operation - op.INTEGERS, memory, (out, a, b), size, step[op.NUMBER])
    elif operation < op.ADD_UP:
        compute(
            operation,
            memory,
            (out, a, b),
            size,
            ratio[op.NUMERATOR],
            ratio[op.FIXED],
            ratio[op.LIMIT],
            np.float64(step[op.NUMBER]),
        )
    elif operation == op.ADD_UP:
        flags[GAPS, slot] = add_up(memory, a, b, c, first, size, flags[GAPS, slot])
    elif operation == op.PUT:
        for i in range(size):
            memory[b + i] = memory[a + i]
    elif operation == op.KEEP:
        for i in range(size):
            memory[b + first + i] = memory[a + i]
    else:
        if (operation == op.AGO or flags[GAPS, slot]) and not flags[FOUND, kind]:
            find_begins(memory, ticks, rows, step[op.TICKS] + (1 if operation == op.AGO else 0), c)
            flags[FOUND, kind] = True
        if operation == op.AGO:
            values_ago(memory, (out, a, ticks, c), first, size, step[op.TICKS])
        else:
            places, gaps = (out, b, d, c, a), flags[GAPS, slot]
            times = np.float64(step[op.NUMBER])
            divide_sums(memory, places, first, size, step[op.TICKS], ratio, times, gaps)
