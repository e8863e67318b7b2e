"""Features and columns over time of `configs/features.toml`.

A family names its columns and makes them from existing ones.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from decimal import Decimal
from fractions import Fraction
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal

from pydantic import Field, ValidationInfo, model_validator

from fleet_slip.catalog.arithmetic import nearest_sql, parse
from fleet_slip.catalog.calibration_parameters import (
    CALIBRATION_PARAMETERS,
    CalibrationParameterName,
    ColumnUnit,
)
from fleet_slip.catalog.definitions import (
    COUNT_BITS,
    LARGEST_BITS,
    MAX_CHANGE_TICKS,
    AttributeFactor,
    AttributeText,
    Bits,
    Combination,
    Definition,
    Equation,
    Gate,
    Made,
    Over,
    ParameterFactor,
    Product,
    Slope,
    integer_arithmetic,
)
from fleet_slip.catalog.signals import Identifier, Scaled, Signal, SignalCatalog, SIUnit
from fleet_slip.config import Config

# Features of `configs/features.toml` as types: integer functions of the counts of one row.

_DECLARED = re.compile(r"(?:[a-z0-9_+\-*() ]|// [1-9][0-9]*(?![0-9]))+")
"""Expressions permitted in `configs/features.toml`; `divided_by` rounds instead."""

_WORD = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


class Feature(Scaled):
    """One feature. Its count is clipped to its bits: 16 are +-32767."""

    counts: str = Field(min_length=1)
    divided_by: str | None = None
    at_least: int | None = Field(default=None, gt=0)
    bits: Bits = COUNT_BITS
    unit: SIUnit
    column: Identifier
    description: str = Field(min_length=1)

    @model_validator(mode="after")
    def _is_integer_arithmetic(self, info: ValidationInfo) -> "Feature":
        guarded = self.divided_by is not None and not self._divisor_is_number
        if guarded != (self.at_least is not None):
            raise ValueError("at_least is for a divisor that varies, which must have it")
        if self._divisor_is_number and int(self.divided_by or 0) == 0:
            raise ValueError("divided_by is zero")
        # What a manifest takes, and every target computes: see `columns/lowering.py`.
        if not parse(integer_arithmetic(self.sql, info)).inputs:
            raise ValueError("it is of no signal")
        return self

    @cached_property
    def sql(self) -> str:
        """The unclipped count, as SQL over the view `log_counts`."""
        counts = _widened(self.counts)
        if self.divided_by is None:
            return counts
        divisor = _widened(self.divided_by)
        quotient = nearest_sql(counts, divisor)
        if self._divisor_is_number:
            return quotient
        return f"CASE WHEN {divisor} >= {self.at_least} THEN {quotient} END"

    @property
    def _divisor_is_number(self) -> bool:
        return self.divided_by is not None and self.divided_by.isdecimal()

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of its signals."""
        return tuple(parse(self.sql).inputs)


def _widened(text: str) -> str:
    """Return a declared expression over counts with every signal widened to 64 bits."""
    if not _DECLARED.fullmatch(text):
        raise ValueError(f"{text!r} is not integer arithmetic of + - * ( ) and // NUMBER")
    return _WORD.sub(lambda m: m[0] if m[0] in ("abs", "sign") else f"{m[0]}::BIGINT", text)


# Columns over time: windows, products, estimates, slopes, factors, gates and car numbers.


class TimeColumn(Scaled):
    """One column over time: its definition and scale."""

    definition: Definition
    unit: ColumnUnit
    column: Identifier
    description: str


class NotYetMadeError(Exception):
    """A column depends on one that has not been made yet."""


