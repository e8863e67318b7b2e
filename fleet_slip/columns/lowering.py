"""Lowers signals, features, windows, factors, gates and own numbers to steps: the one place.

Columns are `fleet_slip.catalogue.definitions`, steps `fleet_slip.columns.operations`, once each.
"""

from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from typing import Any, TypeVar

from fleet_slip.catalogue.arithmetic import nearest, parse
from fleet_slip.catalogue.car_numbers import CAR_NUMBERS
from fleet_slip.catalogue.definitions import (
    LARGEST_FACT,
    WEIGHT,
    Definition,
    Fact,
    Gate,
    Number,
    limit_of,
)
from fleet_slip.catalogue.signals import COUNT_MAX
from fleet_slip.columns.operations import Range, Step, ranges_of

Key = TypeVar("Key", bound=Hashable)

LARGEST_WORD = 2**63 - 1
"""Largest size of anything that steps compute."""

MOST_VALUES = 2**31 - 1
"""Most values of a running mean: 248 days."""


@dataclass(frozen=True)
class CarFact:
    """What a car knows of itself: a number, rounded; or, with `equals`, 1 if it is that, else 0."""

    name: str
    equals: str | None = None

    def count(self, value: Any) -> int | None:
        """Return the whole number for what a car knows; None where it does not know it."""
        if value is None:
            return None
        if self.equals is not None:
            return int(value == self.equals)
        if isinstance(value, str) or not abs(value) <= LARGEST_FACT:
            return None
        return nearest(*value.as_integer_ratio())

    @property
    def field(self) -> str:
        """Its name where programs have one name for each."""
        if self.equals is None:
            return self.name
        return f"{self.name}_is_" + "".join(c if c.isalnum() else "_" for c in self.equals).lower()


@dataclass(frozen=True)
class CarCount:
    """What a car's own drives tell of it: a count of so many `grain`."""

    name: str
    unit: str
    grain: Decimal


