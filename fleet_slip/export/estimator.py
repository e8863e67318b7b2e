"""A published version tick by tick, for test benches: `Fleet.estimator`."""

import struct
from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from operator import itemgetter
from typing import Any

import numpy as np

from fleet_slip.arrays import FloatArray, IntArray
from fleet_slip.catalogue.car_numbers import round_number
from fleet_slip.columns.operations import operands_of, operation_of, plain_of, size_of
from fleet_slip.errors import InputError
from fleet_slip.export import stepping as do
from fleet_slip.export.compile import compile_program
from fleet_slip.export.program import Car, Program
from fleet_slip.models.manifest import Manifest


class Estimator:
    """Estimates the side-slip angle of a drive, a sample at a time.

    Attributes:
        columns: names in SI units that a sample has.
    """

    def __init__(self, manifest: Manifest, car: Mapping[str, Any] | None = None) -> None:
        """Take a version, and what is known of the car: facts, and numbers in SI units, by name.

        Raises `InputError` for what the version does not use, and what `compile_program` raises.
        """
        program = compile_program(manifest)
        layout = _Layout(program, manifest, _known(manifest, program, car or {}))
        self.columns = tuple(one.column for one in program.signals)
        self._name = manifest.name
        self._ticks = program.longest_ticks
        self._begin, self._steps = layout.memory(), layout.rows()
        self._values = layout.values()
        self._intercept = manifest.intercept
        self._memory = self._begin.copy()
        self._given = self._values.data
        self._pack = struct.Struct(f"{len(self.columns)}d").pack_into
        self._chosen = itemgetter(*self.columns)
        self._single = len(self.columns) == 1

    def step(self, sample: Mapping[str, float | None]) -> float | None:
        """Return the angle of the next tick in rad; None if there is none.

        A sample has the columns of `columns` in SI units, None where a value is missing, as one
        that is beyond its valid range is; others are left alone. They are rounded to counts, half
        to even, as the sensors do. The angles of a drive have the bits that `predict` computes.

        Raises `InputError` if the sample lacks a column.
        """
        try:
            found = self._chosen(sample)
            self._pack(self._given, 0, *((found,) if self._single else found))
        except (KeyError, struct.error):
            self._pack(self._given, 0, *self._complete(sample))
        angle: float = do.run_tick(self._steps, self._memory, self._values, self._intercept)
        return None if angle != angle else angle  # noqa: PLR0124 - NaN

    def skip(self, ticks: int = 1) -> None:
        """Take ticks that were not logged."""
        nothing = dict.fromkeys(self.columns)
        for _ in range(min(ticks, self._ticks + 1)):  # then nothing is left of before
            self.step(nothing)

    def restart(self) -> None:
        """Begin another drive of the same car."""
        self._memory[:] = self._begin

    def _complete(self, sample: Mapping[str, float | None]) -> list[float]:
        """Return the values of a sample, NaN where missing."""
        if missing := [name for name in self.columns if name not in sample]:
            raise InputError(f"{self._name} needs {', '.join(missing)} in every sample.")
        values = [sample[name] for name in self.columns]
        try:
            return [np.nan if value is None else float(value) for value in values]
        except (TypeError, ValueError):
            raise InputError(f"{self._name}: a sample has what is no number.") from None


def _known(manifest: Manifest, program: Program, given: Mapping[str, Any]) -> Car:
    """Return a car: numbers in counts."""
    numbers = {one.name: one for one in program.numbers}
    used = {*numbers, *(one.name for one in program.facts)}
    if unknown := sorted({*given} - used):
        raise InputError(
            f"{manifest.name} does not use {', '.join(unknown)} of a car. It uses: "
            f"{', '.join(sorted(used)) or 'nothing'}."
        )
    counts = {
        name: count
        for name, one in numbers.items()
        if given.get(name) is not None
        and (count := round_number(_fraction(given[name]), _fraction(str(one.grain)))) is not None
    }
    return Car({name: value for name, value in given.items() if name not in numbers}, counts)


