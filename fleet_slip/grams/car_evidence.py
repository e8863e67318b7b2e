"""What a car's drives are evidence of: its numbers, and how sure they are.

How sure they are follows from how much single drives move them: drives are the independent pieces
of evidence. One drive has no other to differ from, so that the variance of residuals, as drives
differ, is that of the whole fleet; how much a car's driving determines is its own. Drives go over
the same roads again, so that there is a limit to what more of them determine.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import hypot, sqrt
from statistics import median
from typing import Any

import numpy as np

from fleet_slip.catalogue.facts import CAR_NUMBERS, NumberName
from fleet_slip.grams.car_estimates import (
    LASTING_BY_SATELLITE,
    CarEstimate,
    CarEstimates,
    add_satellite_estimates,
    add_standstill,
    bank_of_bends,
    course_terms,
    estimate_numbers,
)
from fleet_slip.grams.reader import DriveSums
from fleet_slip.regression.exact import sqrt as sqrt_exact
from fleet_slip.regression.gram import Gram
from fleet_slip.regression.least_squares import (
    DriveTermSums,
    ExactSums,
    Influence,
    influence,
)

# What the roads of a fleet have in common: they lean to one side, and are banked in bends.
#
# No car alone separates a road that always leans from an accelerometer that is off. The offsets of
# many cars are of both signs; the road's lean is not. The median, which all share, is the road's.

FEWEST_CARS = 10
"""Fewer do not separate the road's lean and their own offsets."""

BANKED_M2PS2 = Fraction(-5)
"""Lateral acceleration that bends take per curvature, from which on roads are banked: half a
percent in bends of 100 m. Noise and slip make a fifth of it on flat ones."""

USUAL_LEAN_MPS2 = 0.2
"""A crown of 2 %: the standard error of a lean that is unknown."""

SURE = Fraction(31)
"""Square of three standard errors of a median over that of the median deviation and over one less
the number of cars: 3 x 1.2533 x 1.4826, of normal numbers."""


@dataclass(frozen=True)
class Roads:
    """The roads of a fleet.

    Attributes:
        banked: whether bends are, as far as can be determined.
        lean: m/s^2, what they add to every car's lateral acceleration; None if unknown.
        uncertainty: standard error of the lean.
        cars: how many determined it.
    """

    banked: bool
    lean: Fraction | None
    uncertainty: float
    cars: int

    @property
    def hide_offsets(self) -> bool:
        """Whether how an accelerometer is off cannot be separated from how the roads lean."""
        return self.banked and self.lean is None


def are_banked(banks: Sequence[Fraction]) -> bool:
    """Tell by the bank that each car met whether roads are banked: unless they surely are flat.

    Sure are three standard errors; fewer than `FEWEST_CARS` go by their median. The relation of
    banked roads holds on flat ones, too, but not the other way round.
    """
    if not banks:
        return False
    beyond = median(banks) - BANKED_M2PS2
    if beyond <= 0 or len(banks) < FEWEST_CARS:
        return beyond < 0
    return beyond**2 <= _square_of_three_errors(banks)


def roads_of(banked: bool, offsets: Sequence[Fraction]) -> Roads:
    """Return the roads by what each car's accelerometer says when it goes straight.

    The median less the part that may be of the cars: with m the median and e its standard error,
    m - (3 e)^2 / m, zero within three standard errors. So no car's number jumps as a fleet grows.
    What is left of it is uncertain as well.
    """
    if not banked:
        return Roads(banked, None, 0.0, len(offsets))
    if len(offsets) < FEWEST_CARS:
        return Roads(banked, None, USUAL_LEAN_MPS2, len(offsets))
    middle, square = median(offsets), _square_of_three_errors(offsets)
    left = middle if middle**2 <= square else square / middle
    return Roads(banked, middle - left, hypot(sqrt_exact(square) / 3, float(left)), len(offsets))


def _square_of_three_errors(values: Sequence[Fraction]) -> Fraction:
    middle = median(values)
    return SURE * median([abs(value - middle) for value in values]) ** 2 / len(values)


ROADS = 8
"""So many drives are as good as endless ones: more are on the same roads again, whose slopes are
the same."""

LEAST_PART = 1e-9
"""A drive of which the others of its car are less than this part has no other to differ from."""

PAIRS = 300
"""Cars of which two drives are compared: enough to determine a variance to a tenth."""

LASTING: Mapping[bool, Mapping[NumberName, float]] = {
    False: {
        "steering_offset": 0.00004,
        "speed_ratio": 0.0015,
    },
    True: {
        "yaw_rate_offset": 0.0007,
        "steering_offset": 0.0002,
        "speed_ratio": 0.03,
    },
}
"""Standard errors that no drive takes away, on flat and on banked roads: noise flattens and wheels
slip. Where bends are banked, a body that leans 2 to 6 degrees per g makes its accelerometer say 3
to 10 % more, which is no speed."""


