"""Writes the program over blocks of rows that computes columns, from their steps.

Each operation is a loop, but for `_FUSED` ones; values are binary64, or int64 beyond 53 bits.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cache, reduce
from math import inf
from typing import Any

from fleet_slip.columns.blocks import block_operations as op
from fleet_slip.columns.blocks.block_operations import Region
from fleet_slip.columns.blocks.block_program import (
    NOWHERE,
    BlockProgram,
    Code,
    Value,
    VectorOperation,
)
from fleet_slip.columns.blocks.fused_steps import QUOTIENTS, ROUNDED, SCALED, Pattern
from fleet_slip.columns.counted_columns import CountedColumns
from fleet_slip.columns.operations import (
    GIVEN,
    OPERATIONS,
    operands_of,
    operation_of,
    plain_of,
    size_of,
)
from fleet_slip.errors import QuestionError

_EXACT = 2**53

_LOOPS = {
    **{"+": op.ADD, "-": op.SUBTRACT, "*": op.MULTIPLY, "//": op.DIVIDE, "nearest": op.NEAREST},
    **{"negative": op.NEGATE, "abs": op.ABSOLUTE, "sign": op.SIGN, "min": op.LEAST},
    **{"max": op.MOST, "at_least": op.AT_LEAST, "where": op.WHERE, "else": op.ELSE},
}
"""Operations of which each value is made of values of its own row."""

_INTEGERS = ("+", "-", "*", "//", "nearest", "negative", "abs", "sign")
"""Those that there are for int64, too."""

Found = Mapping[str, int]


def compile_plan(
    counted: CountedColumns, names: Sequence[str], also: Sequence[str] = ()
) -> BlockProgram:
    """Return the program of columns, with `also`. Raises `QuestionError` for a bad divisor."""
    writer = _Writer(counted)
    for place in sorted({*counted.places.values(), *counted.times}):
        writer.value(place)
    results = [[writer.value(counted.places[name]) for name in some] for some in (names, also)]
    return writer.code.assemble(*results)


class _Writer:
    """Writes the operations of steps, those that are asked for and what they need."""

    def __init__(self, counted: CountedColumns) -> None:
        self.code = Code(signals={name: n for n, name in enumerate(counted.lowered.signals)})
        self._told = [*counted.lowered.facts, *counted.lowered.numbers]
        self._counted, self._steps, self._ranges = counted, counted.steps, counted.ranges
        self._facts = len(counted.lowered.facts)
        self.value = cache(self._value)
        self.integers = cache(self._integers)
        self._whole = cache(self._needs_integers)

    def _value(self, number: int, guard: int | None = None) -> Value:
        """Return a step in binary64, NaN where missing; `guard` is positive wherever it is used."""
        step = self._steps[number]
        name, plain = operation_of(step), plain_of(step)
        if (constant := self._constant(number)) is not None:
            return self._do(op.FILL, ratio=(float(constant), 1.0, 0.0, inf))
        if name in GIVEN:
            return self._signal_or_told(name, plain[0])
        if self._whole(number):
            found = self._do(op.TO_BINARY64, self.integers(number, guard))
            return self._do(op.WHERE, found, self._present(number, guard))
        fused = None
        if not any(self._whole(one) for one in operands_of(step)):
            fused = self._fused(number, guard)
        return self._plain(number, guard) if fused is None else fused

    def _signal_or_told(self, name: str, place: int) -> Value:
        if name == "signal":
            return (Region.SIGNAL, place)
        told = self._told[place + (self._facts if name == "number" else 0)]
        return self._do(op.BROADCAST, (Region.TOLD, _number(self.code.told, told)))

    def _fused(self, number: int, guard: int | None) -> Value | None:
        """Return what one loop computes of several steps; None if there is no such loop."""
        for pattern, write in _FUSED:
            found: dict[str, int] = {}
            if self._matches(pattern, number, found):
                return write(self, number, found, guard)
        return None

    def _plain(self, number: int, guard: int | None) -> Value:
        name, plain = operation_of(self._steps[number]), plain_of(self._steps[number])
        if name == "at_least" and self._whole(plain[0]):
            # Rounded to binary64, the difference keeps its sign.
            pair = [self.integers(one, guard) for one in plain]
            excess = self._do(op.TO_BINARY64, self._do(op.INTEGERS + op.SUBTRACT, *pair))
            excess = self._do(op.WHERE, excess, self._present(plain[0], guard))
            return self._do(op.AT_LEAST, excess, self._do(op.FILL, ratio=(0.0, 1.0, 0.0, inf)))
        if name == "ago":
            return self._ago(plain[0], plain[1])
        if name == "clip":
            return self._clip(number, plain[0], self._ranges[plain[1]][1], guard)
        if name == "where":
            guard = self._guarded_by(plain[1])
        found = self._do(_LOOPS[name], *(self.value(one, guard) for one in plain))
        if name in ("//", "nearest"):
            return self._divided(found, plain[1], guard)
        return found

    def _guarded_by(self, there: int) -> int | None:
        """Return the step that is above zero wherever another one is there."""
        found: dict[str, int] = {}
        guards = self._matches(("at_least", "guard", "#least"), there, found)
        return found["guard"] if guards and found["#least"] > 0 else None

    def _divided(self, quotient: Value, divisor: int, guard: int | None) -> Value:
        if self._is_positive(divisor, guard):
            return quotient
        return self._do(op.WHERE, quotient, self._above_zero(divisor, guard))

    def _above_zero(self, number: int, guard: int | None) -> Value:
        one = self._do(op.FILL, ratio=(1.0, 1.0, 0.0, inf))
        return self._do(op.AT_LEAST, self.value(number, guard), one)

    def _is_positive(self, number: int, guard: int | None) -> bool:
        if (constant := self._constant(number)) is not None:
            _require_positive(constant)
            return True
        if number == guard or self._ranges[number][0] > 0:
            return True
        step = self._steps[number]
        return step[0] in ("+", "*") and all(
            self._is_positive_term(one, guard) for one in operands_of(step)
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
        """Whether an operation on the counts of a row, or what it works on, may reach 2^53."""
        step = self._steps[number]
        if step[0] not in _INTEGERS or self._constant(number) is not None:
            return False
        if any(OPERATIONS[operation_of(self._steps[n])].over_time for n in operands_of(step)):
            return False  # a drive with so many rows is refused
        size = size_of(self._ranges[number])
        return size >= _EXACT or any(self._whole(one) for one in operands_of(step))

    def _integers(self, number: int, guard: int | None) -> Value:
        """Return a step in int64; anything where it is missing."""
        if (constant := self._constant(number)) is not None:
            return self._do(op.INTEGERS + op.FILL, number=constant)
        if not self._whole(number):
            return self._do(op.INTEGERS + op.COPY, self.value(number, guard))
        found: dict[str, int] = {}
        name, of = operation_of(self._steps[number]), operands_of(self._steps[number])
        if self._matches(ROUNDED, number, found):
            name, of = "nearest", (found["c"], found["d"])
        if name in ("//", "nearest"):
            self._is_positive(of[1], guard)
        parts = [self.integers(one, guard) for one in of]
        return self._do(op.INTEGERS + _LOOPS[name], *parts)

    def _present(self, number: int, guard: int | None) -> Value:
        """Return what is NaN where a step in int64 is missing."""
        step = self._steps[number]
        parts: list[Value] = []
        for one in operands_of(step):
            if self._whole(one):
                parts.append(self._present(one, guard))
            elif self._constant(one) is None:
                parts.append(self.value(one, guard))
        divisor = operands_of(step)[-1]
        if step[0] in ("//", "nearest") and not self._is_positive(divisor, guard):
            parts.append(self._above_zero(divisor, guard))
        return reduce(lambda a, b: self._do(op.WHERE, a, b), parts)

    def _matches(self, pattern: Pattern, number: int, found: dict[str, int]) -> bool:
        """Return whether a step is what a pattern says, and what its names stand for."""
        if isinstance(pattern, int):
            return self._constant(number) == pattern
        if isinstance(pattern, str):
            value = self._constant(number) if pattern.startswith("#") else number
            return value is not None and found.setdefault(pattern, value) == value
        step = self._steps[number]
        name, plain = operation_of(step), plain_of(step)
        if name != pattern[0]:
            return False
        steps = OPERATIONS[name].steps
        return all(
            self._matches(one, of, found) if i < steps else found.setdefault(one, of) == of
            for i, (one, of) in enumerate(zip(pattern[1:], plain, strict=True))
        )

    def _scale(self, number: int, found: Found, guard: int | None) -> Value:
        value, limit = self.value(found["x"], guard), float(found.get("#limit", inf))
        numerator, fixed = found.get("#numerator", 1), found["#fixed"]
        _require_positive(fixed)
        if numerator == fixed and size_of(self._ranges[found["x"]]) <= limit:
            return value
        times = self._counted.times.get(number, 0)
        ratio = (float(numerator), float(fixed), 0.0, limit)
        return self._do(op.SCALE, value, ratio=ratio, number=times)

    def _clip(self, number: int, of: int, limit: int, guard: int | None) -> Value:
        value = self.value(of, guard)
        if size_of(self._ranges[of]) <= limit:
            return value
        times = self._counted.times.get(number, 0)
        return self._do(op.CLIP, value, ratio=(0.0, 1.0, 0.0, float(limit)), number=times)

    def _share(self, _: int, found: Found, guard: int | None) -> Value:
        factors = (self.value(found[one], guard) for one in "xy")
        return self._do(op.SHARE, *factors, ratio=(1.0, float(found["#fixed"]), 0.0, inf))

    def _round(self, _: int, found: Found, guard: int | None) -> Value:
        quotient = self._do(op.NEAREST, *(self.value(found[one], guard) for one in "cd"))
        return self._divided(quotient, found["d"], guard)

    def _quotient(self, number: int, found: Found, _: int | None) -> Value:
        """Write a sum over a window times numerator / (fixed + each * its values), rounded."""
        value = self.value(found["row"])
        ticks, limit = found["ticks"], float(found["#limit"])
        fixed, each = (float(found.get(one, 0)) for one in ("#fixed", "#each"))
        slot, kind = _number(self.code.summed, value), _number(self.code.kinds, ticks)
        sums, counts, begins = (Region.SUM, slot), (Region.COUNT, slot), (Region.BEGIN, kind)
        self._do(op.ADD_UP, value, sums, counts, slot=slot)
        return self._do(
            op.QUOTIENT,
            *(value, sums, begins, counts),
            slot=slot,
            kind=kind,
            ticks=ticks,
            number=self._counted.times.get(number, 0),
            ratio=(float(found.get("#numerator", 1)), fixed, each, limit),
        )

    def _ago(self, row: int, ticks: int) -> Value:
        """Write the value so many ticks ago: its window begins there, one tick longer."""
        value = self.value(row)
        slot, kind = _number(self.code.kept, value), _number(self.code.kinds, ticks + 1)
        kept, begins = (Region.VALUE, slot), (Region.BEGIN, kind)
        self._do(op.KEEP, value, kept)
        return self._do(op.AGO, kept, NOWHERE, begins, kind=kind, ticks=ticks)

    def _do(self, operation: int, *operands: Value, **more: Any) -> int:
        return self.code.add(VectorOperation(operation, operands, **more))


_FUSED: Sequence[tuple[Pattern, Callable[[_Writer, int, Found, int | None], Value]]] = [
    *((one, _Writer._quotient) for one in QUOTIENTS),
    *((("clip", one, "#limit"), _Writer._scale) for one in SCALED),
    *((one, _Writer._scale) for one in SCALED if one[1] != "x"),
    (("nearest", ("*", "x", "y"), "#fixed"), _Writer._share),
    (ROUNDED, _Writer._round),
]
"""What one loop does: several steps, and what writes them."""


def _require_positive(divisor: int) -> None:
    if divisor <= 0:
        raise QuestionError("a feature divides by a number that is not positive.")


def _number(known: dict[Any, int], key: object) -> int:
    return known.setdefault(key, len(known))
