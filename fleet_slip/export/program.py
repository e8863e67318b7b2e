"""Integer programs of published estimators: the computation of a car at each tick.

* **Signals** are counts, or missing. A count outside its signal's valid range is missing, and so is
  a property of the car outside its range. At a tick without a message, all signals are missing.
* **Steps** are operations on integers (`fleet_slip.columns.lowering`).
* **The angle** is a dot product of steps, and missing if one of them is.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from functools import cached_property
from typing import Literal

from fleet_slip.catalog.arithmetic import Step, parse
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.definitions import plain_column
from fleet_slip.catalog.signals import COUNT_MAX, SignalCatalog
from fleet_slip.columns.lowering import (
    Lowering,
    ParameterCount,
    Range,
    VehicleAttribute,
    given_ranges,
    ranges_of,
    rings_of,
    roots_of,
    size_of,
)
from fleet_slip.errors import DataError, RefusedError
from fleet_slip.models.manifest import Manifest

# Coefficients as integers, and a bound of the angle's error.
#
# Claim. Let E be the exact angle in output counts, a sum b + sum(g_i * n_i) of rationals, where n_i
# are counts of columns and |n_i| <= N_i. Let B = round(b * 2^F), C_i = round(g_i * 2^F) and
# A = floor((B + sum(C_i * n_i)) / 2^F + 1/2). Then |A - E| <= 1/2 + (1 + sum(N_i)) / 2^(F + 1).
#
# Proof. Rounding to the nearest integer moves b * 2^F and each g_i * 2^F by at most 1/2. The sum
# S = B + sum(C_i * n_i) is an exact integer. It differs from E * 2^F by at most (1 + sum(N_i)) / 2,
# and A differs from S / 2^F by at most 1/2. (An angle beyond 32 bits is clipped.)
#
# An output count is a tenth of a count of the label, so that the error is far below half of one of
# those. `fixed_point` takes the largest F for which each coefficient fits into two words of 32 bits
# and S into two words of 64 bits. Each of these adds up one part of all coefficients without an
# overflow.

OUTPUT_COUNTS = 10
"""Counts of the angle in one count of the label."""

MAX_LOW_BITS = 31
"""Maximum bits of the lower part of a coefficient, which fits into a word of 32 bits."""

MAX_UPPER_PART = 2**31 - 1
"""Largest size of the upper part of a coefficient."""

MAX_SUM = 2**62
"""Bound of the sums of parts, including the rounding."""

MAX_ANGLE = 2**31 - 1
"""Limit of the angle, a word of 32 bits: angles of thousands of turns are clipped."""

Target = Literal["json", "c", "sql", "dbc", "onnx", "fmu"]
"""Formats of an export."""


@dataclass(frozen=True)
class FixedPoint:
    """A dot product of integers.

    Attributes
    ----------
    bits
        Bits of the fraction, F.
    low_bits
        Bits of the lower part of each coefficient, which is not negative.
    intercept, coefficients
        Integers over 2^bits.
    error
        Bound of |A - E|, in counts of the output.
    largest
        Bound of |A|, before clipping.
    """

    bits: int
    low_bits: int
    intercept: int
    coefficients: tuple[int, ...]
    error: Fraction
    largest: int

    @property
    def parts(self) -> tuple[tuple[int, int], ...]:
        """Upper and lower part of the intercept, then of each coefficient."""
        return tuple(divmod(c, 1 << self.low_bits) for c in (self.intercept, *self.coefficients))


def fixed_point(
    intercept: Fraction, coefficients: Sequence[Fraction], largest: Sequence[int]
) -> FixedPoint:
    """Convert a dot product to integers, given the largest size of each factor, N_i.

    Raises `RefusedError` if the bound of the error is above half a count of the label.
    """
    sizes, values = (1, *largest), (intercept, *coefficients)
    low_bits = min(MAX_LOW_BITS, (MAX_SUM - 1).bit_length() - sum(sizes).bit_length())

    def fits(bits: int) -> bool:
        """Return True if the parts of the coefficients fit into words, and their sums too."""
        upper = [round(value * 2**bits) >> low_bits for value in values]
        total = sum(abs(c) * n for c, n in zip(upper, sizes, strict=True))
        # Plus the carry of the lower parts, and half of an output count.
        carried = total + 2 ** (62 - low_bits) + 2 ** (bits - low_bits)
        return bool(carried < MAX_SUM and max(map(abs, upper[1:])) <= MAX_UPPER_PART)

    bits = next(filter(fits, range(low_bits + 62, low_bits, -1)), 0)
    error = Fraction(1, 2) + Fraction(sum(sizes), 2 ** (bits + 1))
    if not bits or error > Fraction(OUTPUT_COUNTS, 2):
        raise RefusedError(
            "the coefficients are too large to bound the rounding error of the angle. Publish a "
            "model with fewer or other signals."
        )
    size = sum(abs(g) * n for g, n in zip(values, sizes, strict=True))
    scaled = [round(value * 2**bits) for value in values]
    return FixedPoint(bits, low_bits, scaled[0], tuple(scaled[1:]), error, int(size + error))


@dataclass(frozen=True)
class Input:
    """A signal with `physical = scale * count`, and its smallest and largest valid count."""

    name: str
    column: str
    unit: str
    scale: Decimal
    min_count: int
    max_count: int


@dataclass(frozen=True)
class Angle(FixedPoint):
    """The dot product `(intercept + sum(coefficient * step)) / 2^bits`, in counts of `scale`.

    It is rounded to the nearest integer, halves up, and clipped to 32 bits. The comment at the top
    of the module proves the bound of its error.

    Attributes
    ----------
    name, column, unit
        The estimated quantity.
    scale
        Physical value of one count.
    places
        Step of each coefficient.
    limit
        Limit of the clipping.
    """

    name: str
    column: str
    unit: str
    scale: Decimal
    places: tuple[int, ...]
    limit: int

    def count(self, values: Sequence[int | None]) -> int | None:
        """Return the count of the angle, given the value of each step; None: no angle."""
        total = self.intercept + (1 << (self.bits - 1))
        for step, coefficient in self.terms:
            value = values[step]
            if value is None:
                return None
            total += coefficient * value
        return max(-self.limit, min(self.limit, total >> self.bits))

    @cached_property
    def terms(self) -> tuple[tuple[int, int], ...]:
        """Step and coefficient over 2^bits of each term of the model."""
        return tuple(zip(self.places, self.coefficients, strict=True))


@dataclass(frozen=True)
class Steps:
    """Steps that compute columns at each tick, and their inputs."""

    signals: tuple[Input, ...]
    facts: tuple[VehicleAttribute, ...]
    numbers: tuple[ParameterCount, ...]
    steps: tuple[Step, ...]

    @cached_property
    def input_ranges(self) -> dict[str, list[Range]]:
        """Valid ranges of signals, facts and numbers: values outside are missing."""
        signals = [(signal.min_count, signal.max_count) for signal in self.signals]
        return given_ranges(signals, self.facts, self.numbers)

    @cached_property
    def ranges(self) -> list[Range]:
        """Range of each step, including zero if it can be missing."""
        return ranges_of(self.steps, self.input_ranges)

    @cached_property
    def roots(self) -> list[tuple[int, ...]]:
        """For each step, the steps whose own presence decides whether it is missing."""
        return roots_of(self.steps, self.ranges)

    @cached_property
    def rings(self) -> dict[int, int]:
        """Steps with a history, and its number of ticks; 0: all ticks since the start."""
        return rings_of(self.steps)

    @cached_property
    def states(self) -> dict[int, int]:
        """Steps that hold a number of the tick before, with the step of their next value."""
        return {s.operands[1]: s.operands[0] for s in self.steps if s.name == "next"}

    @property
    def sums(self) -> list[tuple[int, ...]]:
        """Sums over time: the step, its ticks, and the maximum number of values."""
        windows = [s for s in self.steps if s.name in ("sum", "values")]
        return list(dict.fromkeys((*s.operands, *s.plain) for s in windows))

    @cached_property
    def learned(self) -> list[tuple[int, ...]]:
        """Sums that slopes are computed from, which can be retained for the next drive."""
        solved = [step.operands for step in self.steps if step.name == "nearest"]
        totals = [a for a, b in solved if self.steps[b].name == "power"]
        places = [place for a in totals for place in (a, *self.steps[a].operands)]
        sums = [self.steps[place] for place in places if self.steps[place].name == "sum"]
        return list(dict.fromkeys((*step.operands, *step.plain) for step in sums))

    @property
    def longest_ticks(self) -> int:
        """Longest history in ticks, apart from running means."""
        return max(self.rings.values(), default=0)


@dataclass(frozen=True)
class Program(Steps):
    """A published estimator."""

    angle: Angle


def write_program(catalog: Catalog, manifest: Manifest) -> Program:
    """Return the program of a manifest.

    Raises `RefusedError` if counts have another meaning now or the error cannot be bounded, and
    `DataError` for a feature without a signal.
    """
    manifest = manifest.estimate
    signals = _inputs(catalog.signals, manifest)
    columns = [term.definition or plain_column(term.signal, term.sql) for term in manifest.terms]
    lowered, places = Lowering.from_columns([signal.name for signal in signals], columns)
    steps, facts, numbers = tuple(lowered.steps), tuple(lowered.facts), tuple(lowered.numbers)
    ranges = lowered.ranges([(signal.min_count, signal.max_count) for signal in signals])
    coefficients, intercept = manifest.counts_coefficients(catalog)
    fixed = fixed_point(
        intercept * OUTPUT_COUNTS,
        [coefficient * OUTPUT_COUNTS for coefficient in coefficients.values()],
        [size_of(ranges[place]) for place in places],
    )
    label = catalog.signals[manifest.label.signal]
    angle = Angle(
        name=manifest.label.signal,
        column=label.column,
        unit=label.unit,
        scale=label.scale / Decimal(OUTPUT_COUNTS),
        places=tuple(places),
        limit=MAX_ANGLE,
        **vars(fixed),
    )
    return Program(signals, facts, numbers, steps, angle)


def _inputs(signals: SignalCatalog, manifest: Manifest) -> tuple[Input, ...]:
    used: set[str] = set()
    for term in manifest.terms:
        parts = term.definition.components if term.definition else (term,)
        if not term.inputs or any(part.sql and not parse(part.sql).inputs for part in parts):
            raise DataError(f"the feature {term.signal} uses no signal. Publish the model again.")
        used |= {*term.inputs}
    return tuple(
        # -32768 means missing on board: a cyclic signal has no count of minus half a turn there.
        Input(name, s.column, s.unit, s.scale, max(s.min_count, -COUNT_MAX), s.max_count)
        for name, s in signals.signals.items()
        if name in used
    )
