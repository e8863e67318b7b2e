"""Compiled sums of products of columns: exact, because all are integers below 2^53.

Tiles of 4 by 4 columns keep their sixteen sums in the processor's registers while rows go by. They
pass over pieces of rows in which columns are zero, as those of a gate that is shut.
"""

from typing import Any

import numpy as np

from fleet_slip.columns.blocks.block_operations import TILE
from fleet_slip.compiling import exact_loop, inner_loop

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
