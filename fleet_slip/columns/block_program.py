"""Writes the program over blocks of rows that computes columns, from their steps.

Each operation is a loop, but for `_FUSED` ones; values are binary64, or int64 beyond 53 bits.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cache, cached_property, lru_cache, reduce
from math import inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.course import COURSE, YAW_RATE
from fleet_slip.catalog.definitions import (
    Definition,
    Slope,
    limit_of,
    plain_column,
    rows_behind,
)
from fleet_slip.columns.column_sql import CountedColumns, components_of, rows_of
from fleet_slip.columns.lowering import (
    GIVEN,
    OPERATIONS,
    ParameterCount,
    VehicleAttribute,
    largest_in,
    most_products,
    operands_of,
    operation_of,
    plain_of,
    size_of,
)
from fleet_slip.columns.recursion import Recursion
from fleet_slip.errors import QuestionError

# The operations of a program over blocks of rows: whole numbers, and one of four ratios or limits.
#
# `kernel` defines and runs them; below, a program of them is written.

BLOCK_ROWS = 2**10
"""Rows of a block: small, so that its columns stay in the processor's cache."""

(
    COPY, ADD, SUBTRACT, MULTIPLY, NEGATE, ABSOLUTE, SIGN,  # the same for binary64 and int64
    LEAST, MOST, DIVIDE, NEAREST, FILL, BROADCAST, AT_LEAST, WHERE, ELSE, TO_BINARY64, CLIP, SHARE,
    SCALE, POWER,
    ADD_UP, KEEP, QUOTIENT, AGO,  # on the rows of before
    PUT, RECUR,  # an input of the recursive steps, and these steps row by row
) = range(27)  # fmt: skip

INTEGERS = 30
"""An operation plus this writes int64; that of `COPY` reads binary64."""

OPERATION, OUT, A, B, C, D = 0, 1, 2, 3, 4, 5
"""Columns of a step: the operation, and the places of what it writes and reads."""

ADVANCE = 5
"""Offset from the column of a place to its flag, true if it advances with the rows of a drive."""

SLOT, KIND, TICKS, NUMBER = 11, 12, 13, 14
"""Further columns of a step: what is summed up, a kind of window, its ticks, and a constant, or how
often a value that is clipped counts."""

NUMERATOR, FIXED, EACH, LIMIT = 0, 1, 2, 3
"""Ratios and limits of a step. A sum over n rows is multiplied by the first and divided by the
second plus the third times n."""


class Region(IntEnum):
    """Parts of a program's memory.

    The first counts columns clipped by row; `OF_CAR` is what is known of the car; signals, sums,
    counts, values, begins and ticks are of all rows.
    """

    CLIPPED = 0
    REGISTER = 1
    OF_CAR = 2
    SIGNAL = 3
    TICK = 4
    SUM = 5
    COUNT = 6
    VALUE = 7
    BEGIN = 8
    RECURSION = 9


# A program of vector operations: how it is written, and put into a memory.

Place = tuple[Region, int]
"""A part of the memory, and its number there."""

Value = int | Place
"""What an operation reads: the result of an earlier one, by its number, or a part of the memory."""

MAX_READS = 4
"""So many values an operation reads at most."""

UNUSED_PLACE: Place = (Region.CLIPPED, 0)

STRIDE = BLOCK_ROWS + 2 * 8
"""Registers are so many numbers apart: if it were a power of two, the cache would have one place
for all of them."""


@dataclass(frozen=True)
class VectorOperation:
    """One operation; `operations` says what it reads and does."""

    operation: int
    reads: tuple[Value, ...] = ()
    slot: int = 0
    kind: int = 0
    ticks: int = 0
    number: int = 0
    ratio: tuple[float, float, float, float] = (0.0, 1.0, 0.0, np.inf)


