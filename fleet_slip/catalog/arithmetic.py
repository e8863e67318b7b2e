"""Parses the integer SQL of a feature, to compute the same integers without SQL.

The SQL of a feature is arithmetic of + - * and // (which truncates), abs and sign over the counts
of one row, perhaps inside CASE WHEN divisor >= number THEN ... END.
"""

import ast
import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

from fleet_slip.errors import QuestionError

LARGEST_INPUT = 2**15
"""Largest size of a logged count, int16."""

_TEXT = re.compile(r"(?!.*--|.*/\*)[A-Za-z0-9_+*/()<>=: -]{1,5000}")
"""Permitted characters and length: a manifest may come from anywhere."""
_CAST = re.compile(r"::BIGINT\b")
_GUARDED = re.compile(r"CASE WHEN (.+) >= ([0-9]+) THEN (.+) END", re.DOTALL)
_OVERFLOW = 2**63

_OPERATORS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.FloorDiv: "//"}


def truncated(a: int, b: int) -> int:
    """Return a / b, truncated towards zero; b is positive."""
    return a // b if a >= 0 else -(-a // b)


def nearest(a: int, b: int) -> int:
    """Return a / b to the nearest, halves away from zero; b is positive."""
    return truncated(2 * a + (b if a >= 0 else -b), 2 * b)


def nearest_sql(number: str, divisor: str) -> str:
    """Return `nearest` in DuckDB's SQL, whose `//` truncates: adds half a divisor before."""
    return f"(2 * ({number}) + sign({number}) * ({divisor})) // (2 * ({divisor}))"


COMPUTED: Mapping[str, Callable[..., int | None]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "//": lambda a, b: truncated(a, b) if b > 0 else None,
    "negative": operator.neg,
    "abs": abs,
    "sign": lambda a: (a > 0) - (a < 0),
}
"""Python function of each step."""


class Step(NamedTuple):
    """The name of an operation, the numbers of the steps that are its operands, plain numbers."""

    name: str
    operands: tuple[int, ...] = ()
    plain: tuple[int, ...] = ()


@dataclass(frozen=True)
class Arithmetic:
    """A parsed expression.

    Attributes
    ----------
    steps
        Operations in order, without repetitions; the last is the result. A `signal` has its place
        among the inputs, and a `constant` its value.
    guard, at_least
        The row has a value if step `guard` is at least `at_least`.
    inputs
        Names of the signals.
    """

    steps: tuple[Step, ...]
    guard: int | None
    at_least: int
    inputs: tuple[str, ...]


@cache
def parse(sql: str) -> Arithmetic:
    """Parse the SQL of a feature.

    Raises `QuestionError` for anything but integer arithmetic, or if it could exceed 64 bits.
    """
    if not _TEXT.fullmatch(sql):
        raise QuestionError(f"{sql[:200]!r} is not integer arithmetic on counts.")
    builder = _Builder()
    text = _CAST.sub("", sql.strip())
    guarded = _GUARDED.fullmatch(text)
    try:
        trees = [
            ast.parse(part.strip(), mode="eval").body
            for part in ((guarded[1], guarded[3]) if guarded else (text,))
        ]
        guard = builder.add(trees[0]) if guarded else None
        builder.add(trees[-1], last=True)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise QuestionError(f"{sql[:200]!r} is not integer arithmetic on counts.") from None
    at_least = int(guarded[2]) if guarded else 0
    if max(builder.bounds) + at_least >= _OVERFLOW:
        raise QuestionError(f"{sql[:200]!r} can need more than 64 bits: divide earlier.")
    return Arithmetic(tuple(builder.steps), guard, at_least, tuple(builder.inputs))


def evaluate(sql: str, counts: Mapping[str, int]) -> int | None:
    """Evaluate the SQL of a feature in one row; return None if it has no value."""
    arithmetic, results = parse(sql), list[int]()
    for step in arithmetic.steps:
        value: int | None
        if step.operands:
            value = COMPUTED[step.name](*(results[operand] for operand in step.operands))
        else:
            number = step.plain[0]
            value = counts[arithmetic.inputs[number]] if step.name == "signal" else number
        if value is None:
            return None
        results.append(value)
    missing = arithmetic.guard is not None and results[arithmetic.guard] < arithmetic.at_least
    return None if missing else results[-1]


class _Builder:
    """Collects steps, with the largest absolute value of each."""

    def __init__(self) -> None:
        self.steps: list[Step] = []
        self.bounds: list[int] = []
        self.inputs: dict[str, int] = {}

    def add(self, tree: ast.expr, *, last: bool = False) -> int:
        """Add the steps of a tree; return the number of its result."""
        match tree:
            case ast.Name(id=name):
                place = self.inputs.setdefault(name, len(self.inputs))
                step, bound = Step("signal", plain=(place,)), LARGEST_INPUT
            case ast.Constant(value=int(value)) if not isinstance(value, bool):
                step, bound = Step("constant", plain=(value,)), abs(value)
            case ast.UnaryOp(op=ast.UAdd(), operand=operand):
                return self.add(operand, last=last)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                step, bound = self._call("negative", operand)
            case ast.BinOp(left=a, op=operator, right=b) if type(operator) in _OPERATORS:
                step, bound = self._call(_OPERATORS[type(operator)], a, b)
            case ast.Call(func=ast.Name(id=("abs" | "sign") as name), args=[operand], keywords=[]):
                step, bound = self._call(name, operand)
            case _:
                raise ValueError("is not integer arithmetic")
        if step in self.steps and not last:
            return self.steps.index(step)
        self.steps.append(step)
        self.bounds.append(bound)
        return len(self.steps) - 1

    def _call(self, function: str, *parts: ast.expr) -> tuple[Step, int]:
        operands = tuple(map(self.add, parts))
        sizes = [self.bounds[operand] for operand in operands]
        last = self.steps[operands[-1]]
        bound = {
            "+": sum(sizes),
            "-": sum(sizes),
            "*": sizes[0] * sizes[-1],
            "sign": 1,
            "//": sizes[0] // (max(1, *last.plain) if last.name == "constant" else 1),
        }.get(function, sizes[0])
        return Step(function, operands), bound
