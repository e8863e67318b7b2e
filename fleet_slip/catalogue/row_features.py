"""Features of `configs/features.toml` as types: integer functions of the counts of one row."""

import re
from decimal import Decimal
from fractions import Fraction
from functools import cached_property

from pydantic import Field, model_validator

from fleet_slip.catalogue.arithmetic import nearest_sql, parse
from fleet_slip.catalogue.definitions import COUNT_BITS, Bits, integer_arithmetic, limit_of
from fleet_slip.catalogue.signals import Identifier, SIUnit, catalogue
from fleet_slip.config import Config

_DECLARED = re.compile(r"(?:[a-z0-9_+\-*() ]|// [1-9][0-9]*(?![0-9]))+")
"""What `configs/features.toml` may say; division that rounds comes of `divided_by`."""

_WORD = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


class Feature(Config):
    """One feature. `physical = scale * count`, the count clipped to its bits: 16 are +-32767."""

    counts: str = Field(min_length=1)
    divided_by: str | None = None
    at_least: int | None = Field(default=None, gt=0)
    scale: Decimal = Field(gt=0)
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

    @property
    def exact_scale(self) -> Fraction:
        """Physical value of one count, exactly."""
        return Fraction(self.scale)

    @property
    def limit(self) -> int:
        """Largest count."""
        return limit_of(self.bits)


def _widened(text: str) -> str:
    """Return a declared expression over counts with every signal widened to 64 bits."""
    if not _DECLARED.fullmatch(text):
        raise ValueError(f"{text!r} is not integer arithmetic of + - * ( ) and // NUMBER")
    return _WORD.sub(lambda m: m[0] if m[0] in ("abs", "sign") else f"{m[0]}::BIGINT", text)