@dataclass
class Code:
    """Operations in order, equal ones once, and what they number.

    Attributes
    ----------
    signals, of_car
        What the program reads of a drive and its car, with their numbers.
    summed, stored
        The values that are summed, and stored, over a drive.
    kinds
        Windows of different lengths in ticks.
    recursion, outputs
        The recursive steps, and those of them that others read, with their numbers.
    """

    operations: list[VectorOperation] = field(default_factory=list)
    signals: dict[str, int] = field(default_factory=dict)
    of_car: dict[VehicleAttribute | ParameterCount, int] = field(default_factory=dict)
    summed: dict[Value, int] = field(default_factory=dict)
    stored: dict[Value, int] = field(default_factory=dict)
    kinds: dict[int, int] = field(default_factory=dict)
    recursion: Recursion = field(default_factory=lambda: Recursion((), ()))
    outputs: dict[int, int] = field(default_factory=dict)
    _numbers: dict[VectorOperation, int] = field(default_factory=dict)

    def add(self, operation: VectorOperation) -> int:
        """Add an operation if there is no equal one; return its number."""
        if operation not in self._numbers:
            self._numbers[operation] = self._append(operation)
        return self._numbers[operation]

    def _append(self, operation: VectorOperation) -> int:
        self.operations.append(operation)
        return len(self.operations) - 1

    def assemble(self, results: Sequence[Value]) -> "BlockProgram":
        """Return the program with results in the first registers."""
        columns: list[int] = []
        for result in results:
            if isinstance(result, int) and result not in columns:
                columns.append(result)
            else:
                columns.append(self._append(VectorOperation(COPY, (result,))))
        registers = {value: register for register, value in enumerate(columns)}
        last = {
            read: number
            for number, operation in enumerate(self.operations)
            for read in operation.reads
        }
        count, free = len(registers), list[int]()
        for number, operation in enumerate(self.operations):
            if number not in registers and operation.operation not in {ADD_UP, KEEP, PUT, RECUR}:
                if not free:
                    free, count = [count], count + 1
                registers[number] = free.pop()
            # Given back after the result has a register: loops do not write what they read.
            ended = {r for r in operation.reads if isinstance(r, int) and last[r] == number}
            free += [registers[read] for read in ended.difference(columns)]
        places = [
            [(Region.REGISTER, registers[number]) if number in registers else UNUSED_PLACE]
            + [
                (Region.REGISTER, registers[r]) if isinstance(r, int) else r
                for r in operation.reads
            ]
            + [UNUSED_PLACE] * (MAX_READS - len(operation.reads))
            for number, operation in enumerate(self.operations)
        ]
        return BlockProgram(self, np.array(places, dtype=np.int64), count)


@dataclass(frozen=True)
class BlockProgram:
    """Operations with `places`, (steps, 5, 2): region and number of what each writes and reads.

    The columns are in the first `registers`.
    """

    code: Code
    places: NDArray[np.int64]
    registers: int

    @cached_property
    def ratios(self) -> FloatArray:
        """The ratio of each step, shape (steps, 4)."""
        return np.array([operation.ratio for operation in self.code.operations])

    @cached_property
    def outputs(self) -> NDArray[np.int64]:
        """Places of the recursive steps that others read."""
        places = self.code.recursion.places
        return np.array([places[number] for number in self.code.outputs], dtype=np.int64)

    def regions(self, rows: int) -> NDArray[np.int64]:
        """Return each region's begin and stride for so many rows, and the memory's size last."""
        code = self.code
        shapes = {
            Region.CLIPPED: (1, STRIDE),
            Region.REGISTER: (self.registers, STRIDE),
            Region.OF_CAR: (len(code.of_car), 1),
            Region.SIGNAL: (len(code.signals), rows),
            Region.TICK: (1, rows),
            Region.SUM: (len(code.summed), rows + 1),
            Region.COUNT: (len(code.summed), rows + 1),
            Region.VALUE: (len(code.stored), rows),
            Region.BEGIN: (len(code.kinds), rows),
            Region.RECURSION: (len(code.recursion.inputs) + len(code.outputs), STRIDE),
        }
        # Whoever reads what is of the car as a block must not read beyond the end.
        sizes = [parts * size for parts, size in shapes.values()] + [BLOCK_ROWS]
        begins = np.cumsum([0, *sizes])
        strides = [shapes[region][1] for region in Region] + [0]
        return np.column_stack([begins[: len(strides)], strides])

    def steps(self, rows: int) -> NDArray[np.int64]:
        """Return the table of `operations` for a memory for so many rows."""
        regions = self.regions(rows)
        begins, strides = regions[self.places[..., 0]].transpose(2, 0, 1)
        moves = self.places[..., 0] == Region.SIGNAL
        settings = [
            [operation.slot, operation.kind, operation.ticks, operation.number]
            for operation in self.code.operations
        ]
        operations = [[operation.operation] for operation in self.code.operations]
        return np.hstack([operations, begins + strides * self.places[..., 1], moves, settings])


# Patterns of steps that one loop over a block does together, for speed.

