"""The operations of a program over blocks of rows: whole numbers, and one of four ratios or limits.

`kernel` runs them, `program` writes them; `block_arithmetic` and `lookback` define them.
"""

from enum import IntEnum

BLOCK_ROWS = 2**10
"""Rows of a block: small, so that its columns stay in the processor's cache."""

TILE = 4
"""Columns are padded to a multiple of this; see `product_sums`."""

(
    COPY, ADD, SUBTRACT, MULTIPLY, NEGATE, ABSOLUTE, SIGN,  # the same for binary64 and int64
    LEAST, MOST, DIVIDE, NEAREST, FILL, BROADCAST, AT_LEAST, WHERE, ELSE, TO_BINARY64, CLIP, SHARE,
    SCALE,
    ADD_UP, KEEP, QUOTIENT, AGO,  # on the rows of before
) = range(24)  # fmt: skip

INTEGERS = 30
"""An operation plus this writes int64; that of `COPY` reads binary64."""

OPERATION, OUT, A, B, C, D = 0, 1, 2, 3, 4, 5
"""Columns of a step: the operation, and the places of what it writes and reads."""

MOVES = 5
"""So many columns behind a place: whether it moves on with the rows of a drive."""

SLOT, KIND, TICKS, NUMBER = 11, 12, 13, 14
"""Further columns of a step: what is summed up, a kind of window, its ticks, and a constant, or how
often a value that is clipped counts."""

NUMERATOR, FIXED, EACH, LIMIT = 0, 1, 2, 3
"""Ratios and limits of a step. A sum over n rows is multiplied by the first and divided by the
second plus the third times n."""


class Region(IntEnum):
    """Parts of a program's memory.

    The first counts columns clipped by row; `TOLD` is what is known of the car; signals, sums,
    counts, values, begins and ticks are of all rows (`lookback`).
    """

    CLIPPED = 0
    REGISTER = 1
    TOLD = 2
    SIGNAL = 3
    TICK = 4
    SUM = 5
    COUNT = 6
    VALUE = 7
    BEGIN = 8
