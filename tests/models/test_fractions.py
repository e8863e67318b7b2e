"""Exact coefficients as text: in decimal, and in hexadecimal where Python refuses decimal."""

from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError

from fleet_slip.models.manifest import MOST_DIGITS, ExactFraction

FRACTIONS: TypeAdapter[Fraction] = TypeAdapter(ExactFraction)


@given(st.fractions(), st.sampled_from([0, 3990, 4000, 4400, 20000]))
def test_a_fraction_is_the_same_again(value: Fraction, digits: int) -> None:
    for one in (value * 10**digits, value / 10**digits - 1):
        text = FRACTIONS.dump_python(one)
        assert FRACTIONS.validate_python(text) == one


def test_what_was_decimal_stays_decimal() -> None:
    assert FRACTIONS.dump_python(Fraction(-3, 4)) == "-3/4"
    largest = 10**MOST_DIGITS - 1
    assert FRACTIONS.dump_python(Fraction(largest)) == f"{largest}/1"
    assert FRACTIONS.dump_python(-Fraction(largest + 1)).startswith("-0x")


@pytest.mark.parametrize("text", ["0x3/4", "3/0x4", "0x/0x1", "0x1/0x0", "1/0", "0X1/0x1", "1"])
def test_other_text_is_no_fraction(text: str) -> None:
    with pytest.raises(ValidationError):
        FRACTIONS.validate_python(text)
