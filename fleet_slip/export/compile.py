"""Makes the integer program of a published manifest."""

from collections.abc import Hashable
from decimal import Decimal
from typing import TypeVar

from fleet_slip.catalogue.arithmetic import parse
from fleet_slip.catalogue.car_numbers import CAR_NUMBERS
from fleet_slip.catalogue.columns import COUNT_BITS, Definition, Gate, Number, Over, limit_of
from fleet_slip.catalogue.signals import COUNT_MAX, catalogue
from fleet_slip.errors import DataError
from fleet_slip.export.fixed_point import LARGEST_ANGLE, OUTPUT_COUNTS, fixed_point
from fleet_slip.export.program import (
    Angle,
    CarFact,
    CarNumber,
    Column,
    Factor,
    Gated,
    Input,
    Numbered,
    Program,
    Source,
    Window,
)
from fleet_slip.models.counts_model import counts_model
from fleet_slip.models.manifest import Manifest, ModelTerm

Key = TypeVar("Key", bound=Hashable)


def compile_program(manifest: Manifest) -> Program:
    """Return what a published version computes.

    Raises what `write_program` raises, and `QuestionError` or `DataError` for definitions that
    contradict each other.
    """
    from fleet_slip.models.predictor import Predictor  # noqa: PLC0415 - numba, not for show

    Predictor.of(manifest)  # raises for definitions that it could not compute
    return write_program(manifest)


def write_program(manifest: Manifest) -> Program:
    """Return the program of definitions that are known to agree.

    Raises `RefusedError` if counts mean something else now, or no bound of the error can be stated,
    and `DataError` for a feature of no signal.
    """
    builder = _Builder()
    places = [builder.term(term) for term in manifest.terms]
    columns, sources = tuple(builder.columns), builder.sources_with_ticks()
    exact = counts_model(manifest)
    fixed = fixed_point(
        exact.intercept * OUTPUT_COUNTS,
        [one * OUTPUT_COUNTS for one in exact.coefficients],
        [columns[place].largest for place in places],
    )
    label = catalogue()[manifest.label.signal]
    angle = Angle(
        name=manifest.label.signal,
        column=label.column,
        unit=label.unit,
        scale=label.scale / Decimal(OUTPUT_COUNTS),
        bits=fixed.bits,
        low_bits=fixed.low_bits,
        intercept=fixed.intercept,
        terms=tuple(zip(places, fixed.coefficients, strict=True)),
        error=fixed.error,
        largest=fixed.largest,
        limit=LARGEST_ANGLE,
    )
    return Program(
        signals=_inputs(sources),
        facts=tuple(builder.facts),
        numbers=tuple(builder.numbers),
        sources=sources,
        columns=columns,
        angle=angle,
    )


def _inputs(sources: tuple[Source, ...]) -> tuple[Input, ...]:
    used = {
        name
        for one in sources
        for name in (one.arithmetic.inputs if one.arithmetic else (one.name,))
    }
    known = catalogue()
    return tuple(
        Input(name, s.column, s.unit, s.scale, s.min_count, s.max_count)
        for name, s in known.signals.items()
        if name in used
        for s in [known[name]]
    )


class _Builder:
    """Numbers what columns are made of, each once, in an order in which it can be computed."""

    def __init__(self) -> None:
        """Begin with nothing."""
        self.sources: dict[Source, int] = {}
        self.columns: dict[Column, int] = {}
        self.facts: dict[CarFact, int] = {}
        self.numbers: dict[CarNumber, int] = {}

    def term(self, term: ModelTerm) -> int:
        """Add what a term of a model is made of; return the place of its column."""
        if term.definition is not None:
            return self._defined(term.definition)
        source = self._source(term.signal, term.sql, COUNT_BITS)
        return self._window(source, None, 0, 1, 1, COUNT_MAX)

    def sources_with_ticks(self) -> tuple[Source, ...]:
        """Return the sources, with how far columns look back on each."""
        windows = [one for one in self.columns if isinstance(one, Window)]
        return tuple(
            Source(
                one.name,
                one.arithmetic,
                one.limit,
                max((w.ticks for w in windows if w.source == place), default=0),
            )
            for one, place in self.sources.items()
        )

    def _source(self, name: str, sql: str, bits: int) -> Source:
        arithmetic = parse(sql) if sql else None
        if arithmetic is not None and not arithmetic.inputs:
            raise DataError(f"the feature {name} is of no signal. Publish the model again.")
        return Source(name, arithmetic, limit_of(bits) if sql else COUNT_MAX)

    def _defined(self, one: Definition) -> int:
        if one.number is not None:
            return self._numbered(one, one.number)
        if one.gate is not None:
            return self._gated(one, one.gate)
        if one.fact is not None:
            fact = _number(self.facts, CarFact(one.fact.name, one.fact.equals))
            of = self._defined(one.model_copy(update={"fact": None}))
            less = 0 if one.fact.equals is not None else one.fact.less
            ratio = one.fact.ratio
            limit = limit_of(one.bits)
            return self._add(Factor(of, fact, less, ratio.numerator, ratio.denominator, limit))
        source = self._source(one.of, one.sql, one.of_bits)
        ratio, limit = one.ratio, limit_of(one.bits)
        return self._window(source, one.over, one.ticks, ratio.numerator, ratio.denominator, limit)

    def _window(
        self,
        source: Source,
        over: Over | None,
        ticks: int,
        numerator: int,
        denominator: int,
        limit: int,
    ) -> int:
        place = _number(self.sources, source)
        return self._add(Window(place, over, ticks, numerator, denominator, limit, source.limit))

    def _gated(self, one: Definition, gate: Gate) -> int:
        of, by = self._defined(one.ungated), self._defined(gate.by)
        return self._add(Gated(of, by, gate.low, gate.peak, gate.high, self._largest(of)))

    def _numbered(self, one: Definition, number: Number) -> int:
        of = self._defined(one.model_copy(update={"number": None}))
        running = None if number.running is None else self._defined(number.running)
        unit = CAR_NUMBERS[number.name].unit
        place = _number(self.numbers, CarNumber(number.name, unit, number.grain))
        size = COUNT_MAX + abs(number.less)
        if running is not None:
            size = max(size, self._largest(running))
        largest = size if number.alone else size * self._largest(of)
        return self._add(Numbered(of, place, number.less, number.alone, running, largest))

    def _largest(self, place: int) -> int:
        return list(self.columns)[place].largest

    def _add(self, column: Column) -> int:
        return _number(self.columns, column)


def _number(known: dict[Key, int], key: Key) -> int:
    """Return the place of a key, in the order in which they came."""
    return known.setdefault(key, len(known))
