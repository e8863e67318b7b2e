"""Runs a program of vector operations over the rows of a drive, block by block, compiled."""

from typing import Any

import numpy as np

from fleet_slip.columns import plan as op
from fleet_slip.columns.plan import EACH, FIXED, LIMIT, NUMERATOR, TILE
from fleet_slip.compiling import equation, exact_loop, inner_loop, kernel

# Compiled loops of integer arithmetic on the rows of a block.
#
# Missing is NaN, which operations pass on; from 2^53 on int64, with validity from the operands.


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


# Compiled loops of windows over the rows of a block: running sums, quotients, values of before.
#
# Sums, counts, values, begins and ticks are of all rows of a drive; sums and counts are of the rows
# before, one more. Sums are integers below 2^53, exact in binary64.


@inner_loop
def add_up(
    memory: Any, values: int, sums: int, counts: int, first: int, size: int, gaps: Any
) -> Any:
    """Write running sums of a block; return whether there have been gaps, which counts are for."""
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
    numerator, fixed, each, limit = ratio[NUMERATOR], ratio[FIXED], ratio[EACH], ratio[LIMIT]
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
        divisor = fixed + each * count
        value = nearest(sums[t + 1] - sums[begin], numerator, divisor)
        if np.isnan(values[i]):
            value = np.nan
        clipped[i] += times if abs(value) > limit else 0.0
        out[i] = clip(value, limit)
    # Slices of one length and a count of integers: then the loop is vectorised.
    rows, until = size - single, first + single + 1
    newest, oldest = sums[until : until + rows], sums[until - ticks : until - ticks + rows]
    written, divisor = out[single:], fixed + each * ticks
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
        there = memory[of_ticks + begin] == memory[of_ticks + first + i] - ticks
        memory[at + i] = memory[of_values + begin] if there else np.nan


@inner_loop
def find_begins(memory: Any, of_ticks: int, rows: int, ticks: int, begins: int) -> None:
    """Write the first row within `ticks` before each; 0 ticks reach back to the start."""
    at = 0
    for t in range(rows):
        while ticks and memory[of_ticks + at] <= memory[of_ticks + t] - ticks:
            at += 1
        memory[begins + t] = at


# Compiled sums of products of columns: exact, because all are integers below 2^53.
#
# Tiles of 4 by 4 columns keep their sixteen sums in the processor's registers while rows go by.
# They pass over pieces of rows in which columns are zero, as those of a gate that is shut.

PIECE_ROWS = 64
"""Rows of a piece: with fewer, moving sums out of registers costs more than what is passed over."""


@inner_loop
def find_pieces(memory: Any, place: int, stride: int, rows: int, pieces: Any) -> Any:
    """Find in which pieces of rows a column of each tile is not zero; one bit of a number each.

    Columns lie `stride` apart from `place` on. Returns whether a value is missing.
    """
    missing = 0.0
    for tile in range(len(pieces)):
        begin, pieces[tile] = place + tile * TILE * stride, 0
        for first in range(0, rows, PIECE_ROWS):
            size = _size(memory, begin + first, stride, min(PIECE_ROWS, rows - first))
            missing += size * 0.0
            pieces[tile] |= (size > 0.0) << first // PIECE_ROWS
    return np.isnan(missing)


@inner_loop
def add_sums(memory: Any, place: int, stride: int, rows: int, columns: int, products: Any) -> None:
    """Add each column's sum to the last row of `products`, whose shape is padded to whole tiles."""
    for i in range(columns):
        products[products.shape[1], i] += _total(memory, place + i * stride, rows)


@inner_loop
def add_products(
    memory: Any, place: int, stride: int, rows: int, pieces: Any, products: Any
) -> None:
    """Add the products of every two columns to the lower triangle."""
    for i in range(len(pieces)):
        for j in range(i + 1):
            a, b = place + i * TILE * stride, place + j * TILE * stride
            tile = products[i * TILE : (i + 1) * TILE, j * TILE : (j + 1) * TILE]
            both, end = pieces[i] & pieces[j], 0
            while both >> end:
                begin = end
                while both >> end & 1:
                    end += 1
                first, last = begin * PIECE_ROWS, min(end * PIECE_ROWS, rows)
                _add_tile(memory, a + first, b + first, stride, last - first, tile)
                end += 1


@exact_loop
def _total(memory: Any, place: int, rows: int) -> Any:
    total = 0.0
    for value in memory[place : place + rows]:
        total += value
    return total


@exact_loop
def _size(memory: Any, place: int, stride: int, rows: int) -> Any:
    total = 0.0
    for begin in range(place, place + TILE * stride, stride):
        for value in memory[begin : begin + rows]:
            total += abs(value)
    return total


