"""Square roots and logarithms of exact rationals, rounded once at the end."""

import math
from fractions import Fraction

_BITS = 160


def sqrt(value: Fraction) -> float:
    """Return the square root of a non-negative rational, correctly rounded to binary64."""
    if value < 0:
        raise ValueError(f"square root of {value}")
    if value == 0:
        return 0.0
    bits = value.numerator.bit_length() - value.denominator.bit_length()
    shift = max(0, _BITS - bits) // 2 * 2
    scaled = (value.numerator << shift) // value.denominator
    root = math.isqrt(scaled)
    # A trailing one stands for all that was cut off: rounding then sees "more than half".
    sticky = int(root * root * value.denominator != value.numerator << shift)
    return float(Fraction(2 * root + sticky, 1 << (shift // 2 + 1)))


def signed_ratio(product: Fraction, squares: Fraction) -> float:
    """Return `product / sqrt(squares)`, correctly rounded: a correlation from exact sums."""
    if squares <= 0:
        return 0.0
    magnitude = sqrt(product * product / squares)
    return -magnitude if product < 0 else magnitude
