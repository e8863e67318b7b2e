"""Exact coefficients as integers, and a proof of how far the angle can be from the exact model.

**The claim.** Let E be the exact angle in output counts, a sum b + sum(g_i * n_i) of rationals,
where n_i are the counts of columns and |n_i| <= N_i. Let B = round(b * 2^F), C_i = round(g_i * 2^F)
and A = floor((B + sum(C_i * n_i)) / 2^F + 1/2). Then |A - E| <= 1/2 + (1 + sum(N_i)) / 2^(F + 1).

**The proof.** Rounding to the nearest integer moves b * 2^F and each g_i * 2^F by at most 1/2. So
S = B + sum(C_i * n_i), an integer that is computed without an error, differs from E * 2^F by at
most (1 + sum(N_i)) / 2; and A from S / 2^F by at most 1/2. (An angle beyond 32 bits is clipped.)

An output count is a tenth of a count of the label, so that this is far below half of one of those.
`fixed_point` takes the largest F for which each coefficient is two words of 32 bits, and S two of
64 bits, each of which adds up one part of every coefficient, and none of which can overflow.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

from fleet_slip.errors import RefusedError

OUTPUT_COUNTS = 10
"""Counts of the angle for one count of the label."""

LOW_BITS = 31
"""Most bits of the lower part of a coefficient, so that it is a word of 32 bits."""

LARGEST_PART = 2**31 - 1
"""Largest size of the upper part."""

LARGEST_SUM = 2**62
"""No sum of parts, nor the rounding after it, reaches this."""

LARGEST_ANGLE = 2**31 - 1
"""Largest size of the angle, a word of 32 bits: what is beyond, thousands of turns, is clipped."""

_TOO_LARGE = (
    "the coefficients are so large, for what the columns can count, that no bound of the angle's "
    "error can be stated. Publish a model with fewer or other signals."
)


@dataclass(frozen=True)
class FixedPoint:
    """A dot product of integers.

    Attributes:
        bits: of the fraction, F.
        low_bits: of the lower part of each coefficient, which is not negative.
        intercept, coefficients: over 2^bits.
        error: bound of |A - E|, in counts of the output.
        largest: bound of |A|, before it is clipped.
    """

    bits: int
    low_bits: int
    intercept: int
    coefficients: tuple[int, ...]
    error: Fraction
    largest: int

    @property
    def parts(self) -> tuple[tuple[int, int], ...]:
        """The upper and lower part of the intercept, then of each coefficient."""
        return tuple(divmod(c, 1 << self.low_bits) for c in (self.intercept, *self.coefficients))


def fixed_point(
    intercept: Fraction, coefficients: Sequence[Fraction], largest: Sequence[int]
) -> FixedPoint:
    """Return the integers of a dot product, given the largest size of each factor, N_i.

    Raises `RefusedError` if the bound would be above half a count of the label.
    """
    sizes = sum(largest)
    low_bits = min(LOW_BITS, (LARGEST_SUM - 1).bit_length() - (sizes + 1).bit_length())
    bits = _most_bits(intercept, coefficients, largest, low_bits)
    scaled = [round(one * 2**bits) for one in (intercept, *coefficients)]
    error = Fraction(1, 2) + Fraction(1 + sizes, 2 ** (bits + 1))
    size = abs(intercept) + sum(abs(g) * n for g, n in zip(coefficients, largest, strict=True))
    if error > Fraction(OUTPUT_COUNTS, 2):
        raise RefusedError(_TOO_LARGE)
    return FixedPoint(bits, low_bits, scaled[0], tuple(scaled[1:]), error, int(size + error))


def _most_bits(
    intercept: Fraction, coefficients: Sequence[Fraction], largest: Sequence[int], low_bits: int
) -> int:
    """Return the largest F with which the sum of the upper parts stays below `LARGEST_SUM`."""
    sizes = (1, *largest)
    bits = low_bits + 62
    while bits > low_bits:
        upper = [round(one * 2**bits) >> low_bits for one in (intercept, *coefficients)]
        total = sum(abs(c) * n for c, n in zip(upper, sizes, strict=True))
        # The carry of the lower parts, and half of an output count, come to it.
        carried = total + 2 ** (62 - low_bits) + 2 ** (bits - low_bits)
        if carried < LARGEST_SUM and max(map(abs, upper[1:])) <= LARGEST_PART:
            return bits
        bits -= 1
    raise RefusedError(_TOO_LARGE)