@exact_loop
def _add_tile(memory: Any, a: int, b: int, stride: int, rows: int, tile: Any) -> None:
    a0, a1 = memory[a : a + rows], memory[a + stride : a + stride + rows]
    a2 = memory[a + 2 * stride : a + 2 * stride + rows]
    a3 = memory[a + 3 * stride : a + 3 * stride + rows]
    b0, b1 = memory[b : b + rows], memory[b + stride : b + stride + rows]
    b2 = memory[b + 2 * stride : b + 2 * stride + rows]
    b3 = memory[b + 3 * stride : b + 3 * stride + rows]
    s00 = s01 = s02 = s03 = s10 = s11 = s12 = s13 = 0.0
    s20 = s21 = s22 = s23 = s30 = s31 = s32 = s33 = 0.0
    for t in range(rows):
        x0, x1, x2, x3 = a0[t], a1[t], a2[t], a3[t]
        y0, y1, y2, y3 = b0[t], b1[t], b2[t], b3[t]
        s00 += x0 * y0
        s01 += x0 * y1
        s02 += x0 * y2
        s03 += x0 * y3
        s10 += x1 * y0
        s11 += x1 * y1
        s12 += x1 * y2
        s13 += x1 * y3
        s20 += x2 * y0
        s21 += x2 * y1
        s22 += x2 * y2
        s23 += x2 * y3
        s30 += x3 * y0
        s31 += x3 * y1
        s32 += x3 * y2
        s33 += x3 * y3
    tile[0, 0] += s00
    tile[0, 1] += s01
    tile[0, 2] += s02
    tile[0, 3] += s03
    tile[1, 0] += s10
    tile[1, 1] += s11
    tile[1, 2] += s12
    tile[1, 3] += s13
    tile[2, 0] += s20
    tile[2, 1] += s21
    tile[2, 2] += s22
    tile[2, 3] += s23
    tile[3, 0] += s30
    tile[3, 1] += s31
    tile[3, 2] += s32
    tile[3, 3] += s33


GAPS, FOUND = 0, 1
"""Rows of `flags`: whether a sum has had gaps, and whether a kind's begins were found."""


@kernel
def run(
    steps: Any,
    ratios: Any,
    memory: Any,
    flags: Any,
    rows: int,
    ticks: int,
    first: int,
    columns: int,
    place: int,
    stride: int,
    exact_rows: int,
    products: Any,
    totals: Any,
) -> Any:
    """Compute blocks from the row `first` on.

    With `exact_rows`, sums and products of complete blocks go to the integers `totals` by way of
    `products`, at most so many rows at once (shapes: `product_sums`), until a block lacks a value;
    without, it stops after one block. `steps` and `ratios` are a program, `memory` its registers,
    `flags` what is known of sums and windows; `ticks` begin there, columns at `place`, `stride`
    apart. Returns the first row not done, whether the block lacks a value, rows added, and values
    clipped.
    """
    added, clipped, waiting = 0, 0.0, 0
    lacks, pieces = False, np.zeros(products.shape[1] // op.TILE, dtype=np.int64)
    while first < rows:
        size = min(op.BLOCK_ROWS, rows - first)
        memory[:size] = 0.0
        for number in range(len(steps)):
            _do(steps[number], ratios[number], memory, flags, rows, ticks, first, size)
        if exact_rows == 0:
            break
        if waiting + size > exact_rows:
            _move_to_integers(products, totals)
            waiting = 0
        lacks = find_pieces(memory, place, stride, size, pieces)
        if lacks:
            break
        add_sums(memory, place, stride, size, columns, products)
        add_products(memory, place, stride, size, pieces, products)
        for count in memory[:size]:
            clipped += count
        waiting += size
        added += size
        first += size
    _move_to_integers(products, totals)
    return first, lacks, added, int(clipped)


@inner_loop
def _do(
    step: Any, ratio: Any, memory: Any, flags: Any, rows: int, ticks: int, first: int, size: int
) -> None:
    operation, slot, kind = step[op.OPERATION], step[op.SLOT], step[op.KIND]
    out = step[op.OUT] + step[op.MOVES + op.OUT] * first
    a, b = step[op.A] + step[op.MOVES + op.A] * first, step[op.B] + step[op.MOVES + op.B] * first
    c, d = step[op.C] + step[op.MOVES + op.C] * first, step[op.D] + step[op.MOVES + op.D] * first
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


@inner_loop
def _move_to_integers(values: Any, totals: Any) -> None:
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            totals[i, j] += np.int64(values[i, j])
            values[i, j] = 0.0