@dataclass(frozen=True)
class CalibratedNumber:
    """One number of one car.

    Attributes:
        value: in its SI unit; the exact rational rounded once.
        count: the integer count of its grain that models and boards use.
        uncertainty: standard error in the same unit; None if no car has two drives.
        drives, rows: what determines it.
    """

    value: float
    count: int
    uncertainty: float | None
    drives: int
    rows: int


LEANS = (
    "roads are banked, and may always lean to one side, which cannot be separated from the car's "
    f"own offset with fewer than {FEWEST_CARS} cars"
)
BEYOND = "it is beyond what 16 bits count of its grain"
"""Why a number is missing."""


class CarEvidence:
    """Sums of the drives of all cars, and the variance of residuals as drives differ."""

    def __init__(self, sums: Mapping[str, DriveSums]) -> None:
        """Take the sums by kind of plane, and learn the variances."""
        self.sums = sums
        self._moments = {kind: one.table.moments() for kind, one in sums.items()}
        self.cars = sorted({car for one in sums.values() for car in one.cars})
        banks = [bank_of_bends(self._totals(self.slices(car))) for car in self.cars]
        self._banked = are_banked([bank for bank in banks if bank is not None])
        self._whole = {car: self._estimate(self.slices(car)) for car in self.cars}
        self.estimates = {car: whole.numbers for car, whole in self._whole.items()}
        offsets = [
            estimates["ay_offset"].value
            for estimates in self.estimates.values()
            if "ay_offset" in estimates
        ]
        self.roads = roads_of(self._banked, offsets)
        self.variances = self._variances()
        self.variances_of_one = self._variances_of_one()

    def slices(self, car: str, first: int = 0, last: int | None = None) -> dict[str, slice]:
        """Return where the drives `first` to `last` of a car stand, by kind."""
        found = {}
        for kind, one in self.sums.items():
            if car in one.cars:
                every = range(*one.cars[car].indices(len(one.drives)))[first:last]
                found[kind] = slice(every.start, every.stop)
        return found

    def means(self, car: str, terms: Sequence[str]) -> list[Fraction]:
        """Return means of terms of the relations of course over a car's drives; 0 of no drive."""
        totals = self._totals(self.slices(car))
        if not (course := totals.get("course")):
            return [Fraction(0) for _ in terms]
        sums = ExactSums(course, course_terms())
        return [sums.mean(term) for term in terms]

    def _totals(self, slices: Mapping[str, slice]) -> dict[str, Gram]:
        return {
            kind: self.sums[kind].table.take(_range(at)).total()
            for kind, at in slices.items()
            if at.stop > at.start
        }

    def estimate(self, slices: Mapping[str, slice]) -> dict[NumberName, CarEstimate]:
        """Return the numbers that some drives determine, with the lean of their roads."""
        return self._estimate(slices).numbers

    def _estimate(self, slices: Mapping[str, slice]) -> CarEstimates:
        totals = self._totals(slices)
        estimates = estimate_numbers(totals, self._banked)
        add_satellite_estimates(totals, estimates)
        add_standstill(totals, estimates)
        return estimates

    def influence(self, estimate: CarEstimate, at: slice) -> Influence | None:
        """Return how drives move a number."""
        signals = self.sums[estimate.kind].table.signals
        sums = DriveTermSums(self._moments[estimate.kind][at], signals, estimate.terms)
        return influence(estimate.relation, sums, float(estimate.noise), estimate.gradient)

    def _variances(self) -> dict[NumberName, float]:
        """Return the variance of residuals, as drives differ, of each number's plane.

        A drive's shift, about the number of its car, has the variance times its share times one
        less the part of the share in the car's. Every drive counts the same: errors do not grow
        with shares as noise does, and uninformative drives would decide for informative ones.
        """
        ratios: dict[NumberName, list[float]] = {}
        for car in self.cars:
            slices = self.slices(car)
            for name, estimate in self.estimates[car].items():
                found = self.influence(estimate, slices[estimate.kind])
                if found is None:
                    continue
                expected = found.shares * (1 - found.shares / found.shares.sum())
                alone = expected <= LEAST_PART * found.shares
                ratios.setdefault(name, []).extend(
                    (found.shifts[~alone] ** 2 / expected[~alone]).tolist()
                )
        return {name: sum(some) / len(some) for name, some in ratios.items() if some}

    def _variances_of_one(self) -> dict[NumberName, float]:
        """Return the same of the numbers of one drive: how far a car's first two differ.

        What makes roads differ, such as the bank of their bends, moves a number that several roads
        determine at once; one road alone explains its own.
        """
        ratios: dict[NumberName, list[float]] = {}
        pairs = [
            car for car in self.cars if all(s.stop - s.start > 1 for s in self.slices(car).values())
        ]
        for car in pairs[:PAIRS]:
            one, other = (self._of_drive(car, drive) for drive in (0, 1))
            for name in one.keys() & other.keys():
                apart = one[name][0] - other[name][0]
                ratios.setdefault(name, []).append(apart**2 / (one[name][1] + other[name][1]))
        return {name: sum(some) / len(some) for name, some in ratios.items()}

    def _of_drive(self, car: str, drive: int) -> dict[NumberName, tuple[float, float]]:
        """Return the numbers that a drive alone determines, and their shares."""
        at = self.slices(car, drive, drive + 1)
        found = {}
        for name, estimate in self.estimate(at).items():
            influence_of_it = self.influence(estimate, at[estimate.kind])
            if influence_of_it is not None:
                found[name] = float(estimate.value), float(influence_of_it.shares.sum())
        return found

    def scatter(
        self, estimates: Mapping[NumberName, CarEstimate], slices: Mapping[str, slice]
    ) -> dict[NumberName, float]:
        """Return the variances of what some drives determine, as drives differ."""
        own: dict[NumberName, float] = {}
        for name, estimate in estimates.items():
            found = self.influence(estimate, slices[estimate.kind])
            if found is None or name not in self.variances:
                continue
            drives = len(found.shares)
            of_one = self.variances_of_one if drives == 1 else self.variances
            again = 1 + drives / ROADS
            variance = of_one.get(name, self.variances[name]) * float(found.shares.sum())
            own[name] = variance * again
        return own

    def uncertainties(
        self, estimates: Mapping[NumberName, CarEstimate], slices: Mapping[str, slice]
    ) -> dict[NumberName, float]:
        """Return the standard errors of what some drives determine."""
        own = self.scatter(estimates, slices)
        for name in own:
            by_satellite = LASTING_BY_SATELLITE.get(estimates[name].kind, {})
            own[name] += {**LASTING[self._banked], **by_satellite}.get(name, 0.0) ** 2
        common = self.roads.uncertainty
        return {
            name: sqrt(variance + (common * float(estimates[name].by_lean)) ** 2)
            for name, variance in with_others(estimates, own).items()
        }

    def level(self, estimate: CarEstimate) -> Fraction:
        """Return a number as it is without the lean of the roads."""
        return estimate.value - (self.roads.lean or 0) * estimate.by_lean

    def calibrated(self, car: str) -> dict[NumberName, CalibratedNumber]:
        """Return the numbers of a car, by all of its drives.

        `ay_offset` is missing where it cannot be separated from the lean of the roads.
        """
        slices, estimates = self.slices(car), self.estimates[car]
        sure = self.uncertainties(estimates, slices)
        found: dict[NumberName, CalibratedNumber] = {}
        for name in CAR_NUMBERS:
            if name in estimates and not self._hidden(name):
                at = slices[estimates[name].kind]
                rows = int(self.sums[estimates[name].kind].table.n[at].sum())
                value = self.level(estimates[name])
                count = CAR_NUMBERS[name].count(value)
                if count is None:
                    continue
                found[name] = CalibratedNumber(
                    value=float(value),
                    count=count,
                    uncertainty=three_digits(sure[name]) if name in sure else None,
                    drives=at.stop - at.start,
                    rows=rows,
                )
        return found

    def _hidden(self, name: NumberName) -> bool:
        return name == "ay_offset" and self.roads.hide_offsets

    def refusals(self, car: str) -> dict[NumberName, str]:
        """Return why numbers of a car are missing."""
        whole = self._whole[car]
        found: dict[NumberName, str] = {}
        for name in CAR_NUMBERS:
            if name not in whole.numbers:
                found[name] = whole.missing[name]
            elif self._hidden(name):
                found[name] = LEANS
            elif CAR_NUMBERS[name].count(self.level(whole.numbers[name])) is None:
                found[name] = BEYOND
        return found


def with_others(
    estimates: Mapping[NumberName, CarEstimate], own: Mapping[NumberName, float]
) -> dict[NumberName, float]:
    """Return variances of numbers with those of others that they depend on."""
    return {
        name: variance + sum(d**2 * own.get(n, 0.0) for n, d in estimates[name].also.items())
        for name, variance in own.items()
    }


def _range(at: slice) -> Any:
    return np.arange(at.start, at.stop)


def three_digits(value: float) -> float:
    """Return an uncertainty as it is stated, which is the same on every machine."""
    return float(f"{value:.3g}")
