"""Features and feature sets: `configs/features.toml` as types.

A feature is an integer function of the counts of one row. A feature set is the columns of one kind
of Gram row, and how a drive's rows are divided into several Gram rows, if they are.
"""

from collections.abc import Mapping, Sequence
from decimal import Decimal
from fractions import Fraction
from functools import cache, cached_property
from importlib.resources.abc import Traversable
from itertools import pairwise

from pydantic import Field, model_validator

from fleet_slip.canonical import canonical_json, sha256_of
from fleet_slip.catalogue.feature_sql import integer_sql, names_in
from fleet_slip.catalogue.signals import Identifier, Signal, SIUnit, catalogue
from fleet_slip.config import Config, load_config
from fleet_slip.errors import QuestionError
from fleet_slip.resources import folder

PLAIN = "signals"
"""The feature set whose columns are the catalogue's inputs and label themselves."""

LAG = "_lag"
"""What the column of a signal's previous value ends in."""


def lag_signals(signals: Sequence[str]) -> tuple[str, ...]:
    """Return the columns of a lagged set: all signals now, then all one sample before."""
    return (*signals, *(name + LAG for name in signals))


class Feature(Config):
    """One feature. `physical = scale * count`, the count clipped to +-32767."""

    counts: str = Field(min_length=1)
    divided_by: str | None = None
    at_least: int | None = Field(default=None, gt=0)
    scale: Decimal = Field(gt=0)
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
        _ = self.sql
        return self

    @cached_property
    def sql(self) -> str:
        """The count before it is clipped, as SQL over the view `log_counts`."""
        counts = integer_sql(self.counts)
        if self.divided_by is None:
            return counts
        divisor = integer_sql(self.divided_by)
        # `//` truncates, so half a divisor with the sign of the dividend rounds to the nearest.
        quotient = f"(2 * ({counts}) + sign({counts}) * ({divisor})) // (2 * ({divisor}))"
        if self._divisor_is_number:
            return quotient
        return f"CASE WHEN {divisor} >= {self.at_least} THEN {quotient} END"

    @property
    def _divisor_is_number(self) -> bool:
        return self.divided_by is not None and self.divided_by.isdecimal()

    @property
    def inputs(self) -> tuple[str, ...]:
        """The signals that it is computed from, in catalogue order."""
        used = names_in(self.counts) | names_in(self.divided_by or "")
        return tuple(name for name in catalogue().inputs if name in used)

    @property
    def exact_scale(self) -> Fraction:
        """Physical value of one count, exactly."""
        return Fraction(self.scale)


