"""The file `configs/features.toml` as types: features, columns over time, feature sets.

A family names its columns and makes them from existing ones.
"""

import math
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from decimal import Decimal
from fractions import Fraction
from functools import cached_property
from typing import Any, Literal

from pydantic import (
    Field,
    PrivateAttr,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)

from fleet_slip.catalog.arithmetic import nearest_sql, parse
from fleet_slip.catalog.course import AUXILIARY
from fleet_slip.catalog.course import MAX_CHANGE_TICKS as MAX_COURSE_CHANGE_TICKS
from fleet_slip.catalog.definitions import (
    CALIBRATION_PARAMETERS,
    COUNT_BITS,
    LARGEST_BITS,
    MAX_CHANGE_TICKS,
    AttributeFactor,
    AttributeText,
    Bits,
    CalibrationParameterName,
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
from fleet_slip.catalog.signals import (
    RECEIVED,
    SAMPLE_TIME_S,
    Identifier,
    Scaled,
    Signal,
    SignalCatalog,
    SIUnit,
)
from fleet_slip.config import Config, faults_of, load_config, load_toml
from fleet_slip.errors import ConfigError
from fleet_slip.resources import Configs, folder

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
        divisor = self.divided_by or ""
        varies = bool(divisor) and not divisor.isdecimal()
        if varies != (self.at_least is not None):
            raise ValueError("at_least is for a divisor that varies, which must have it")
        if divisor.isdecimal() and int(divisor) == 0:
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
        if self.at_least is None:
            return quotient
        return f"CASE WHEN {divisor} >= {self.at_least} THEN {quotient} END"

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
    unit: SIUnit
    column: Identifier
    description: str


@dataclass
class ColumnSources:
    """Sources of columns: signals, features, and columns over time, which are made on first use.

    Attributes
    ----------
    families
        By the name of each column over time: place in the file, name and entry of its family.
    columns
        The columns over time that were made so far.
    """

    signals: SignalCatalog
    features: Mapping[str, Feature]
    families: dict[str, tuple[str, str, "ColumnFamily"]] = field(default_factory=dict)
    columns: dict[str, TimeColumn] = field(default_factory=dict)
    _begun: set[str] = field(default_factory=set)

    def find(self, name: str) -> tuple[Definition, Signal | Feature | TimeColumn]:
        """Return an input and its definition. Raises `ValueError` if unknown."""
        if name in self.families:
            column = self.over_time(name)
            return column.definition, column
        if feature := self.features.get(name):
            return Definition(of=name, sql=feature.sql, of_bits=feature.bits), feature
        if name not in self.signals.feature_inputs:
            raise ValueError(f"{name} is no input signal or feature")
        return Definition(of=name), self.signals[name]

    def over_time(self, name: str) -> TimeColumn:
        """Return a column over time. Raises `ValueError` if unknown, or made of itself."""
        if name in self.columns:
            return self.columns[name]
        if name not in self.families:
            raise ValueError(f"{name}: no column over time")
        where, family_name, family = self.families[name]
        if where in self._begun:
            raise ValueError("it is made of itself")
        self._begun.add(where)
        try:
            self.columns |= family.make(family_name, self)
        except ValueError as error:
            reason = faults_of(error) if isinstance(error, ValidationError) else error
            raise ValueError(f"{where}: {reason}") from None
        return self.columns[name]


class ColumnFamily(Config):
    """A table entry that defines columns over time."""

    description: str = Field(min_length=1)

    def names(self, name: str) -> tuple[str, ...]:
        """Return the names of the columns."""
        return (name,)

    def make(self, name: str, sources: ColumnSources) -> dict[str, TimeColumn]:
        """Return the columns by name. Raises `ValueError`."""
        raise NotImplementedError

    def _column(self, definition: Definition, **other: Any) -> TimeColumn:
        """Return a column with the family's attributes, except for `other`."""
        names = ("scale", "unit", "column", "description")
        shared = {name: getattr(self, name) for name in names if name not in other}
        return TimeColumn(definition=definition, **shared, **other)


class ScaledFamily(ColumnFamily):
    """A family whose columns have the scale and unit that the file states."""

    scale: Decimal = Field(gt=0)
    unit: SIUnit
    column: str = Field(min_length=1, max_length=60)

    def _composite(
        self, name: str, composite: Made, bits: int = LARGEST_BITS
    ) -> dict[str, TimeColumn]:
        """Return the column of a composite."""
        return {name: self._column(Definition(of=name, made=composite, of_bits=bits, bits=bits))}


TICKS = "{ticks}"
"""Placeholder for the number of ticks in the name of a window's column."""


class Window(ScaledFamily):
    """A family of windows over a signal, feature, product or estimate.

    The column of N ticks is called NAME_N; the mean since the start of the drive is called NAME.
    """

    of: Identifier
    over: Over
    ticks: tuple[int, ...] = ()
    bits: Bits = 20

    @model_validator(mode="after")
    def _ticks_fit(self) -> "Window":
        if any(not 1 <= n <= MAX_CHANGE_TICKS for n in self.ticks):
            raise ValueError(f"ticks must lie in 1..{MAX_CHANGE_TICKS}")
        if bool(self.ticks) != (TICKS in self.column):
            raise ValueError(f"column must contain {TICKS} if there are ticks, and only then")
        return self

    def names(self, name: str) -> tuple[str, ...]:
        """Return the name of each length, or that of the mean since the drive began."""
        return tuple(f"{name}_{n}" for n in self.ticks) or (name,)

    def make(self, name: str, sources: ColumnSources) -> dict[str, TimeColumn]:
        """Return a column for each length."""
        row, source = sources.find(self.of)
        if self.of in sources.families and not (row.made and row.of == self.of):
            raise ValueError(f"{self.of} is no input signal or feature")
        ratio, members = source.exact_scale / Fraction(self.scale), {}
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


class Factor(ScaledFamily):
    """A column times a vehicle attribute: a number minus `less`, or 1 if it `equals` a text."""

    of: Identifier
    fact: Identifier
    less: int = 0
    equals: AttributeText | None = None

    def make(self, name: str, sources: ColumnSources) -> dict[str, TimeColumn]:
        """Return the product."""
        base, source = sources.find(self.of)
        if base.fact is not None:
            raise ValueError(f"{self.of} has a factor already")
        ratio = source.exact_scale / Fraction(self.scale)
        fact = AttributeFactor.model_validate(
            {"name": self.fact, "less": self.less, "equals": self.equals, "ratio": ratio},
            context=sources.signals,
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

    def make(self, name: str, sources: ColumnSources) -> dict[str, TimeColumn]:
        """Return the column times a number.

        Raises `ValueError` if `running` has another grain than the number, or `less` is between
        counts.
        """
        base, source = sources.find(self.of)
        number = CALIBRATION_PARAMETERS[self.number]
        if isinstance(source, Feature):  # the count itself, as it stands in the rows
            base = base.model_copy(update={"bits": base.of_bits})
        if base.number is not None:
            raise ValueError(f"{self.of} has a number already")
        running = sources.over_time(self.running) if self.running else None
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


class EstimateColumn(ScaledFamily):
    """The estimate of a first-stage model, which the `line` of a model list names."""

    unit: Literal["rad"] = "rad"

    def make(self, name: str, sources: ColumnSources) -> dict[str, TimeColumn]:  # noqa: ARG002
        """Return the estimate of a model that has not been fitted."""
        return self._composite(name, Combination(line=""))


class ProductColumn(ScaledFamily):
    """The product of two columns, signals or features; of none, 1."""

    of: tuple[Identifier, ...] = Field(max_length=2)
    bits: Bits = 20

    def make(self, name: str, sources: ColumnSources) -> dict[str, TimeColumn]:
        """Return the product."""
        factors = [sources.find(factor) for factor in self.of]
        ratio = math.prod((source.exact_scale for _, source in factors), start=Fraction(1))
        columns = tuple(definition for definition, _ in factors)
        return self._composite(
            name, Product(of=columns, ratio=ratio / Fraction(self.scale)), self.bits
        )


class EquationColumns(Config):
    """An equation of a slope: `y`, a sum of columns, is the slope times `of` plus noise.

    Further terms are unknowns times the columns `beside`; an integer is a constant column. The
    equation has a `weight` of at most 1.
    """

    y: dict[Identifier, Literal[-1, 1]] = Field(min_length=1)
    of: Identifier
    beside: tuple[Identifier | int, ...] = ()
    weight: Decimal = Field(default=Decimal(1), gt=0, le=1)


class SlopeColumn(ScaledFamily):
    """The first unknown of equations, by ridge regression over the drive so far."""

    equations: tuple[EquationColumns, ...] = Field(min_length=1)
    ridge: tuple[int, ...] = Field(min_length=1)

    def make(self, name: str, sources: ColumnSources) -> dict[str, TimeColumn]:
        """Return a slope. Raises `ValueError` if the scales of its equations differ."""
        equations, ratios = [], set()
        for number, equation in enumerate(self.equations, 1):
            parts = [(sign, sources.over_time(column)) for column, sign in equation.y.items()]
            base = sources.over_time(equation.of)
            ratios |= {part.exact_scale / base.exact_scale for _, part in parts}
            y = Definition(
                of=f"{name}_{number}",
                made=Combination(terms=tuple((sign, part.definition) for sign, part in parts)),
                of_bits=COUNT_BITS,
                bits=COUNT_BITS,
            )
            beside = [
                sources.over_time(column).definition if isinstance(column, str) else column
                for column in equation.beside
            ]
            x = (base.definition, *beside)
            equations.append(Equation(y=y, x=x, weight=Fraction(equation.weight)))
        if len(ratios) > 1:
            raise ValueError("the scales of y and of differ in ratio between its equations")
        ratio = ratios.pop() / Fraction(self.scale)
        return self._composite(
            name, Slope(equations=tuple(equations), ridge=self.ridge, ratio=ratio)
        )


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

    def names(self, name: str) -> tuple[str, ...]:
        """Return the names of the columns of each knot."""
        knots = range(1, len(self.knots))
        return tuple(f"{column}_{name}_{knot}" for knot in knots for column in self.columns)

    def make(self, name: str, sources: ColumnSources) -> dict[str, TimeColumn]:
        """Return the columns of each knot."""
        by = sources.over_time(self.of)
        bases = [sources.over_time(column) for column in self.columns]
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


# Feature sets, and the file.

PLAIN = "signals"
"""The feature set whose columns are the catalog's inputs and label themselves."""

FAMILIES = ("windows", "products", "estimates", "slopes", "factors", "gates", "calibrated")
"""Tables of the file that define columns over time, in order."""


class FeatureSetEntry(Config):
    """A feature set as the file states it; `Catalog.feature_set` resolves it."""

    description: str = Field(min_length=1)
    of: Identifier | None = None
    """The set whose columns' changes this set contains, besides the named ones."""
    signals: tuple[Identifier, ...] = ()
    features: tuple[Identifier, ...] = ()
    windows: tuple[Identifier, ...] = ()
    calibrated: tuple[Identifier, ...] = ()
    block_s: Decimal | None = Field(default=None, gt=0, le=100_000)
    change_s: tuple[Decimal, ...] = ()
    """Times over which columns change, with the course as label; one block of rows per time."""
    as_logged: bool = False
    """True if the delay of the course is not corrected."""

    @field_validator("change_s", mode="before")
    @classmethod
    def _accept_scalar(cls, value: object) -> object:
        return value if isinstance(value, list | tuple) else (value,)

    @model_validator(mode="after")
    def _consistent(self) -> "FeatureSetEntry":
        ticks = self.change_ticks
        names = (*self.signals, *self.features, *self.windows)
        out_of_range = any(not 0 < n <= MAX_COURSE_CHANGE_TICKS for n in ticks)
        longest = f"{MAX_COURSE_CHANGE_TICKS * float(SAMPLE_TIME_S):g}"
        for wrong, message in (
            (self.of is None and not self.signals, "a set has signals, or is of another set"),
            (self.of is not None and not ticks, "a set of another has change_s"),
            (len(set(names)) < len(names), "a column appears twice"),
            (ticks and self.block_s, "a set with change_s does not divide rows"),
            (ticks and not (self.windows or self.of), "a set with change_s has windows"),
            (self.as_logged and not ticks, "only a set with change_s is as_logged"),
            (out_of_range, f"change_s is at most {longest}"),
        ):
            if wrong:
                raise ValueError(message)
        for name, times_s in (("block_s", (self.block_s,)), ("change_s", self.change_s)):
            if any(time_s and Fraction(time_s) % SAMPLE_TIME_S for time_s in times_s):
                raise ValueError(f"{name} must be a multiple of {float(SAMPLE_TIME_S)}")
        return self

    @property
    def block_ticks(self) -> int | None:
        """Length of a block in ticks; None if rows are not divided by time."""
        return None if self.block_s is None else int(Fraction(self.block_s) / SAMPLE_TIME_S)

    @property
    def change_ticks(self) -> tuple[int, ...]:
        """Numbers of ticks over which columns change; empty if they do not."""
        return tuple(int(Fraction(time_s) / SAMPLE_TIME_S) for time_s in self.change_s)


class FeatureSet(FeatureSetEntry):
    """The columns of one kind of Gram row, and the division of a drive's rows.

    It is an entry whose families are replaced by their members, with the columns of set `of`.

    Attributes
    ----------
    label
        Name of the label signal, the last column.
    """

    label: str

    @property
    def change_text(self) -> str:
        """The times over which columns change, for messages."""
        *earlier, last = (f"{time_s:f}" for time_s in self.change_s)
        return f"{', '.join(earlier)} and {last} s" if earlier else f"{last} s"

    @property
    def in_time(self) -> bool:
        """True if the delays of receivers are corrected in the Gram rows."""
        return bool(self.change_ticks) and not self.as_logged

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs of a model of this set."""
        return (*self.signals, *self.features, *self.windows, *self.calibrated)

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns of a Gram row, in order; calibrated ones are derived from them."""
        beside = AUXILIARY if self.change_ticks else ()
        return (*self.signals, *self.features, *self.windows, *beside, self.label)


class FeatureFile(Config):
    """All features and feature sets, in the file's order.

    Validation needs the `SignalCatalog` as context.
    """

    features: dict[Identifier, Feature]
    windows: dict[Identifier, Window] = Field(default_factory=dict)
    products: dict[Identifier, ProductColumn] = Field(default_factory=dict)
    estimates: dict[Identifier, EstimateColumn] = Field(default_factory=dict)
    slopes: dict[Identifier, SlopeColumn] = Field(default_factory=dict)
    factors: dict[Identifier, Factor] = Field(default_factory=dict)
    gates: dict[Identifier, GateFamily] = Field(default_factory=dict)
    calibrated: dict[Identifier, Calibrated] = Field(default_factory=dict)
    sets: dict[Identifier, FeatureSetEntry]
    _time_columns: dict[str, TimeColumn] = PrivateAttr(default_factory=dict)

    @model_validator(mode="after")
    def _consistent(self, info: ValidationInfo) -> "FeatureFile":
        signals = info.context
        if not isinstance(signals, SignalCatalog):
            raise TypeError("the validation of features needs the signals as context")
        sources = ColumnSources(signals, self.features)
        for kind in FAMILIES:
            for name, family in getattr(self, kind).items():
                for member in family.names(name):
                    if member in sources.families:
                        raise ValueError(f"{kind}.{name}: {member} appears twice")
                    sources.families[member] = (f"{kind}.{name}", name, family)
        self._time_columns = {name: sources.over_time(name) for name in sources.families}
        columns: dict[str, Feature | TimeColumn] = {**self.features, **self._time_columns}
        names = [*signals.names, "clipped", *AUXILIARY, *columns]
        names += [column.column for column in columns.values()]
        if twice := sorted(name for name, number in Counter(names).items() if number > 1):
            raise ValueError(f"names must differ, from those of signals too: {', '.join(twice)}")
        for name, purpose in ((PLAIN, "the catalog's own signals"), (RECEIVED, "what cars sent")):
            if name in self.sets:
                raise ValueError(f"{name!r} is the set of {purpose}")
        windows = {*self.windows, *self.gates, *self._time_columns} - self.calibrated.keys()
        for name, entry in self.sets.items():
            unknown = [
                column
                for columns_of_set, available in (
                    (entry.signals, signals.feature_inputs),
                    (entry.features, self.features),
                    (entry.windows, windows),
                    (entry.calibrated, self.calibrated),
                    ((entry.of,) if entry.of else (), self.sets),
                )
                for column in columns_of_set
                if column not in available
            ]
            if unknown:
                raise ValueError(f"sets.{name}: unknown {', '.join(unknown)}")
            if entry.of and self.sets[entry.of].of:
                raise ValueError(f"sets.{name}: {entry.of} is itself a set of changes")
            constant = [c for c in entry.calibrated if entry.change_s and self.calibrated[c].alone]
            if constant:
                raise ValueError(f"sets.{name}: {', '.join(constant)}: a number does not change")
        return self

    @property
    def time_columns(self) -> Mapping[str, TimeColumn]:
        """Every column over time: windows, products, estimates, slopes, factors, gates."""
        return self._time_columns


def load_features(configs: Configs, signals: SignalCatalog) -> FeatureFile:
    """Return the shipped features, with the user's file laid over them.

    The user's entries are added, or replace others. Raises `ConfigError`.
    """
    shipped, override = folder("configs") / "features.toml", configs.file("features.toml")
    if str(override) == str(shipped):
        return load_config(shipped, FeatureFile, signals)
    content = load_toml(shipped)
    for kind, entries in load_toml(override).items():
        if kind not in content or not isinstance(entries, dict):
            raise ConfigError(f"{override}: {kind}: unknown key. Known: {', '.join(content)}.")
        content[kind] = {**content[kind], **entries}
    try:
        return FeatureFile.model_validate(content, context=signals)
    except ValidationError as error:
        raise ConfigError(f"{override}, over {shipped}: {faults_of(error)}") from None
