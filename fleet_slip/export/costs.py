"""Costs of an estimator in a car, counted from its integer program.

The counts are those of the C export at a tick without missing values, which is the maximum. Size of
the code and instructions depend on the compiler: they are estimates for a Cortex-M4, which
`python -m benchmarks.on_board` compares with measurements.
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
"""Size of a coefficient: two words of 32 bits."""


@dataclass(frozen=True)
class Costs(Record):
    """Costs of one estimate.

    Attributes
    ----------
    columns
        Terms of the dot product.
    coefficient_bytes, memory_bytes
        Size of the coefficients, and of the state: ring buffers, sums, numbers of values.
    multiplications, additions, divisions
        Operations of a tick, at most. Subtractions count as additions. Comparisons, shifts,
        absolute values and signs do not count.
    divisions_64
        Divisions that need 64 bits, which small processors lack.
    estimated_code_bytes, estimated_instructions
        Code and constants, and instructions of a tick, on a Cortex-M4; at or above measurements.
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
        """Multiplications, additions and divisions."""
        return self.multiplications + self.additions + self.divisions

    def __str__(self) -> str:
        """Return the text that `show` prints."""
        return (
            f"{pluralize(self.columns, 'column')}: {self.coefficient_bytes:,} bytes of "
            f"coefficients, {pluralize(self.memory_bytes, 'byte')} of memory; "
            f"{self.multiplications} multiplications, {self.additions} additions, "
            f"{self.divisions} divisions an estimate"
        )


def cost_on_board(catalog: Catalog, manifest: Manifest) -> Costs:
    """Count the costs of a published version. Raises as `write_program`."""
    return count_costs(write_program(catalog, manifest))


def count_costs(program: Program) -> Costs:
    """Count the costs of a program at a tick."""
    counts, terms = count_steps(program), len(program.angle.terms)
    total = {
        kind: sum(n * _OPERATIONS.get(name, {}).get(kind, 0) for name, n in counts.items())
        for kind in ("*", "+", "//", "//64")
    }
    return Costs(
        columns=terms,
        coefficient_bytes=COEFFICIENT_BYTES * terms,
        memory_bytes=state_bytes(program),
        multiplications=total["*"],
        additions=total["+"],
        divisions=total["//"],
        divisions_64=total["//64"],
        estimated_code_bytes=_estimate(_CODE_BYTES, counts)
        + (_DIVISION_BYTES if total["//64"] else 0),
        estimated_instructions=_estimate(_INSTRUCTIONS, counts),
    )


def dot_product_operations(terms: int) -> tuple[int, int]:
    """Return the multiplications and additions of a dot product of signals, as `show` counts them.

    A product of a count and a coefficient needs two multiplications of 32 bits.
    """
    term = _OPERATIONS["term"]
    rounding = _OPERATIONS["shift"]["+"] + _OPERATIONS["floor_shift"]["+"]
    return term["*"] * terms, term["+"] * terms + rounding


def describe_costs(version: ModelVersion) -> str:
    """Describe the costs of a version, or the reason why it cannot run on board."""
    try:
        return str(cost_on_board(version.catalog, version.manifest))
    except FleetSlipError as error:
        return f"cannot be exported: {error}"


def costs_content(version: ModelVersion) -> dict[str, Any]:
    """Return the costs of a version for a JSON document, or its `error`."""
    try:
        return cost_on_board(version.catalog, version.manifest).as_dict()
    except FleetSlipError as error:
        return {"error": str(error)}


def count_steps(program: Program) -> Counter[str]:
    """Count the calls of helpers and the operations in the C of a tick."""
    writer = StepWriter(program)
    step_lines(program, writer)
    return writer.counts


_OPERATIONS: Mapping[str, Mapping[str, int]] = {
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
    "shift": {"+": 1},
}
"""Multiplications, additions and divisions of each helper and operation, at most."""

_ARITHMETIC = ("+", "-", "*", "//", "negative", "abs", "sign", "min", "max", "max_64", "clip")
_LONG = ("shift", "min_64", "clip_64")
_WINDOWS = ("ago_16", "ago_32", "slide_32", "slide_64", "keep_16", "keep_32", "gather")
_WIDE = ("//64", "nearest_64", "power")

_Weights = Sequence[tuple[int, Sequence[str]]]

_INSTRUCTIONS: tuple[int, _Weights] = (
    10,
    (
        (5, _ARITHMETIC),
        (10, _WINDOWS),
        (20, _LONG),
        (40, ("nearest_32",)),
        (125, _WIDE),
        (33, ("term",)),
    ),
)
"""Instructions of a tick, and of each operation.

The smallest weights that are about 5 % above the counts of qemu in ticks of the self-test. The code
was compiled by arm-none-eabi-gcc 12 with -Os, for 21 models: one of each kind of column, and models
of 2 to 24 columns.
"""

_CODE_BYTES: tuple[int, _Weights] = (
    95,
    (
        (46, ("within",)),
        (124, ("nearest_32",)),
        (290, _WIDE),
        (46, ("term",)),
        (7, _WINDOWS),
        (20, _LONG),
    ),
)
_DIVISION_BYTES = 920
"""Size of the compiler's division of 64 bits, which is linked once."""


def _estimate(weights: tuple[int, _Weights], counts: Counter[str]) -> int:
    constant, terms = weights
    return constant + sum(weight * counts[name] for weight, names in terms for name in names)
