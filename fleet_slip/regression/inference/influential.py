"""Cars whose influence on a model no honest car has, from Gram matrices alone.

Influence is the root mean square, over all rows, of how the estimate changes without the car:
Cook's distance (1977) of a group, exact leave-one-out. With M the moments of the inputs, M_c a
car's and H = M^-1 M_c its leverage, its mean square is a tr(H H) if coefficients differ by car, and
b tr(H) if by drive; a car may have the larger of both beside that of median leverage.
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
    """A car, its influence over what its leverage gives and the median car's, and its rows."""

    car: int
    times: float
    rows: float


def find_influential(moments: DriveMoments, cars: IntArray) -> list[Influential]:
    """Return the cars of unusual influence, the most unusual first.

    `cars` numbers each drive's car from 0. One by one the car goes whose log influence lies above
    the median by more spreads (1.4826 median absolute deviations) than `FALSE_ALARMS` would. Raises
    `DataError` for fewer than `LEAST_CARS` cars.
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