@dataclass
class ColumnSources:
    """Sources of columns: signals, features, and the columns over time made so far.

    `missing` contains the names of columns that have not been made yet.
    """

    signals: SignalCatalog
    features: Mapping[str, Feature]
    over_time: dict[str, TimeColumn] = field(default_factory=dict)
    missing: frozenset[str] = frozenset()

    def find(self, name: str) -> Signal | Feature | TimeColumn:
        """Return an input by name. Raises `ValueError` if unknown, and `NotYetMadeError`."""
        if name in self.missing:
            raise NotYetMadeError
        if column := self.over_time.get(name) or self.features.get(name):
            return column
        if name not in self.signals.feature_inputs:
            raise ValueError(f"{name} is no input signal or feature")
        return self.signals[name]

    def definition(self, name: str) -> Definition:
        """Return the definition of an input. Raises `ValueError` if unknown."""
        column = self.find(name)
        if isinstance(column, TimeColumn):
            return column.definition
        if isinstance(column, Feature):
            return Definition(of=name, sql=column.sql, of_bits=column.bits)
        return Definition(of=name)

    def columns(self, *names: str) -> list[TimeColumn]:
        """Return columns over time. Raises `ValueError` if unknown, and `NotYetMadeError`."""
        if not self.missing.isdisjoint(names):
            raise NotYetMadeError
        if unknown := [name for name in names if name not in self.over_time]:
            raise ValueError(f"{', '.join(unknown)}: no column over time")
        return [self.over_time[name] for name in names]


class ColumnFamily(Config):
    """A table entry that defines columns over time."""

    description: str = Field(min_length=1)

    def names(self, name: str) -> tuple[str, ...]:
        """Return the names of the columns."""
        return (name,)

    def make(self, name: str, columns: ColumnSources) -> dict[str, TimeColumn]:
        """Return the columns by name. Raises `ValueError`, and `NotYetMadeError`."""
        raise NotImplementedError

    def _column(self, definition: Definition, **other: Any) -> TimeColumn:
        """Return a column with the family's attributes, except for `other`."""
        names = ("scale", "unit", "column", "description")
        shared = {name: getattr(self, name) for name in names if name not in other}
        return TimeColumn(definition=definition, **shared, **other)


TICKS = "{ticks}"
"""Placeholder for the number of ticks in the name of a window's column."""


class Window(ColumnFamily):
    """A family of windows over a signal, feature, product or estimate.

    The column of N ticks is called NAME_N; the mean since the start of the drive is called NAME.
    """

    of: Identifier
    over: Over
    ticks: tuple[int, ...] = ()
    scale: Decimal = Field(gt=0)
    bits: Bits = 20
    unit: SIUnit
    column: str = Field(min_length=1, max_length=60)

    @model_validator(mode="after")
    def _ticks_fit(self) -> "Window":
        if (self.over != "running_mean") != bool(self.ticks):
            raise ValueError("ticks is for mean, sum, lag and change, which must have it")
        if len(set(self.ticks)) < len(self.ticks):
            raise ValueError("a number of ticks appears twice")
        if any(not 1 <= n <= MAX_CHANGE_TICKS for n in self.ticks):
            raise ValueError(f"ticks must lie in 1..{MAX_CHANGE_TICKS}")
        if bool(self.ticks) != (TICKS in self.column):
            raise ValueError(f"column must have {TICKS} in it if there are ticks, and only then")
        return self

    def names(self, name: str) -> tuple[str, ...]:
        """Return the name of each length, or that of the mean since the drive began."""
        return tuple(f"{name}_{n}" for n in self.ticks) or (name,)

    def make(self, name: str, columns: ColumnSources) -> dict[str, TimeColumn]:
        """Return a column for each length."""
        row = columns.definition(self.of)
        if self.of in columns.over_time and not (row.made and row.of == self.of):
            raise ValueError(f"{self.of} is no input signal or feature")
        ratio, members = columns.find(self.of).exact_scale / Fraction(self.scale), {}
        for member, ticks in zip(self.names(name), self.ticks or (0,), strict=True):
            definition = Definition(
                of=row.of,
                sql=row.sql,
                made=row.made,
                of_bits=row.of_bits,
                over=self.over,
                ticks=ticks,
                ratio=ratio,
                bits=self.bits,
            )
            members[member] = self._column(
                definition,
                column=self.column.replace(TICKS, str(ticks)),
                description=self.description + (f", over {ticks} ticks" if ticks else ""),
            )
        return members


