"""How the sensors of every car are off, from the Gram rows of its drives: no label, no log row.

The numbers of a car are exact functions of the sum of its drives' Gram rows (`car_numbers`), so
that they are the same in whatever order drives came, and a drive that is forgotten is gone from
them. How sure they are is told by how much single drives move them: drives are the independent
pieces of evidence. One drive has no other to differ from, so that the variance of residuals, as
drives differ, is that of the whole fleet; how much a car's driving tells is its own.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import sqrt
from typing import Any

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.car_numbers import CALIBRATION, CAR_NUMBERS, NumberName
from fleet_slip.catalogue.sources import ALL_DRIVES
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.grams.car_numbers import KINDS, Telling, gradient_about, tell_numbers
from fleet_slip.grams.drive_sums import DriveSums, collect_sums
from fleet_slip.grams.reader import GramReader, OpenedGrams, open_grams
from fleet_slip.regression.plane import Influence, influence
from fleet_slip.warehouse.condition import Condition, parse_condition
from fleet_slip.warehouse.tables import Warehouse


@dataclass(frozen=True)
class Calibrated:
    """One number of one car.

    Attributes:
        value: in its SI unit; the exact rational rounded once.
        count: the integer count of its grain that models and boards use.
        uncertainty: standard error in the same unit; None if no car has two drives.
        drives, rows: what tells it.
    """

    value: float
    count: int
    uncertainty: float | None
    drives: int
    rows: int


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
class Calibration:
    """The numbers of every car of a cohort.

    Attributes:
        cars: the numbers of each car, by its `vehicle_id`; a number is missing that its drives do
            not tell.
        logs_version, grams_version: versions of the Delta tables that were read.
        evidence: sums and variances that the numbers came from.
    """

    cars: Mapping[str, Mapping[NumberName, Calibrated]]
    logs_version: int
    grams_version: int
    evidence: "Evidence"

    def car(self, vehicle_id: str) -> Mapping[NumberName, Calibrated]:
        """Return the numbers of a car. Raises `QuestionError` if no drive is of it."""
        if vehicle_id not in self.cars:
            raise QuestionError(
                f"no drive of a car {vehicle_id!r} tells its numbers. See: fleet-slip sql "
                '"SELECT DISTINCT vehicle_id FROM drives"'
            )
        return self.cars[vehicle_id]

    def counts(self) -> dict[str, dict[str, int]]:
        """Return the integer counts of every car's numbers."""
        return {
            car: {name: one.count for name, one in numbers.items()}
            for car, numbers in self.cars.items()
        }

    def convergence(self) -> tuple[Convergence, ...]:
        """Return how sure the numbers are after 1, 2, 5, 10 ... drives of a car."""
        return self.evidence.convergence()

    def as_dict(self) -> dict[str, Any]:
        """Return what `calibrate --json` prints."""
        return {
            "logs_version": self.logs_version,
            "grams_version": self.grams_version,
            "numbers": {name: one.model_dump(mode="json") for name, one in CAR_NUMBERS.items()},
            "cars": {
                car: {name: vars(one) for name, one in numbers.items()}
                for car, numbers in self.cars.items()
            },
            "convergence": [vars(one) for one in self.convergence()],
        }


TABLE = pa.schema(
    [
        ("vehicle_id", pa.string()),
        ("number", pa.string()),
        ("value", pa.float64()),
        ("uncertainty", pa.float64()),
        ("unit", pa.string()),
        ("count", pa.int64()),
        ("grain", pa.float64()),
        ("drives", pa.int64()),
        ("rows", pa.int64()),
    ]
)
"""The table `calibration`."""

STEPS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
"""Numbers of drives that a convergence is shown for."""


