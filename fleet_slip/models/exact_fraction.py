"""Fractions in the documents of models, exact however long they are."""

import re
from fractions import Fraction
from typing import Annotated, Any

from pydantic import PlainSerializer, PlainValidator

MOST_DIGITS = 4000
"""Most decimal digits of a number that stands in decimal; Python refuses longer ones as text."""

_FRACTION = re.compile(r"-?[0-9]{1,4000}/[0-9]{1,4000}")
_LONG_FRACTION = re.compile(r"-?0x[0-9a-f]{1,30000}/0x[0-9a-f]{1,30000}")
"""In hexadecimal, as models of hundreds of inputs need it."""


def _exact_fraction(value: Any) -> Fraction:
    """Return a fraction, also from its text "3/4". Raises `ValueError` for anything else."""
    if isinstance(value, Fraction):
        return value
    if isinstance(value, str) and _FRACTION.fullmatch(value):
        base = 10
    elif isinstance(value, str) and _LONG_FRACTION.fullmatch(value):
        base = 16
    else:
        raise ValueError("is not a fraction such as 3/4")
    numerator, denominator = (int(part, base) for part in value.split("/"))
    if not denominator:
        raise ValueError("is divided by zero")
    return Fraction(numerator, denominator)


def _fraction_text(value: Fraction) -> str:
    """Return the text of a fraction, such as "3/4"; "0x3/0x4" if it were too long in decimal."""
    numerator, denominator = value.numerator, value.denominator
    if max(abs(numerator), denominator) < 10**MOST_DIGITS:
        return f"{numerator}/{denominator}"
    return f"{numerator:#x}/{denominator:#x}"


ExactFraction = Annotated[
    Fraction, PlainValidator(_exact_fraction), PlainSerializer(_fraction_text)
]
