"""Takes the integer SQL of a feature apart, to compute the same integers without SQL.

The SQL of a feature is arithmetic of + - * and // (which truncates), abs and sign over the counts
of one row, perhaps inside CASE WHEN divisor >= number THEN ... END.
"""

import ast
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache

from fleet_slip.errors import QuestionError

LARGEST_INPUT = 2**15
"""Largest size of a logged count, int16."""

_TEXT = re.compile(r"(?!.*--|.*/\*)[A-Za-z0-9_+*/()<>=: -]{1,5000}")
"""What can stand in it, of a manifest that may come from anywhere."""
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
    """Return `nearest` as DuckDB has it, whose `//` truncates: half a divisor is added before."""
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
"""What each function of a step is."""


@dataclass(frozen=True)
class Step:
    """One operation; its operands are numbers of earlier steps, a name or a constant."""

    function: str
    operands: tuple[int, ...] = ()
    value: int = 0
    name: str = ""


@dataclass(frozen=True)
class Arithmetic:
    """An expression taken apart into steps, equal parts once; the last step is the result.

    Attributes:
        steps: what to compute, in order.
        guard: the step that must be at least `at_least` for the row to have a value.
        inputs: names of the signals in it.
    """

    steps: tuple[Step, ...]
    guard: int | None
    at_least: int
    inputs: tuple[str, ...]


@cache
def parse(sql: str) -> Arithmetic:
    """Take the SQL of a feature apart. Raises `QuestionError` if it is no such arithmetic.

    Also if it could need more than 64 bits, where SQL would end with an error.
    """
    if not _TEXT.fullmatch(sql):
        raise QuestionError(f"{sql[:200]!r} is not integer arithmetic on counts.")
    builder = _Builder()
    text = _CAST.sub("", sql.strip())
    guarded = _GUARDED.fullmatch(text)
    try:
        guard = builder.add(_tree(guarded[1])) if guarded else None
        builder.add(_tree(guarded[3] if guarded else text), last=True)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise QuestionError(f"{sql[:200]!r} is not integer arithmetic on counts.") from None
    names = tuple(dict.fromkeys(step.name for step in builder.steps if step.name))
    at_least = int(guarded[2]) if guarded else 0
    if max(builder.bounds) + at_least >= _OVERFLOW:
        raise QuestionError(f"{sql[:200]!r} can need more than 64 bits: divide earlier.")
    return Arithmetic(tuple(builder.steps), guard, at_least, names)


def evaluate(sql: str, counts: Mapping[str, int]) -> int | None:
    """Return what the SQL of a feature comes to in one row; None where it has no value."""
    arithmetic, results = parse(sql), list[int]()
    for step in arithmetic.steps:
        if step.function:
            value = COMPUTED[step.function](*(results[operand] for operand in step.operands))
        else:
            value = counts[step.name] if step.name else step.value
        if value is None:
            return None
        results.append(value)
    missing = arithmetic.guard is not None and results[arithmetic.guard] < arithmetic.at_least
    return None if missing else results[-1]


def _tree(text: str) -> ast.expr:
    return ast.parse(text.strip(), mode="eval").body


class _Builder:
    """Collects steps, and the largest size that each can have."""

    def __init__(self) -> None:
        self.steps: list[Step] = []
        self.bounds: list[int] = []

    def add(self, tree: ast.expr, *, last: bool = False) -> int:
        """Add what computes a tree; return the number of its result."""
        step, bound = self._step(tree)
        if step in self.steps and not last:
            return self.steps.index(step)
        self.steps.append(step)
        self.bounds.append(bound)
        return len(self.steps) - 1

    def _step(self, tree: ast.expr) -> tuple[Step, int]:
        match tree:
            case ast.Name(id=name):
                return Step("", name=name), LARGEST_INPUT
            case ast.Constant(value=int(value)) if not isinstance(value, bool):
                return Step("", value=value), abs(value)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return self._call("negative", [operand])
            case ast.UnaryOp(op=ast.UAdd(), operand=operand):
                return self._step(operand)
            case ast.BinOp(left=left, op=operator, right=right) if type(operator) in _OPERATORS:
                return self._call(_OPERATORS[type(operator)], [left, right])
            case ast.Call(func=ast.Name(id=("abs" | "sign") as function), args=[one], keywords=[]):
                return self._call(function, [one])
        raise ValueError("is not integer arithmetic")

    def _call(self, function: str, parts: Sequence[ast.expr]) -> tuple[Step, int]:
        operands = tuple(self.add(part) for part in parts)
        sizes = [self.bounds[operand] for operand in operands]
        bound = {
            "+": sum(sizes),
            "-": sum(sizes),
            "*": sizes[0] * sizes[-1],
            "sign": 1,
            "//": sizes[0] // max(1, self.steps[operands[-1]].value),
        }.get(function, sizes[0])
        return Step(function, operands), bound
