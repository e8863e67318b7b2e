"""What an estimator costs in a car, counted from the integer program that every export writes.

Counted is what the C export does at a tick at which nothing is missing: the most that a tick can
take. Of the size of its code and the instructions of a step, which a compiler decides, there is an
estimate for a Cortex-M4; `python -m benchmarks.on_board` measures both.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fleet_slip.base import Record, pluralize
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.errors import FleetSlipError
from fleet_slip.export.c import StepWriter, state_bytes, step_lines
from fleet_slip.export.program import Program, write_program
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.registry import ModelVersion

COEFFICIENT_BYTES = 8
"""Two words of 32 bits."""


@dataclass(frozen=True)
class Costs(Record):
    """What one estimate takes.

    Attributes:
        columns: terms of the dot product.
        coefficient_bytes: of the table of coefficients.
        memory_bytes: of the state: ring buffers, running sums, numbers of values.
        multiplications, additions, divisions: of a tick, at most. Subtractions count as additions;
            comparisons, shifts, absolute values and signs do not count.
        divisions_64: those of the divisions that need 64 bits, which small processors lack.
        estimated_code_bytes, estimated_instructions: on a Cortex-M4, of code and constants with the
            compiler's divisions of 64 bits, and of a tick; at or above what was measured.
    """

    DOCUMENT = "... operations"

    columns: int
    coefficient_bytes: int
    memory_bytes: int
    multiplications: int
    additions: int
    divisions: int
    divisions_64: int
    estimated_code_bytes: int
    estimated_instructions: int

    @property
    def operations(self) -> int:
        """All of them."""
        return self.multiplications + self.additions + self.divisions

    def __str__(self) -> str:
        """Return it as `show` prints it."""
        return (
            f"{pluralize(self.columns, 'column')}: {self.coefficient_bytes:,} bytes of "
            f"coefficients, {pluralize(self.memory_bytes, 'byte')} of memory; "
            f"{self.multiplications} multiplications, {self.additions} additions, "
            f"{self.divisions} divisions an estimate"
        )


def cost_on_board(catalog: Catalog, manifest: Manifest) -> Costs:
    """Count what a published version costs. Raises what `write_program` raises."""
    return count_costs(write_program(catalog, manifest))


def count_costs(program: Program) -> Costs:
    """Count what a program costs at a tick."""
    done, terms = count_steps(program), len(program.angle.terms)
    parts = {
        kind: sum(number * _PARTS.get(one, {}).get(kind, 0) for one, number in done.items())
        for kind in ("*", "+", "//", "//64")
    }
    return Costs(
        columns=terms,
        coefficient_bytes=COEFFICIENT_BYTES * terms,
        memory_bytes=state_bytes(program),
        multiplications=parts["*"],
        additions=parts["+"],
        divisions=parts["//"],
        divisions_64=parts["//64"],
        estimated_code_bytes=_estimate(_CODE_BYTES, done)
        + (_DIVISION_BYTES if parts["//64"] else 0),
        estimated_instructions=_estimate(_INSTRUCTIONS, done),
    )


def describe_costs(version: ModelVersion) -> str:
    """Return what a version costs in words; or why it cannot run on board."""
    try:
        return str(cost_on_board(version.catalog, version.manifest))
    except FleetSlipError as error:
        return f"cannot be exported: {error}"


def costs_content(version: ModelVersion) -> dict[str, Any]:
    """Return the same for a JSON document: what it costs, or `error`."""
    try:
        return cost_on_board(version.catalog, version.manifest).as_dict()
    except FleetSlipError as error:
        return {"error": str(error)}


def count_steps(program: Program) -> Counter[str]:
    """Return how often the C of a tick calls each helper and does each operation of a feature."""
    writer = StepWriter(program)
    step_lines(program, writer)
    return writer.done


_PARTS: Mapping[str, Mapping[str, int]] = {
    "*": {"*": 1},
    "+": {"+": 1},
    "-": {"+": 1},
    "negative": {"+": 1},
    "//": {"//": 1},
    "//64": {"//": 1, "//64": 1},
    "nearest_32": {"*": 2, "+": 1, "//": 1},
    "nearest_64": {"*": 2, "+": 1, "//": 1, "//64": 1},
    "ago_16": {"+": 2},
    "ago_32": {"+": 2},
    "slide_32": {"+": 4},
    "slide_64": {"+": 4},
    "gather": {"+": 2},
    "keep_16": {"+": 1},
    "keep_32": {"+": 1},
    "term": {"*": 2, "+": 2},
    "floor_shift": {"+": 1},
}
"""What each of them is made of, at most."""

_ARITHMETIC = ("+", "-", "*", "//", "negative", "abs", "sign", "min", "max", "max_64", "clip")
_WINDOWS = ("ago_16", "ago_32", "slide_32", "slide_64", "keep_16", "keep_32", "gather")
_WIDE = ("//64", "nearest_64", "power")

_Weights = Sequence[tuple[int, Sequence[str]]]

_INSTRUCTIONS: tuple[int, _Weights] = (
    10,
    (
        (5, _ARITHMETIC),
        (10, _WINDOWS),
        (40, ("nearest_32",)),
        (125, _WIDE),
        (33, ("term",)),
    ),
)
"""Of a tick, and of each of these parts.

The least that are some 5 % above what qemu counted, in ticks of the self-test, for code of
arm-none-eabi-gcc 12 with -Os, of 21 models: of each kind of column alone, and of 2 to 24 columns.
"""

_CODE_BYTES: tuple[int, _Weights] = (
    95,
    (
        (46, ("within",)),
        (124, ("nearest_32",)),
        (290, _WIDE),
        (46, ("term",)),
        (7, _WINDOWS),
    ),
)
_DIVISION_BYTES = 920
"""Of the compiler's own division of 64 bits, which is there once."""


def _estimate(weights: tuple[int, _Weights], done: Counter[str]) -> int:
    least, parts = weights
    return least + sum(weight * done[name] for weight, names in parts for name in names)
