"""The features in force: `configs/features.toml`, and one's own laid over it."""

from collections.abc import Iterable, Mapping
from decimal import Decimal
from fractions import Fraction
from functools import cache, cached_property
from importlib.resources.abc import Traversable
from typing import Any

from pydantic import Field, ValidationError, field_validator, model_validator

from fleet_slip.base import canonical_json, sha256_of
from fleet_slip.catalogue.course import BESIDE, LONGEST_TICKS, YAW_RATE, course_units
from fleet_slip.catalogue.definitions import COUNT_BITS, Definition, parity, plain_column
from fleet_slip.catalogue.facts import CALIBRATION, DELAY, RECEIVED
from fleet_slip.catalogue.lines import FittedLine, Fitting, known_line
from fleet_slip.catalogue.signals import (
    SAMPLE_TIME_S,
    Identifier,
    Signal,
    SignalCatalogue,
    catalogue,
)
from fleet_slip.catalogue.time_columns import (
    Calibrated,
    ColumnFamily,
    EstimateColumn,
    Factor,
    Feature,
    GateFamily,
    KnownColumns,
    NotYetMadeError,
    ProductColumn,
    SlopeColumn,
    TimeColumn,
    Window,
)
from fleet_slip.config import Config, faults_of, load_config, load_toml
from fleet_slip.errors import ConfigError, QuestionError
from fleet_slip.resources import config_file, folder

# Feature sets of `configs/features.toml` as types.
#
# A feature set is the columns of one kind of Gram row, and how a drive's rows are divided into
# several, if they are.

PLAIN = "signals"
"""The feature set whose columns are the catalogue's inputs and label themselves."""


