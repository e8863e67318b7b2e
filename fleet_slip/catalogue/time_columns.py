"""Columns over time of `configs/features.toml`: windows, factors, gates and car numbers."""

import math
import re
from collections.abc import Mapping, Sequence
from decimal import Decimal
from fractions import Fraction
from functools import cached_property
from itertools import pairwise
from typing import Literal

from pydantic import Field, model_validator

from fleet_slip.catalogue.arithmetic import nearest_sql, parse
from fleet_slip.catalogue.definitions import (
    COUNT_BITS,
    LARGEST_BITS,
    LONGEST_TICKS,
    Bits,
    Combination,
    Definition,
    Equation,
    Fact,
    FactText,
    Gate,
    Number,
    Over,
    Product,
    Slope,
    integer_arithmetic,
)
from fleet_slip.catalogue.facts import CAR_NUMBERS, NumberName, Unit
from fleet_slip.catalogue.signals import Identifier, Scaled, SIUnit, catalogue
from fleet_slip.config import Config

TICKS = "{ticks}"
"""In the column of a family of windows: the number of ticks of each."""


class Window(Config):
    """A family of columns that look back on a signal, feature, product or estimate: one of N ticks.

    The column of N ticks is called NAME_N; the mean since the drive began is called NAME.
    """

    of: Identifier
    over: Over
    ticks: tuple[int, ...] = ()
    scale: Decimal = Field(gt=0)
    bits: Bits = 20
    unit: SIUnit
    column: str = Field(min_length=1, max_length=60)
    description: str = Field(min_length=1)

    @model_validator(mode="after")
    def _ticks_fit(self) -> "Window":
        if (self.over != "running_mean") != bool(self.ticks):
            raise ValueError("ticks is for mean, sum, lag and change, which must have it")
        if len(set(self.ticks)) < len(self.ticks):
            raise ValueError("a number of ticks stands twice")
        if any(not 1 <= n <= LONGEST_TICKS for n in self.ticks):
            raise ValueError(f"ticks must lie in 1..{LONGEST_TICKS}")
        if bool(self.ticks) != (TICKS in self.column):
            raise ValueError(f"column must have {TICKS} in it if there are ticks, and only then")
        return self

    def members(self, name: str) -> dict[str, int]:
        """Return the names of the family's columns, and the ticks of each."""
        return {f"{name}_{n}": n for n in self.ticks} or {name: 0}


class Factor(Config):
    """A column times what a car knows of itself: a number less `less`, or whether it `equals`."""

    of: Identifier
    fact: Identifier
    less: int = 0
    equals: FactText | None = None
    scale: Decimal = Field(gt=0)
    unit: SIUnit
    column: Identifier
    description: str = Field(min_length=1)


class Calibrated(Config):
    """A column times a number that the car's own drives tell; `alone`, the number by itself."""

    of: Identifier
    number: NumberName
    less: Decimal = Decimal(0)
    alone: bool = False
    running: Identifier | None = None
    column: Identifier
    description: str = Field(min_length=1)


class EstimateColumn(Config):
    """The estimate of a line that is fitted before, by the `line` of a model list."""

    scale: Decimal = Field(gt=0)
    column: Identifier
    description: str = Field(min_length=1)


class ProductColumn(Config):
    """The product of two columns, signals or features; of none, 1."""

    of: tuple[Identifier, ...] = Field(max_length=2)
    scale: Decimal = Field(gt=0)
    bits: Bits = 20
    unit: SIUnit
    column: Identifier
    description: str = Field(min_length=1)


class EquationColumns(Config):
    """What tells a slope: `y`, a sum of columns, is the slope times `of`, but for noise.

    Other unknowns times the columns `beside` come to it; a whole number there is a column that is
    always the same. It counts with a `weight`, at most 1.
    """

    y: dict[Identifier, Literal[-1, 1]] = Field(min_length=1)
    of: Identifier
    beside: tuple[Identifier | int, ...] = ()
    weight: Decimal = Decimal(1)

    @property
    def names(self) -> tuple[str, ...]:
        """The columns in it."""
        return (*self.y, self.of, *(one for one in self.beside if isinstance(one, str)))


class SlopeColumn(Config):
    """The first unknown of equations, by ridge regression over the drive so far."""

    equations: tuple[EquationColumns, ...] = Field(min_length=1)
    ridge: tuple[int, ...] = Field(min_length=1)
    scale: Decimal = Field(gt=0)
    unit: SIUnit
    column: Identifier
    description: str = Field(min_length=1)


