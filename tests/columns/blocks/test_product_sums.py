"""Sums of products of columns, of which many are zero for a while, against whole numbers."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_slip.columns.kernel import PIECE_ROWS, add_products, add_sums, find_pieces
from fleet_slip.columns.plan import BLOCK_ROWS, TILE


@settings(deadline=None, max_examples=60)
@given(
    columns=st.integers(1, 13),
    rows=st.sampled_from([1, 2, PIECE_ROWS - 1, PIECE_ROWS, 3 * PIECE_ROWS + 1, BLOCK_ROWS]),
    begin=st.integers(0, 5),
    seed=st.integers(0, 2**32 - 1),
)
def test_products_pass_over_nothing_but_zeros(
    columns: int, rows: int, begin: int, seed: int
) -> None:
    random = np.random.default_rng(seed)
    tiles, stride = -(-columns // TILE), rows + 3
    memory = np.full(begin + tiles * TILE * stride, np.nan)
    block = np.zeros((tiles * TILE, rows), dtype=np.int64)
    for column in block[:columns]:  # open for a few stretches of time, perhaps of a single row
        for first in random.integers(0, rows, random.integers(0, 4)):
            column[first : first + random.integers(1, 2 * PIECE_ROWS)] = 1
    block *= random.integers(-(2**18), 2**18, block.shape)
    for i, column in enumerate(block):
        memory[begin + i * stride :][:rows] = column
    products, pieces = np.zeros((len(block) + 1, len(block))), np.zeros(tiles, dtype=np.int64)
    assert not find_pieces(memory, begin, stride, rows, pieces)
    add_sums(memory, begin, stride, rows, columns, products)
    add_products(memory, begin, stride, rows, pieces, products)
    assert np.array_equal(np.tril(products[:-1]), np.tril(block @ block.T))
    assert np.array_equal(products[-1], block.sum(axis=1))
    lacking = begin + random.integers(columns) * stride + random.integers(rows)
    memory[lacking] = np.nan
    assert find_pieces(memory, begin, stride, rows, pieces)
