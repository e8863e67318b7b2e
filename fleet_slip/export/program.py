"""A published estimator as an integer program: what a car computes at each tick, and nothing else.

* **Signals** are counts, or missing. A count beyond its signal's valid range is missing, and so is
  what a car is told of itself. At a tick that was not logged, all signals are missing.
* **Steps** are operations on whole numbers (`fleet_slip.columns.lowering`).
* **The angle** is a dot product of steps, and missing where one of them is.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from functools import cached_property
from typing import Literal

from fleet_slip.catalog.arithmetic import parse
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.definitions import plain_column
from fleet_slip.catalog.signals import COUNT_MAX, SignalCatalog
from fleet_slip.columns.lowering import (
    Lowering,
    ParameterCount,
    Range,
    Step,
    VehicleAttribute,
    given_ranges,
    operands_of,
    plain_of,
    ranges_of,
    rings_of,
    roots_of,
    size_of,
)
from fleet_slip.errors import DataError, RefusedError
from fleet_slip.models.manifest import Manifest

# Exact coefficients as integers, and a proof of how far the angle can be from the exact model.
#
# **The claim.** Let E be the exact angle in output counts, a sum b + sum(g_i * n_i) of rationals,
# where n_i are counts of columns and |n_i| <= N_i. Let B = round(b * 2^F), C_i = round(g_i * 2^F)
# and A = floor((B + sum(C_i * n_i)) / 2^F + 1/2). Then |A - E| <= 1/2 + (1 + sum(N_i)) / 2^(F + 1).
#
# **The proof.** Rounding to the nearest integer moves b * 2^F and each g_i * 2^F by at most 1/2. So
# S = B + sum(C_i * n_i), an integer that is computed without an error, differs from E * 2^F by at
# most (1 + sum(N_i)) / 2; and A from S / 2^F by at most 1/2. (An angle beyond 32 bits is clipped.)
#
# An output count is a tenth of a count of the label, so that this is far below half of one of
# those. `fixed_point` takes the largest F for which each coefficient is two words of 32 bits, and
# S two of 64 bits, each of which adds up one part of every coefficient, and none of which can
# overflow.

OUTPUT_COUNTS = 10
"""Counts of the angle for one count of the label."""

LOW_BITS = 31
"""Most bits of the lower part of a coefficient, so that it is a word of 32 bits."""

LARGEST_PART = 2**31 - 1
"""Largest size of the upper part."""

LARGEST_SUM = 2**62
"""No sum of parts, nor the rounding after it, reaches this."""

LARGEST_ANGLE = 2**31 - 1
"""Largest size of the angle, a word of 32 bits: what is beyond, thousands of turns, is clipped."""

_TOO_LARGE = (
    "the coefficients are too large to bound the rounding error of the angle. Publish a model with "
    "fewer or other signals."
)


Target = Literal["json", "c", "sql", "dbc", "onnx", "fmu"]
"""What a version can be exported to."""


@dataclass(frozen=True)
class FixedPoint:
    """A dot product of integers.

    Attributes:
        bits: of the fraction, F.
        low_bits: of the lower part of each coefficient, which is not negative.
        intercept, coefficients: over 2^bits.
        error: bound of |A - E|, in counts of the output.
        largest: bound of |A|, before it is clipped.
    """

    bits: int
    low_bits: int
    intercept: int
    coefficients: tuple[int, ...]
    error: Fraction
    largest: int

    @property
    def parts(self) -> tuple[tuple[int, int], ...]:
        """The upper and lower part of the intercept, then of each coefficient."""
        return tuple(divmod(c, 1 << self.low_bits) for c in (self.intercept, *self.coefficients))


def fixed_point(
    intercept: Fraction, coefficients: Sequence[Fraction], largest: Sequence[int]
) -> FixedPoint:
    """Return the integers of a dot product, given the largest size of each factor, N_i.

    Raises `RefusedError` if the bound would be above half a count of the label.
    """
    sizes = sum(largest)
    low_bits = min(LOW_BITS, (LARGEST_SUM - 1).bit_length() - (sizes + 1).bit_length())
    bits = _most_bits(intercept, coefficients, largest, low_bits)
    scaled = [round(one * 2**bits) for one in (intercept, *coefficients)]
    error = Fraction(1, 2) + Fraction(1 + sizes, 2 ** (bits + 1))
    size = abs(intercept) + sum(abs(g) * n for g, n in zip(coefficients, largest, strict=True))
    if error > Fraction(OUTPUT_COUNTS, 2):
        raise RefusedError(_TOO_LARGE)
    return FixedPoint(bits, low_bits, scaled[0], tuple(scaled[1:]), error, int(size + error))


def _most_bits(
    intercept: Fraction, coefficients: Sequence[Fraction], largest: Sequence[int], low_bits: int
) -> int:
    """Return the largest F with which the sum of the upper parts stays below `LARGEST_SUM`."""
    sizes = (1, *largest)
    bits = low_bits + 62
    while bits > low_bits:
        upper = [round(one * 2**bits) >> low_bits for one in (intercept, *coefficients)]
        total = sum(abs(c) * n for c, n in zip(upper, sizes, strict=True))
        # The carry of the lower parts, and half of an output count, come to it.
        carried = total + 2 ** (62 - low_bits) + 2 ** (bits - low_bits)
        if carried < LARGEST_SUM and max(map(abs, upper[1:])) <= LARGEST_PART:
            return bits
        bits -= 1
    raise RefusedError(_TOO_LARGE)


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
    model is proven in `fleet_slip.export.program`.

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
    facts: tuple[VehicleAttribute, ...]
    numbers: tuple[ParameterCount, ...]
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

    @cached_property
    def learned(self) -> list[tuple[int, ...]]:
        """The sums that slopes are solved from, which may outlive a drive."""
        solved = [step for step in self.steps if step[0] == "nearest"]
        totals = [a for _, a, b in solved if self.steps[int(b)][0] == "power"]
        parts = [place for a in totals for place in (a, *operands_of(self.steps[int(a)]))]
        found = [self.steps[int(place)] for place in parts]
        return list(dict.fromkeys(plain_of(step) for step in found if step[0] == "sum"))

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


def write_program(catalog: Catalog, manifest: Manifest) -> Program:
    """Return the program of definitions that are known to agree.

    Raises `RefusedError` if counts mean something else now, or no bound of the error can be stated,
    and `DataError` for a feature of no signal.
    """
    signals = _inputs(catalog.signals, manifest)
    columns = [term.definition or plain_column(term.signal, term.sql) for term in manifest.terms]
    lowered, places = Lowering.of([one.name for one in signals], columns)
    steps, facts, numbers = tuple(lowered.steps), tuple(lowered.facts), tuple(lowered.numbers)
    ranges = lowered.ranges([(one.min_count, one.max_count) for one in signals])
    exact = manifest.counts_model(catalog)
    fixed = fixed_point(
        exact.intercept * OUTPUT_COUNTS,
        [one * OUTPUT_COUNTS for one in exact.coefficients],
        [size_of(ranges[place]) for place in places],
    )
    label = catalog.signals[manifest.label.signal]
    angle = Angle(
        name=manifest.label.signal,
        column=label.column,
        unit=label.unit,
        scale=label.scale / Decimal(OUTPUT_COUNTS),
        places=tuple(places),
        limit=LARGEST_ANGLE,
        **vars(fixed),
    )
    return Program(signals, facts, numbers, steps, angle)


def _inputs(signals: SignalCatalog, manifest: Manifest) -> tuple[Input, ...]:
    used: set[str] = set()
    for term in manifest.terms:
        parts = term.definition.parts if term.definition else (term,)
        if not term.inputs or any(part.sql and not parse(part.sql).inputs for part in parts):
            raise DataError(f"the feature {term.signal} uses no signal. Publish the model again.")
        used |= {*term.inputs}
    return tuple(
        # -32768 is a missing count on board, so that a cyclic signal lacks its half turn there.
        Input(name, s.column, s.unit, s.scale, max(s.min_count, -COUNT_MAX), s.max_count)
        for name, s in signals.signals.items()
        if name in used
    )
