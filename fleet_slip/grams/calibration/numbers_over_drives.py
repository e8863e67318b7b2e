"""What more drives of a car make of its numbers: how sure they become, and which have changed."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from math import sqrt

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.car_numbers import CAR_NUMBERS, NumberName
from fleet_slip.grams.calibration.car_evidence import (
    CarEvidence,
    Piece,
    three_digits,
    with_others,
)

SURE_ERRORS = 5.0
"""Standard errors by which a number has changed. Of 6,300 numbers of simulated cars in which
nothing changed, before and after some day, none differed by more."""

STEPS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
"""Numbers of drives that a convergence is shown for."""


@dataclass(frozen=True)
class Convergence:
    """How sure a number is after so many drives of a car.

    Attributes:
        drives: the first so many of each car that has them.
        cars: how many have.
        stated: root mean square of the standard errors.
        measured: the same by how much the next so many drives of a car differ; None if no car has.
    """

    number: NumberName
    drives: int
    cars: int
    stated: float
    measured: float | None


@dataclass(frozen=True)
class ChangedNumber:
    """A number of which a car's drives from a day on tell otherwise than those before.

    `uncertainty` is the standard error of the difference; all in the number's unit.
    """

    car: str
    number: NumberName
    before: float
    after: float
    uncertainty: float


def changed_numbers(evidence: CarEvidence, since: date) -> list[ChangedNumber]:
    """Return the numbers that are others from a day on, surely; by car.

    Errors that no drive of a car takes away are in both, and not in the difference. How drives
    differ is told by each half by itself: a car that changed would pass for one that is uneven.
    Of a car that is more uneven than others, such as by its loads, its own drives tell it.
    """
    halves = {car: _halves(evidence, car, since) for car in evidence.cars}
    variances = evidence.variances_of(half for both in halves.values() for half in both)
    found = []
    for car, (before, after) in halves.items():
        (was, _), (now, _) = before, after
        own = evidence.variances_of((before, after))
        uneven = {name: max(one, own.get(name, 0.0)) for name, one in variances.items()}
        of_was, of_now = (
            with_others(half[0], evidence.scatter(half, uneven, same_roads=True))
            for half in (before, after)
        )
        for name in CAR_NUMBERS:
            if name in of_was and name in of_now:
                error = three_digits(sqrt(of_was[name] + of_now[name]))
                one, other = float(evidence.level(was[name])), float(evidence.level(now[name]))
                if abs(other - one) > SURE_ERRORS * error:
                    found.append(ChangedNumber(car, name, one, other, error))
    return found


def _halves(evidence: CarEvidence, car: str, since: date) -> tuple[Piece, Piece]:
    before, after = {}, {}
    for kind, at in evidence.slices(car).items():
        early = sum(day < since for _, day, _ in evidence.sums[kind].drives[at])
        before[kind] = slice(at.start, at.start + early)
        after[kind] = slice(at.start + early, at.stop)
    return (evidence.tell(before), before), (evidence.tell(after), after)


def convergence(evidence: CarEvidence) -> tuple[Convergence, ...]:
    """Return how sure the numbers are after so many drives of a car."""
    most = max(
        (
            len(range(*s.indices(s.stop)))
            for one in evidence.sums.values()
            for s in one.cars.values()
        ),
        default=0,
    )
    return tuple(row for step in STEPS if step <= most for row in _converged(evidence, step))


def _converged(evidence: CarEvidence, step: int) -> list[Convergence]:
    stated: dict[NumberName, list[float]] = {}
    differences: dict[NumberName, list[float]] = {}
    for car in evidence.cars:
        first, others = evidence.slices(car, 0, step), evidence.slices(car, step, 2 * step)
        if any(at.stop - at.start < step for at in first.values()):
            continue
        told = evidence.tell(first)
        for name, error in evidence.uncertainties(told, first).items():
            stated.setdefault(name, []).append(error)
        if all(at.stop - at.start == step for at in others.values()):
            for name, other in evidence.tell(others).items():
                if name in told:
                    apart = float(told[name].value - other.value)
                    differences.setdefault(name, []).append(apart)
    return [
        Convergence(
            name,
            step,
            len(stated[name]),
            three_digits(_root_mean_square(stated[name])),
            three_digits(_root_mean_square(differences[name]) / sqrt(2))
            if name in differences
            else None,
        )
        for name in CAR_NUMBERS
        if name in stated
    ]


def _root_mean_square(values: Sequence[float]) -> float:
    squares: FloatArray = np.square(values)
    return float(np.sqrt(squares.mean()))
