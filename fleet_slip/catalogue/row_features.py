"""Features of `configs/features.toml` as types: integer functions of the counts of one row."""

from decimal import Decimal
from fractions import Fraction
from functools import cached_property

from pydantic import Field, model_validator

from fleet_slip.catalogue.arithmetic import parse
from fleet_slip.catalogue.definitions import COUNT_BITS, Bits, limit_of
from fleet_slip.catalogue.feature_sql import integer_sql, names_in, require_integer_sql
from fleet_slip.catalogue.signals import Identifier, SIUnit, catalogue
from fleet_slip.config import Config
from fleet_slip.errors import QuestionError


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
        try:
            # What a manifest takes, and every target computes: see `columns/lowering.py`.
            arithmetic = parse(require_integer_sql(self.sql))
        except QuestionError as error:
            raise ValueError(str(error)) from None
        if not arithmetic.inputs:
            raise ValueError("it is of no signal")
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
        return tuple(name for name in catalogue().feature_inputs if name in used)

    @property
    def exact_scale(self) -> Fraction:
        """Physical value of one count, exactly."""
        return Fraction(self.scale)

    @property
    def limit(self) -> int:
        """Largest count."""
        return limit_of(self.bits)
