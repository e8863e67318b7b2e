"""Writes the operations of a column of one row: a logged signal, or a feature's arithmetic."""

from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from operator import add, mul, sub

from fleet_slip.catalogue.arithmetic import Arithmetic, Step
from fleet_slip.catalogue.signals import COUNT_MAX
from fleet_slip.columns.blocks import block_operations as op
from fleet_slip.columns.blocks.block_program import Code, Value, VectorOperation
from fleet_slip.errors import QuestionError

_BINARY64 = {
    "+": op.ADD,
    "-": op.SUBTRACT,
    "*": op.MULTIPLY,
    "abs": op.ABSOLUTE,
    "sign": op.SIGN,
}
_INTEGERS = {
    "+": op.ADD_INTEGERS,
    "-": op.SUBTRACT_INTEGERS,
    "*": op.MULTIPLY_INTEGERS,
    "abs": op.ABSOLUTE_INTEGERS,
    "sign": op.SIGN_INTEGERS,
}
_FUNCTIONS: dict[str, Callable[..., int]] = {
    "+": add,
    "-": sub,
    "*": mul,
    "negative": lambda value: -value,
    "abs": abs,
    "sign": lambda value: (value > 0) - (value < 0),
}


@dataclass(frozen=True)
class RowColumn:
    """A column of one row: a logged signal, or a feature with its arithmetic and largest count."""

    name: str
    arithmetic: Arithmetic | None = None
    limit: int = COUNT_MAX

    @property
    def inputs(self) -> tuple[str, ...]:
        """The signals that it is computed from."""
        return self.arithmetic.inputs if self.arithmetic else (self.name,)


def add_row_column(code: Code, row: RowColumn) -> Value:
    """Add what computes a column of one row; return its result.

    Raises `QuestionError` if it divides by a number that is not positive.
    """
    if row.arithmetic is None:
        return code.signal(row.name)
    result = _Expression(code, row.arithmetic).result()
    return code.add_anew(VectorOperation(op.CLIP, result, ratio=(0.0, 1.0, 0.0, float(row.limit))))


@dataclass(frozen=True)
class _Constant:
    value: int