class Evidence:
    """Sums of the drives of all cars, and the variance of residuals as drives differ."""

    def __init__(self, sums: Mapping[str, DriveSums]) -> None:
        """Take the sums by kind of plane, and learn the variances."""
        self.sums = sums
        self._origins = {kind: one.origin() for kind, one in sums.items()}
        self._moments = {kind: one.moments(self._origins[kind]) for kind, one in sums.items()}
        self.cars = sorted({car for one in sums.values() for car in one.cars})
        self.told = {car: self.tell(self._slices(car)) for car in self.cars}
        self.variances = self._variances()

    def _slices(self, car: str, first: int = 0, last: int | None = None) -> dict[str, slice]:
        """Return where the drives of a car are, from the `first` to before the `last`, by kind."""
        found = {}
        for kind, one in self.sums.items():
            if car in one.cars:
                every = range(*one.cars[car].indices(len(one.drives)))[first:last]
                found[kind] = slice(every.start, every.stop)
        return found

    def tell(self, slices: Mapping[str, slice]) -> dict[NumberName, Telling]:
        """Return the numbers that some drives tell."""
        return tell_numbers(
            {
                kind: self.sums[kind].table.take(_range(at)).total()
                for kind, at in slices.items()
                if at.stop > at.start
            }
        )

    def influence(self, telling: Telling, at: slice) -> Influence | None:
        """Return how drives move a number."""
        signals = self.sums[telling.kind].table.signals
        origin = np.array(self._origins[telling.kind], dtype=np.float64)
        gradient = gradient_about(telling, signals, origin)
        return influence(self._moments[telling.kind][at], telling.shape, signals, gradient)

    def _variances(self) -> dict[NumberName, float]:
        """Return the variance of residuals, as drives differ, of each number's plane.

        A drive's shift, about its car's number, has the variance times its share times one less
        the part of the share in the car's.
        """
        squares: dict[NumberName, list[float]] = {}
        expected: dict[NumberName, list[float]] = {}
        for car, told in self.told.items():
            for name, telling in told.items():
                found = self.influence(telling, self._slices(car)[telling.kind])
                if found is None or len(found.shifts) < 2:
                    continue
                shares = found.shares
                squares.setdefault(name, []).extend((found.shifts**2).tolist())
                expected.setdefault(name, []).extend(
                    (shares * (1 - shares / shares.sum())).tolist()
                )
        return {
            name: sum(squares[name]) / total
            for name in squares
            if (total := sum(expected[name])) > 0
        }

    def uncertainties(
        self, told: Mapping[NumberName, Telling], slices: Mapping[str, slice]
    ) -> dict[NumberName, float]:
        """Return the standard errors of what some drives tell."""
        own: dict[NumberName, float] = {}
        for name, telling in told.items():
            found = self.influence(telling, slices[telling.kind])
            if found is not None and name in self.variances:
                own[name] = self.variances[name] * float(found.shares.sum())
        return {
            name: sqrt(variance + sum(d**2 * own.get(n, 0.0) for n, d in told[name].also.items()))
            for name, variance in own.items()
        }

    def calibrated(self, car: str) -> dict[NumberName, Calibrated]:
        """Return the numbers of a car."""
        told, slices = self.told[car], self._slices(car)
        sure = self.uncertainties(told, slices)
        found: dict[NumberName, Calibrated] = {}
        for name in CAR_NUMBERS:
            if name in told:
                at = slices[told[name].kind]
                rows = int(self.sums[told[name].kind].table.n[at].sum())
                count = CAR_NUMBERS[name].count(told[name].value)
                found[name] = Calibrated(
                    value=float(told[name].value),
                    count=count or 0,
                    uncertainty=_three_digits(sure[name]) if name in sure else None,
                    drives=at.stop - at.start,
                    rows=rows,
                )
        return found

    def convergence(self) -> tuple[Convergence, ...]:
        """Return how sure the numbers are after so many drives of a car."""
        most = max(
            (
                len(range(*s.indices(s.stop)))
                for one in self.sums.values()
                for s in one.cars.values()
            ),
            default=0,
        )
        return tuple(row for step in STEPS if step <= most for row in self._converged(step))

    def _converged(self, step: int) -> list[Convergence]:
        stated: dict[NumberName, list[float]] = {}
        differences: dict[NumberName, list[float]] = {}
        for car in self.cars:
            first, others = self._slices(car, 0, step), self._slices(car, step, 2 * step)
            if any(at.stop - at.start < step for at in first.values()):
                continue
            told = self.tell(first)
            for name, error in self.uncertainties(told, first).items():
                stated.setdefault(name, []).append(error)
            if all(at.stop - at.start == step for at in others.values()):
                for name, other in self.tell(others).items():
                    if name in told:
                        apart = float(told[name].value - other.value)
                        differences.setdefault(name, []).append(apart)
        return [
            Convergence(
                name,
                step,
                len(stated[name]),
                _three_digits(_root_mean_square(stated[name])),
                _three_digits(_root_mean_square(differences[name]) / sqrt(2))
                if name in differences
                else None,
            )
            for name in CAR_NUMBERS
            if name in stated
        ]


def calibration_of(opened: OpenedGrams, condition: Condition) -> Calibration:
    """Return the numbers of every car that the Gram rows of a cohort tell; none, if there are none.

    `opened` are the Gram rows of the feature set `calibration`.
    """
    evidence = Evidence(collect_sums(opened.batches(condition), KINDS))
    cars = {car: evidence.calibrated(car) for car in evidence.cars}
    return Calibration(cars, opened.logs_version, opened.grams_version, evidence)


def calibration_table(opened: OpenedGrams) -> pa.Table:
    """Return the numbers as the table `calibration` that SQL sees, one row a car and number.

    Of the Gram rows that there are: none are required.
    """
    found = calibration_of(opened, parse_condition(ALL_DRIVES))
    rows = [
        {
            "vehicle_id": car,
            "number": name,
            **vars(one),
            "unit": CAR_NUMBERS[name].unit,
            "grain": float(CAR_NUMBERS[name].grain),
        }
        for car, numbers in found.cars.items()
        for name, one in numbers.items()
    ]
    return pa.Table.from_pylist(rows, schema=TABLE)


def calibrate(
    source: Warehouse | GramReader, condition: str | Condition = ALL_DRIVES
) -> Calibration:
    """Return the numbers of every car that has drives of a cohort, from their Gram rows.

    Drives without a label count as others do. Raises `QuestionError` for a condition that is none,
    and `DataError` if no drive satisfies it or the Gram rows of `calibration` are missing.
    """
    condition = parse_condition(condition)
    with open_grams(source, CALIBRATION, condition) as opened:
        found = calibration_of(opened, condition)
    if not found.cars:
        raise DataError(
            f"no drive of {condition.text!r} has yaw rate, ay and wheel speeds. Choose another "
            "cohort."
        )
    return found


def _range(at: slice) -> Any:
    return np.arange(at.start, at.stop)


def _root_mean_square(values: Sequence[float]) -> float:
    squares: FloatArray = np.square(values)
    return float(np.sqrt(squares.mean()))


def _three_digits(value: float) -> float:
    """Return an uncertainty as it is stated, which is the same on every machine."""
    return float(f"{value:.3g}")