class Regime(Config):
    """Bands of a signal or feature."""

    of: Identifier
    absolute: bool = False
    bounds: tuple[Decimal, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _bounds_rise(self) -> "Regime":
        if list(self.bounds) != sorted(set(self.bounds)):
            raise ValueError("the bounds of a regime must rise")
        return self

    @property
    def bands(self) -> tuple[str, ...]:
        """What the bands are called."""
        name = f"|{self.of}|" if self.absolute else self.of
        edges = [f"{bound:f}".rstrip("0").rstrip(".") for bound in self.bounds]
        middle = [f"{name} {low}-{high}" for low, high in pairwise(edges)]
        return (f"{name} < {edges[0]}", *middle, f"{name} >= {edges[-1]}")


class FeatureSet(Config):
    """The columns of one kind of Gram row, and what divides a drive's rows."""

    description: str = Field(min_length=1)
    signals: tuple[Identifier, ...] = Field(min_length=1)
    features: tuple[Identifier, ...] = ()
    regimes: tuple[Identifier, ...] = ()
    row_folds: int | None = Field(default=None, ge=2, le=1000)
    lagged: bool = False

    @model_validator(mode="after")
    def _consistent(self) -> "FeatureSet":
        unknown = [name for name in self.signals if name not in catalogue().inputs]
        if unknown:
            raise ValueError(f"not input signals: {', '.join(unknown)}")
        if len(set(self.columns)) < len(self.columns):
            raise ValueError("a column stands twice")
        if bool(self.regimes) + bool(self.row_folds) + self.lagged > 1:
            raise ValueError("a set has regimes, row_folds or lagged, not several of them")
        return self

    @property
    def inputs(self) -> tuple[str, ...]:
        """What a model of this set may use."""
        return (*self.signals, *self.features)

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns of a Gram row, in its order."""
        now = (*self.inputs, catalogue().label)
        return lag_signals(now) if self.lagged else now


class FeatureCatalogue(Config):
    """All features, regimes and feature sets, in the file's order."""

    features: dict[Identifier, Feature]
    regimes: dict[Identifier, Regime]
    sets: dict[Identifier, FeatureSet]

    @model_validator(mode="after")
    def _consistent(self) -> "FeatureCatalogue":
        signals = catalogue()
        taken = {*signals.signals, *(s.column for s in signals.signals.values()), *signals.drive}
        names = [*self.features, *(feature.column for feature in self.features.values())]
        twice = sorted(name for name in names if name in taken or names.count(name) > 1)
        if twice:
            raise ValueError(f"names must differ, from those of signals too: {', '.join(twice)}")
        if PLAIN in self.sets:
            raise ValueError(f"{PLAIN!r} is the set of the catalogue's own signals")
        for name, regime in self.regimes.items():
            if regime.of not in {*self.features, *signals.inputs}:
                raise ValueError(f"regimes.{name}: {regime.of} is no input signal or feature")
        for name, one in self.sets.items():
            unknown = [f for f in one.features if f not in self.features]
            unknown += [r for r in one.regimes if r not in self.regimes]
            if unknown:
                raise ValueError(f"sets.{name}: unknown {', '.join(unknown)}")
        return self

    def feature_set(self, name: str) -> FeatureSet:
        """Return a feature set by name. Raises `QuestionError` for an unknown one."""
        if name == PLAIN:
            return FeatureSet(description="The logged signals", signals=catalogue().inputs)
        if name not in self.sets:
            known = ", ".join((PLAIN, *self.sets))
            raise QuestionError(f"no feature set is called {name!r}. Feature sets: {known}.")
        return self.sets[name]

    def identity(self, name: str) -> str:
        """Return what the Gram rows of a set carry: its name and a checksum of its definition.

        The set of the catalogue's own signals is just called `signals`.
        """
        if name == PLAIN:
            return PLAIN
        one = self.feature_set(name)
        used = [*one.features, *(self.regimes[r].of for r in one.regimes)]
        content = {
            "columns": list(one.columns),
            "signals": {s: str(catalogue()[s].scale) for s in catalogue().inputs},
            "features": {f: self._definition(f) for f in used if f in self.features},
            "regimes": {r: self.regimes[r].model_dump(mode="json") for r in one.regimes},
            "row_folds": one.row_folds,
            "lagged": one.lagged,
        }
        digest = sha256_of(canonical_json(content))
        return f"{name}-{digest[:12]}"

    def name_of(self, identity: str) -> str:
        """Return the name of the set that Gram rows are of, if it is still defined like that.

        Raises `QuestionError` otherwise.
        """
        name = identity.rpartition("-")[0] or identity
        if name in {PLAIN, *self.sets} and self.identity(name) == identity:
            return name
        raise QuestionError(
            f"the feature set {identity} is not defined as it was then: configs/features.toml has "
            "changed. Publish the model again."
        )

    def _definition(self, name: str) -> Mapping[str, str]:
        feature = self.features[name]
        return {"sql": feature.sql, "scale": str(feature.scale), "unit": feature.unit}

    def of(self, name: str) -> Signal | Feature:
        """Return an input by name: a logged signal, or a feature."""
        return self.features[name] if name in self.features else catalogue()[name]


def load_features(file: Traversable) -> FeatureCatalogue:
    """Read a file of features. Raises `ConfigError`."""
    return load_config(file, FeatureCatalogue)


@cache
def features() -> FeatureCatalogue:
    """Return the features that ship with this installation."""
    return load_features(folder("configs") / "features.toml")


@cache
def input_scales() -> Mapping[str, Fraction]:
    """Return the physical value of one count of every input signal, feature and the label."""
    signals = catalogue()
    scales = {name: signals[name].exact_scale for name in signals.gram_signals}
    return scales | {name: one.exact_scale for name, one in features().features.items()}