@dataclass
class Lowering:
    """Steps in an order in which they can be computed; signals, facts and numbers by place."""

    signals: Mapping[str, int]
    steps: dict[Step, int] = field(default_factory=dict)
    facts: dict[CarFact, int] = field(default_factory=dict)
    numbers: dict[CarCount, int] = field(default_factory=dict)

    @classmethod
    def of(
        cls, signals: Sequence[str], columns: Sequence[Definition]
    ) -> tuple["Lowering", list[int]]:
        """Lower columns; return the step of each, too."""
        self = cls({name: place for place, name in enumerate(signals)})
        for one in columns:
            self._rows(one)
        return self, [self.column(one) for one in columns]

    def ranges(self, signals: Sequence[Range]) -> list[Range]:
        """Return the range of each step, given those of the signals."""
        return ranges_of(tuple(self.steps), given_ranges(signals, self.facts, self.numbers))

    def do(self, operation: str, *operands: int) -> int:
        """Add a step; return its number."""
        return self.steps.setdefault((operation, *operands), len(self.steps))

    def constant(self, value: int) -> int:
        """Return the number of a step that is always the same."""
        return self.do("constant", value)

    def clip(self, step: int, limit: int) -> int:
        """Return a step within ±limit."""
        return self.do("clip", step, self.constant(limit))

    def clip_where(self, step: int, limit: int, there: Callable[[], int]) -> int:
        """Return a step within ±limit, where another one is there too, which comes after it."""
        return self.do("where", self.clip(step, limit), there())

    def nearest(self, step: int, numerator: int, divisor: int) -> int:
        """Return a step times a constant over another step, rounded."""
        times = step if numerator == 1 else self.do("*", step, self.constant(numerator))
        return self.do("nearest", times, divisor)

    def less(self, step: int, constant: int) -> int:
        """Return a step less a constant."""
        return self.do("-", step, self.constant(constant)) if constant else step

    def _rows(self, one: Definition) -> None:
        """Add what a column is made of at one tick, before anything that looks back."""
        self.row(one)
        if one.gate is not None:
            self.row(one.gate.by)
        if one.number is not None and one.number.running is not None:
            self.row(one.number.running)

    def row(self, one: Definition) -> int:
        """Return the step of what a column looks back on: a signal, or a feature clipped."""
        if not one.sql:
            return self.do("signal", self.signals[one.of])
        arithmetic = parse(one.sql)
        found: list[int] = []
        for step in arithmetic.steps:
            if step.name:
                found.append(self.do("signal", self.signals[step.name]))
            elif not step.function:
                found.append(self.constant(step.value))
            else:
                found.append(self.do(step.function, *(found[i] for i in step.operands)))
        limit = limit_of(one.of_bits)
        if arithmetic.guard is None:
            return self.clip(found[-1], limit)
        guard, least = found[arithmetic.guard], arithmetic.at_least
        return self.clip_where(
            found[-1], limit, lambda: self.do("at_least", guard, self.constant(least))
        )

    def column(self, one: Definition) -> int:
        """Return the step of a column."""
        if one.number is not None:
            return self._numbered(one, one.number)
        if one.gate is not None:
            return self._gated(one.ungated, one.gate)
        if one.fact is not None:
            return self._factor(one, one.fact)
        return self._window(one)

    def _window(self, one: Definition) -> int:
        now = total = self.row(one)
        numerator = one.ratio.numerator
        divisor = self.constant(one.ratio.denominator)
        if one.over == "lag":
            now = total = self.do("ago", now, one.ticks)
        elif one.over is not None:
            window = (now, one.ticks, most_values(one))
            total = self.do("sum", *window)
            if one.over != "sum":
                divisor = self.do("*", divisor, self.do("values", *window))
        found, limit = self.nearest(total, numerator, divisor), limit_of(one.bits)
        return (
            self.clip(found, limit) if total == now else self.clip_where(found, limit, lambda: now)
        )

    def _factor(self, one: Definition, fact: Fact) -> int:
        place = _place(self.facts, CarFact(fact.name, fact.equals))
        of = self.column(one.model_copy(update={"fact": None}))
        less = 0 if fact.equals is not None else fact.less
        times = self.do("*", of, self.less(self.do("fact", place), less))
        divisor = self.constant(fact.ratio.denominator)
        return self.clip(self.nearest(times, fact.ratio.numerator, divisor), limit_of(one.bits))

    def _gated(self, ungated: Definition, gate: Gate) -> int:
        of, by = self.column(ungated), self.column(gate.by)
        times = self.do("*", of, self.weight(by, gate))
        return self.nearest(times, 1, self.constant(WEIGHT))

    def weight(self, by: int, gate: Gate) -> int:
        """Return the weight of a gate: what rises, or what falls where that is less."""
        full, none = self.constant(WEIGHT), self.constant(0)
        rises = self._ramp(by, gate.low, gate.peak)
        opened = self.do("max", self.do("min", rises, full), none)
        if gate.high is None:
            return opened
        falls = self.do("-", full, self._ramp(by, gate.peak, gate.high))
        return self.do("max", self.do("min", opened, falls), none)

    def _ramp(self, by: int, low: int, high: int) -> int:
        times = self.do("*", self.less(by, low), self.constant(WEIGHT))
        return self.do("//", times, self.constant(high - low))

    def _numbered(self, one: Definition, number: Number) -> int:
        of = self.column(one.model_copy(update={"number": None}))
        running = None if number.running is None else self.column(number.running)
        unit = CAR_NUMBERS[number.name].unit
        place = _place(self.numbers, CarCount(number.name, unit, number.grain))
        stand_in = self.constant(0) if running is None else running
        factor = self.do("else", self.less(self.do("number", place), number.less), stand_in)
        return self.do("where", factor, of) if number.alone else self.do("*", of, factor)


def given_ranges(
    signals: Sequence[Range], facts: Iterable[CarFact], numbers: Collection[CarCount]
) -> dict[str, list[Range]]:
    """Return the valid ranges of signals, facts and numbers: what is beyond is missing."""
    fact = (-LARGEST_FACT, LARGEST_FACT)
    return {
        "signal": list(signals),
        "fact": [fact if one.equals is None else (0, 1) for one in facts],
        "number": [(-COUNT_MAX, COUNT_MAX)] * len(numbers),
    }


def most_values(one: Definition) -> int:
    """Return how many values a window adds up at most, so that 2 sum numerator has 64 bits."""
    if one.over != "running_mean":
        return one.ticks
    limit = limit_of(one.of_bits) if one.sql else COUNT_MAX
    each = 2 * limit * one.ratio.numerator + one.ratio.denominator
    return min(MOST_VALUES, LARGEST_WORD // each)


def _place(known: dict[Key, int], key: Key) -> int:
    """Return the place of a key, in the order in which they came."""
    return known.setdefault(key, len(known))
