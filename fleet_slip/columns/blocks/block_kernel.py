"""Runs a program of vector operations over the rows of a drive, block by block, compiled."""

from typing import Any

import numpy as np

from fleet_slip.columns.blocks import block_operations as op
from fleet_slip.columns.blocks.block_arithmetic import compute, compute_integers
from fleet_slip.columns.blocks.lookback import add_up, divide_sums, find_begins, values_ago
from fleet_slip.columns.blocks.product_sums import add_products, add_sums, find_pieces
from fleet_slip.compiling import inner_loop, kernel

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
