"""Patterns of steps that one loop over a block does together, for speed."""

from typing import Any

Pattern = Any
"""A step: its operation and operands; names stand for steps, #names for constants, numbers too."""

ROUNDED = ("//", ("+", ("*", 2, "c"), ("*", ("sign", "c"), "d")), ("*", 2, "d"))
"""A quotient to the nearest, as the SQL of a feature says it."""


def _times(step: Pattern) -> list[Pattern]:
    return [("*", step, "#numerator"), step]


_TOTAL = ("sum", "row", "ticks", "most")
_SHARED = ("#fixed", ("*", "#each", ("values", "row", "ticks", "most")))
SCALED: list[Pattern] = [("nearest", x, "#fixed") for x in _times("x")]
SCALED.append(("//", ("+", ("*", 2, "x"), ("*", ("sign", "x"), "#fixed")), ("*", 2, "#fixed")))
"""A value times a ratio of constants, rounded."""

QUOTIENTS = [
    ("clip", ("where", ("nearest", total, divisor), "row"), "#limit")
    for total in _times(_TOTAL)
    for divisor in _SHARED
]
"""A sum or mean over a window, times a ratio, rounded and clipped."""
