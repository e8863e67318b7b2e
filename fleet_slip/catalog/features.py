"""The file `configs/features.toml` as types: features, columns over time, feature sets."""

from collections import Counter
from collections.abc import Mapping
from decimal import Decimal
from fractions import Fraction
from importlib.resources.abc import Traversable

from pydantic import (
    Field,
    PrivateAttr,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)

from fleet_slip.catalog.course import AUXILIARY, MAX_CHANGE_TICKS
from fleet_slip.catalog.signals import RECEIVED, SAMPLE_TIME_S, Identifier, SignalCatalog
from fleet_slip.catalog.time_columns import (
    Calibrated,
    ColumnFamily,
    ColumnSources,
    EstimateColumn,
    Factor,
    Feature,
    GateFamily,
    NotYetMadeError,
    ProductColumn,
    SlopeColumn,
    TimeColumn,
    Window,
)
from fleet_slip.config import Config, faults_of, load_config, load_toml
from fleet_slip.errors import ConfigError
from fleet_slip.resources import Configs, folder

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
    def _consistent(self, info: ValidationInfo) -> "FeatureSetEntry":
        signals = info.context if isinstance(info.context, SignalCatalog) else None
        unknown = ", ".join(
            name for name in self.signals if signals and name not in signals.feature_inputs
        )
        ticks = self.change_ticks
        names = (*self.signals, *self.features, *self.windows)
        out_of_range = any(not 0 < n <= MAX_CHANGE_TICKS for n in ticks)
        longest = f"{MAX_CHANGE_TICKS * float(SAMPLE_TIME_S):g}"
        for wrong, message in (
            (self.of is None and not self.signals, "a set has signals, or is of another set"),
            (self.of is not None and not self.change_s, "a set of another has change_s"),
            (unknown, f"not input signals: {unknown}"),
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
        taken = {*signals.signals, *(s.column for s in signals.signals.values()), *signals.drive}
        over_time = self._time_columns = _make_time_columns(self, signals)
        columns: dict[str, Feature | TimeColumn] = {**self.features, **over_time}
        taken |= {"day", "tick", "clipped", *AUXILIARY}
        names = [*columns, *(column.column for column in columns.values())]
        twice = sorted(n for n, number in Counter(names).items() if n in taken or number > 1)
        if twice:
            raise ValueError(f"names must differ, from those of signals too: {', '.join(twice)}")
        for name, purpose in ((PLAIN, "the catalog's own signals"), (RECEIVED, "what cars sent")):
            if name in self.sets:
                raise ValueError(f"{name!r} is the set of {purpose}")
        for name, entry in self.sets.items():
            unknown = [f for f in entry.features if f not in self.features]
            names_of_windows = {*self.windows, *self.gates, *over_time}
            unknown += [
                w for w in entry.windows if w not in names_of_windows or w in self.calibrated
            ]
            unknown += [c for c in entry.calibrated if c not in self.calibrated]
            unknown += [entry.of] if entry.of and entry.of not in self.sets else []
            still = [c for c in entry.calibrated if entry.change_s and self.calibrated[c].alone]
            if still:
                raise ValueError(f"sets.{name}: {', '.join(still)}: a number does not change")
            if unknown:
                raise ValueError(f"sets.{name}: unknown {', '.join(unknown)}")
        return self

    @property
    def time_columns(self) -> Mapping[str, TimeColumn]:
        """Every column over time: windows, products, estimates, slopes, factors, gates."""
        return self._time_columns


def _make_time_columns(features: FeatureFile, signals: SignalCatalog) -> dict[str, TimeColumn]:
    """Return every column over time: windows, products, estimates, slopes, factors, gates.

    Raises `ValueError` for a column that refers to an unknown one, or for a repeated name.
    """
    columns = ColumnSources(signals, features.features)
    waiting: list[tuple[str, str, ColumnFamily]] = [
        (f"{kind}.{name}", name, family)
        for kind in FAMILIES
        for name, family in getattr(features, kind).items()
    ]
    while waiting:
        columns.missing = frozenset(n for _, name, family in waiting for n in family.names(name))
        postponed = [entry for entry in waiting if not _make(*entry, columns)]
        if len(postponed) == len(waiting):
            raise ValueError(f"{waiting[0][0]}: it is made of itself")
        waiting = postponed
    return columns.over_time


def _make(where: str, name: str, family: ColumnFamily, columns: ColumnSources) -> bool:
    """Add the columns of a family; return False if it refers to columns not made yet."""
    try:
        members = family.make(name, columns)
    except NotYetMadeError:
        return False
    except ValueError as error:
        reason = faults_of(error) if isinstance(error, ValidationError) else error
        raise ValueError(f"{where}: {reason}") from None
    if repeated := [member for member in members if member in columns.over_time]:
        raise ValueError(f"{where}: {repeated[0]} appears twice")
    columns.over_time.update(members)
    return True


def load_features(configs: Configs, signals: SignalCatalog) -> FeatureFile:
    """Return the shipped features, with the user's file laid over them. Raises `ConfigError`."""
    shipped, chosen = folder("configs") / "features.toml", configs.file("features.toml")
    if str(chosen) == str(shipped):
        return load_config(shipped, FeatureFile, signals)
    return load_features_over(shipped, chosen, signals)


def load_features_over(
    shipped: Traversable, override: Traversable, signals: SignalCatalog
) -> FeatureFile:
    """Read a file of features laid over another: its entries are added, or replace others.

    Raises `ConfigError`.
    """
    content = load_toml(shipped)
    for kind, entries in load_toml(override).items():
        if kind not in content or not isinstance(entries, dict):
            raise ConfigError(f"{override}: {kind}: unknown key. Known: {', '.join(content)}.")
        content[kind] = {**content[kind], **entries}
    try:
        return FeatureFile.model_validate(content, context=signals)
    except ValidationError as error:
        raise ConfigError(f"{override}, over {shipped}: {faults_of(error)}") from None
