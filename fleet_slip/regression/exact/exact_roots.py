"""Square roots and logarithms of exact rationals, rounded once at the end."""

import math
from fractions import Fraction

_BITS = 160


def sqrt(value: Fraction) -> float:
    """Return the square root of a non-negative rational, correctly rounded to binary64."""
    if value < 0:
        raise ValueError(f"square root of {value}")
    return _root_of_ratio(value.numerator, value.denominator)


def _root_of_ratio(numerator: int, denominator: int) -> float:
    """Return the root of a ratio in any terms: the lowest take longer to find than the root."""
    if numerator == 0:
        return 0.0
    bits = numerator.bit_length() - denominator.bit_length()
    shift = max(0, _BITS - bits) // 2 * 2
    shifted = numerator << shift
    root = math.isqrt(shifted // denominator)
    # A trailing one stands for all that was cut off: rounding then sees "more than half".
    sticky = int(root * root * denominator != shifted)
    return (2 * root + sticky) / (1 << (shift // 2 + 1))


def signed_ratio(product: Fraction | int, squares: Fraction | int) -> float:
    """Return `product / sqrt(squares)`, correctly rounded: a correlation from exact sums."""
    if squares <= 0:
        return 0.0
    magnitude = _root_of_ratio(
        product.numerator**2 * squares.denominator, product.denominator**2 * squares.numerator
    )
    return -magnitude if product < 0 else magnitude
