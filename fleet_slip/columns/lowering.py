"""Lowers columns to steps of some twenty integer operations (docs/export.md).

A step is an operation, the numbers of earlier steps, then plain numbers. Its value is an integer of
at most 63 bits, or missing. Each target (SQL, kernel, C, ONNX) has a table with one entry per
operation, and uses the ranges, rules of missing values and look-back of this module.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from functools import reduce
from itertools import combinations_with_replacement
from typing import Any, Literal

from fleet_slip.catalog.arithmetic import Step, nearest, parse, truncated
from fleet_slip.catalog.definitions import (
    CALIBRATION_PARAMETERS,
    COUNT_BITS,
    MAX_ATTRIBUTE,
    WEIGHT,
    AttributeFactor,
    Blend,
    Definition,
    Equation,
    Gate,
    Made,
    Observer,
    ParameterFactor,
    Product,
    Slope,
    limit_of,
)
from fleet_slip.catalog.signals import COUNT_MAX
from fleet_slip.columns.observer import ObserverLowering, lower_blend
from fleet_slip.errors import QuestionError

Range = tuple[int, int]

Missing = Literal["never", "given", "operands", "divisor", "less", "both"]
"""When a step is missing: never; with its input or past value; with an operand; also for a divisor
not above zero, or for a first operand below the second; if both operands are missing.
"""


@dataclass(frozen=True)
class Operation:
    """An operation on `steps` operands, with the function of its range.

    `over_time`: True if it uses past values of its operand.
    """

    range_of: Callable[..., Range]
    steps: int = 2
    missing: Missing = "operands"
    over_time: bool = False


def _corners(compute: Callable[[int, int], int]) -> Callable[[Range, Range], Range]:
    """Return the range of a function that is monotonic in each operand."""

    def range_of(a: Range, b: Range) -> Range:
        corners = [compute(x, y) for x in a for y in b]
        return min(corners), max(corners)

    return range_of


def _quotients(compute: Callable[[int, int], int]) -> Callable[[Range, Range], Range]:
    range_of = _corners(compute)
    return lambda a, b: range_of(a, (max(1, b[0]), max(1, b[1])))


def _first(a: Range, *_: object) -> Range:
    return a


def _powers(a: Range, divisor: Range) -> Range:
    return power(a[0], divisor[0]), power(a[1], divisor[0])


POWERS = 32
"""Number of powers of two with which targets without bit operations compare."""


def power(value: int, divisor: int) -> int:
    """Return the least power of two, at least 1, times which `divisor` is not below a value."""
    return 1 << max(0, (max(value, 1) - 1) // divisor).bit_length()


def _sums(a: Range, _: int, count: int) -> Range:
    return min(0, a[0] * count), max(0, a[1] * count)


OPERATIONS: Mapping[str, Operation] = {
    # Inputs, by their place. `ranges_of` receives their ranges.
    "signal": Operation(_first, 0, "given"),
    "fact": Operation(_first, 0, "given"),
    "number": Operation(_first, 0, "given"),
    "constant": Operation(lambda n: (n, n), 0, "never"),
    # Arithmetic.
    "+": Operation(_corners(lambda a, b: a + b)),
    "-": Operation(_corners(lambda a, b: a - b)),
    "*": Operation(_corners(lambda a, b: a * b)),
    "//": Operation(_quotients(truncated), missing="divisor"),
    "nearest": Operation(_quotients(nearest), missing="divisor"),
    "min": Operation(_corners(min)),
    "max": Operation(_corners(max)),
    "negative": Operation(lambda a: (-a[1], -a[0]), 1),
    "abs": Operation(lambda a: (0 if a[0] <= 0 <= a[1] else min(map(abs, a)), max(map(abs, a))), 1),
    "sign": Operation(lambda a: ((a[0] > 0) - (a[0] < 0), (a[1] > 0) - (a[1] < 0)), 1),
    "clip": Operation(lambda _, limit: (-limit[1], limit[1])),
    "power": Operation(_powers),  # of two, the least p with a <= b p
    "shift": Operation(lambda a, bits: (nearest(a[0], 1 << bits), nearest(a[1], 1 << bits)), 1),
    # Missing values.
    "at_least": Operation(_first, missing="less"),
    "where": Operation(_first),
    "else": Operation(lambda a, b: (min(a[0], b[0]), max(a[1], b[1])), missing="both"),
    # Past values, with a number of ticks.
    "ago": Operation(_first, 1, "given", over_time=True),
    "sum": Operation(_sums, 1, "never", over_time=True),
    "values": Operation(lambda *operands: (0, operands[2]), 1, "never", over_time=True),
    # Recursion: a number of the tick before, 0 at the start, within a limit; its next value.
    "state": Operation(lambda _, limit: (-limit, limit), 0, "never"),
    "next": Operation(_first),
}

GIVEN = ("signal", "fact", "number")


def ranges_of(steps: Sequence[Step], inputs: Mapping[str, Sequence[Range]]) -> list[Range]:
    """Return the range of each step, zero included in what is `inputs`, as for missing values."""
    ranges: list[Range] = []
    for step in steps:
        if step.name in GIVEN:
            least, largest = inputs[step.name][step.plain[0]]
            ranges.append((min(least, 0), max(largest, 0)))
        else:
            operands = [ranges[i] for i in step.operands]
            ranges.append(OPERATIONS[step.name].range_of(*operands, *step.plain))
    return ranges


def roots_of(steps: Sequence[Step], ranges: Sequence[Range]) -> list[tuple[int, ...]]:
    """Return, for each step, the steps whose presence determines its presence."""
    result: list[tuple[int, ...]] = []
    for number, step in enumerate(steps):
        missing, operands = OPERATIONS[step.name].missing, step.operands
        roots = [root for i in operands for root in result[i]]
        if step.name == "where":  # a value of now is one of its window's, so that it has values
            roots = [
                root for root in roots if root not in _mean_of(steps, operands[0], operands[1])
            ]
        if missing == "less" or (missing == "divisor" and ranges[operands[1]][0] <= 0):
            roots.append(number)
        elif missing == "given" or (missing == "both" and all(result[i] for i in operands)):
            roots = [number]
        elif missing in ("never", "both"):
            roots = []
        result.append(tuple(dict.fromkeys(roots)))
    return result


def _mean_of(steps: Sequence[Step], mean: int, now: int) -> set[int]:
    """Return the quotients in a mean whose window contains the value `now`."""
    quotients, inner = set[int](), [mean]
    while inner:
        number = inner.pop()
        step = steps[number]
        if step.name in ("clip", "where"):
            inner.append(step.operands[0])
        elif step.name == "nearest":
            divisor = steps[step.operands[1]]
            counts = [divisor, *(steps[i] for i in divisor.operands if divisor.name == "*")]
            if any(count[:2] == ("values", (now,)) for count in counts):
                quotients.add(number)
    return quotients


def rings_of(steps: Sequence[Step]) -> dict[int, int]:
    """Return the steps whose past values are used, with the number of ticks; 0 for all."""
    rings: dict[int, int] = {}
    for step in steps:
        if OPERATIONS[step.name].over_time:
            (source,), ticks = step.operands, step.plain[0]
            rings[source] = max(rings.get(source, 0), ticks)
    return rings


def size_of(interval: Range) -> int:
    """Return the largest absolute value of a range."""
    return max(-interval[0], interval[1])


def largest_in(step: Step, number: int, ranges: Sequence[Range]) -> int:
    """Return the largest absolute value of a step, including intermediate values of rounding."""
    sizes = [size_of(ranges[i]) for i in step.operands]
    if step.name == "nearest":
        return 2 * sizes[0] + sizes[1]
    if step.name == "shift":
        return sizes[0] + (1 << (step.plain[0] - 1))
    return size_of(ranges[number])


# The lowering of `fleet_slip.catalog.definitions` to steps, each step once.

LARGEST_WORD = 2**63 - 1
"""Largest absolute value of any step."""

MOST_VALUES = 2**31 - 1
"""Maximum number of values of a running mean: 248 days."""


@dataclass(frozen=True)
class VehicleAttribute:
    """A vehicle attribute: a rounded number; with `equals`, 1 if it has that value, else 0."""

    name: str
    equals: str | None = None

    def count(self, value: Any) -> int | None:
        """Return the integer of an attribute's value; None if unknown."""
        if value is None:
            return None
        if self.equals is not None:
            return int(value == self.equals)
        if isinstance(value, str) or not abs(value) <= MAX_ATTRIBUTE:
            return None
        return nearest(*value.as_integer_ratio())

    @property
    def field(self) -> str:
        """Unique name for programs."""
        if self.equals is None:
            return self.name
        return f"{self.name}_is_" + "".join(c if c.isalnum() else "_" for c in self.equals).lower()


