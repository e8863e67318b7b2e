"""The catalog of a data root: signals, features, feature sets, first-stage models."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from fractions import Fraction
from functools import cached_property, lru_cache
from typing import Any, Protocol

from fleet_slip.base import canonical_json, hash_fold, sha256_of
from fleet_slip.catalog.course import YAW_RATE, course_units
from fleet_slip.catalog.definitions import (
    CALIBRATION,
    COUNT_BITS,
    DELAY,
    Combination,
    Definition,
    limit_of,
    parity,
    plain_column,
    rows_behind,
)
from fleet_slip.catalog.features import (
    PLAIN,
    Calibrated,
    EstimateColumn,
    Feature,
    FeatureFile,
    FeatureSet,
    FeatureSetEntry,
    TimeColumn,
    load_features,
)
from fleet_slip.catalog.signals import (
    Identifier,
    Signal,
    SignalCatalog,
    load_signals,
)
from fleet_slip.config import Config, read_named_file
from fleet_slip.errors import QuestionError
from fleet_slip.resources import SHIPPED_CONFIGS, Configs

DIGEST_DIGITS = 12
"""Hexadecimal digits of a checksum that name a model."""

MAX_SUM_BITS = 50
"""Bits of the largest sum of an estimate, so that twice the sum is exact in binary64."""

MIN_DIVISOR_BITS = 8
"""Bits of the smallest divisor: coefficients are multiples of 1/256 or finer."""


class FirstStageModel(Config):
    """A first-stage model, fitted to all drives and to all but each fold.

    Attributes
    ----------
    estimate
        Name of its estimate in `configs/features.toml`.
    fitted
        The fit to all drives.
    folds
        The fits without a fold, by the fold's name (`fold_of`).
    hashed
        Number of folds by the hash of the drive id; None if each drive is a fold.
    scale
        Physical value of one count of the estimate, in rad.
    models, models_sha256
        The model list that it was chosen from, and its checksum.
    feature_set
        Identity of the feature set of its Gram rows.
    cohort, drives
        Predicate and number of the training drives.
    drive_hashes
        The training drives, 16 digits each, sorted.
    """

    estimate: Identifier
    fitted: Combination
    folds: dict[str, Combination]
    hashed: int | None = None
    scale: Decimal
    models: str
    feature_set: str
    models_sha256: str
    cohort: str
    drives: int
    drive_hashes: str

    @cached_property
    def sha256(self) -> str:
        """Checksum of the whole model."""
        return sha256_of(canonical_json(self.model_dump(mode="json")))

    @property
    def digest(self) -> str:
        """Name of the model: the first digits of its checksum."""
        return self.sha256[:DIGEST_DIGITS]

    def fold_of(self, drive_id: str) -> str | None:
        """Return the fold of a training drive; None for other drives."""
        fold = drive_id if self.hashed is None else str(hash_fold(drive_id, self.hashed) + 1)
        return fold if fold in self.folds else None


def substitute_estimate(
    part: Any, estimate: str, fit: Combination, copies: dict[int, Any] | None = None
) -> Any:
    """Return a definition with a fit in place of the estimate of that name, wherever it occurs.

    `copies` has the copy of each part by its identity: columns that share a part share its copy.
    """
    copies = {} if copies is None else copies
    if isinstance(part, tuple):
        return tuple(substitute_estimate(item, estimate, fit, copies) for item in part)
    if not isinstance(part, Config):
        return part
    if id(part) not in copies:
        values = {name: getattr(part, name) for name in type(part).model_fields}
        if isinstance(part, Definition) and part.made and part.of == estimate:
            changes: dict[str, Any] = {"made": fit}
        else:
            new = {n: substitute_estimate(v, estimate, fit, copies) for n, v in values.items()}
            changes = {name: value for name, value in new.items() if value != values[name]}
        copies[id(part)] = part.model_copy(update=changes) if changes else part
    return copies[id(part)]


def integer_combination(
    intercept: Fraction, coefficients: Sequence[Fraction], columns: Sequence[Definition]
) -> Combination:
    """Return a linear model of counts with integer coefficients over a power of two.

    The divisor is the largest for which the sum is exact in binary64. Raises `QuestionError` if
    that divisor is too small.
    """
    sizes = [limit_of(column.bits) + 1 for column in columns]
    largest = abs(intercept) + sum(abs(g) * n for g, n in zip(coefficients, sizes, strict=True))
    bits = MAX_SUM_BITS - max(0, math.ceil(largest)).bit_length()
    if bits < MIN_DIVISOR_BITS:
        raise QuestionError("its coefficients are so large that its estimate would not be exact.")
    scaled = [round(value * 2**bits) for value in (intercept, *coefficients)]
    terms = tuple((c, column) for c, column in zip(scaled[1:], columns, strict=True) if c)
    return Combination(intercept=scaled[0], terms=terms, divisor=2**bits)


class FirstStageModels(Protocol):
    """Finds first-stage models by digest."""

    def find(self, digest: str) -> FirstStageModel | None:
        """Return a model; None if there is none. Raises `StorageError`."""


@dataclass(frozen=True)
class Catalog:
    """Signals, features, feature sets and first-stage models of a data root; immutable.

    A `Warehouse` owns it and passes it to functions.

    Attributes
    ----------
    signals
        The signals and drive columns of `signals.toml`.
    file
        The features and feature sets of `features.toml`.
    configs
        The folder of configs that both were read from.
    first_stage_models
        Source of the first-stage models of a data root; None outside one.
    """

    signals: SignalCatalog
    file: FeatureFile
    configs: Configs = SHIPPED_CONFIGS
    first_stage_models: FirstStageModels | None = None
    _identities: dict[str, str] = field(default_factory=dict, repr=False, compare=False)
    """Identity of each set: computed once, shared by copies, as it follows from the content."""

    @property
    def features(self) -> Mapping[str, Feature]:
        """The features, by name."""
        return self.file.features

    @property
    def sets(self) -> Mapping[str, FeatureSetEntry]:
        """The feature sets as the file states them, by name."""
        return self.file.sets

    @property
    def calibrated(self) -> Mapping[str, Calibrated]:
        """The calibrated columns, by name."""
        return self.file.calibrated

    @property
    def estimates(self) -> Mapping[str, EstimateColumn]:
        """The estimates of first-stage models, by name."""
        return self.file.estimates

    @property
    def time_columns(self) -> Mapping[str, TimeColumn]:
        """Every column over time, by name."""
        return self.file.time_columns

    @cached_property
    def input_scales(self) -> Mapping[str, Fraction]:
        """Physical value of one count of every input signal, feature, column and the label."""
        names = (*self.signals.feature_inputs, self.signals.label)
        scales = {name: self.signals[name].exact_scale for name in names}
        columns: dict[str, Feature | TimeColumn] = {**self.features, **self.time_columns}
        return scales | {name: column.exact_scale for name, column in columns.items()}

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of everything that a model may use."""
        return (*self.signals.feature_inputs, *self.features, *self.time_columns)

    def input(self, name: str) -> Signal | Feature | TimeColumn:
        """Return an input: a logged signal, a feature, or a column over time."""
        return self.time_columns.get(name) or self.features.get(name) or self.signals[name]

    def definition(self, name: str) -> Definition | None:
        """Return the definition of an input that is more than a signal or a feature of 16 bits."""
        if name in self.time_columns:
            return self.time_columns[name].definition
        feature = self.features.get(name)
        if feature is None or feature.bits == COUNT_BITS:
            return None
        return Definition(of=name, sql=feature.sql, of_bits=feature.bits, bits=feature.bits)

    def rows(self, names: Iterable[str]) -> dict[str, Definition]:
        """Return the definitions of the features among names, as columns of one row."""
        return {
            name: plain_column(name, feature.sql, feature.bits)
            for name in names
            if (feature := self.features.get(name))
        }

    def definitions(self, name: str, fold: str | None = None) -> dict[str, Definition]:
        """Return the definitions of a set's columns over time, by name.

        A set with a first-stage model uses, for drives of a `fold`, the fit without that fold.
        """
        model = self.first_stage_model(name)
        windows = self.feature_set(name).windows
        definitions = {window: self.time_columns[window].definition for window in windows}
        if model is None:
            return definitions
        fit = model.folds.get(fold, model.fitted) if fold is not None else model.fitted
        fit, copies = fit.model_copy(update={"line": model.digest}), dict[int, Any]()
        return {
            window: substitute_estimate(definition, model.estimate, fit, copies)
            for window, definition in definitions.items()
        }

    def first_stage_model(self, name: str) -> FirstStageModel | None:
        """Return the first-stage model of a set `SET_DIGEST`; None for other sets.

        Raises `QuestionError` if it does not exist or its estimate has another scale now.
        """
        base, _, digest = name.rpartition("_")
        if name in self.sets or base not in self.sets:
            return None
        model = self.first_stage_models.find(digest) if self.first_stage_models else None
        if model is None:
            raise QuestionError(
                f"the first-stage model {digest} is not in this data root. Publish the model again."
            )
        estimate = self.estimates.get(model.estimate)
        if estimate is None or estimate.scale != model.scale:
            raise QuestionError(
                f"{name}: the first-stage estimate had counts of {model.scale} rad. "
                "configs/features.toml has changed: publish the model again, from its list."
            )
        return model

    @cached_property
    def stacked_sets(self) -> Mapping[str, str]:
        """Sets whose columns need a first-stage model, and the estimate that each needs."""
        stacked = {}
        for name in self.sets if self.estimates else ():
            rows = rows_behind(self.definitions(name))
            if estimates := [row for row in rows if row in self.estimates]:
                stacked[name] = estimates[0]
        return stacked

    def feature_set(self, name: str) -> FeatureSet:
        """Return a feature set, its families replaced by their members.

        Raises `QuestionError` for an unknown one.
        """
        if name == PLAIN:
            return FeatureSet.model_construct(
                label=self.signals.label,
                description="The logged signals",
                signals=self.signals.inputs,
            )
        base = name.rpartition("_")[0] if self.first_stage_model(name) else name
        if base not in self.sets:
            names = ", ".join((PLAIN, *self.sets))
            raise QuestionError(f"no feature set is called {name!r}. Feature sets: {names}.")
        return self.resolve(self.sets[base])

    def resolve(self, entry: FeatureSetEntry) -> FeatureSet:
        """Return a feature set as the file states it, its families replaced by their members.

        A set of changes has the columns of its source that change.
        """
        members = [member for window in entry.windows for member in self.members(window)]
        content = {**dict(entry), "windows": tuple(dict.fromkeys(members))}
        feature_set = FeatureSet.model_construct(label=self.signals.label, **content)
        if entry.of is None:
            return feature_set
        source = self.feature_set(entry.of)
        columns = {}
        for kind in ("signals", "features", "windows", "calibrated"):
            names = dict.fromkeys((*getattr(source, kind), *getattr(feature_set, kind)))
            columns[kind] = tuple(name for name in names if self._changes(name))
        return feature_set.model_copy(update=columns)

    def _changes(self, name: str) -> bool:
        """Return True if the changes of a column contain information.

        Others are sums of the yaw rate, whose gyroscope noise also enters the course label; means
        since the drive began, which hardly change; and numbers of the car, which are constant.
        """
        if name not in self.time_columns:
            return True
        column = self.time_columns[name].definition
        alone = column.number is not None and column.number.alone
        summed = column.over == "sum" and YAW_RATE in column.signals
        return not (alone or summed or column.over == "running_mean")

    def auxiliary_sets(self, name: str) -> tuple[str, ...]:
        """Return the sets that a model of changes needs for its intercept and course delay."""
        feature_set = self.feature_set(name)
        source = (feature_set.of,) if feature_set.of else ()
        return (*source, CALIBRATION, DELAY) if feature_set.change_ticks else ()

    def is_odd(self, name: str) -> bool:
        """Return True if a column changes sign when left and right are exchanged."""
        row = self.rows([name]).get(name)
        return parity(self.definition(name) or row or plain_column(name)) == -1

    def search_inputs(self, name: str) -> tuple[str, ...]:
        """Return the inputs that a search may choose from; of changes, the odd and short ones.

        Changes do not determine an intercept, which an even column would absorb. A window longer
        than half of the change time follows the errors of the course more than the angle.
        """
        feature_set = self.feature_set(name)
        if not feature_set.change_ticks:
            return feature_set.inputs
        longest = max(feature_set.change_ticks) // 2
        if feature_set.of:
            source = self.feature_set(feature_set.of)
            feature_set = feature_set.model_copy(update={"features": source.features})
        return tuple(
            column
            for column in feature_set.inputs
            if column not in self.time_columns
            or self.time_columns[column].definition.ticks <= longest
            if self.is_odd(column)
        )

    def members(self, name: str) -> tuple[str, ...]:
        """Return the columns of a family of windows or gates; any other name stays."""
        family = self.file.windows.get(name) or self.file.gates.get(name)
        return family.names(name) if family else (name,)

    def families(self, signals: Iterable[str]) -> dict[str, int]:
        """Return names and member counts, complete families of windows and gates by their own.

        A signal that is no family has the count 0.
        """
        names = {name: (name, 0) for name in signals}
        for family in (*self.file.windows, *self.file.gates):
            members = self.members(family)
            if names.keys() >= set(members):
                names |= dict.fromkeys(members, (family, len(members)))
        return dict(names.values())

    def identity(self, name: str) -> str:
        """Return the identity of a set in Gram rows: its name and a checksum of its definition.

        The identity of the logged signals is `signals`, without a checksum.
        """
        if name == PLAIN:
            return PLAIN
        model = self.first_stage_model(name)  # raises without the model
        if name in self._identities:
            return self._identities[name]
        feature_set, signals = self.feature_set(name), self.signals
        features = {feature: self.features[feature] for feature in feature_set.features}
        windows = {window: self.time_columns[window] for window in feature_set.windows}
        content: dict[str, Any] = {
            "columns": list(feature_set.columns),
            "signals": {signal: str(signals[signal].scale) for signal in signals.inputs},
            "features": {
                feature: {
                    "sql": declared.sql,
                    "scale": str(declared.scale),
                    "unit": declared.unit,
                    **({} if declared.bits == COUNT_BITS else {"bits": str(declared.bits)}),
                }
                for feature, declared in features.items()
            },
            "regimes": {},  # these three keep the identities of sets of earlier releases
            "row_folds": None,
            "lagged": False,
        }
        if model:
            content["line"] = {"sha256": model.sha256}
        used = {*feature_set.signals}.union(
            *(feature.inputs for feature in features.values()),
            *(window.definition.signals for window in windows.values()),
        )
        if extras := [name for name in signals.extras if name in used]:
            content["extras"] = {extra: str(signals[extra].scale) for extra in extras}
        if feature_set.block_ticks:
            content["block_ticks"] = feature_set.block_ticks
        if feature_set.change_ticks:
            ticks = list(feature_set.change_ticks)
            content["change"] = {"ticks": ticks, **vars(course_units(signals))}
        if windows:
            content["windows"] = {
                window: column.model_dump(mode="json", exclude={"description"})
                for window, column in windows.items()
            }
        digest = sha256_of(canonical_json(content))[:12]
        return self._identities.setdefault(name, f"{name}-{digest}")

    def name_of(self, identity: str) -> str:
        """Return the name of the set that Gram rows are of, if its definition is unchanged.

        Raises `QuestionError` otherwise.
        """
        name = identity.rpartition("-")[0] or identity
        exists = name in {PLAIN, *self.sets} or self.first_stage_model(name)
        if exists and self.identity(name) == identity:
            return name
        raise QuestionError(
            f"the definition of the feature set {identity} has changed in configs/features.toml. "
            "Publish the model again."
        )


def load_catalog(configs: Configs = SHIPPED_CONFIGS) -> Catalog:
    """Return the catalog of a folder of configs, without first-stage models.

    Raises `ConfigError` for an invalid file.
    """
    files = [configs.file("signals.toml"), configs.file("features.toml")]
    return _load(configs, tuple(read_named_file(file) for file in files))


@lru_cache(maxsize=16)
def _load(configs: Configs, contents: tuple[bytes, ...]) -> Catalog:  # noqa: ARG001
    """Parse the catalog of a folder, once for each content of its files."""
    signals = load_signals(configs)
    return Catalog(signals, load_features(configs, signals), configs)
