"""Numbers with their nouns."""

import pytest

from fleet_slip.base import number_of


@pytest.mark.parametrize(
    ("number", "noun", "said"),
    [
        (0, "drive", "0 drives"),
        (1, "car", "1 car"),
        (2, "row", "2 rows"),
        (1500, "Gram row", "1,500 Gram rows"),
    ],
)
def test_one_thing_is_singular(number: int, noun: str, said: str) -> None:
    assert number_of(number, noun) == said