Pattern = Any
"""A step: its operation and operands; names stand for steps, #names for constants, numbers too."""

ROUNDED = ("//", ("+", ("*", 2, "c"), ("*", ("sign", "c"), "d")), ("*", 2, "d"))
"""A quotient to the nearest, as the SQL of a feature says it."""


def _times(step: Pattern) -> list[Pattern]:
    return [("*", step, "#numerator"), step]


_TOTAL = ("sum", "row", "ticks", "most")
_SHARED = ("#fixed", ("*", "#each", ("values", "row", "ticks", "most")))
SCALED: list[Pattern] = [("nearest", x, "#fixed") for x in _times("x")]
SCALED.append(("//", ("+", ("*", 2, "x"), ("*", ("sign", "x"), "#fixed")), ("*", 2, "#fixed")))
"""A value times a ratio of constants, rounded."""

QUOTIENTS = [
    ("clip", ("where", ("nearest", total, divisor), "row"), "#limit")
    for total in _times(_TOTAL)
    for divisor in _SHARED
]
"""A sum or mean over a window, times a ratio, rounded and clipped."""

_EXACT = 2**53

_LOOPS = {
    **{"+": ADD, "-": SUBTRACT, "*": MULTIPLY, "//": DIVIDE, "nearest": NEAREST},
    **{"negative": NEGATE, "abs": ABSOLUTE, "sign": SIGN, "min": LEAST},
    **{"max": MOST, "at_least": AT_LEAST, "where": WHERE, "else": ELSE, "power": POWER},
}
"""Operations of which each value is made of values of its own row."""

_INTEGERS = ("+", "-", "*", "//", "nearest", "negative", "abs", "sign")
"""Those that there are for int64, too."""

Found = Mapping[str, int]


