"""A published estimator as an integer program: what a car computes at each tick, and nothing else.

A program has four layers, each computed from those before it:

* **Signals** are counts, or missing. A count beyond its signal's valid range is missing. A tick
  that was not logged is one at which all signals are missing.
* **Sources** are integer functions of the signals of one tick, clipped; missing where a signal in
  them is missing, where their guard is too small, or where they would divide by what is not
  positive.
* **Columns** look back on sources, and are multiplied by what a car knows of itself.
* **The angle** is a dot product of columns, and missing where one of them is.

A quotient is rounded to the nearest integer, halves away from zero. These are the rules of
`fleet_slip.catalogue.columns`, so that a program computes what the warehouse computes.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction

from fleet_slip.catalogue.arithmetic import Arithmetic
from fleet_slip.catalogue.columns import LARGEST_FACT, Over

LARGEST_WORD = 2**63 - 1
"""Largest size of anything that a program computes."""

MOST_VALUES = 2**31 - 1
"""Most values of a running mean: 248 days."""


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
class CarFact:
    """What a car knows of itself: a number, rounded; or, with `equals`, 1 if it is that, else 0."""

    name: str
    equals: str | None = None

    @property
    def field(self) -> str:
        """Its name where programs have one name for each."""
        if self.equals is None:
            return self.name
        return f"{self.name}_is_" + "".join(c if c.isalnum() else "_" for c in self.equals).lower()


@dataclass(frozen=True)
class CarNumber:
    """What a car's own drives tell of it: a count of so many `grain`."""

    name: str
    unit: str
    grain: Decimal


@dataclass(frozen=True)
class Source:
    """An integer function of the signals of one tick.

    Attributes:
        name: of the signal or feature.
        arithmetic: of the feature; None for a signal as it is.
        limit: largest size of its count.
        ticks: how far columns look back on it.
    """

    name: str
    arithmetic: Arithmetic | None
    limit: int
    ticks: int = 0


@dataclass(frozen=True)
class Window:
    """Looks back on a source; without `over`, the source's value now.

    `count * numerator / denominator`, of a mean over as many values as there are, rounded once and
    clipped to `limit`. `ticks` is 0 for all since the drive began.
    """

    source: int
    over: Over | None
    ticks: int
    numerator: int
    denominator: int
    limit: int
    source_limit: int

    @property
    def most_values(self) -> int:
        """How many values are added up at most: a running mean stays as it is after so many.

        So many that twice the sum times the numerator, and the divisor, fit into 64 bits.
        """
        if self.over != "running_mean":
            return self.ticks
        each = 2 * self.source_limit * self.numerator + self.denominator
        return min(MOST_VALUES, LARGEST_WORD // each)

    @property
    def largest(self) -> int:
        """Largest size of the count."""
        return self.limit


@dataclass(frozen=True)
class Factor:
    """A column times a fact less `less`, times the ratio; rounded, and clipped to `limit`.

    Missing where the car does not know the fact: beyond `LARGEST_FACT` it does not.
    """

    of: int
    fact: int
    less: int
    numerator: int
    denominator: int
    limit: int

    @property
    def largest(self) -> int:
        """Largest size of the count."""
        return self.limit


@dataclass(frozen=True)
class Gated:
    """A column times the weight of a gate, over `WEIGHT`, rounded.

    The weight is 0 up to `low`, `WEIGHT` at `peak`, and 0 again from `high`, rounded down on the
    way up; without `high` it stays.
    """

    of: int
    by: int
    low: int
    peak: int
    high: int | None
    largest: int


@dataclass(frozen=True)
class Numbered:
    """A column times a number of the car less `less`; `alone`, the number where the column is.

    Where the number is not known, the column `running` takes its place, `less` not taken from it;
    where there is none, 0.
    """

    of: int
    number: int
    less: int
    alone: bool
    running: int | None
    largest: int


Column = Window | Factor | Gated | Numbered


@dataclass(frozen=True)
class Angle:
    """The dot product: `(intercept + sum(coefficient * column)) / 2^bits`, in counts of `scale`.

    Rounded to the nearest integer, halves up, and clipped to 32 bits. How far it is from the exact
    model is proven in `fleet_slip.export.fixed_point`.

    Attributes:
        name, column, unit: what is estimated.
        scale: physical value of one count.
        bits: of the fraction.
        low_bits: of the lower part of each coefficient, where two words hold it.
        intercept: over 2^bits.
        terms: a column and its coefficient over 2^bits, for each term of the model.
        error: bound of the distance from the exact model, rounding included, in counts.
        largest: bound of the size before it is clipped, in counts.
        limit: to which it is clipped.
    """

    name: str
    column: str
    unit: str
    scale: Decimal
    bits: int
    low_bits: int
    intercept: int
    terms: tuple[tuple[int, int], ...]
    error: Fraction
    largest: int
    limit: int

    @property
    def parts(self) -> tuple[tuple[int, int], ...]:
        """The upper and lower part of the intercept, then of each coefficient."""
        whole = (self.intercept, *(coefficient for _, coefficient in self.terms))
        return tuple(divmod(one, 1 << self.low_bits) for one in whole)


@dataclass(frozen=True)
class Program:
    """A published estimator, complete. Columns refer to those before them by their place."""

    signals: tuple[Input, ...]
    facts: tuple[CarFact, ...]
    numbers: tuple[CarNumber, ...]
    sources: tuple[Source, ...]
    columns: tuple[Column, ...]
    angle: Angle

    @property
    def longest_ticks(self) -> int:
        """How far it looks back; a running mean looks back on all."""
        return max(source.ticks for source in self.sources)


@dataclass(frozen=True)
class Car:
    """What a program is told of a car: facts as the drive's metadata, numbers as counts."""

    facts: Mapping[str, object]
    numbers: Mapping[str, int]

    def fact_counts(self, program: Program) -> tuple[int | None, ...]:
        """Return the facts of a program as whole numbers, None where not known."""
        return tuple(_fact_count(one, self.facts.get(one.name)) for one in program.facts)

    def number_counts(self, program: Program) -> tuple[int | None, ...]:
        """Return the numbers of a program as counts, None where not known."""
        return tuple(self.numbers.get(one.name) for one in program.numbers)


UNKNOWN_CAR = Car({}, {})
"""A car of which nothing is known."""


def _fact_count(fact: CarFact, value: object) -> int | None:
    if value is None:
        return None
    if fact.equals is not None:
        return int(value == fact.equals)
    if not isinstance(value, int | float) or not abs(value) <= LARGEST_FACT:
        return None
    size = int(abs(value) + 0.5)
    return -size if value < 0 else size
