"""A published estimator as an integer program: what a car computes at each tick, and nothing else.

* **Signals** are counts, or missing. A count beyond its signal's valid range is missing, and so is
  what a car is told of itself. At a tick that was not logged, all signals are missing.
* **Steps** are operations on whole numbers (`fleet_slip.columns.operations`).
* **The angle** is a dot product of steps, and missing where one of them is.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from decimal import Decimal
from functools import cached_property

from fleet_slip.columns.lowering import CarCount, CarFact, given_ranges
from fleet_slip.columns.operations import Range, Step, plain_of, ranges_of, rings_of, roots_of
from fleet_slip.export.fixed_point import FixedPoint


@dataclass(frozen=True)
class Input:
    """A signal: `physical = scale * count`, and its smallest and largest valid count."""

    name: str
    column: str
    unit: str
    scale: Decimal
    min_count: int
    max_count: int


@dataclass(frozen=True)
class Angle(FixedPoint):
    """The dot product: `(intercept + sum(coefficient * step)) / 2^bits`, in counts of `scale`.

    Rounded to the nearest integer, halves up, and clipped to 32 bits. How far it is from the exact
    model is proven in `fleet_slip.export.fixed_point`.

    Attributes:
        name, column, unit: what is estimated.
        scale: physical value of one count.
        places: the step of each coefficient.
        limit: to which it is clipped.
    """

    name: str
    column: str
    unit: str
    scale: Decimal
    places: tuple[int, ...]
    limit: int

    @property
    def terms(self) -> tuple[tuple[int, int], ...]:
        """A step and its coefficient over 2^bits, for each term of the model."""
        return tuple(zip(self.places, self.coefficients, strict=True))


@dataclass(frozen=True)
class Steps:
    """What columns are computed by at each tick: steps, and what they are given."""

    signals: tuple[Input, ...]
    facts: tuple[CarFact, ...]
    numbers: tuple[CarCount, ...]
    steps: tuple[Step, ...]

    @cached_property
    def given(self) -> dict[str, list[Range]]:
        """The valid ranges of signals, facts and numbers: what is beyond is missing."""
        ends = [(one.min_count, one.max_count) for one in self.signals]
        return given_ranges(ends, self.facts, self.numbers)

    @cached_property
    def ranges(self) -> list[Range]:
        """The range of each step, zero included where it can be missing."""
        return ranges_of(self.steps, self.given)

    @cached_property
    def roots(self) -> list[tuple[int, ...]]:
        """For each step, the steps that must be there by themselves for it to be there."""
        return roots_of(self.steps, self.ranges)

    @cached_property
    def rings(self) -> dict[int, int]:
        """The steps that are looked back on, and how many ticks; 0 are all since the start."""
        return rings_of(self.steps)

    @property
    def sums(self) -> list[tuple[int, ...]]:
        """What is added up over time: a step, its ticks, and the most values."""
        return list(dict.fromkeys(plain_of(s) for s in self.steps if s[0] in ("sum", "values")))

    @property
    def longest_ticks(self) -> int:
        """How far it looks back; a running mean looks back on all."""
        return max(self.rings.values(), default=0)


@dataclass(frozen=True)
class Program(Steps):
    """A published estimator, complete."""

    angle: Angle


@dataclass(frozen=True)
class Car:
    """What a program is told of a car: facts as the drive's metadata, numbers as counts."""

    facts: Mapping[str, object]
    numbers: Mapping[str, int]

    def fact_counts(self, program: Program) -> tuple[int | None, ...]:
        """Return the facts of a program as whole numbers, None where not known."""
        return tuple(one.count(self.facts.get(one.name)) for one in program.facts)

    def number_counts(self, program: Program) -> tuple[int | None, ...]:
        """Return the numbers of a program as counts, None where not known."""
        return tuple(self.numbers.get(one.name) for one in program.numbers)


UNKNOWN_CAR = Car({}, {})
"""A car of which nothing is known."""