class TimeColumn(Scaled):
    """One column over time: how it is defined, and what a count of it is worth."""

    definition: Definition
    unit: Unit
    column: Identifier
    description: str


def window_column(window: Window, ticks: int, row: Definition, scale: Fraction) -> TimeColumn:
    """Return a member of a family, given what it looks back on and that one's scale."""
    definition = Definition(
        of=row.of,
        sql=row.sql,
        made=row.made,
        of_bits=row.of_bits,
        over=window.over,
        ticks=ticks,
        ratio=scale / Fraction(window.scale),
        bits=window.bits,
    )
    return TimeColumn(
        definition=definition,
        scale=window.scale,
        unit=window.unit,
        column=window.column.replace(TICKS, str(ticks)),
        description=window.description + (f", over {ticks} ticks" if ticks else ""),
    )


def _made_column(
    name: str,
    one: EstimateColumn | ProductColumn | SlopeColumn,
    made: Combination | Product | Slope,
) -> TimeColumn:
    """Return what is made of other columns as a column of its own."""
    bits = one.bits if isinstance(one, ProductColumn) else LARGEST_BITS
    return TimeColumn(
        definition=Definition(of=name, made=made, of_bits=bits, bits=bits),
        scale=one.scale,
        unit="rad" if isinstance(one, EstimateColumn) else one.unit,
        column=one.column,
        description=one.description,
    )


def estimate_column(name: str, one: EstimateColumn) -> TimeColumn:
    """Return the estimate of a line that has not been fitted."""
    return _made_column(name, one, Combination(line=""))


def product_column(
    name: str, one: ProductColumn, factors: Sequence[tuple[Definition, Fraction]]
) -> TimeColumn:
    """Return a product, given each factor and its scale."""
    scale = math.prod((scale for _, scale in factors), start=Fraction(1))
    ratio = scale / Fraction(one.scale)
    return _made_column(name, one, Product(of=tuple(of for of, _ in factors), ratio=ratio))


def slope_column(name: str, one: SlopeColumn, known: Mapping[str, TimeColumn]) -> TimeColumn:
    """Return a slope. Raises `ValueError` if a scale of its equations does not fit the others."""
    equations, values = [], set()
    for number, equation in enumerate(one.equations, 1):
        of_y = {known[column].exact_scale for column in equation.y}
        if len(of_y) > 1:
            raise ValueError(f"{', '.join(equation.y)} differ in scale")
        terms = tuple((sign, known[column].definition) for column, sign in equation.y.items())
        y = Definition(
            of=f"{name}_{number}",
            made=Combination(terms=terms),
            of_bits=COUNT_BITS,
            bits=COUNT_BITS,
        )
        x = (equation.of, *equation.beside)
        columns = tuple(known[of].definition if isinstance(of, str) else of for of in x)
        equations.append(Equation(y=y, x=columns, weight=Fraction(equation.weight)))
        values.add(of_y.pop() / known[equation.of].exact_scale)
    if len(values) > 1:
        raise ValueError(
            "the scales of y and `of` have another ratio from one equation to the next"
        )
    slope = Slope(
        equations=tuple(equations), ridge=one.ridge, ratio=values.pop() / Fraction(one.scale)
    )
    return _made_column(name, one, slope)


def calibrated_column(
    one: Calibrated, base: Definition, scale: Decimal, unit: str, running: TimeColumn | None
) -> TimeColumn:
    """Return a column times a number, given the column without it, its scale and its unit.

    Raises `ValueError` if `running` has another grain than the number, or `less` is between counts.
    """
    number = CAR_NUMBERS[one.number]
    if running is not None and running.scale != number.grain:
        raise ValueError(
            f"{one.running} has the scale {running.scale}, {one.number} {number.grain}"
        )
    less = Fraction(one.less) / Fraction(number.grain)
    if less.denominator != 1:
        raise ValueError(f"less is no multiple of {number.grain}")
    factor = Number(
        name=one.number,
        grain=number.grain,
        less=int(less),
        alone=one.alone,
        running=running.definition if running else None,
    )
    own = [] if number.unit == "1" else [number.unit]
    return TimeColumn(
        definition=base.model_copy(update={"number": factor}),
        scale=number.grain if one.alone else number.grain * scale,
        unit="*".join(own if one.alone else [*own, unit]) or "1",
        column=one.column,
        description=one.description,
    )


