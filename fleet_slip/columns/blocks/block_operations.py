"""The operations of a program over blocks of rows, and how a program writes them.

A step is a row of whole numbers, and one of four ratios or limits. `kernel` runs them, and
`program` writes them; `block_arithmetic` and `lookback` say what each does.
"""

from enum import IntEnum

BLOCK_ROWS = 2**10
"""Rows of a block: small, so that its columns stay in the processor's cache."""

TILE = 4
"""Columns are padded to a multiple of this; see `product_sums`."""

COPY, ADD, SUBTRACT, MULTIPLY, ABSOLUTE, SIGN, DIVIDE = 0, 1, 2, 3, 4, 5, 6
MULTIPLY_BY, NEAREST, FILL = 7, 8, 9
TO_BINARY64, GUARD, CLIP, SCALE, FACT, WEIGH = 10, 11, 12, 13, 14, 15

ADD_UP, KEEP, QUOTIENT, AGO = 20, 21, 22, 23
"""Operations on the rows of before."""

TO_INTEGERS = 30
"""From here on, what is written is int64."""
ADD_INTEGERS, SUBTRACT_INTEGERS, MULTIPLY_INTEGERS, ABSOLUTE_INTEGERS = 31, 32, 33, 34
SIGN_INTEGERS, DIVIDE_INTEGERS, MULTIPLY_INTEGERS_BY = 35, 36, 37
NEAREST_INTEGERS, FILL_INTEGERS = 38, 39

OPERATION, OUT, A, B, C, D = 0, 1, 2, 3, 4, 5
"""Columns of a step: the operation, and the places of what it writes and reads."""

MOVES = 5
"""So many columns behind a place: whether it moves on with the rows of a drive."""

SLOT, KIND, TICKS, NUMBER = 11, 12, 13, 14
"""Further columns of a step: what is summed up, a kind of window, its ticks, a constant."""

STEP_SIZE = 15

NUMERATOR, FIXED, EACH, LIMIT = 0, 1, 2, 3
"""Ratios and limits of a step. A sum over n rows is multiplied by the first and divided by the
second plus the third times n. `WEIGH` has the knots of its gate in the first, second and last."""


class Region(IntEnum):
    """Parts of the memory of a program.

    The first counts how many columns of each row of the block were clipped. Signals, sums, counts,
    values, begins and ticks are of all rows of a drive; see `lookback`.
    """

    CLIPPED = 0
    REGISTER = 1
    FACT = 2
    SIGNAL = 3
    TICK = 4
    SUM = 5
    COUNT = 6
    VALUE = 7
    BEGIN = 8
