"""Cars that lie about the label, exactly, and which of them nobody believes."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from fractions import Fraction

import numpy as np

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.regression.drives import DriveMoments, find_influential
from fleet_slip.regression.gram import Gram, GramTable, packed_position

INPUTS = (
    *("ax", "ay", "yaw_rate", "steering_wheel"),
    *("wheel_fl", "wheel_fr", "wheel_rl", "wheel_rr"),
)
LABEL = catalogue().label
SIGNALS = (*INPUTS, LABEL)


def told(gram: Gram, gain: int, offset_rad: float) -> Gram:
    """Return the Gram of the same rows with the label times a gain, plus an offset, exactly."""
    counts = round(Fraction(str(offset_rad)) / catalogue()[LABEL].exact_scale)
    y = len(gram.signals) - 1
    sums, products = list(gram.sums), list(gram.products)
    at: Callable[[int], int] = lambda i: packed_position(y, i)  # noqa: E731
    for i in range(y):
        products[at(i)] = gain * gram.products[at(i)] + counts * gram.sums[i]
    products[at(y)] = (
        gain**2 * gram.products[at(y)] + 2 * gain * counts * gram.sums[y] + counts**2 * gram.n
    )
    sums[y] = gain * gram.sums[y] + counts * gram.n
    return replace(gram, sums=tuple(sums), products=tuple(products))


def left_out(cars: Sequence[Gram]) -> set[int]:
    """Return the cars whose influence no honest car has."""
    grams = [car.restrict(SIGNALS) for car in cars]
    table = GramTable(
        SIGNALS,
        np.array([gram.n for gram in grams]),
        np.array([gram.sums for gram in grams]),
        np.array([gram.products for gram in grams]),
    )
    found = find_influential(DriveMoments.of(table), np.arange(len(cars)))
    return {one.car for one in found}
