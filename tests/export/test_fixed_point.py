"""The bound of the angle's error is kept, whatever the coefficients and counts."""

from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_slip.errors import RefusedError
from fleet_slip.export.program import LARGEST_SUM, OUTPUT_COUNTS, fixed_point

COEFFICIENT = st.fractions(-1000, 1000, max_denominator=10**30)


@given(
    st.lists(st.tuples(COEFFICIENT, st.integers(1, 2**19)), min_size=1, max_size=8),
    COEFFICIENT,
    st.data(),
)
def test_the_angle_is_within_the_bound(
    terms: list[tuple[Fraction, int]], intercept: Fraction, data: st.DataObject
) -> None:
    found = fixed_point(intercept, [g for g, _ in terms], [n for _, n in terms])
    counts = [data.draw(st.integers(-n, n) | st.sampled_from([-n, n])) for _, n in terms]
    exact = intercept + sum(g * n for (g, _), n in zip(terms, counts, strict=True))
    total = found.intercept + sum(c * n for c, n in zip(found.coefficients, counts, strict=True))
    angle = (total + 2 ** (found.bits - 1)) >> found.bits
    assert abs(angle - exact) <= found.error < Fraction(OUTPUT_COUNTS, 2)
    assert abs(angle) <= found.largest


@given(st.lists(st.tuples(COEFFICIENT, st.integers(1, 2**19)), min_size=1, max_size=8), COEFFICIENT)
def test_no_sum_of_parts_overflows_and_together_they_are_the_whole(
    terms: list[tuple[Fraction, int]], intercept: Fraction
) -> None:
    found = fixed_point(intercept, [g for g, _ in terms], [n for _, n in terms])
    sizes = [1, *(n for _, n in terms)]
    upper = sum(abs(part) * n for (part, _), n in zip(found.parts, sizes, strict=True))
    lower = sum(part * n for (_, part), n in zip(found.parts, sizes, strict=True))
    assert all(0 <= part < 2**found.low_bits for _, part in found.parts)
    half = 2 ** (found.bits - found.low_bits - 1)
    assert upper + (lower >> found.low_bits) + half < LARGEST_SUM
    assert lower < LARGEST_SUM
    whole = [(u << found.low_bits) + low for u, low in found.parts]
    assert whole == [found.intercept, *found.coefficients]
    assert all(-(2**31) < part < 2**31 for part, _ in found.parts[1:])


def test_one_bit_more_would_not_fit() -> None:
    """A coefficient of 1/3 takes 31 bits and 31 more: its upper part is the largest below 2^31."""
    found = fixed_point(Fraction(0), [Fraction(1, 3)], [2**19])
    assert found.bits == 31 + 32
    assert found.coefficients == (round(Fraction(2**63, 3)),)
    assert found.error == Fraction(1, 2) + Fraction(2**19 + 1, 2**64)


def test_what_has_no_bound_is_refused() -> None:
    with pytest.raises(RefusedError, match="no bound"):
        fixed_point(Fraction(0), [Fraction(10**30)], [2**19])
