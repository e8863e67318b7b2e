"""Feature sets and regimes of `configs/features.toml` as types.

A feature set is the columns of one kind of Gram row, and how a drive's rows are divided into
several, if they are.
"""

from collections.abc import Sequence
from decimal import Decimal
from fractions import Fraction
from itertools import pairwise

from pydantic import Field, field_validator, model_validator

from fleet_slip.catalogue.course_change import BESIDE, LONGEST_TICKS
from fleet_slip.catalogue.signals import SAMPLE_TIME_S, Identifier, catalogue
from fleet_slip.config import Config

PLAIN = "signals"
"""The feature set whose columns are the catalogue's inputs and label themselves."""

LAG = "_lag"
"""What the column of a signal's previous value ends in."""


def lag_signals(signals: Sequence[str]) -> tuple[str, ...]:
    """Return the columns of a lagged set: all signals now, then all one sample before."""
    return (*signals, *(name + LAG for name in signals))


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
    of: Identifier | None = None
    """The set whose columns these are the changes of, beside those that are named."""
    signals: tuple[Identifier, ...] = ()
    features: tuple[Identifier, ...] = ()
    windows: tuple[Identifier, ...] = ()
    calibrated: tuple[Identifier, ...] = ()
    regimes: tuple[Identifier, ...] = ()
    block_s: Decimal | None = Field(default=None, gt=0, le=100_000)
    row_folds: int | None = Field(default=None, ge=2, le=1000)
    lagged: bool = False
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
        if self.of is None and not self.signals:
            raise ValueError("a set has signals, or is of another set")
        if self.of is not None and not self.change_s:
            raise ValueError("a set of another has change_s")
        unknown = [name for name in self.signals if name not in catalogue().feature_inputs]
        if unknown:
            raise ValueError(f"not input signals: {', '.join(unknown)}")
        if len(set(self.columns)) < len(self.columns):
            raise ValueError("a column stands twice")
        if bool(self.regimes) + bool(self.block_s) + bool(self.row_folds) + self.lagged > 1:
            raise ValueError("a set has regimes, block_s, row_folds or lagged, not several of them")
        if (self.windows or self.calibrated) and (self.row_folds or self.lagged):
            raise ValueError("a set with windows has no row_folds or lagged")
        if self.change_ticks and (self.row_folds or self.lagged or self.regimes or self.block_s):
            raise ValueError("a set with change_s does not divide rows")
        if self.change_ticks and not (self.windows or self.of):
            raise ValueError("a set with change_s has windows")
        if self.as_logged and not self.change_ticks:
            raise ValueError("only a set with change_s is as_logged")
        if any(not 0 < ticks <= LONGEST_TICKS for ticks in self.change_ticks):
            raise ValueError(f"change_s is at most {LONGEST_TICKS * float(SAMPLE_TIME_S):g}")
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
        now = (*self.signals, *self.features, *self.windows, *beside, catalogue().label)
        return lag_signals(now) if self.lagged else now
