"""A column of counts over time: what it is, as types that a manifest can hold.

A window looks back on the counts of one row, a logged signal or a feature, within its drive. One
rule for all, in SQL, in the compiled kernel and on board:

* A window of N ticks is what was logged in the last N ticks, this one included. Where a drive
  begins, or after a hole, that is fewer values; a mean divides by as many as there are.
* Where the looked-back value itself is missing now, the mean and the sum are missing too.
* The value N ticks ago is missing where no such tick was logged.
* Everything is an integer. A quotient is rounded to the nearest, halves away from zero, once; then
  the count is clipped to its bits.
"""

from collections.abc import Mapping
from decimal import Decimal
from fractions import Fraction
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, StringConstraints, model_validator

from fleet_slip.catalogue.arithmetic import parse
from fleet_slip.catalogue.facts import NumberName
from fleet_slip.catalogue.signals import COUNT_MAX, Identifier, catalogue
from fleet_slip.config import Config
from fleet_slip.errors import QuestionError

Over = Literal["mean", "sum", "lag", "running_mean"]
"""What a window makes of the values: mean or sum over the last ticks, the value so many ticks ago,
mean since the drive began."""

LONGEST_TICKS = 2**16
"""Longest window: eleven minutes."""

LARGEST_RATIO = 2**14
"""Largest numerator and denominator of a ratio of scales: keeps every quotient below 2^53."""

LARGEST_FACT = 2**16
"""Largest size of a number that a car knows of itself."""

COUNT_BITS = 16
"""Bits of a logged count, and of a feature that does not say how many."""

Bits = Annotated[int, Field(ge=16, le=20)]

FactText = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_.-]{1,60}$")]

NO_CAR_KNOWS = frozenset({"adhesion", "lost_control_s", "speed_factor", "saturated"})
"""Drive columns that are known to a simulation or afterwards, and to no car while it drives."""

NOT_FACTS = NO_CAR_KNOWS | {
    *("drive_id", "drive_name", "source_file", "trip_id", "started_at", "duration_s", "rows"),
    *("vehicle_id", "source", "campaign", "track"),
}


def limit_of(bits: int) -> int:
    """Return the largest count of so many bits; the range is symmetric."""
    return int(2 ** (bits - 1) - 1)


def _ratio(value: Fraction) -> Fraction:
    if not 0 < value.numerator <= LARGEST_RATIO or value.denominator > LARGEST_RATIO:
        raise ValueError(
            f"the scales are {value} to one: choose scales whose ratio has no numerator or "
            f"denominator above {LARGEST_RATIO}"
        )
    return value


def integer_arithmetic(sql: str) -> str:
    """Return the SQL of a feature. Raises `ValueError` if it is more than integer arithmetic."""
    if not sql:
        return sql
    try:
        inputs = parse(sql).inputs
    except QuestionError as error:
        raise ValueError(str(error)) from None
    if unknown := set(inputs) - set(catalogue().feature_inputs):
        raise ValueError(f"{', '.join(sorted(unknown))}: not an input signal")
    return sql


def _not_unknowable(name: str) -> str:
    if name in NOT_FACTS or name not in catalogue().drive:
        raise ValueError(f"{name} is no fact that a car knows of itself")
    return name


Ratio = Annotated[Fraction, AfterValidator(_ratio)]


_LEFT_OUT = Field(exclude_if=lambda one: one is None)


class Fact(Config):
    """What a car knows of itself, as a whole number: a factor of a column.

    The number is `name` rounded, less `less`; or with `equals` 1 for cars of that value, 0 for
    others. The column's count times that number times `ratio` is rounded and clipped again.
    """

    name: Annotated[Identifier, AfterValidator(_not_unknowable)]
    less: Annotated[int, Field(ge=-LARGEST_FACT, le=LARGEST_FACT)] = 0
    equals: FactText | None = None
    ratio: Ratio = Fraction(1)

    @model_validator(mode="after")
    def _fits_its_type(self) -> "Fact":
        text = catalogue().drive[self.name].type == "string"
        if text != (self.equals is not None):
            raise ValueError(f"{self.name} {'needs' if text else 'is a number without'} equals")
        return self


WEIGHT = 2**10
"""Full weight of a gate."""


class Gate(Config):
    """How much of a column counts, in parts of `WEIGHT`: a hat over another column.

    The weight is 0 up to `low`, `WEIGHT` at `peak`, and 0 again from `high`, linear in between and
    rounded down on the way up, so that the weights of neighbours add up to `WEIGHT`. Without `high`
    it stays full. The column's count times the weight over `WEIGHT` is rounded.

    Attributes:
        by: the column that opens and closes the gate; it has no gate or factor itself.
        low, peak, high: counts of it, rising.
    """

    by: "Definition"
    low: int
    peak: int
    high: int | None = None

    @model_validator(mode="after")
    def _consistent(self) -> "Gate":
        if self.by.gate or self.by.fact:
            raise ValueError("what opens a gate has no gate or factor itself")
        high = self.peak + 1 if self.high is None else self.high
        if not -limit_of(20) <= self.low < self.peak < high <= limit_of(20):
            raise ValueError("the knots of a gate must rise, within what a column can count")
        return self