class Factor(ColumnFamily):
    """A column times a vehicle attribute: a number minus `less`, or 1 if it `equals` a text."""

    of: Identifier
    fact: Identifier
    less: int = 0
    equals: AttributeText | None = None
    scale: Decimal = Field(gt=0)
    unit: SIUnit
    column: Identifier

    def make(self, name: str, columns: ColumnSources) -> dict[str, TimeColumn]:
        """Return the product."""
        base = columns.definition(self.of)
        if base.fact is not None:
            raise ValueError(f"{self.of} has a factor already")
        ratio = columns.find(self.of).exact_scale / Fraction(self.scale)
        fact = AttributeFactor.model_validate(
            {"name": self.fact, "less": self.less, "equals": self.equals, "ratio": ratio},
            context=columns.signals,
        )
        return {name: self._column(base.model_copy(update={"fact": fact}))}


class Calibrated(ColumnFamily):
    """A column times a calibration parameter; `alone`, the parameter itself."""

    of: Identifier
    number: CalibrationParameterName
    less: Decimal = Decimal(0)
    alone: bool = False
    running: Identifier | None = None
    column: Identifier

    def make(self, name: str, columns: ColumnSources) -> dict[str, TimeColumn]:
        """Return the column times a number.

        Raises `ValueError` if `running` has another grain than the number, or `less` is between
        counts.
        """
        base, source, number = (
            columns.definition(self.of),
            columns.find(self.of),
            CALIBRATION_PARAMETERS[self.number],
        )
        if isinstance(source, Feature):  # the count itself, as it stands in the rows
            base = base.model_copy(update={"bits": base.of_bits})
        if base.number is not None:
            raise ValueError(f"{self.of} has a number already")
        running = columns.columns(self.running)[0] if self.running else None
        if running is not None and running.scale != number.grain:
            raise ValueError(
                f"{self.running} has the scale {running.scale}, {self.number} {number.grain}"
            )
        less = Fraction(self.less) / Fraction(number.grain)
        if less.denominator != 1:
            raise ValueError(f"less is no multiple of {number.grain}")
        factor = ParameterFactor(
            name=self.number,
            grain=number.grain,
            less=int(less),
            alone=self.alone,
            running=running.definition if running else None,
        )
        units = [] if number.unit == "1" else [number.unit]
        column = self._column(
            base.model_copy(update={"number": factor}),
            scale=number.grain if self.alone else number.grain * source.scale,
            unit="*".join(units if self.alone else [*units, source.unit]) or "1",
        )
        return {name: column}


class MadeColumn(ColumnFamily):
    """A composite of other columns."""

    scale: Decimal = Field(gt=0)
    unit: SIUnit
    column: Identifier

    def _single(
        self, name: str, composite: Made, bits: int = LARGEST_BITS
    ) -> dict[str, TimeColumn]:
        return {name: self._column(Definition(of=name, made=composite, of_bits=bits, bits=bits))}


class EstimateColumn(MadeColumn):
    """The estimate of a first-stage model, which the `line` of a model list names."""

    unit: Literal["rad"] = "rad"

    def make(self, name: str, columns: ColumnSources) -> dict[str, TimeColumn]:  # noqa: ARG002
        """Return the estimate of a model that has not been fitted."""
        return self._single(name, Combination(line=""))


class ProductColumn(MadeColumn):
    """The product of two columns, signals or features; of none, 1."""

    of: tuple[Identifier, ...] = Field(max_length=2)
    bits: Bits = 20

    def make(self, name: str, columns: ColumnSources) -> dict[str, TimeColumn]:
        """Return the product."""
        factors = tuple(map(columns.definition, self.of))
        scale = math.prod(
            (columns.find(factor).exact_scale for factor in self.of), start=Fraction(1)
        )
        return self._single(
            name, Product(of=factors, ratio=scale / Fraction(self.scale)), self.bits
        )


