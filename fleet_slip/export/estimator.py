"""A published version tick by tick, for test benches: `Fleet.estimator`."""

import struct
from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from operator import itemgetter
from typing import Any

import numpy as np

from fleet_slip.arrays import FloatArray, IntArray
from fleet_slip.catalogue.car_numbers import round_number
from fleet_slip.errors import InputError
from fleet_slip.export import stepping as do
from fleet_slip.export.c_columns import sum_key, summed
from fleet_slip.export.compile import compile_program
from fleet_slip.export.program import Car, Factor, Gated, Numbered, Program, Source, Window
from fleet_slip.models.manifest import Manifest

_OPERATIONS = {
    "+": do.ADD,
    "-": do.SUBTRACT,
    "*": do.MULTIPLY,
    "//": do.DIVIDE,
    "negative": do.NEGATIVE,
    "abs": do.ABSOLUTE,
    "sign": do.SIGN,
}


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
        self._begin, self._steps = layout.memory(), layout.steps()
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
        that is not finite is; others are left alone. They are rounded to counts, half to even, and
        clipped to their valid range, as the sensors do. The angles of a drive have the bits that
        `predict` computes.

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
        name: round_number(_fraction(given[name]), _fraction(str(one.grain)))
        for name, one in numbers.items()
        if given.get(name) is not None
    }
    return Car({name: value for name, value in given.items() if name not in numbers}, counts)


def _fraction(value: Any) -> Fraction:
    try:
        return Fraction(value)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{value!r} is no number of a car.") from None


class _Layout:
    """Where everything of a program lies in memory, and the rows of its operations."""

    def __init__(self, program: Program, manifest: Manifest, car: Car) -> None:
        """Take a program and a car."""
        self._program, self._manifest = program, manifest
        self._begin: list[int] = []
        signals = self._room(len(program.signals))
        self._signals = {one.name: signals + i for i, one in enumerate(program.signals)}
        self._facts = self._keep(car.fact_counts(program))
        self._numbers = self._keep(car.number_counts(program))
        self._sources = self._room(len(program.sources))
        self._columns = self._room(len(program.columns))
        self._sums = {key: self._keep((0, 0)) for key in summed(program)}
        self._ats = self._keep((0,) * len(program.sources))
        self._rings = [self._room(one.ticks) for one in program.sources]
        self._rows = [row for part in self._parts() for row in part]

    def memory(self) -> IntArray:
        """Return memory at the beginning of a drive."""
        return np.array(self._begin, dtype=np.int64)

    def steps(self) -> IntArray:
        """Return the rows of all operations, in order."""
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

    def _room(self, size: int) -> int:
        return self._keep((None,) * size)

    def _keep(self, values: Sequence[int | None]) -> int:
        place = len(self._begin)
        self._begin += [do.MISSING if one is None else one for one in values]
        return place

    def _parts(self) -> Iterator[list[tuple[int, ...]]]:
        signals = self._program.signals
        yield [
            (do.SIGNAL, self._signals[s.name], i, len(signals) + i, s.min_count, s.max_count)
            for i, s in enumerate(signals)
        ]
        for place, one in enumerate(self._program.sources):
            yield self._source(place, one)
        yield [self._slide(key, one) for key, (_, one) in summed(self._program).items()]
        for place in range(len(self._program.columns)):
            yield [self._column(place)]
        yield [
            (do.KEEP, 0, self._sources + i, self._rings[i], one.ticks, 0, self._ats + i)
            for i, one in enumerate(self._program.sources)
            if one.ticks
        ]
        first, terms = 2 * len(signals), self._program.angle.terms
        yield [
            (do.TERM, 0, self._columns + place, first + i, first + len(terms) + i)
            for i, (place, _) in enumerate(terms)
        ]

    def _source(self, place: int, one: Source) -> list[tuple[int, ...]]:
        out = self._sources + place
        if one.arithmetic is None:
            return [(do.SOURCE, out, self._signals[one.name], -1, 0, one.limit)]
        rows: list[tuple[int, ...]] = []
        places: list[int] = []
        for step in one.arithmetic.steps:
            if step.name:
                places.append(self._signals[step.name])
            elif not step.function:
                places.append(self._keep((step.value,)))
            else:
                places.append(self._room(1))
                a, b = places[step.operands[0]], places[step.operands[-1]]
                rows.append((_OPERATIONS[step.function], places[-1], a, b))
        guard = -1 if one.arithmetic.guard is None else places[one.arithmetic.guard]
        last = (do.SOURCE, out, places[-1], guard, one.arithmetic.at_least, one.limit)
        return [*rows, last]

    def _slide(self, key: str, one: Window) -> tuple[int, ...]:
        source, sums = self._sources + one.source, self._sums[key]
        if one.over == "running_mean":
            return (do.GATHER, sums, source, one.most_values)
        length = self._program.sources[one.source].ticks
        at = self._ats + one.source
        return (do.SLIDE, sums, source, self._rings[one.source], length, one.ticks, at)

    def _column(self, place: int) -> tuple[int, ...]:
        column, out = self._program.columns[place], self._columns + place
        match column:
            case Window():
                return self._window(place, column, out)
            case Factor():
                ratio = (column.numerator, column.denominator, column.limit)
                of, fact = self._columns + column.of, self._facts + column.fact
                return (do.FACTOR, out, of, *ratio, fact, column.less)
            case Gated():
                high = do.MISSING if column.high is None else column.high
                of, by = self._columns + column.of, self._columns + column.by
                return (do.GATE, out, of, by, column.low, column.peak, high)
            case Numbered():
                running = -1 if column.running is None else self._columns + column.running
                number = self._numbers + column.number
                of = self._columns + column.of
                return (do.NUMBER, out, of, running, column.alone, 0, number, column.less)

    def _window(self, place: int, one: Window, out: int) -> tuple[int, ...]:
        source = self._sources + one.source
        ratio = (one.numerator, one.denominator, one.limit)
        if one.over is None:
            return (do.VALUE, out, source, *ratio)
        if one.over == "lag":
            length = self._program.sources[one.source].ticks
            at = self._ats + one.source
            return (do.LAG, out, self._rings[one.source], *ratio, length, at, one.ticks)
        kind = do.SUM if one.over == "sum" else do.MEAN
        return (kind, out, source, *ratio, self._sums[sum_key(place, one)])
