"""A program of vector operations: how it is written, and put into a memory."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray
from fleet_slip.columns.blocks.block_operations import ADD_UP, BLOCK_ROWS, COPY, KEEP, TILE, Region
from fleet_slip.columns.lowering import CarCount, CarFact

Place = tuple[Region, int]
"""A part of the memory, and its number there."""

Value = int | Place
"""What an operation reads: the result of an earlier one, by its number, or a part of the memory."""

MOST_READ = 4
"""So many values an operation reads at most."""

NOWHERE: Place = (Region.CLIPPED, 0)

STRIDE = BLOCK_ROWS + 2 * 8
"""Registers are so many numbers apart: if it were a power of two, the cache would have one place
for all of them."""


@dataclass(frozen=True)
class VectorOperation:
    """One operation; `operations` says what it reads and does."""

    operation: int
    reads: tuple[Value, ...] = ()
    slot: int = 0
    kind: int = 0
    ticks: int = 0
    number: int = 0
    ratio: tuple[float, float, float, float] = (0.0, 1.0, 0.0, np.inf)


@dataclass
class Code:
    """Operations in order, equal ones once, and what they number.

    Attributes:
        signals, told: what the program reads of a drive and its car, with their numbers.
        summed, kept: what is summed up, and what is kept, over a drive.
        kinds: windows of different lengths in ticks.
    """

    operations: list[VectorOperation] = field(default_factory=list)
    signals: dict[str, int] = field(default_factory=dict)
    told: dict[CarFact | CarCount, int] = field(default_factory=dict)
    summed: dict[Value, int] = field(default_factory=dict)
    kept: dict[Value, int] = field(default_factory=dict)
    kinds: dict[int, int] = field(default_factory=dict)
    _known: dict[VectorOperation, int] = field(default_factory=dict)

    def add(self, one: VectorOperation) -> int:
        """Add an operation if there is no equal one; return its number."""
        if one not in self._known:
            self._known[one] = self._append(one)
        return self._known[one]

    def _append(self, one: VectorOperation) -> int:
        self.operations.append(one)
        return len(self.operations) - 1

    def assemble(self, results: Sequence[Value], also: Sequence[Value] = ()) -> "BlockProgram":
        """Return the program with results in the first registers, then `also`, padded to tiles."""
        columns: list[int] = []
        for one in results:
            if isinstance(one, int) and one not in columns:
                columns.append(one)
            else:
                columns.append(self._append(VectorOperation(COPY, (one,))))
        beside = [self._append(VectorOperation(COPY, (one,))) for one in also]
        registers = {value: register for register, value in enumerate(columns)}
        registers |= {value: padded(len(columns)) + i for i, value in enumerate(beside)}
        last = {read: number for number, one in enumerate(self.operations) for read in one.reads}
        count, free = padded(len(columns)) + len(beside), list[int]()
        for number, operation in enumerate(self.operations):
            if number not in registers and operation.operation not in {ADD_UP, KEEP}:
                if not free:
                    free, count = [count], count + 1
                registers[number] = free.pop()
            # Given back after the result has a register: loops do not write what they read.
            ended = {r for r in operation.reads if isinstance(r, int) and last[r] == number}
            free += [registers[read] for read in ended.difference(columns, beside)]
        places = [
            [(Region.REGISTER, registers[number]) if number in registers else NOWHERE]
            + [(Region.REGISTER, registers[r]) if isinstance(r, int) else r for r in one.reads]
            + [NOWHERE] * (MOST_READ - len(one.reads))
            for number, one in enumerate(self.operations)
        ]
        return BlockProgram(self, np.array(places, dtype=np.int64), len(columns), count)


def padded(columns: int) -> int:
    """Return how many columns whole tiles have."""
    return -(-columns // TILE) * TILE


@dataclass(frozen=True)
class BlockProgram:
    """Operations with `places`, (steps, 5, 2): region and number of what each writes and reads.

    The first `columns` of the `registers` are columns.
    """

    code: Code
    places: NDArray[np.int64]
    columns: int
    registers: int

    @cached_property
    def ratios(self) -> FloatArray:
        """The ratio of each step, shape (steps, 4)."""
        return np.array([one.ratio for one in self.code.operations])

    @cached_property
    def signals(self) -> tuple[str, ...]:
        """The signals that it reads, in the order of their numbers."""
        return tuple(self.code.signals)

    @cached_property
    def told(self) -> tuple[CarFact | CarCount, ...]:
        """What it is told of a car, in the order of their numbers."""
        return tuple(self.code.told)

    @property
    def slots(self) -> int:
        """How many values it sums up over a drive."""
        return len(self.code.summed)

    @property
    def kinds(self) -> int:
        """How many windows of different lengths it has."""
        return len(self.code.kinds)

    def regions(self, rows: int) -> NDArray[np.int64]:
        """Return each region's begin and stride for so many rows, and the memory's size last."""
        code = self.code
        shapes = {
            Region.CLIPPED: (1, STRIDE),
            Region.REGISTER: (self.registers, STRIDE),
            Region.TOLD: (len(code.told), 1),
            Region.SIGNAL: (len(code.signals), rows),
            Region.TICK: (1, rows),
            Region.SUM: (len(code.summed), rows + 1),
            Region.COUNT: (len(code.summed), rows + 1),
            Region.VALUE: (len(code.kept), rows),
            Region.BEGIN: (len(code.kinds), rows),
        }
        # Whoever reads what is told as a block must not read beyond the end.
        sizes = [parts * size for parts, size in shapes.values()] + [BLOCK_ROWS]
        begins = np.cumsum([0, *sizes])
        strides = [shapes[region][1] for region in Region] + [0]
        return np.column_stack([begins[: len(strides)], strides])

    def steps(self, rows: int) -> NDArray[np.int64]:
        """Return the table of `operations` for a memory for so many rows."""
        regions = self.regions(rows)
        begins, strides = regions[self.places[..., 0]].transpose(2, 0, 1)
        moves = self.places[..., 0] == Region.SIGNAL
        others = [[one.slot, one.kind, one.ticks, one.number] for one in self.code.operations]
        operations = [[one.operation] for one in self.code.operations]
        return np.hstack([operations, begins + strides * self.places[..., 1], moves, others])
