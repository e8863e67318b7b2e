"""Cars whose influence on a model no honest car has, from Gram matrices alone.

The influence of a car is the root mean square, over all rows, of how much the estimate changes when
the car is taken out of the sums: Cook's distance (Technometrics 19, 1977) of a group of rows, but
for its scale. It is leave-one-out itself, not an approximation, since a Gram can be subtracted.

A car with ten times the drives has more influence by right. With M the moments of the inputs, M_c
those of a car and H = M^-1 M_c its leverage, the mean square of the influence is a tr(H H) for
coefficients that differ from car to car, and b tr(H) for what differs from drive to drive. How the
two are mixed is not known, so a car may have the larger of what either alone would give it, beside
the car of median leverage: influence is judged in these units.
"""

from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from fleet_slip.arrays import FloatArray, IntArray
from fleet_slip.errors import DataError
from fleet_slip.regression.inference.drive_moments import DriveMoments

FALSE_ALARMS = 0.001
"""One honest car in so many would be left out, were the logarithms of influences normal."""

MOST_LEFT_OUT = 10
"""At most one car in so many is left out: where more are unusual, nothing is usual."""

LEAST_CARS = 20


@dataclass(frozen=True)
class Influential:
    """A car of unusual influence.

    Attributes:
        car: its number.
        times: its influence, by what its leverage gives, as a multiple of the median car's.
        rows: its part of all rows.
    """

    car: int
    times: float
    rows: float


def find_influential(moments: DriveMoments, cars: IntArray) -> list[Influential]:
    """Return the cars of unusual influence, the most unusual first.

    `cars` numbers the car of each drive, from 0. One after the other, the car goes whose influence,
    by what its leverage gives, lies above the cars' median by more than so many spreads that
    `FALSE_ALARMS` would, in logarithms; the spread is 1.4826 times the median absolute deviation.
    Raises `DataError` for
    fewer than `LEAST_CARS` cars.
    """
    number = int(cars.max()) + 1
    if number < LEAST_CARS:
        raise DataError(
            f"what is usual among cars takes {LEAST_CARS} of them, and these drives are of "
            f"{number}. Select without leaving cars out, or widen the cohort."
        )
    each = np.zeros((number, moments.size, moments.size))
    np.add.at(each, cars, moments.matrix(moments.packed))
    rest = np.arange(number)
    found: list[Influential] = []
    limit = NormalDist().inv_cdf(1 - FALSE_ALARMS)
    while len(found) < number // MOST_LEFT_OUT:
        some = each[rest]
        influence = influences(some) / allowances(some)
        logs = np.log(np.maximum(influence, np.finfo(np.float64).tiny))
        spread = 1.4826 * float(np.median(np.abs(logs - np.median(logs))))
        worst = int(np.argmax(logs))
        if logs[worst] <= np.median(logs) + limit * spread:
            break
        times = float(np.exp(logs[worst] - np.median(logs)))
        rows = float(each[rest[worst], 0, 0] / each[:, 0, 0].sum())
        found.append(Influential(int(rest[worst]), times, rows))
        rest = np.delete(rest, worst)
    return found


def influences(each: FloatArray) -> FloatArray:
    """Return the influence of each car, from its moments of (1, inputs, label), label last."""
    total = each.sum(axis=0)
    left = total - each
    whole = _solve(total[None])[0]
    change = whole - _solve(left)
    squares = np.einsum("ci,ij,cj->c", change, total[:-1, :-1], change) / total[0, 0]
    return np.asarray(np.sqrt(np.maximum(squares, 0.0)), dtype=np.float64)


def allowances(each: FloatArray) -> FloatArray:
    """Return the influence that its leverage gives each car, beside a car of median leverage."""
    inputs = each[:, :-1, :-1]
    leverage = _inverse(inputs.sum(axis=0)) @ inputs
    squared = np.einsum("cij,cji->c", leverage, leverage)
    single = np.einsum("cii->c", leverage)
    largest = np.maximum(squared / np.median(squared), single / np.median(single))
    return np.asarray(np.sqrt(largest), dtype=np.float64)


def _solve(moments: FloatArray) -> FloatArray:
    """Return the coefficients of each; inputs that depend on others share theirs."""
    inverse = _inverse(moments[:, :-1, :-1])
    return np.asarray((inverse @ moments[:, :-1, -1:])[..., 0], dtype=np.float64)


def _inverse(inputs: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.pinv(inputs, rcond=1e-13, hermitian=True), dtype=np.float64)
