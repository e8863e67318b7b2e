"""What a model costs in a car: columns, bytes of memory, and operations for one estimate.

Counted for an ECU that works on whole counts and shares what columns have in common: a source (a
signal or a feature) is computed once a tick, and kept in one ring buffer as long as its longest
window; every window has a running sum and a number of values. Each estimate is one dot product.
"""

from collections import defaultdict
from collections.abc import Hashable, Iterable
from dataclasses import asdict, dataclass
from typing import Any

from fleet_slip.catalogue.arithmetic import parse
from fleet_slip.catalogue.columns import Definition, limit_of
from fleet_slip.models.manifest import Manifest

COEFFICIENT_BYTES = 8
"""A binary64, as it is published."""

COUNTER_BYTES = 4


@dataclass(frozen=True)
class OnBoard:
    """What one estimate takes.

    Attributes:
        columns: terms of the dot product.
        coefficient_bytes: of the intercept and the coefficients.
        memory_bytes: of ring buffers, running sums and numbers of values.
        multiplications, additions, divisions: for one estimate. Subtractions count as additions;
            comparisons, absolute values and signs do not count, nor does rounding a quotient.
    """

    columns: int
    coefficient_bytes: int
    memory_bytes: int
    multiplications: int
    additions: int
    divisions: int

    @property
    def operations(self) -> int:
        """All of them."""
        return self.multiplications + self.additions + self.divisions

    def as_dict(self) -> dict[str, Any]:
        """Return what a JSON document needs."""
        return {**asdict(self), "operations": self.operations}

    def __str__(self) -> str:
        """Return it as `show` prints it."""
        return (
            f"{self.columns} columns: {self.coefficient_bytes:,} bytes of coefficients, "
            f"{self.memory_bytes:,} bytes of memory; {self.multiplications} multiplications, "
            f"{self.additions} additions, {self.divisions} divisions an estimate"
        )


def cost_on_board(manifest: Manifest) -> OnBoard:
    """Count what a published model costs in a car."""
    windows = set(manifest.definitions.values())
    sources = {one.of: one for one in windows}
    arithmetic = {*manifest.features.values(), *(one.sql for one in sources.values() if one.sql)}
    done = _operations(arithmetic)
    kept: dict[str, int] = defaultdict(int)
    memory = 0
    for one in windows:
        kept[one.of] = max(kept[one.of], one.ticks)
        if one.over in ("mean", "sum", "running_mean"):
            memory += _sum_bytes(one) + COUNTER_BYTES
            done["+"] += 1 if one.over == "running_mean" else 2  # the newest in, the oldest out
        done["*"] += (one.ratio.numerator != 1) + bool(one.fact)
        done["//"] += one.over in ("mean", "running_mean") or one.ratio.denominator != 1
    memory += sum(ticks * _bytes(limit_of(sources[of].of_bits)) for of, ticks in kept.items())
    terms = len(manifest.terms)
    return OnBoard(
        columns=terms,
        coefficient_bytes=COEFFICIENT_BYTES * (terms + 1),
        memory_bytes=memory,
        multiplications=done["*"] + terms,
        additions=done["+"] + terms,
        divisions=done["//"],
    )


def _operations(sql: Iterable[str]) -> dict[str, int]:
    """Count the operations of some expressions, equal parts of all of them once.

    What is made of constants alone is made before.
    """
    steps: dict[Hashable, str] = {}
    for one in map(parse, sql):
        keys: list[Hashable] = []
        constant: list[bool] = []
        for step in one.steps:
            parts = tuple(keys[at] for at in step.operands)
            keys.append((step.function, parts, step.value, step.name))
            constant.append(not step.name and all(constant[at] for at in step.operands))
            if not constant[-1]:
                steps[keys[-1]] = step.function
    done: dict[str, int] = defaultdict(int)
    for function in steps.values():
        done["+" if function == "-" else function] += 1
    return done


def _sum_bytes(one: Definition) -> int:
    """Return the bytes of a running sum; that of all since the start may grow for ever."""
    return _bytes(limit_of(one.of_bits) * one.ticks) if one.ticks else 8


def _bytes(largest: int) -> int:
    """Return the bytes of an integer type that holds a size."""
    return next(size for size in (2, 4, 8) if largest < 2 ** (8 * size - 1))
