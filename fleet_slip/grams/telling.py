"""What the sums of a car's drives tell: its numbers, and why others are missing."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from fractions import Fraction

from fleet_slip.catalogue.facts import NumberName
from fleet_slip.regression.least_squares import Relation, Terms

NO_COURSE = "no row above 3 m/s has the yaw rate, ay and all four wheel speeds"
NO_STEERING = "no row above 3 m/s has both steering angles beside the other signals"
STRAIGHT = "it drove too straight: turns are hardly more than noise"
EVEN = (
    "it drove too evenly: one over speed must differ to tell an offset of ay from one of yaw rate"
)
ALIKE = "its rows are too much alike to tell one number from another"
NO_TYRE = (
    "what its sensors say of speed fits no tyre: noise made it, or a signal is of another unit or "
    "sign. See: fleet-slip quality"
)
TIGHT_BENDS = (
    "bends are so tight that a bank is not in proportion to them: satellite speed tells it"
)
"""Why a number is missing."""


@dataclass(frozen=True)
class Telling:
    """A number of a relation, its gradient by the unknowns, and by others that it depends on.

    `noise` is the variance of the gyroscope's noise that was taken out; `by_lean` is how much a
    lean of the road adds to the number.
    """

    kind: str
    relation: Relation
    terms: Terms
    noise: Fraction
    value: Fraction
    gradient: tuple[float, ...]
    also: Mapping[NumberName, float]
    by_lean: Fraction = Fraction(0)


@dataclass(frozen=True)
class Told:
    """The numbers that the sums of a car's drives tell, and why the others are missing."""

    numbers: dict[NumberName, Telling] = field(default_factory=dict)
    missing: dict[NumberName, str] = field(default_factory=dict)

    def take(self, names: Iterable[NumberName], found: dict[NumberName, Telling] | str) -> None:
        """Take what was found of some numbers, or why there is none."""
        if isinstance(found, str):
            self.missing.update(dict.fromkeys(names, found))
        else:
            self.numbers.update(found)
