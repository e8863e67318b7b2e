"""Computes the formulas by which a file states its conversions, as ASAM MCD-2 MC writes them.

A formula is a stranger's text. It is read by the grammar below and by nothing else: numbers, the
raw value `X1` or `X`, `+ - * / ^`, parentheses, and functions by name.
"""

import re
from collections.abc import Callable

import numpy as np

from fleet_slip.arrays import FloatArray

_LONGEST, _DEEPEST = 1000, 50
_TOKEN = re.compile(r"\s*((?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?|[A-Za-z_]\w*|\*\*|[-+*/^(),])")
_FUNCTIONS: dict[str, Callable[..., FloatArray]] = {
    "sin": np.sin, "cos": np.cos, "tan": np.tan, "asin": np.arcsin, "arcsin": np.arcsin,
    "acos": np.arccos, "arccos": np.arccos, "atan": np.arctan, "arctan": np.arctan,
    "sinh": np.sinh, "cosh": np.cosh, "tanh": np.tanh, "exp": np.exp, "ln": np.log,
    "log10": np.log10, "sqrt": np.sqrt, "abs": np.abs, "pow": np.power,
}  # fmt: skip
_OF_TWO = {"pow"}
_OPERATIONS: dict[str, Callable[..., FloatArray]] = {
    "+": np.add, "-": np.subtract, "*": np.multiply, "/": np.divide,
}  # fmt: skip


def compute_formula(formula: str, raw: FloatArray) -> FloatArray:
    """Return a formula's value for each raw one. Raises `ValueError`, which says what is wrong."""
    if len(formula) > _LONGEST:
        raise ValueError(f"it has more than {_LONGEST:,} characters")
    with np.errstate(all="ignore"):
        value = _Formula(formula, raw).compute()
    return np.array(np.broadcast_to(value, raw.shape))


class _Formula:
    """A formula that is read from left to right."""

    def __init__(self, formula: str, raw: FloatArray) -> None:
        tokens, text, at = [], formula.strip(), 0
        while at < len(text):
            found = _TOKEN.match(text, at)
            if found is None:
                raise ValueError(f"{text[at : at + 10]!r} is not known")
            tokens.append(found[1])
            at = found.end()
        self._raw, self._depth, self._tokens = raw, 0, tokens[::-1]

    def compute(self) -> FloatArray:
        """Return the value of all of it."""
        value = self._sum()
        if self._tokens:
            raise ValueError(f"{self._tokens[-1]!r} is out of place")
        return value

    def _next(self, *wanted: str) -> str:
        """Take the next token if it is one of some; return it, or nothing."""
        return self._tokens.pop() if self._tokens and self._tokens[-1] in wanted else ""

    def _sum(self) -> FloatArray:
        value = self._product()
        while sign := self._next("+", "-"):
            value = _OPERATIONS[sign](value, self._product())
        return value

    def _product(self) -> FloatArray:
        value = self._signed()
        while sign := self._next("*", "/"):
            value = _OPERATIONS[sign](value, self._signed())
        return value

    def _signed(self) -> FloatArray:
        self._depth += 1
        if self._depth > _DEEPEST:
            raise ValueError(f"it is more than {_DEEPEST} deep")
        if sign := self._next("+", "-"):
            value = self._signed() if sign == "+" else -self._signed()
        else:
            value = self._value()
            # Of two powers in a row some take the left one first and some the right.
            if self._next("^", "**"):
                value = np.power(value, self._signed_exponent())
        self._depth -= 1
        return value

    def _signed_exponent(self) -> FloatArray:
        return -self._value() if self._next("-") else self._value()

    def _value(self) -> FloatArray:
        part = self._tokens.pop() if self._tokens else "its end"
        name = part.lower()
        if part[0].isdigit() or part[0] == ".":
            return np.asarray(float(part))
        if name in {"x", "x1"}:
            return self._raw
        if part == "(" or (name in _FUNCTIONS and self._next("(")):
            values = [self._sum()]
            if name in _OF_TWO and self._next(","):
                values.append(self._sum())
            if self._next(")") and len(values) == 1 + (name in _OF_TWO):
                return _FUNCTIONS[name](*values) if name in _FUNCTIONS else values[0]
        hint = ": it may be natural or decimal, write ln or log10" if name == "log" else ""
        raise ValueError(f"{part!r} is not known, or out of place{hint}")