class _Expression:
    """Writes the operations of one expression: those that its result needs."""

    def __init__(self, code: Code, arithmetic: Arithmetic) -> None:
        """Take what is written to, and the expression."""
        self._code, self._arithmetic = code, arithmetic
        self._integers = arithmetic.needs_integers
        self._known: dict[int, Value | _Constant] = {}
        self._divisors: list[int] = []
        self._guarded: int | None = None
        if arithmetic.guard is not None:
            self._guarded = self._guard(arithmetic.guard)

    def result(self) -> Value:
        """Return the result, in binary64, NaN where the row has no value.

        Raises `QuestionError` if it divides by a number that is not positive.
        """
        result = self._written(self._value(len(self._arithmetic.steps) - 1))
        if self._integers:
            return self._code.add(VectorOperation(op.TO_BINARY64, result, c=self._valid()))
        if self._guarded is not None or self._divisors:
            return self._code.add(VectorOperation(op.ADD, result, self._valid()))
        return result

    def _value(self, number: int) -> Value | _Constant:
        """Return what a step computes."""
        if number not in self._known:
            self._known[number] = self._computed(self._arithmetic.steps[number])
        return self._known[number]

    def _computed(self, step: Step) -> Value | _Constant:
        if step.name:
            counts = self._code.signal(step.name)
            return (
                self._code.add(VectorOperation(op.TO_INTEGERS, c=counts))
                if self._integers
                else counts
            )
        if not step.function:
            return _Constant(step.value)
        if step.function == "//":
            return self._quotient(step)
        operands = [self._value(operand) for operand in step.operands]
        constants = [one.value for one in operands if isinstance(one, _Constant)]
        if len(constants) == len(operands):
            return _Constant(_FUNCTIONS[step.function](*constants))
        if step.function == "negative" or (step.function == "*" and constants):
            (factor,) = (one for one in operands if not isinstance(one, _Constant))
            return self._multiplied(factor, constants[0] if constants else -1)
        operation = (_INTEGERS if self._integers else _BINARY64)[step.function]
        a, b = (self._written(one) for one in (operands * 2)[:2])
        return self._code.add(VectorOperation(operation, a, b))

    def _quotient(self, step: Step) -> int:
        divides = step.operands[-1]
        rounded = self._rounded_quotient(step)
        if rounded is not None:
            operation = op.NEAREST_INTEGERS if self._integers else op.NEAREST
            return self._divided(operation, divides, *rounded)
        dividend, divisor = (self._value(operand) for operand in step.operands)
        operation = op.DIVIDE_INTEGERS if self._integers else op.DIVIDE
        return self._divided(operation, divides, dividend, divisor)

    def _rounded_quotient(self, step: Step) -> tuple[Value | _Constant, Value | _Constant] | None:
        """Return c and d of (2 * c + sign(c) * d) // (2 * d), as features round; None of others."""
        steps = self._arithmetic.steps
        match [(steps[n].function, steps[n].operands) for n in step.operands]:
            case [("+", (twice, signed)), ("*", (two, d))]:
                pass
            case _:
                return None
        match (steps[twice], steps[signed], steps[two]):
            case (
                Step(function="*", operands=(also_two, c)),
                Step(function="*", operands=(sign, also_d)),
                Step(function="", name="", value=2),
            ) if also_two == two and also_d == d and steps[sign] == Step("sign", (c,)):
                return self._value(c), self._value(d)
        return None

    def _divided(
        self, operation: int, divides: int, a: Value | _Constant, b: Value | _Constant
    ) -> int:
        if isinstance(b, _Constant):
            if b.value <= 0:
                raise QuestionError("a feature divides by a number that is not positive.")
            if operation == op.NEAREST:
                ratio = (1.0, float(b.value), 0.0, inf)
                return self._code.add(VectorOperation(op.SCALE, self._written(a), ratio=ratio))
        elif not self._arithmetic.is_positive(divides):
            self._divisors.append(self._at_least(self._written(b), 1))
        return self._code.add(VectorOperation(operation, self._written(a), self._written(b)))

    def _multiplied(self, a: Value | _Constant, factor: int) -> int:
        if self._integers:
            by = VectorOperation(op.MULTIPLY_INTEGERS_BY, self._written(a), number=factor)
        else:
            ratio = (float(factor), 1.0, 0.0, inf)
            by = VectorOperation(op.MULTIPLY_BY, self._written(a), ratio=ratio)
        return self._code.add(by)

    def _written(self, one: Value | _Constant) -> Value:
        """Return a result; a constant fills a register."""
        if not isinstance(one, _Constant):
            return one
        if self._integers:
            return self._code.add(VectorOperation(op.FILL_INTEGERS, number=one.value))
        return self._code.add(VectorOperation(op.FILL, ratio=(float(one.value), 1.0, 0.0, inf)))

    def _guard(self, number: int) -> int:
        """Return what is 0 where the guard is large enough and nothing is missing, else NaN."""
        return self._at_least(self._written(self._value(number)), self._arithmetic.at_least)

    def _at_least(self, value: Value, least: int) -> int:
        """Return what is 0 where a value is large enough and nothing is missing, else NaN."""
        if self._integers:  # the sign of a difference is exact however it is rounded
            smallest = self._written(_Constant(least))
            excess = self._code.add(VectorOperation(op.SUBTRACT_INTEGERS, value, smallest))
            value = self._code.add(VectorOperation(op.TO_BINARY64, excess, c=self._given()))
            least = 0
        return self._code.add(VectorOperation(op.GUARD, value, ratio=(float(least), 1.0, 0.0, inf)))

    def _valid(self) -> int:
        """Return what is 0 where the row has a value, else NaN."""
        valid = self._given() if self._guarded is None else self._guarded
        for one in self._divisors:
            valid = self._code.add(VectorOperation(op.ADD, valid, one))
        return valid

    def _given(self) -> int:
        """Return what is 0 where no signal is missing, else NaN."""
        total: Value | None = None
        for name in self._arithmetic.inputs:
            counts = self._code.signal(name)
            total = (
                counts if total is None else self._code.add(VectorOperation(op.ADD, total, counts))
            )
        if total is None:
            return self._code.add(VectorOperation(op.FILL))
        return self._code.add(VectorOperation(op.GUARD, total, ratio=(-inf, 1.0, 0.0, inf)))