class FeatureSet(Config):
    """The columns of one kind of Gram row, and what divides a drive's rows."""

    description: str = Field(min_length=1)
    of: Identifier | None = None
    """The set whose columns these are the changes of, beside those that are named."""
    signals: tuple[Identifier, ...] = ()
    features: tuple[Identifier, ...] = ()
    windows: tuple[Identifier, ...] = ()
    calibrated: tuple[Identifier, ...] = ()
    block_s: Decimal | None = Field(default=None, gt=0, le=100_000)
    change_s: tuple[Decimal, ...] = ()
    """Instead of the columns, what they change by in so much time, with the course as the label;
    of several times, each is a part of the drive."""
    as_logged: bool = False
    """Whether the course of changes stays where it was logged, however late its receiver is."""

    @field_validator("change_s", mode="before")
    @classmethod
    def _one_is_enough(cls, given: object) -> object:
        return given if isinstance(given, list | tuple) else (given,)

    @model_validator(mode="after")
    def _consistent(self) -> "FeatureSet":
        inputs = catalogue().feature_inputs
        unknown = ", ".join(name for name in self.signals if name not in inputs)
        ticks = self.change_ticks
        out_of_range = any(not 0 < n <= LONGEST_TICKS for n in ticks)
        longest = f"{LONGEST_TICKS * float(SAMPLE_TIME_S):g}"
        for wrong, what in (
            (self.of is None and not self.signals, "a set has signals, or is of another set"),
            (self.of is not None and not self.change_s, "a set of another has change_s"),
            (unknown, f"not input signals: {unknown}"),
            (len(set(self.columns)) < len(self.columns), "a column appears twice"),
            (ticks and self.block_s, "a set with change_s does not divide rows"),
            (ticks and not (self.windows or self.of), "a set with change_s has windows"),
            (self.as_logged and not ticks, "only a set with change_s is as_logged"),
            (out_of_range, f"change_s is at most {longest}"),
        ):
            if wrong:
                raise ValueError(what)
        for name, times_s in (("block_s", (self.block_s,)), ("change_s", self.change_s)):
            if any(one and Fraction(one) % SAMPLE_TIME_S for one in times_s):
                raise ValueError(f"{name} must be a multiple of {float(SAMPLE_TIME_S)}")
        return self

    @property
    def block_ticks(self) -> int | None:
        """Number of ticks of a block of time; None where rows are not divided by time."""
        return None if self.block_s is None else int(Fraction(self.block_s) / SAMPLE_TIME_S)

    @property
    def change_ticks(self) -> tuple[int, ...]:
        """Numbers of ticks over which columns change; none where they stand for themselves."""
        return tuple(int(Fraction(time_s) / SAMPLE_TIME_S) for time_s in self.change_s)

    @property
    def change_text(self) -> str:
        """The times over which columns change, as messages say them."""
        *most, last = (f"{time_s:f}" for time_s in self.change_s)
        return f"{', '.join(most)} and {last} s" if most else f"{last} s"

    @property
    def in_time(self) -> bool:
        """Whether the delays of receivers are corrected in the Gram rows."""
        return bool(self.change_ticks) and not self.as_logged

    @property
    def inputs(self) -> tuple[str, ...]:
        """What a model of this set may use."""
        return (*self.signals, *self.features, *self.windows, *self.calibrated)

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns of a Gram row, in its order; calibrated ones follow from it."""
        beside = BESIDE if self.change_ticks else ()
        return (*self.signals, *self.features, *self.windows, *beside, catalogue().label)


# Features and feature sets: `configs/features.toml` as a catalogue.
#
# A feature is an integer function of the counts of one row; a window looks back on a signal or a
# feature over time; a factor is a column times what a car knows of itself; a gate is a column as
# far as another one opens it.

_FAMILIES = ("windows", "products", "estimates", "slopes", "factors", "gates", "calibrated")
"""What makes columns over time, in the order in which they stand."""

_identities: dict[str, tuple["FeatureCatalogue", SignalCatalogue, str]] = {}
"""The identity of a set by its name, and the catalogues of which it was computed last."""


class FeatureCatalogue(Config):
    """All features and feature sets, in the file's order."""

    features: dict[Identifier, Feature]
    windows: dict[Identifier, Window] = Field(default_factory=dict)
    products: dict[Identifier, ProductColumn] = Field(default_factory=dict)
    estimates: dict[Identifier, EstimateColumn] = Field(default_factory=dict)
    slopes: dict[Identifier, SlopeColumn] = Field(default_factory=dict)
    factors: dict[Identifier, Factor] = Field(default_factory=dict)
    gates: dict[Identifier, GateFamily] = Field(default_factory=dict)
    calibrated: dict[Identifier, Calibrated] = Field(default_factory=dict)
    sets: dict[Identifier, FeatureSet]

    @model_validator(mode="after")
    def _consistent(self) -> "FeatureCatalogue":
        signals = catalogue()
        taken = {*signals.signals, *(s.column for s in signals.signals.values()), *signals.drive}
        columns: dict[str, Feature | TimeColumn] = {**self.features, **self.time_columns}
        taken |= {"day", "tick", "clipped", *BESIDE}
        names = [*columns, *(one.column for one in columns.values())]
        twice = sorted(name for name in names if name in taken or names.count(name) > 1)
        if twice:
            raise ValueError(f"names must differ, from those of signals too: {', '.join(twice)}")
        for name, what in ((PLAIN, "the catalogue's own signals"), (RECEIVED, "what cars sent")):
            if name in self.sets:
                raise ValueError(f"{name!r} is the set of {what}")
        for name, one in self.sets.items():
            unknown = [f for f in one.features if f not in self.features]
            known = {*self.windows, *self.gates, *self.time_columns}
            unknown += [w for w in one.windows if w not in known or w in self.calibrated]
            unknown += [c for c in one.calibrated if c not in self.calibrated]
            unknown += [one.of] if one.of and one.of not in self.sets else []
            still = [c for c in one.calibrated if one.change_s and self.calibrated[c].alone]
            if still:
                raise ValueError(f"sets.{name}: {', '.join(still)}: a number does not change")
            if unknown:
                raise ValueError(f"sets.{name}: unknown {', '.join(unknown)}")
        return self

    @cached_property
    def time_columns(self) -> Mapping[str, TimeColumn]:
        """Every column over time: members of families of windows, products, factors, gates.

        Raises `ValueError` for one that looks back on nothing known, or twice the same name.
        """
        known = KnownColumns(self.features)
        waiting: list[tuple[str, str, ColumnFamily]] = [
            (f"{kind}.{name}", name, one)
            for kind in _FAMILIES
            for name, one in getattr(self, kind).items()
        ]
        while waiting:
            known.missing = frozenset(n for _, name, one in waiting for n in one.names(name))
            later = [each for each in waiting if not _made(*each, known)]
            if len(later) == len(waiting):
                raise ValueError(f"{waiting[0][0]}: it is made of itself")
            waiting = later
        return known.over_time

    def definition(self, name: str) -> Definition | None:
        """Return the definition of an input that is more than a signal or a feature of 16 bits."""
        if name in self.time_columns:
            return self.time_columns[name].definition
        one = self.features.get(name)
        if one is None or one.bits == COUNT_BITS:
            return None
        return Definition(of=name, sql=one.sql, of_bits=one.bits, bits=one.bits)

    def rows(self, names: Iterable[str]) -> dict[str, Definition]:
        """Return the definitions of those names that are features, as columns of one row."""
        known = {name: self.features[name] for name in names if name in self.features}
        return {name: plain_column(name, one.sql, one.bits) for name, one in known.items()}

    def definitions(self, name: str, fold: str | None = None) -> dict[str, Definition]:
        """Return the definitions of a set's columns over time, by name.

        Those of a set with a line are, for drives of a `fold`, made by that fitted without it.
        """
        line = self.line_of(name)
        found = {w: self.time_columns[w].definition for w in self.feature_set(name).windows}
        if line is None:
            return found
        fitting = Fitting(line, fold)
        return {w: fitting(one) for w, one in found.items()}

    def line_of(self, name: str) -> FittedLine | None:
        """Return the line of a set `SET_DIGEST`; None of others. Raises `QuestionError`."""
        of, _, digest = name.rpartition("_")
        if name in self.sets or of not in self.sets:
            return None
        line = known_line(digest)
        estimate = self.estimates.get(line.estimate)
        if estimate is None or estimate.scale != line.scale:
            raise QuestionError(
                f"{name}: the line's estimate was in counts of {line.scale} rad. "
                "configs/features.toml has changed: publish the model again, from its list."
            )
        return line

    @cached_property
    def learning(self) -> Mapping[str, str]:
        """The sets that need a line and have none, and the estimate in each."""
        found = {}
        for name in self.sets:
            seen = set[int]()
            used = (self.time_columns[w].definition for w in self.feature_set(name).windows)
            rows = (row.of for one in used for row in one.rows(seen))
            if estimate := next((of for of in rows if of in self.estimates), None):
                found[name] = estimate
        return found

    def feature_set(self, name: str) -> FeatureSet:
        """Return a feature set by name. Raises `QuestionError` for an unknown one.

        Families of windows are replaced by their members.
        """
        if name == PLAIN:
            return FeatureSet(description="The logged signals", signals=catalogue().inputs)
        of = name.rpartition("_")[0] if self.line_of(name) else name
        if of not in self.sets:
            known = ", ".join((PLAIN, *self.sets))
            raise QuestionError(f"no feature set is called {name!r}. Feature sets: {known}.")
        one = self.sets[of]
        members = [member for window in one.windows for member in self.members(window)]
        one = one.model_copy(update={"windows": tuple(dict.fromkeys(members))})
        return one if one.of is None else self._changes_of(one, self.feature_set(one.of))

    def _changes_of(self, one: FeatureSet, of: FeatureSet) -> FeatureSet:
        """Return a set with the columns of another whose changes tell something, beside its own.

        A sum of the yaw rate has the gyroscope's noise in common with the course, which least
        squares takes for knowledge. A mean since the drive began hardly changes, a number of the
        car not at all.
        """
        columns = {}
        for kind in ("signals", "features", "windows", "calibrated"):
            both = dict.fromkeys((*getattr(of, kind), *getattr(one, kind)))
            columns[kind] = tuple(name for name in both if self._changes(name))
        return one.model_copy(update=columns)

    def beside(self, name: str) -> tuple[str, ...]:
        """Return the sets that a model of changes needs: for its intercept, and when fixes came."""
        one = self.feature_set(name)
        of = (one.of,) if one.of else ()
        return (*of, CALIBRATION, DELAY) if one.change_ticks else ()

    def _changes(self, name: str) -> bool:
        if name not in self.time_columns:
            return True
        one = self.time_columns[name].definition
        alone = one.number is not None and one.number.alone
        summed = one.over == "sum" and YAW_RATE in one.signals
        return not (alone or summed or one.over == "running_mean")

    def is_odd(self, name: str) -> bool:
        """Return whether a column changes sign where left and right are exchanged."""
        one = self.definition(name) or self.rows([name]).get(name) or plain_column(name)
        return parity(one) == -1

    def searched(self, name: str) -> tuple[str, ...]:
        """Return what a search among a set's inputs may choose: of changes what tells of slip.

        Changes tell no intercept, which an even column would stand in for, and which follows from
        the set whose changes they are. And a window longer than half of their time hardly changes
        with the angle, but with what is wrong about the course.
        """
        one = self.feature_set(name)
        if not one.change_ticks:
            return one.inputs
        longest = max(one.change_ticks) // 2
        if one.of:
            one = one.model_copy(update={"features": self.feature_set(one.of).features})
        columns = self.time_columns
        short = [
            n for n in one.inputs if n not in columns or columns[n].definition.ticks <= longest
        ]
        return tuple(n for n in short if self.is_odd(n))

    def members(self, name: str) -> tuple[str, ...]:
        """Return the columns of a family of windows or gates; any other name stays."""
        family = self.windows.get(name) or self.gates.get(name)
        return family.names(name) if family else (name,)

    def families(self, signals: Iterable[str]) -> dict[str, int]:
        """Return the names of signals, whole families of windows and gates by their own.

        Beside a family is the number of its members, beside a signal 0.
        """
        shown = {name: (name, 0) for name in signals}
        for family in (*self.windows, *self.gates):
            members = self.members(family)
            if shown.keys() >= set(members):
                shown |= dict.fromkeys(members, (family, len(members)))
        return dict(shown.values())

    def identity(self, name: str) -> str:
        """Return what the Gram rows of a set carry: its name and a checksum of its definition.

        The set of the catalogue's own signals is just called `signals`.
        """
        if name == PLAIN:
            return PLAIN
        signals, known = catalogue(), _identities.get(name)
        if known is None or known[0] is not self or known[1] is not signals:
            known = _identities[name] = (self, signals, self._identity(name))
        return known[2]

    def _identity(self, name: str) -> str:
        one = self.feature_set(name)
        content: dict[str, Any] = {
            "columns": list(one.columns),
            "signals": {s: str(catalogue()[s].scale) for s in catalogue().inputs},
            "features": {f: self._definition(f) for f in one.features},
            "regimes": {},  # these three of sets that earlier releases had: identities stay
            "row_folds": None,
            "lagged": False,
        }
        if line := self.line_of(name):
            content["line"] = {"sha256": line.sha256}
        if extras := self._extras(one):
            content["extras"] = {name: str(catalogue()[name].scale) for name in extras}
        if one.block_ticks:
            content["block_ticks"] = one.block_ticks
        if one.change_ticks:
            content["change"] = {"ticks": list(one.change_ticks), **vars(course_units())}
        if one.windows:
            content["windows"] = {
                w: self.time_columns[w].model_dump(mode="json", exclude={"description"})
                for w in one.windows
            }
        digest = sha256_of(canonical_json(content))
        return f"{name}-{digest[:12]}"

    def _extras(self, one: FeatureSet) -> tuple[str, ...]:
        """Return the signals that a set is made of and that not every set knows."""
        used = {*one.signals}
        for name in one.features:
            used |= set(self.features[name].inputs)
        for name in one.windows:
            used |= set(self.time_columns[name].definition.signals)
        return tuple(name for name in catalogue().extras if name in used)

    def name_of(self, identity: str) -> str:
        """Return the name of the set that Gram rows are of, if it is still defined like that.

        Raises `QuestionError` otherwise.
        """
        name = identity.rpartition("-")[0] or identity
        if (name in {PLAIN, *self.sets} or self.line_of(name)) and self.identity(name) == identity:
            return name
        raise QuestionError(
            f"the feature set {identity} is not defined as it was then: configs/features.toml has "
            "changed. Publish the model again."
        )

    def _definition(self, name: str) -> Mapping[str, str]:
        feature = self.features[name]
        content = {"sql": feature.sql, "scale": str(feature.scale), "unit": feature.unit}
        return content if feature.bits == COUNT_BITS else content | {"bits": str(feature.bits)}

    def of(self, name: str) -> Signal | Feature | TimeColumn:
        """Return an input by name: a logged signal, a feature, or a column over time."""
        if name in self.time_columns:
            return self.time_columns[name]
        return self.features[name] if name in self.features else catalogue()[name]

    @property
    def inputs(self) -> tuple[str, ...]:
        """Everything that a model may use."""
        return (*catalogue().feature_inputs, *self.features, *self.time_columns)


