"""The worked example of the README: products by hand, a fold left out by subtraction."""

import re
from fractions import Fraction
from pathlib import Path

import numpy as np

from fleet_slip.regression.gram import Gram
from fleet_slip.regression.least_squares import fit

README = (Path(__file__).parents[2] / "README.md").read_text("utf-8")
SIGNALS = ("x1", "x2", "y")


def parse(text: str) -> int:
    return int(text.replace("−", "-"))


def test_the_example_is_what_the_code_computes() -> None:
    rows = re.findall(r"^\| ([AB]) \| \d \| (−?\d) \| (−?\d) \| (−?\d) \|$", README, re.M)
    counts = {
        drive: np.array([list(map(parse, row[1:])) for row in rows if row[0] == drive])
        for drive in "AB"
    }
    assert len(rows) == 3
    a, b = (Gram.from_counts(SIGNALS, counts[drive]) for drive in "AB")
    for gram in (a, b, a + b):
        products = [[gram.product(i, j) for j in SIGNALS[:2]] for i in SIGNALS[:2]]
        label = [gram.product(i, "y") for i in SIGNALS[:2]]
        assert str(products) in README.replace("−", "-")
        assert str(label) in README.replace("−", "-")
    assert (a + b) - b == a
    both = fit((a + b).about_origin(), SIGNALS[:2], "y")
    held_out = fit(((a + b) - b).about_origin(), SIGNALS[:2], "y")
    assert list(map(Fraction, both.model.coefficients)) == [Fraction(67, 30), Fraction(-7, 5)]
    assert "w = [67/30, −7/5]" in README
    assert list(map(Fraction, held_out.model.coefficients)) == [2, -1]
    x1, x2, y = counts["B"][0]
    assert 2 * x1 - x2 - y == 1