class EquationColumns(Config):
    """An equation of a slope: `y`, a sum of columns, is the slope times `of` plus noise.

    Further terms are unknowns times the columns `beside`; an integer is a constant column. The
    equation has a `weight` of at most 1.
    """

    y: dict[Identifier, Literal[-1, 1]] = Field(min_length=1)
    of: Identifier
    beside: tuple[Identifier | int, ...] = ()
    weight: Decimal = Decimal(1)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its columns."""
        return (*self.y, self.of, *(column for column in self.beside if isinstance(column, str)))


class SlopeColumn(MadeColumn):
    """The first unknown of equations, by ridge regression over the drive so far."""

    equations: tuple[EquationColumns, ...] = Field(min_length=1)
    ridge: tuple[int, ...] = Field(min_length=1)

    def make(self, name: str, sources: ColumnSources) -> dict[str, TimeColumn]:
        """Return a slope. Raises `ValueError` if a scale of its equations does not fit others."""
        equations, values = [], set()
        for number, equation in enumerate(self.equations, 1):
            sources.columns(*equation.names)
            columns = sources.over_time
            of_y = {columns[name_y].exact_scale for name_y in equation.y}
            if len(of_y) > 1:
                raise ValueError(f"{', '.join(equation.y)} differ in scale")
            terms = tuple((sign, columns[name_y].definition) for name_y, sign in equation.y.items())
            y = Definition(
                of=f"{name}_{number}",
                made=Combination(terms=terms),
                of_bits=COUNT_BITS,
                bits=COUNT_BITS,
            )
            x = (equation.of, *equation.beside)
            factors = tuple(
                columns[regressor].definition if isinstance(regressor, str) else regressor
                for regressor in x
            )
            equations.append(Equation(y=y, x=factors, weight=Fraction(equation.weight)))
            values.add(of_y.pop() / columns[equation.of].exact_scale)
        if len(values) > 1:
            raise ValueError(
                "the scales of y and `regressor` have another ratio from one equation to the next"
            )
        ratio = values.pop() / Fraction(self.scale)
        return self._single(name, Slope(equations=tuple(equations), ridge=self.ridge, ratio=ratio))


class GateFamily(ColumnFamily):
    """Columns of a gate, which blends linear models: one for each knot except the first.

    At a knot one model holds; between two knots both are mixed linearly. Weights add up to one, so
    a model contains the columns themselves and, for each further knot, the change there. The column
    of a knot is called COLUMN_NAME_K, K from 1.
    """

    of: Identifier
    """The column over time that determines the weights."""
    knots: tuple[Decimal, ...] = Field(min_length=2, max_length=20)
    """Physical values of it, increasing; the outermost models hold beyond the ends."""
    columns: tuple[Identifier, ...] = Field(min_length=1)
    """Columns over time that are gated."""

    @model_validator(mode="after")
    def _knots_rise(self) -> "GateFamily":
        if any(high <= low for low, high in pairwise(self.knots)):
            raise ValueError("the knots of a gate must increase")
        if len(set(self.columns)) < len(self.columns):
            raise ValueError("a column appears twice")
        return self

    def names(self, name: str) -> tuple[str, ...]:
        """Return the names of the columns of each knot."""
        knots = range(1, len(self.knots))
        return tuple(f"{column}_{name}_{knot}" for knot in knots for column in self.columns)

    def make(self, name: str, sources: ColumnSources) -> dict[str, TimeColumn]:
        """Return the columns of each knot."""
        by, *bases = sources.columns(self.of, *self.columns)
        counts = [round(Fraction(knot) / by.exact_scale) for knot in self.knots]
        members = []
        for knot, peak in enumerate(counts[1:], 1):
            high = counts[knot + 1] if knot + 1 < len(counts) else None
            gate = Gate(by=by.definition, low=counts[knot - 1], peak=peak, high=high)
            suffix = f", where {self.of} is near {self.knots[knot]:f}"
            for base in bases:
                changed = {
                    "definition": base.definition.model_copy(update={"gate": gate}),
                    "column": f"{base.column}_{name}_{knot}",
                    "description": base.description + suffix,
                }
                members.append(base.model_copy(update=changed))
        return dict(zip(self.names(name), members, strict=True))