class _Writer:
    """Writes the operations of steps, those that are asked for and what they need."""

    def __init__(self, counted: CountedColumns) -> None:
        self.code = Code(signals={name: n for n, name in enumerate(counted.lowered.signals)})
        self._of_car = [*counted.lowered.facts, *counted.lowered.numbers]
        self._counted, self._steps, self._ranges = counted, counted.steps, counted.ranges
        self._facts = len(counted.lowered.facts)
        self.code.recursion = Recursion.of_steps(counted.steps)
        self._recursive = frozenset(self.code.recursion.members)
        self.value = cache(self._value)
        self.integers = cache(self._integers)
        self._is_integer = cache(self._needs_integers)

    def _value(self, number: int, guard: int | None = None) -> Value:
        """Return a step in binary64, NaN where missing; `guard` is positive wherever it is used."""
        step = self._steps[number]
        name, plain = operation_of(step), plain_of(step)
        if (constant := self._constant(number)) is not None:
            return self._do(FILL, ratio=(float(constant), 1.0, 0.0, inf))
        if name in GIVEN:
            return self._signal_or_car(name, plain[0])
        if number in self._recursive:
            return self._recur(number)
        if self._is_integer(number):
            value = self._do(TO_BINARY64, self.integers(number, guard))
            return self._do(WHERE, value, self._present(number, guard))
        fused = None
        if not any(self._is_integer(operand) for operand in operands_of(step)):
            fused = self._fused(number, guard)
        return self._plain(number, guard) if fused is None else fused

    def _recur(self, number: int) -> Value:
        """Run the recursive steps once, and read one of them."""
        inputs = self.code.recursion.inputs
        for place, source in enumerate(inputs):
            self._do(PUT, self.value(source), (Region.RECURSION, place))
        self._do(RECUR, UNUSED_PLACE, (Region.RECURSION, 0), number=len(inputs))
        place = len(inputs) + _number(self.code.outputs, number)
        return self._do(COPY, (Region.RECURSION, place))

    def _signal_or_car(self, name: str, place: int) -> Value:
        if name == "signal":
            return (Region.SIGNAL, place)
        car_input = self._of_car[place + (self._facts if name == "number" else 0)]
        return self._do(BROADCAST, (Region.OF_CAR, _number(self.code.of_car, car_input)))

    def _fused(self, number: int, guard: int | None) -> Value | None:
        """Return what one loop computes of several steps; None if there is no such loop."""
        for pattern, write in _FUSED:
            bindings: dict[str, int] = {}
            if self._matches(pattern, number, bindings):
                return write(self, number, bindings, guard)
        return None

    def _plain(  # noqa: PLR0911 - one for each kind of operation
        self, number: int, guard: int | None
    ) -> Value:
        name, plain = operation_of(self._steps[number]), plain_of(self._steps[number])
        if name == "at_least" and self._is_integer(plain[0]):
            # Rounded to binary64, the difference keeps its sign.
            pair = [self.integers(operand, guard) for operand in plain]
            excess = self._do(TO_BINARY64, self._do(INTEGERS + SUBTRACT, *pair))
            excess = self._do(WHERE, excess, self._present(plain[0], guard))
            return self._do(AT_LEAST, excess, self._do(FILL, ratio=(0.0, 1.0, 0.0, inf)))
        if name == "ago":
            return self._ago(plain[0], plain[1])
        if name == "sum":  # of a slope: what is missing is 0 there already
            return self._quotient(number, {"row": plain[0], "ticks": plain[1], "#fixed": 1}, guard)
        if name == "shift":
            return self._do(
                SCALE, self.value(plain[0], guard), ratio=(1.0, 2.0 ** plain[1], 0.0, inf)
            )
        if name == "clip":
            return self._clip(number, plain[0], self._ranges[plain[1]][1], guard)
        if name == "where":
            guard = self._guarded_by(plain[1])
        result = self._do(_LOOPS[name], *(self.value(operand, guard) for operand in plain))
        if name in ("//", "nearest"):
            return self._divided(result, plain[1], guard)
        return result

    def _guarded_by(self, step: int) -> int | None:
        """Return the step that is above zero wherever another one is there."""
        bindings: dict[str, int] = {}
        guards = self._matches(("at_least", "guard", "#least"), step, bindings)
        return bindings["guard"] if guards and bindings["#least"] > 0 else None

    def _divided(self, quotient: Value, divisor: int, guard: int | None) -> Value:
        if self._is_positive(divisor, guard):
            return quotient
        return self._do(WHERE, quotient, self._above_zero(divisor, guard))

    def _above_zero(self, number: int, guard: int | None) -> Value:
        least = self._do(FILL, ratio=(1.0, 1.0, 0.0, inf))
        return self._do(AT_LEAST, self.value(number, guard), least)

    def _is_positive(self, number: int, guard: int | None) -> bool:
        if (constant := self._constant(number)) is not None:
            _require_positive(constant)
            return True
        if number == guard or self._ranges[number][0] > 0:
            return True
        step = self._steps[number]
        return step[0] in ("+", "*") and all(
            self._is_positive_term(operand, guard) for operand in operands_of(step)
        )

    def _is_positive_term(self, number: int, guard: int | None) -> bool:
        constant = self._constant(number)
        return self._is_positive(number, guard) if constant is None else constant > 0

    def _constant(self, number: int) -> int | None:
        step = self._steps[number]
        if step[0] == "constant":
            return plain_of(step)[0]
        if step[0] in _INTEGERS and all(self._constant(n) is not None for n in operands_of(step)):
            if step[0] in ("//", "nearest"):
                self._is_positive(operands_of(step)[1], None)
            return self._ranges[number][0]
        return None

    def _needs_integers(self, number: int) -> bool:
        """Return True if an operation on the counts of a row, or an operand, may reach 2^53."""
        step = self._steps[number]
        if step[0] not in _INTEGERS or self._constant(number) is not None:
            return False
        if number in self._recursive:
            return False
        if any(OPERATIONS[operation_of(self._steps[n])].over_time for n in operands_of(step)):
            return False  # a drive with so many rows is refused
        size = largest_in(step, number, self._ranges)
        return size >= _EXACT or any(self._is_integer(operand) for operand in operands_of(step))

    def _integers(self, number: int, guard: int | None) -> Value:
        """Return a step in int64; anything where it is missing."""
        if (constant := self._constant(number)) is not None:
            return self._do(INTEGERS + FILL, number=constant)
        if not self._is_integer(number):
            return self._do(INTEGERS + COPY, self.value(number, guard))
        bindings: dict[str, int] = {}
        name, operands = operation_of(self._steps[number]), operands_of(self._steps[number])
        if self._matches(ROUNDED, number, bindings):
            name, operands = "nearest", (bindings["c"], bindings["d"])
        if name in ("//", "nearest"):
            self._is_positive(operands[1], guard)
        parts = [self.integers(operand, guard) for operand in operands]
        return self._do(INTEGERS + _LOOPS[name], *parts)

    def _present(self, number: int, guard: int | None) -> Value:
        """Return what is NaN where a step in int64 is missing."""
        step = self._steps[number]
        parts: list[Value] = []
        for operand in operands_of(step):
            if self._is_integer(operand):
                parts.append(self._present(operand, guard))
            elif self._constant(operand) is None:
                parts.append(self.value(operand, guard))
        divisor = operands_of(step)[-1]
        if step[0] in ("//", "nearest") and not self._is_positive(divisor, guard):
            parts.append(self._above_zero(divisor, guard))
        return reduce(lambda a, b: self._do(WHERE, a, b), parts)

    def _matches(self, pattern: Pattern, number: int, bindings: dict[str, int]) -> bool:
        """Return whether a step is what a pattern says, and what its names stand for."""
        if isinstance(pattern, int):
            return self._constant(number) == pattern
        if isinstance(pattern, str):
            value = self._constant(number) if pattern.startswith("#") else number
            return value is not None and bindings.setdefault(pattern, value) == value
        step = self._steps[number]
        name, plain = operation_of(step), plain_of(step)
        if name != pattern[0]:
            return False
        steps = OPERATIONS[name].steps
        return all(
            self._matches(element, operand, bindings)
            if i < steps
            else bindings.setdefault(element, operand) == operand
            for i, (element, operand) in enumerate(zip(pattern[1:], plain, strict=True))
        )

    def _scale(self, number: int, bindings: Found, guard: int | None) -> Value:
        value, limit = self.value(bindings["x"], guard), float(bindings.get("#limit", inf))
        numerator, fixed = bindings.get("#numerator", 1), bindings["#fixed"]
        _require_positive(fixed)
        if numerator == fixed and size_of(self._ranges[bindings["x"]]) <= limit:
            return value
        times = self._counted.times.get(number, 0)
        ratio = (float(numerator), float(fixed), 0.0, limit)
        return self._do(SCALE, value, ratio=ratio, number=times)

    def _clip(self, number: int, source: int, limit: int, guard: int | None) -> Value:
        value = self.value(source, guard)
        if size_of(self._ranges[source]) <= limit:
            return value
        times = self._counted.times.get(number, 0)
        return self._do(CLIP, value, ratio=(0.0, 1.0, 0.0, float(limit)), number=times)

    def _share(self, _: int, bindings: Found, guard: int | None) -> Value:
        factors = (self.value(bindings[factor], guard) for factor in "xy")
        return self._do(SHARE, *factors, ratio=(1.0, float(bindings["#fixed"]), 0.0, inf))

    def _round(self, _: int, bindings: Found, guard: int | None) -> Value:
        quotient = self._do(NEAREST, *(self.value(bindings[operand], guard) for operand in "cd"))
        return self._divided(quotient, bindings["d"], guard)

    def _quotient(self, number: int, bindings: Found, _: int | None) -> Value:
        """Write a sum over a window times numerator / (fixed + each * its values), rounded."""
        value = self.value(bindings["row"])
        ticks, limit = bindings["ticks"], float(bindings.get("#limit", inf))
        fixed, per_value = (float(bindings.get(key, 0)) for key in ("#fixed", "#each"))
        slot, kind = _number(self.code.summed, value), _number(self.code.kinds, ticks)
        sums, counts, begins = (Region.SUM, slot), (Region.COUNT, slot), (Region.BEGIN, kind)
        self._do(ADD_UP, value, sums, counts, slot=slot)
        return self._do(
            QUOTIENT,
            *(value, sums, begins, counts),
            slot=slot,
            kind=kind,
            ticks=ticks,
            number=self._counted.times.get(number, 0),
            ratio=(float(bindings.get("#numerator", 1)), fixed, per_value, limit),
        )

    def _ago(self, row: int, ticks: int) -> Value:
        """Write the value so many ticks ago: its window begins there, one tick longer."""
        value = self.value(row)
        slot, kind = _number(self.code.stored, value), _number(self.code.kinds, ticks + 1)
        history, begins = (Region.VALUE, slot), (Region.BEGIN, kind)
        self._do(KEEP, value, history)
        return self._do(AGO, history, UNUSED_PLACE, begins, kind=kind, ticks=ticks)

    def _do(self, operation: int, *operands: Value, **more: Any) -> int:
        return self.code.add(VectorOperation(operation, operands, **more))