def _made(where: str, name: str, family: ColumnFamily, known: KnownColumns) -> bool:
    """Make the columns of a family, if there is all that they are made of. Raises `ValueError`."""
    try:
        found = family.make(name, known)
    except NotYetMadeError:
        return False
    except ValueError as error:
        told = faults_of(error) if isinstance(error, ValidationError) else error
        raise ValueError(f"{where}: {told}") from None
    if twice := [member for member in found if member in known.over_time]:
        raise ValueError(f"{where}: {twice[0]} appears twice")
    known.over_time.update(found)
    return True


def load_features_over(shipped: Traversable, own: Traversable) -> FeatureCatalogue:
    """Read a file of features laid over another: what it names is added, or takes the place.

    Raises `ConfigError`.
    """
    content = load_toml(shipped)
    for kind, entries in load_toml(own).items():
        if kind not in content or not isinstance(entries, dict):
            raise ConfigError(f"{own}: {kind}: unknown key. Known: {', '.join(content)}.")
        content[kind] = {**content[kind], **entries}
    try:
        return FeatureCatalogue.model_validate(content)
    except ValidationError as error:
        raise ConfigError(f"{own}, over {shipped}: {faults_of(error)}") from None


@cache
def features() -> FeatureCatalogue:
    """Return the features that are in force: the shipped ones, and one's own over them."""
    shipped, chosen = folder("configs") / "features.toml", config_file("features.toml")
    if str(chosen) == str(shipped):
        return load_config(shipped, FeatureCatalogue)
    return load_features_over(shipped, chosen)


@cache
def input_scales() -> Mapping[str, Fraction]:
    """Return the physical value of one count of every input signal, feature and the label."""
    signals = catalogue()
    usable = (*signals.feature_inputs, signals.label)
    scales = {name: signals[name].exact_scale for name in usable}
    known = features()
    columns: dict[str, Feature | TimeColumn] = {**known.features, **known.time_columns}
    return scales | {name: one.exact_scale for name, one in columns.items()}