@dataclass(frozen=True)
class ParameterCount:
    """A calibration parameter as an input: a count of `grain`."""

    name: str
    unit: str
    grain: Decimal


@dataclass
class Lowering:
    """Steps in the order of computation; signals, attributes and parameters by place."""

    signals: Mapping[str, int]
    steps: dict[Step, int] = field(default_factory=dict)
    facts: dict[VehicleAttribute, int] = field(default_factory=dict)
    numbers: dict[ParameterCount, int] = field(default_factory=dict)
    _composites: dict[int, int] = field(default_factory=dict)

    @classmethod
    def from_columns(
        cls, signals: Sequence[str], columns: Sequence[Definition]
    ) -> tuple["Lowering", list[int]]:
        """Lower columns; return the lowering and the step of each column."""
        self = cls({name: place for place, name in enumerate(signals)})
        for column in columns:  # before steps that use past values
            for component in column.components:
                self.row(component)
        return self, [self.column(column) for column in columns]

    def ranges(self, signals: Sequence[Range]) -> list[Range]:
        """Return the range of each step, given those of the signals.

        Raises `QuestionError` for a step that may need more than 63 bits.
        """
        steps = tuple(self.steps)
        ranges = ranges_of(steps, given_ranges(signals, self.facts, self.numbers))
        if any(largest_in(step, i, ranges) > LARGEST_WORD for i, step in enumerate(steps)):
            raise QuestionError(
                "a column may need more than 63 bits: choose smaller coefficients, or columns of "
                "fewer bits."
            )
        return ranges

    def do(self, operation: str, *operands: int) -> int:
        """Add a step; return its number."""
        count = OPERATIONS[operation].steps
        step = Step(operation, operands[:count], operands[count:])
        return self.steps.setdefault(step, len(self.steps))

    def constant(self, value: int) -> int:
        """Return the number of a constant step."""
        return self.do("constant", value)

    def clip(self, step: int, limit: int) -> int:
        """Return a step within ±limit."""
        return self.do("clip", step, self.constant(limit))

    def clip_where(self, step: int, limit: int, presence: Callable[[], int]) -> int:
        """Return a step within ±limit that is missing with a later step, `presence`."""
        return self.do("where", self.clip(step, limit), presence())

    def nearest(self, step: int, numerator: int, divisor: int) -> int:
        """Return a step times a constant over another step, rounded."""
        times = step if numerator == 1 else self.do("*", step, self.constant(numerator))
        return self.do("nearest", times, divisor)

    def _add(self, steps: Iterable[int]) -> int:
        """Return the sum of some steps."""
        return reduce(lambda a, b: self.do("+", a, b), steps)

    def less(self, step: int, constant: int) -> int:
        """Return a step less a constant."""
        return self.do("-", step, self.constant(constant)) if constant else step

    def row(self, column: Definition) -> int:
        """Return the step of a column's source: a signal or a clipped feature or composite."""
        if column.made:
            key = id(column.made)  # shared by several columns
            if key not in self._composites:
                self._composites[key] = self._made_of(column.made)
            return self.clip(self._composites[key], limit_of(column.of_bits))
        if not column.sql:
            return self.do("signal", self.signals[column.of])
        arithmetic = parse(column.sql)
        results: list[int] = []
        for step in arithmetic.steps:
            plain = step.plain
            if step.name == "signal":
                plain = (self.signals[arithmetic.inputs[plain[0]]],)
            results.append(self.do(step.name, *(results[i] for i in step.operands), *plain))
        limit = limit_of(column.of_bits)
        if arithmetic.guard is None:
            return self.clip(results[-1], limit)
        guard, least = results[arithmetic.guard], arithmetic.at_least
        return self.clip_where(
            results[-1], limit, lambda: self.do("at_least", guard, self.constant(least))
        )

    def column(self, column: Definition) -> int:
        """Return the step of a column."""
        if column.number is not None:
            return self._numbered(column, column.number)
        if column.gate is not None:
            return self._gated(column.ungated, column.gate)
        if column.fact is not None:
            return self._factor(column, column.fact)
        return self._window(column)

    def _window(self, column: Definition) -> int:
        now = total = self.row(column)
        numerator = column.ratio.numerator
        divisor = self.constant(column.ratio.denominator)
        if column.over == "lag":
            now = total = self.do("ago", now, column.ticks)
        elif column.over == "change":
            total = self.do("-", now, self.do("ago", now, column.ticks))
        elif column.over is not None:
            window = (now, column.ticks, most_values(column))
            total = self.do("sum", *window)
            if column.over != "sum":
                divisor = self.do("*", divisor, self.do("values", *window))
        value, limit = self.nearest(total, numerator, divisor), limit_of(column.bits)
        if total == now:
            return self.clip(value, limit)
        return self.clip_where(value, limit, lambda: now)

    def _factor(self, column: Definition, fact: AttributeFactor) -> int:
        place = self.facts.setdefault(VehicleAttribute(fact.name, fact.equals), len(self.facts))
        base = self.column(column.model_copy(update={"fact": None}))
        less = 0 if fact.equals is not None else fact.less
        times = self.do("*", base, self.less(self.do("fact", place), less))
        divisor = self.constant(fact.ratio.denominator)
        return self.clip(self.nearest(times, fact.ratio.numerator, divisor), limit_of(column.bits))

    def _gated(self, ungated: Definition, gate: Gate) -> int:
        base, by = self.column(ungated), self.column(gate.by)
        full, none = self.constant(WEIGHT), self.constant(0)
        rises = self._ramp(by, gate.low, gate.peak)
        weight = self.do("max", self.do("min", rises, full), none)
        if gate.high is not None:  # the lesser of both ramps
            falls = self.do("-", full, self._ramp(by, gate.peak, gate.high))
            weight = self.do("max", self.do("min", weight, falls), none)
        return self.nearest(self.do("*", base, weight), 1, full)

    def _ramp(self, by: int, low: int, high: int) -> int:
        times = self.do("*", self.less(by, low), self.constant(WEIGHT))
        return self.do("//", times, self.constant(high - low))

    def _numbered(self, column: Definition, number: ParameterFactor) -> int:
        base = self.column(column.model_copy(update={"number": None}))
        running = None if number.running is None else self.column(number.running)
        unit = CALIBRATION_PARAMETERS[number.name].unit
        parameter = ParameterCount(number.name, unit, number.grain)
        place = self.numbers.setdefault(parameter, len(self.numbers))
        stand_in = self.constant(0) if running is None else running
        factor = self.do("else", self.less(self.do("number", place), number.less), stand_in)
        return self.do("where", factor, base) if number.alone else self.do("*", base, factor)

    def _made_of(self, composite: Made) -> int:
        """Return the step of a composite.

        Raises `QuestionError` for the estimate of a model that has not been fitted.
        """
        if isinstance(composite, Slope):
            return self._slope(composite)
        if isinstance(composite, Observer):
            return ObserverLowering(self, composite).angle()
        if isinstance(composite, Blend):
            return lower_blend(self, composite)
        if isinstance(composite, Product):
            factors = [self.column(column) for column in composite.of] or [self.constant(1)]
            product = factors[0] if len(factors) == 1 else self.do("*", *factors)
            divisor = self.constant(composite.ratio.denominator)
            return self.nearest(product, composite.ratio.numerator, divisor)
        if composite.line == "":
            raise QuestionError(
                "its columns use the estimate of a first-stage model, which is not fitted. Run: "
                "fleet-slip publish NAME --models learning, or another list of its feature set"
            )
        terms = [
            self.column(column)
            if times == 1
            else self.do("*", self.column(column), self.constant(times))
            for times, column in composite.terms
        ]
        total = self._add([self.constant(composite.intercept), *terms])
        return self.nearest(total, 1, self.constant(composite.divisor))

    def _slope(self, slope: Slope) -> int:
        """Eliminate all unknowns except the first, which is last before the right-hand side.

        Dividing all sums of products by one power of two limits the sums of squares to `PIVOT`.
        These bound the others (Cauchy-Schwarz), and elimination makes none larger; clipping only
        removes rounding errors.
        """
        last = len(slope.ridge)
        sums = self._normal_equations(slope)
        places = [sums[i, i] for i in range(last + 1)]
        largest = reduce(lambda a, b: self.do("max", a, b), places)
        scale = self.do("power", largest, self.constant(PIVOT))
        del sums[last, last]
        entries = {
            at: self.clip(self.nearest(total, 1, scale), PIVOT) for at, total in sums.items()
        }
        for pivot in range(last - 1):
            divisor = self.do("max", entries[pivot, pivot], self.constant(1))
            for i in range(pivot + 1, last):
                for j in range(i, last + 1):
                    times = self.do("*", entries[pivot, i], entries[pivot, j])
                    less = self.do("-", entries[i, j], self.do("nearest", times, divisor))
                    entries[i, j] = self.clip(less, PIVOT)
        square = self.do("max", entries[last - 1, last - 1], self.constant(1))
        times = self.do("*", square, self.constant(slope.ratio.denominator))
        return self.nearest(entries[last - 1, last], slope.ratio.numerator, times)

    def _normal_equations(self, slope: Slope) -> dict[tuple[int, int], int]:
        """Return the sums of products with the ridge, in reverse order of unknowns, then `y`."""
        order = [*range(len(slope.ridge) - 1, -1, -1), None]
        products = [self._products_of(equation, order) for equation in slope.equations]
        sums = {}
        for at in products[0]:
            tick_sum = self._add(equation[at] for equation in products)
            total = self.do("sum", tick_sum, 0, most_products(len(products)))
            unknown = order[at[0]]
            if at[0] == at[1] and unknown is not None:
                total = self.do("+", total, self.constant(slope.ridge[unknown]))
            sums[at] = total
        return sums

    def _products_of(
        self, equation: Equation, order: Sequence[int | None]
    ) -> dict[tuple[int, int], int]:
        """Return the products of an equation's columns at one tick; 0 if one is missing."""
        columns = [equation.y if unknown is None else equation.x[unknown] for unknown in order]
        steps = [
            self.constant(column) if isinstance(column, int) else self.column(column)
            for column in columns
        ]
        varying = [
            step for step, column in zip(steps, columns, strict=True) if not isinstance(column, int)
        ]
        presence = self._add(varying)
        divisor, products = GRAIN * equation.weight.denominator, {}
        for i, j in combinations_with_replacement(range(len(order)), 2):
            a, b = columns[i], columns[j]
            if isinstance(a, int) and isinstance(b, int):
                product = self.constant(nearest(a * b * equation.weight.numerator, divisor))
            else:
                times = self.do("*", steps[i], steps[j])
                product = self.nearest(times, equation.weight.numerator, self.constant(divisor))
            products[i, j] = self.do("else", self.do("where", product, presence), self.constant(0))
        return products