def _fraction(value: Any) -> Fraction:
    try:
        return Fraction(value)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{value!r} is no number of a car.") from None


class _Layout:
    """Where everything of a program lies in memory, and the rows of its steps.

    The value of a step lies at its number.
    """

    def __init__(self, program: Program, manifest: Manifest, car: Car) -> None:
        """Take a program and a car."""
        self._program, self._manifest = program, manifest
        self._begin: list[int] = []
        told = {"fact": car.fact_counts(program), "number": car.number_counts(program)}
        for step in program.steps:
            name, (first, *_) = operation_of(step), plain_of(step)
            constant = first if name == "constant" else told[name][first] if name in told else None
            self._keep((0 if name in ("sum", "values") else constant,))
        self._rings = {
            of: (self._keep((None,) * ticks), ticks, self._keep((0,)))
            for of, ticks in program.rings.items()
        }
        self._rows = list(self._written())

    def memory(self) -> IntArray:
        """Return memory at the beginning of a drive."""
        return np.array(self._begin, dtype=np.int64)

    def rows(self) -> IntArray:
        """Return the rows of all steps, in order."""
        table = np.zeros((len(self._rows), do.ROW), dtype=np.int64)
        for number, row in enumerate(self._rows):
            table[number, : len(row)] = row
        return table

    def values(self) -> FloatArray:
        """Return room for a sample, the scales of signals, coefficients, and scales of terms."""
        signals, terms = self._program.signals, self._manifest.terms
        scales = [float(one.scale) for one in signals]
        coefficients = [term.coefficient for term in terms]
        known = {one.name: float(one.scale) for one in signals}
        worth = [known[t.signal] if t.logged else float(t.scale) for t in terms]
        return np.array([np.nan] * len(signals) + scales + coefficients + worth)

    def _keep(self, values: Sequence[int | None]) -> int:
        place = len(self._begin)
        self._begin += [do.MISSING if one is None else one for one in values]
        return place

    def _written(self) -> Iterator[tuple[int, ...]]:
        signals, terms = self._program.signals, self._program.angle.terms
        slid: set[tuple[int, ...]] = set()
        at = list(range(len(self._program.steps)))
        for place, step in enumerate(self._program.steps):
            name, plain = operation_of(step), plain_of(step)
            operands = [at[one] for one in operands_of(step)]
            if self._changes_nothing(name, plain):
                at[place] = operands[0]
            elif name == "signal":
                one = signals[plain[0]]
                scale = len(signals) + plain[0]
                yield (do.SIGNAL, place, plain[0], scale, one.min_count, one.max_count)
            elif name == "ago":
                yield (do.AGO, place, operands[0], *self._rings[plain[0]], plain[1])
            elif name in ("sum", "values"):
                if plain not in slid:
                    yield self._slide(operands[0], *plain)
                slid.add(plain)
            elif name not in ("constant", "fact", "number"):
                yield (do.CODES[name], place, operands[0], operands[-1])
        for of, ring in self._rings.items():
            if ring[1]:
                yield (do.KEEP, 0, at[of], *ring)
        first = 2 * len(signals)
        for i, (column, _) in enumerate(terms):
            yield (do.TERM, 0, at[column], first + i, first + len(terms) + i)

    def _changes_nothing(self, name: str, plain: tuple[int, ...]) -> bool:
        """Whether a step is always what it works on first: it takes no time then."""
        ranges = self._program.ranges
        if name == "clip":
            return size_of(ranges[plain[0]]) <= ranges[plain[1]][1]
        return name in ("nearest", "//") and ranges[plain[1]] == (1, 1)

    def _slide(self, at: int, of: int, ticks: int, most: int) -> tuple[int, ...]:
        """Return what brings a sum and its number of values to this tick."""
        known = {step: place for place, step in enumerate(self._program.steps)}
        both = [known.get((name, of, ticks, most)) for name in ("sum", "values")]
        total, count = (self._keep((0,)) if one is None else one for one in both)
        ring = self._rings[of] if ticks else (0, 0, 0)
        return (do.SLIDE, total, at, *ring, ticks or most, count)