_FUSED: Sequence[tuple[Pattern, Callable[[_Writer, int, Found, int | None], Value]]] = [
    *((pattern, _Writer._quotient) for pattern in QUOTIENTS),
    *((("clip", pattern, "#limit"), _Writer._scale) for pattern in SCALED),
    *((pattern, _Writer._scale) for pattern in SCALED if pattern[1] != "x"),
    (("nearest", ("*", "x", "y"), "#fixed"), _Writer._share),
    (ROUNDED, _Writer._round),
]
"""What one loop does: several steps, and what writes them."""


def _require_positive(divisor: int) -> None:
    if divisor <= 0:
        raise QuestionError("a feature divides by a number that is not positive.")


def _number(numbers: dict[Any, int], key: object) -> int:
    return numbers.setdefault(key, len(numbers))


# What to compute of a drive: columns of single rows, and columns that look back.


@dataclass(frozen=True)
class ColumnPlan:
    """Columns to compute of a drive: by `names`, of `rows` (one row each) and `windows`.

    `rows` has what is looked back on, too.
    """

    names: tuple[str, ...]
    rows: Mapping[str, Definition]
    windows: Mapping[str, Definition]

    @classmethod
    def from_definitions(
        cls,
        names: Sequence[str],
        features: Mapping[str, Definition],
        windows: Mapping[str, Definition],
    ) -> "ColumnPlan":
        """Plan columns by name: of `features`, of `windows`, or logged.

        Raises `DataError` for a feature that is defined in two ways.
        """
        single = [name for name in names if name not in windows]
        rows = {name: features.get(name, plain_column(name)) for name in single}
        return cls(tuple(names), rows_of(rows, windows), dict(windows))

    @classmethod
    def of_set(cls, catalog: Catalog, name: str, fold: str | None = None) -> "ColumnPlan":
        """Plan the columns of a feature set, the label last; of changes, what makes it.

        For the `fold` see `Catalog.definitions`.
        """
        feature_set = catalog.feature_set(name)
        features = catalog.rows(feature_set.features)
        inputs = (*feature_set.signals, *feature_set.features, *feature_set.windows)
        changes = (*inputs, COURSE, YAW_RATE)
        columns = changes if feature_set.change_ticks else feature_set.columns
        return cls.from_definitions(columns, features, catalog.definitions(name, fold))

    @property
    def signals(self) -> tuple[str, ...]:
        """The logged signals that are needed, sorted."""
        return tuple(sorted({name for row in self.rows.values() for name in row.signals}))

    @property
    def facts(self) -> tuple[str, ...]:
        """The drive columns that are needed."""
        components = [component for column in self._columns for component in components_of(column)]
        return tuple(
            dict.fromkeys(component.fact.name for component in components if component.fact)
        )

    @property
    def _columns(self) -> list[Definition]:
        """The columns that look back, and those that the combinations among them are made of."""
        columns, seen = list(self.windows.values()), set[int]()
        for column in columns:
            if column.made and id(column.made) not in seen:
                seen.add(id(column.made))
                columns += [c for c in column.made.columns if c.made or c.fact or c.number]
        return columns

    @property
    def numbers(self) -> tuple[str, ...]:
        """Calibration parameters of the car that the columns need."""
        names = (column.number.name for column in self._columns if column.number)
        return tuple(dict.fromkeys(names))

    @property
    def limits(self) -> tuple[int, ...]:
        """The largest size that each column can have."""
        return tuple(
            limit_of(self.windows[name].bits)
            if name in self.windows
            else limit_of(self.rows[name].of_bits) + (not self.rows[name].sql)
            for name in self.names
        )

    @cached_property
    def most_rows(self) -> float:
        """Number of rows up to which the slopes are exact, here and on board."""
        composites = (row.made for row in rows_behind(self.windows).values())
        slopes = [
            len(composite.equations) for composite in composites if isinstance(composite, Slope)
        ]
        return min(map(most_products, slopes), default=inf)

    @cached_property
    def program(self) -> BlockProgram:
        """The program that computes the columns, one for equal plans. Raises `QuestionError`."""
        return _program(self.names, tuple(self.rows.items()), tuple(self.windows.items()))


@lru_cache(maxsize=64)
def _program(
    names: tuple[str, ...],
    rows: tuple[tuple[str, Definition], ...],
    windows: tuple[tuple[str, Definition], ...],
) -> BlockProgram:
    counted = CountedColumns.from_definitions(dict(rows), dict(windows))
    writer = _Writer(counted)
    for place in sorted({*counted.places.values(), *counted.times}):
        writer.value(place)
    return writer.code.assemble([writer.value(counted.places[name]) for name in names])