def factor_column(factor: Factor, base: Definition, scale: Fraction) -> TimeColumn:
    """Return a column times a fact, given the column without it and that one's scale.

    Raises `ValueError` if the column has a factor already.
    """
    if base.fact is not None:
        raise ValueError(f"{factor.of} has a factor already")
    fact = Fact(
        name=factor.fact,
        less=factor.less,
        equals=factor.equals,
        ratio=scale / Fraction(factor.scale),
    )
    return TimeColumn(
        definition=base.model_copy(update={"fact": fact}),
        scale=factor.scale,
        unit=factor.unit,
        column=factor.column,
        description=factor.description,
    )


class GateFamily(Config):
    """Several linear models with a blend between them, as columns: one for each knot but the first.

    At a knot one model holds alone; between two knots they are mixed in proportion. Weights add up
    to one, so that a model has the columns themselves and, for each further knot, what changes
    there. The column of a knot is called COLUMN_NAME_K, K from 1.
    """

    of: Identifier
    """The column over time that opens and closes the gates."""
    knots: tuple[Decimal, ...] = Field(min_length=2, max_length=20)
    """Physical values of it, rising; beyond the ends the outermost models hold."""
    columns: tuple[Identifier, ...] = Field(min_length=1)
    """Columns over time that are gated."""
    description: str = Field(min_length=1)

    @model_validator(mode="after")
    def _knots_rise(self) -> "GateFamily":
        if any(high <= low for low, high in pairwise(self.knots)):
            raise ValueError("the knots of a gate must rise")
        if len(set(self.columns)) < len(self.columns):
            raise ValueError("a column stands twice")
        return self

    def members(self, name: str) -> dict[str, tuple[str, int]]:
        """Return the names of the family's columns, and of each the column and the knot."""
        return {
            f"{column}_{name}_{knot}": (column, knot)
            for knot in range(1, len(self.knots))
            for column in self.columns
        }


def gated_columns(
    name: str, family: GateFamily, known: Mapping[str, TimeColumn]
) -> dict[str, TimeColumn]:
    """Return the members of a family of gates. Raises `ValueError` for what is no column."""
    unknown = [one for one in (family.of, *family.columns) if one not in known]
    if unknown:
        raise ValueError(f"{', '.join(unknown)}: no column over time")
    by = known[family.of]
    counts = [round(Fraction(knot) / by.exact_scale) for knot in family.knots]
    found = {}
    for member, (column, knot) in family.members(name).items():
        base = known[column]
        gate = Gate(
            by=by.definition,
            low=counts[knot - 1],
            peak=counts[knot],
            high=counts[knot + 1] if knot + 1 < len(counts) else None,
        )
        changed = {
            "definition": base.definition.model_copy(update={"gate": gate}),
            "column": f"{base.column}_{name}_{knot}",
            "description": f"{base.description}, where {family.of} is near {family.knots[knot]:f}",
        }
        found[member] = base.model_copy(update=changed)
    return found


# Features of `configs/features.toml` as types: integer functions of the counts of one row.

_DECLARED = re.compile(r"(?:[a-z0-9_+\-*() ]|// [1-9][0-9]*(?![0-9]))+")
"""What `configs/features.toml` may say; division that rounds comes of `divided_by`."""

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
    def _is_integer_arithmetic(self) -> "Feature":
        guarded = self.divided_by is not None and not self._divisor_is_number
        if guarded != (self.at_least is not None):
            raise ValueError("at_least is for a divisor that varies, which must have it")
        if self._divisor_is_number and int(self.divided_by or 0) == 0:
            raise ValueError("divided_by is zero")
        # What a manifest takes, and every target computes: see `columns/lowering.py`.
        if not parse(integer_arithmetic(self.sql)).inputs:
            raise ValueError("it is of no signal")
        return self

    @cached_property
    def sql(self) -> str:
        """The count before it is clipped, as SQL over the view `log_counts`."""
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
        """The signals that it is computed from, in catalogue order."""
        used = parse(self.sql).inputs
        return tuple(name for name in catalogue().feature_inputs if name in used)


def _widened(text: str) -> str:
    """Return a declared expression over counts with every signal widened to 64 bits."""
    if not _DECLARED.fullmatch(text):
        raise ValueError(f"{text!r} is not integer arithmetic of + - * ( ) and // NUMBER")
    return _WORD.sub(lambda m: m[0] if m[0] in ("abs", "sign") else f"{m[0]}::BIGINT", text)