class Number(Config):
    """What a car's drives tell of it (`fleet_slip.catalogue.facts`): a factor of a column.

    The column's count times the number's, less `less`: not rounded, and not clipped. A car whose
    number is not known takes the mean since its drive began, `running`, of the same grain; without
    one it counts as a usual car, whose number is `less`.

    Attributes:
        name: of the number.
        grain: physical value of one of its counts.
        less: taken from its count, so that the factor is small for a usual car.
        alone: whether the column is the number itself, wherever what it is `of` has a value.
        running: column that takes its place.
    """

    name: NumberName
    grain: Annotated[Decimal, Field(gt=0)]
    less: Annotated[int, Field(ge=-COUNT_MAX, le=COUNT_MAX)] = 0
    alone: bool = False
    running: "Definition | None" = None

    @model_validator(mode="after")
    def _runs_plainly(self) -> "Number":
        one = self.running
        if one and (one.over != "running_mean" or one.fact or one.number or self.less):
            raise ValueError("running is a mean since the drive began, without factors")
        return self


class Definition(Config):
    """Everything that defines a column of counts over time, whatever it is called.

    Attributes:
        of: the signal or feature that is looked back on.
        sql: integer SQL of that feature; empty for a logged signal.
        of_bits: to which the feature's count is clipped.
        over, ticks: the window; ticks is 0 for all since the drive began. Without `over` it is
            the value of this row.
        ratio: counts of the column for one count of what is looked back on.
        bits: to which the column's count is clipped.
        fact: a factor, if there is one.
        gate: how much of all that counts, if it is not everything.
        number: a factor that the car's own drives tell, if there is one.
    """

    of: Identifier
    sql: Annotated[str, AfterValidator(integer_arithmetic)] = ""
    of_bits: Bits = COUNT_BITS
    over: Over | None = None
    ticks: int = Field(default=0, ge=0, le=LONGEST_TICKS)
    ratio: Ratio = Fraction(1)
    bits: Bits = 20
    fact: Fact | None = None
    gate: Annotated[Gate | None, _LEFT_OUT] = None
    number: Annotated[Number | None, _LEFT_OUT] = None

    @model_validator(mode="after")
    def _ticks_fit(self) -> "Definition":
        if (self.over in {"mean", "sum", "lag"}) != bool(self.ticks):
            raise ValueError("ticks is for mean, sum and lag, which must have it")
        return self

    @model_validator(mode="after")
    def _of_is_known(self) -> "Definition":
        if not self.sql and self.of not in catalogue().feature_inputs:
            raise ValueError(f"{self.of} is not an input signal")
        if self.sql and self.of in {*catalogue().signals, *catalogue().drive, "tick", "day"}:
            raise ValueError(f"{self.of} is the name of a column of the logs")
        return self

    @property
    def signals(self) -> tuple[str, ...]:
        """The logged signals in it."""
        own = parse(self.sql).inputs if self.sql else (self.of,)
        beside = (self.gate and self.gate.by, self.number and self.number.running)
        return tuple(dict.fromkeys((*own, *(n for one in beside if one for n in one.signals))))

    @property
    def ungated(self) -> "Definition":
        """The same without its gate."""
        return self.model_copy(update={"gate": None})

    @property
    def parts(self) -> tuple["Definition", ...]:
        """What it is made of, each without a gate: itself, or the gated column and the gate's."""
        return (self.ungated, self.gate.by) if self.gate else (self,)


Gate.model_rebuild()
Number.model_rebuild()


def plain_column(name: str, sql: str = "", bits: int = COUNT_BITS) -> Definition:
    """Return the definition of a signal, or of a feature of so many bits, as a column itself."""
    return Definition.model_construct(of=name, sql=sql, of_bits=bits, bits=bits)


def features_behind(definitions: Mapping[str, Definition]) -> dict[str, Definition]:
    """Return a definition with the SQL of each feature that columns are made of, by its name.

    Raises `QuestionError` if a column has the name of such a feature and is something else.
    """
    parts = [part for one in definitions.values() for part in one.parts]
    found = {part.of: part for part in parts if part.sql}
    for name, one in definitions.items():
        if name in found and (one.over or one.fact or one.gate or one.number or one.of != name):
            raise QuestionError(f"{name} is a column, and a feature that another looks back on.")
    for part in parts:
        if part.sql and (part.sql, part.of_bits) != (found[part.of].sql, found[part.of].of_bits):
            raise QuestionError(f"the feature {part.of} is defined in two ways.")
    return found