GRAIN = 16
"""Divisor of the products that a slope sums."""

PIVOT = 2**25
"""Largest entry of a slope's equations, so that twice a product is exact in binary64."""


def most_products(equations: int) -> int:
    """Return the maximum number of ticks of a slope, so that twice a sum is below 2^53."""
    largest = equations * nearest(limit_of(COUNT_BITS) ** 2, GRAIN)
    return 2**51 // largest


def given_ranges(
    signals: Sequence[Range], facts: Iterable[VehicleAttribute], numbers: Collection[ParameterCount]
) -> dict[str, list[Range]]:
    """Return the valid ranges of signals, attributes and parameters; other values are missing."""
    fact = (-MAX_ATTRIBUTE, MAX_ATTRIBUTE)
    return {
        "signal": list(signals),
        "fact": [fact if attribute.equals is None else (0, 1) for attribute in facts],
        "number": [(-COUNT_MAX, COUNT_MAX)] * len(numbers),
    }


def most_values(column: Definition) -> int:
    """Return the maximum number of values of a window, so that 2 sum numerator has 64 bits."""
    if column.over != "running_mean":
        return column.ticks
    limit = limit_of(column.of_bits) if column.sql else COUNT_MAX
    largest = 2 * limit * column.ratio.numerator + column.ratio.denominator
    return min(MOST_VALUES, LARGEST_WORD // largest)
