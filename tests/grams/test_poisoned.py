"""Cars that lie: their lies are exact, and one that nobody could miss is found."""

import numpy as np

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.regression.gram import Gram
from tests.support.lying_cars import LABEL, SIGNALS, left_out, told


def counts_of(car: int) -> np.ndarray:
    random = np.random.default_rng(car)
    counts = random.integers(-3000, 3000, (400, len(SIGNALS)))
    counts[:, -1] = counts[:, 0] // 5 - counts[:, 1] // 7 + random.integers(-40, 40, 400)
    return counts


def test_a_lie_is_that_of_rows_whose_label_lies() -> None:
    counts = counts_of(1)
    gram = Gram.from_counts(SIGNALS, counts)
    for gain, offset_rad in ((2, 0.0), (-1, 0.0), (1, 0.02), (3, -0.01)):
        lied = counts.copy()
        offset = round(offset_rad / float(catalogue()[LABEL].exact_scale))
        lied[:, -1] = gain * lied[:, -1] + offset
        assert told(gram, gain, offset_rad) == Gram.from_counts(SIGNALS, lied)


def test_a_car_with_the_other_sign_is_left_out_and_no_other() -> None:
    cars = [Gram.from_counts(SIGNALS, counts_of(car)) for car in range(30)]
    assert left_out(cars) == set()
    cars[7] = told(cars[7], -1, 0.0)
    assert left_out(cars) == {7}
