"""Cars whose influence on a model no honest car has, from Gram matrices alone.

The influence of a car is the root mean square, over all rows, of how much the estimate changes when
the car is taken out of the sums: Cook's distance (Technometrics 19, 1977) of a group of rows, but
for its scale. It is leave-one-out itself, not an approximation, since a Gram can be subtracted.
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
    """The number of a car of unusual influence, which is so many `times` the median one."""

    car: int
    times: float


def find_influential(moments: DriveMoments, cars: IntArray) -> list[Influential]:
    """Return the cars of unusual influence, the most unusual first.

    `cars` numbers the car of each drive, from 0. One after the other, the car goes whose influence
    lies above the cars' median by more than so many spreads that `FALSE_ALARMS` would, in
    logarithms; the spread is 1.4826 times the median absolute deviation. Raises `DataError` for
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
        influence = influences(each[rest])
        logs = np.log(np.maximum(influence, np.finfo(np.float64).tiny))
        spread = 1.4826 * float(np.median(np.abs(logs - np.median(logs))))
        worst = int(np.argmax(logs))
        if logs[worst] <= np.median(logs) + limit * spread:
            break
        times = float(np.exp(logs[worst] - np.median(logs)))
        found.append(Influential(int(rest[worst]), times))
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


def _solve(moments: FloatArray) -> FloatArray:
    """Return the coefficients of each; inputs that depend on others share theirs."""
    inverse = np.linalg.pinv(moments[:, :-1, :-1], rcond=1e-13, hermitian=True)
    return np.asarray((inverse @ moments[:, :-1, -1:])[..., 0], dtype=np.float64)
