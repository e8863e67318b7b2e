"""Compiled loops of windows over the rows of a block: running sums, quotients, values of before.

Sums, counts, values, begins and ticks are of all rows of a drive; sums and counts are of the rows
before, one more. Sums are integers below 2^53, exact in binary64.
"""

from typing import Any

import numpy as np

from fleet_slip.columns.blocks.block_arithmetic import clip, nearest
from fleet_slip.columns.blocks.block_operations import EACH, FIXED, LIMIT, NUMERATOR
from fleet_slip.compiling import inner_loop


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
