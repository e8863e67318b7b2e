"""Computes what the integer SQL of a feature says, on arrays of counts: the same integers.

The SQL of a feature is arithmetic of + - * and // (which truncates), abs and sign over the counts
of one row, perhaps inside CASE WHEN divisor >= number THEN ... END.
"""

import ast
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import BoolArray
from fleet_slip.errors import QuestionError

LARGEST_INPUT = 2**15
"""Largest size of a logged count, int16."""

_CAST = re.compile(r"::BIGINT\b")
_GUARDED = re.compile(r"CASE WHEN (.+) >= ([0-9]+) THEN (.+) END", re.DOTALL)
_OVERFLOW = 2**63
_EXACT = 2**53

_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "+": np.add,
    "-": np.subtract,
    "*": np.multiply,
    "negative": np.negative,
    "abs": np.abs,
    "sign": np.sign,
}
_OPERATORS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.FloorDiv: "//"}


@dataclass(frozen=True)
class _Step:
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
        bound: largest size that the result can have.
        largest: largest size that anything in it can have.
        keys: number of each step that is the same wherever the same is computed.
    """

    steps: tuple[_Step, ...]
    guard: int | None
    at_least: int
    inputs: tuple[str, ...]
    bound: int
    largest: int
    keys: tuple[int, ...]

    @property
    def dtype(self) -> type[np.float64] | type[np.int64]:
        """What to compute in: binary64, which is faster, if every integer in it is below 2^53."""
        return np.float64 if self.largest < _EXACT else np.int64

    def __call__(
        self, counts: Mapping[str, NDArray[Any]], known: dict[Any, Any] | None = None
    ) -> tuple[NDArray[Any], BoolArray | None]:
        """Return the result for each row, shape (rows,), and which rows have one; None is all.

        The counts, and the result, are integers of `dtype`. `known` keeps what was computed of the
        same counts, for other expressions with equal parts.
        """
        known = {} if known is None else known
        values: list[Any] = []
        chosen: BoolArray | None = None
        for number, step in enumerate(self.steps):
            if chosen is not None:  # what may be divided by nothing is not for others
                values.append(self._computed(step, values, counts, chosen))
                continue
            key = (self.dtype, self.keys[number])
            if key not in known:
                known[key] = self._computed(step, values, counts, None)
            values.append(known[key])
            if number == self.guard:
                chosen = values[number] >= self.at_least
        rows = len(next(iter(counts.values())))
        return np.broadcast_to(np.asarray(values[-1], dtype=self.dtype), rows), chosen

    def _computed(
        self,
        step: _Step,
        values: Sequence[Any],
        counts: Mapping[str, NDArray[Any]],
        chosen: BoolArray | None,
    ) -> Any:
        if step.name:
            return counts[step.name]
        if not step.function:
            return self.dtype(step.value)
        operands = [values[operand] for operand in step.operands]
        if step.function != "//":
            return _FUNCTIONS[step.function](*operands)
        dividend, divisor = operands
        if chosen is not None:  # a row without a value must not be divided by nothing
            divisor = np.where(chosen, divisor, 1)
        if np.any(divisor <= 0):
            raise QuestionError("a feature divides by a count that is not positive.")
        if self.dtype is np.int64:
            return np.sign(dividend) * (np.abs(dividend) // divisor)
        # Rounded once and then down, a quotient of integers below 2^53 is the exact one down.
        return np.trunc(dividend / divisor)


_KEYS: dict[tuple[str, tuple[int, ...], int, str], int] = {}
"""Numbers of all steps that were ever parsed."""


@cache
def parse(sql: str) -> Arithmetic:
    """Take the SQL of a feature apart. Raises `QuestionError` if it is no such arithmetic.

    Also if it could need more than 64 bits, where SQL would end with an error.
    """
    builder = _Builder()
    text = _CAST.sub("", sql.strip())
    guarded = _GUARDED.fullmatch(text)
    try:
        guard = builder.add(_tree(guarded[1])) if guarded else None
        builder.add(_tree(guarded[3] if guarded else text), last=True)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise QuestionError(f"{sql[:200]!r} is not integer arithmetic on counts.") from None
    names = tuple(dict.fromkeys(step.name for step in builder.steps if step.name))
    if max(builder.bounds) >= _OVERFLOW:
        raise QuestionError(f"{sql[:200]!r} can need more than 64 bits: divide earlier.")
    at_least = int(guarded[2]) if guarded else 0
    largest = max(builder.bounds)
    keys: list[int] = []
    for step in builder.steps:
        parts = tuple(keys[operand] for operand in step.operands)
        keys.append(_KEYS.setdefault((step.function, parts, step.value, step.name), len(_KEYS)))
    return Arithmetic(
        tuple(builder.steps), guard, at_least, names, builder.bounds[-1], largest, tuple(keys)
    )


def _tree(text: str) -> ast.expr:
    return ast.parse(text.strip(), mode="eval").body


class _Builder:
    """Collects steps, and the largest size that each can have."""

    def __init__(self) -> None:
        self.steps: list[_Step] = []
        self.bounds: list[int] = []

    def add(self, tree: ast.expr, *, last: bool = False) -> int:
        """Add what computes a tree; return the number of its result."""
        step, bound = self._step(tree)
        if step in self.steps and not last:
            return self.steps.index(step)
        self.steps.append(step)
        self.bounds.append(bound)
        return len(self.steps) - 1

    def _step(self, tree: ast.expr) -> tuple[_Step, int]:
        match tree:
            case ast.Name(id=name):
                return _Step("", name=name), LARGEST_INPUT
            case ast.Constant(value=int(value)) if not isinstance(value, bool):
                return _Step("", value=value), abs(value)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return self._call("negative", [operand])
            case ast.UnaryOp(op=ast.UAdd(), operand=operand):
                return self._step(operand)
            case ast.BinOp(left=left, op=operator, right=right) if type(operator) in _OPERATORS:
                return self._call(_OPERATORS[type(operator)], [left, right])
            case ast.Call(func=ast.Name(id=("abs" | "sign") as function), args=[one], keywords=[]):
                return self._call(function, [one])
        raise ValueError("is not integer arithmetic")

    def _call(self, function: str, parts: Sequence[ast.expr]) -> tuple[_Step, int]:
        operands = tuple(self.add(part) for part in parts)
        sizes = [self.bounds[operand] for operand in operands]
        bound = {
            "+": sum(sizes),
            "-": sum(sizes),
            "*": sizes[0] * sizes[-1],
            "sign": 1,
        }.get(function, sizes[0])
        return _Step(function, operands), bound
