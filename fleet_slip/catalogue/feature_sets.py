"""Feature sets and regimes of `configs/features.toml` as types.

A feature set is the columns of one kind of Gram row, and how a drive's rows are divided into
several, if they are.
"""

from collections.abc import Sequence
from decimal import Decimal
from fractions import Fraction
from itertools import pairwise

from pydantic import Field, model_validator

from fleet_slip.catalogue.course_change import TURNED
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
    signals: tuple[Identifier, ...] = Field(min_length=1)
    features: tuple[Identifier, ...] = ()
    windows: tuple[Identifier, ...] = ()
    calibrated: tuple[Identifier, ...] = ()
    regimes: tuple[Identifier, ...] = ()
    block_s: Decimal | None = Field(default=None, gt=0, le=100_000)
    row_folds: int | None = Field(default=None, ge=2, le=1000)
    lagged: bool = False
    change_s: Decimal | None = Field(default=None, gt=0, le=10)
    """Instead of the columns, what they change by in so much time, with the course as the label."""
    as_logged: bool = False
    """Whether the course of changes stays where it was logged, however late its receiver is."""

    @model_validator(mode="after")
    def _consistent(self) -> "FeatureSet":
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
        if self.change_ticks and (not self.windows or self.calibrated):
            raise ValueError("a set with change_s has windows, and no calibrated columns")
        if self.as_logged and not self.change_ticks:
            raise ValueError("only a set with change_s is as_logged")
        for name in ("block_s", "change_s"):
            time_s = getattr(self, name)
            if time_s is not None and Fraction(time_s) % SAMPLE_TIME_S:
                raise ValueError(f"{name} must be a multiple of {float(SAMPLE_TIME_S)}")
        return self

    @property
    def block_ticks(self) -> int | None:
        """Number of ticks of a block of time; None where rows are not divided by time."""
        return None if self.block_s is None else int(Fraction(self.block_s) / SAMPLE_TIME_S)

    @property
    def change_ticks(self) -> int | None:
        """Number of ticks over which columns change; None where they stand for themselves."""
        return None if self.change_s is None else int(Fraction(self.change_s) / SAMPLE_TIME_S)

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
        turned = (TURNED,) if self.change_ticks else ()
        now = (*self.signals, *self.features, *self.windows, *turned, catalogue().label)
        return lag_signals(now) if self.lagged else now
