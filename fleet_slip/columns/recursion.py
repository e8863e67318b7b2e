"""Steps that depend on the tick before, run row by row in int64: an interpreter for the kernel."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleet_slip.catalog.arithmetic import Step
from fleet_slip.compiling import kernel

NAMES = (
    "state", "next", "+", "-", "*", "shift", "nearest", "//", "clip", "min", "max", "negative",
    "abs", "sign", "at_least", "where", "else",
)  # fmt: skip
"""Operations of the interpreter, by number."""

(
    STATE, NEXT, ADD, SUBTRACT, MULTIPLY, SHIFT, NEAREST, DIVIDE, CLIP, LEAST, MOST, NEGATE,
    ABSOLUTE, SIGN, AT_LEAST, WHERE, ELSE,
) = range(len(NAMES))  # fmt: skip


@dataclass(frozen=True)
class Recursion:
    """The recursive steps of a program.

    Attributes
    ----------
    steps
        All steps.
    members
        Numbers of the steps between the states of the tick before and the next ones, in order.
    dependent
        Numbers of all steps that depend on a state.
    """

    steps: Sequence[Step]
    members: tuple[int, ...]
    dependent: frozenset[int]

    @classmethod
    def of_steps(cls, steps: Sequence[Step]) -> "Recursion":
        """Find the steps that depend on a state, and that a next state depends on."""
        after, before = set[int](), set[int]()
        for number, step in enumerate(steps):
            if step.name == "state" or not after.isdisjoint(step.operands):
                after.add(number)
        for number in range(len(steps) - 1, -1, -1):
            if number in before or steps[number].name == "next":
                before |= {number, *steps[number].operands}
        return cls(steps, tuple(sorted(after & before)), frozenset(after))

    @cached_property
    def inputs(self) -> tuple[int, ...]:
        """Numbers of the steps that members read, constants excepted."""
        read = self._read_by(self.members)
        inner = set(self.members)
        return tuple(i for i in read if i not in inner and self.steps[i].name != "constant")

    def _read_by(self, numbers: Iterable[int]) -> dict[int, None]:
        """Return the operands of some steps, each once."""
        return dict.fromkeys(i for number in numbers for i in self.steps[number].operands)

    @cached_property
    def outputs(self) -> tuple[int, ...]:
        """Numbers of the members that other steps read."""
        read = self._read_by(self.dependent.difference(self.members))
        return tuple(i for i in self.members if i in read)

    @cached_property
    def places(self) -> dict[int, int]:
        """Place of each step in the memory of the interpreter: inputs, constants, members."""
        constants = [i for i in self._read_by(self.members) if self.steps[i].name == "constant"]
        order = dict.fromkeys((*self.inputs, *constants, *self.members))
        return {number: place for place, number in enumerate(order)}

    @cached_property
    def code(self) -> NDArray[np.int64]:
        """Operation, place of the result, and places of the operands or a number, by member."""
        rows = []
        for number in self.members:
            step = self.steps[number]
            operands = [self.places[i] for i in step.operands]
            # An operation on one operand reads it twice; a state reads nothing.
            reads = [*operands, *step.plain, *operands][:2] if operands else [0, 0]
            rows.append([NAMES.index(step.name), self.places[number], *reads])
        return np.array(rows, dtype=np.int64).reshape(-1, 4)

    def memory(self) -> NDArray[np.int64]:
        """Return values and presence of all places at the start of a drive, shape (2, places)."""
        memory = np.zeros((2, len(self.places)), dtype=np.int64)
        for number, place in self.places.items():
            if self.steps[number].name == "constant":
                memory[:, place] = self.steps[number].plain[0], 1
            elif self.steps[number].name == "state":
                memory[1, place] = 1
        return memory


@kernel
def run_recursion(  # noqa: PLR0912, PLR0915 - one branch for each operation
    code: Any, words: Any, places: Any, inputs: Any, results: Any
) -> None:
    """Execute the recursive steps for a block of rows.

    Inputs and results are binary64, shape (steps, rows), NaN where missing. `words` is the memory,
    and `places` has the places of the results in it.
    """
    values, present = words[0], words[1]
    for row in range(inputs.shape[1]):
        for number in range(len(inputs)):
            x = inputs[number, row]
            present[number] = 0 if np.isnan(x) else 1
            values[number] = 0 if np.isnan(x) else np.int64(x)
        for step in range(len(code)):
            operation, out, first, second = code[step]
            if operation in (STATE, NEXT):
                continue
            a = values[first]
            if operation == SHIFT:
                half = np.int64(1) << (second - 1)
                value = (a + half) >> second if a >= 0 else -((half - a) >> second)
                values[out], present[out] = value, present[first]
                continue
            b = values[second]
            valid = present[first] & present[second]
            if operation == ADD:
                value = a + b
            elif operation == SUBTRACT:
                value = a - b
            elif operation == MULTIPLY:
                value = a * b
            elif operation == NEAREST:
                valid = valid if b > 0 else 0
                divisor = max(b, 1)
                value = (2 * abs(a) + divisor) // (2 * divisor)
                value = -value if a < 0 else value
            elif operation == DIVIDE:
                valid = valid if b > 0 else 0
                value = abs(a) // max(b, 1)
                value = -value if a < 0 else value
            elif operation == CLIP:
                value = min(max(a, -b), b)
            elif operation == LEAST:
                value = min(a, b)
            elif operation == MOST:
                value = max(a, b)
            elif operation == NEGATE:
                value = -a
            elif operation == ABSOLUTE:
                value = abs(a)
            elif operation == SIGN:
                value = np.int64(1 if a > 0 else (-1 if a < 0 else 0))
            elif operation == AT_LEAST:
                valid = valid if a >= b else 0
                value = a
            elif operation == WHERE:
                value = a
            else:
                value = a if present[first] else b
                valid = present[first] | present[second]
            values[out], present[out] = (value if valid else 0), valid
        for number in range(len(places)):
            place = places[number]
            results[number, row] = values[place] if present[place] == 1 else np.nan
        for step in range(len(code)):
            if code[step, 0] == NEXT:
                values[code[step, 3]] = values[code[step, 2]]
