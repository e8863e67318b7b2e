"""What the roads of a fleet have in common: they lean to one side, and are banked in bends.

No car alone tells a road that always leans from an accelerometer that is off. The offsets of many
cars are of both signs; the road's lean is not. So what all cars share is the road's: the median.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import hypot
from statistics import median

from fleet_slip.regression.exact.exact_roots import sqrt

FEWEST_CARS = 10
"""Fewer do not tell the road's lean from their own offsets."""

BANKED_M2PS2 = Fraction(-5)
"""Lateral acceleration that bends take per curvature, from which on roads are banked: half a
percent in bends of 100 m. Noise and slip make a fifth of it on flat ones."""

USUAL_LEAN_MPS2 = 0.2
"""A crown of 2 %: the standard error of a lean that nobody can tell."""

SURE = Fraction(31)
"""Square of three standard errors of a median over that of the median deviation and over one less
the number of cars: 3 x 1.2533 x 1.4826, of normal numbers."""


@dataclass(frozen=True)
class Roads:
    """The roads of a fleet.

    Attributes:
        banked: whether bends are, as far as anybody can tell.
        lean: m/s^2, what they add to every car's lateral acceleration; None if nobody can tell.
        uncertainty: standard error of the lean.
        cars: how many told it.
    """

    banked: bool
    lean: Fraction | None
    uncertainty: float
    cars: int

    @property
    def hide_offsets(self) -> bool:
        """Whether nobody can tell how an accelerometer is off from how the roads lean."""
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
    return Roads(banked, middle - left, hypot(sqrt(square) / 3, float(left)), len(offsets))


def _square_of_three_errors(values: Sequence[Fraction]) -> Fraction:
    middle = median(values)
    return SURE * median([abs(value - middle) for value in values]) ** 2 / len(values)
