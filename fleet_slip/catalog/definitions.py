"""A column of counts over time: what it is, as types that a manifest can hold.

A window looks back on the counts of one row, a logged signal or a feature, within its drive. One
rule for all, in SQL, in the compiled kernel and on board:

* A window of N ticks is what was logged in the last N ticks, this one included. Where a drive
  begins, or after a hole, that is fewer values; a mean divides by as many as there are.
* Where the looked-back value itself is missing now, the mean and the sum are missing too.
* The value N ticks ago, and the change since, are missing where no such tick was logged.
* Everything is an integer. A quotient is rounded to the nearest, halves away from zero, once; then
  the count is clipped to its bits.
"""

from collections.abc import Iterator, Mapping
from decimal import Decimal
from fractions import Fraction
from functools import cache
from random import Random
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, StringConstraints, ValidationInfo, model_validator

from fleet_slip.catalog.arithmetic import evaluate, parse
from fleet_slip.catalog.calibration_parameters import CalibrationParameterName
from fleet_slip.catalog.signals import COUNT_MAX, Identifier, SignalCatalog
from fleet_slip.config import Config
from fleet_slip.errors import QuestionError

Over = Literal["mean", "sum", "lag", "change", "running_mean"]
"""What a window makes of the values: mean or sum over the last ticks, the value so many ticks ago,
its change since then, mean since the drive began."""

LONGEST_TICKS = 2**16
"""Longest window: eleven minutes."""

LARGEST_RATIO = 2**14
"""Largest numerator and denominator of a ratio of scales: keeps every quotient below 2^53."""

MAX_ATTRIBUTE = 2**16
"""Largest size of a number that a car knows of itself."""

COUNT_BITS = 16
"""Bits of a logged count, and of a feature that does not say how many."""

LARGEST_BITS = 20
"""Bits of a column that does not say how many."""

Bits = Annotated[int, Field(ge=COUNT_BITS, le=LARGEST_BITS)]

AttributeText = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_.-]{1,60}$")]

NO_CAR_KNOWS = frozenset({"adhesion", "lost_control_s", "speed_factor", "saturated"})
"""Drive columns that are known to a simulation or afterwards, and to no car while it drives."""

NOT_ATTRIBUTES = NO_CAR_KNOWS | {
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


def _signals_of(info: ValidationInfo) -> SignalCatalog | None:
    """Return the signals to check names against: the context of a file or document that is read."""
    return info.context if isinstance(info.context, SignalCatalog) else None


def integer_arithmetic(sql: str, info: ValidationInfo) -> str:
    """Return the SQL of a feature. Raises `ValueError` if it is more than integer arithmetic.

    With a `SignalCatalog` as context it must also be of input signals.
    """
    if not sql:
        return sql
    try:
        inputs = parse(sql).inputs
    except QuestionError as error:
        raise ValueError(str(error)) from None
    signals = _signals_of(info)
    if signals and (unknown := set(inputs) - set(signals.feature_inputs)):
        raise ValueError(f"{', '.join(sorted(unknown))}: not an input signal")
    return sql


def _not_unknowable(name: str, info: ValidationInfo) -> str:
    signals = _signals_of(info)
    if name in NOT_ATTRIBUTES or (signals and name not in signals.drive):
        raise ValueError(f"{name} is not a property of the car that the catalog has")
    return name


Ratio = Annotated[Fraction, AfterValidator(_ratio)]

LARGEST_DIVISOR = 2**46

LARGEST_WEIGHT = 2**10

LARGEST_SLOPE = 2**36
"""Largest part of a slope's ratio: times 25 bits it has 61."""

Whole = Annotated[int, Field(ge=-(2**62), le=2**62)]

LineId = Annotated[str, StringConstraints(pattern=r"^([0-9a-f]{12})?$")]
"""The first digits of a line's checksum."""


_LEFT_OUT = Field(exclude_if=lambda value: value is None)


class AttributeFactor(Config):
    """A vehicle attribute, as a whole number, as a factor of a column.

    The number is `name` rounded, less `less`; or with `equals` 1 for cars of that value, 0 for
    others. The column's count times that number times `ratio` is rounded and clipped again.
    """

    name: Annotated[Identifier, AfterValidator(_not_unknowable)]
    less: Annotated[int, Field(ge=-MAX_ATTRIBUTE, le=MAX_ATTRIBUTE)] = 0
    equals: AttributeText | None = None
    ratio: Ratio = Fraction(1)

    @model_validator(mode="after")
    def _fits_its_type(self, info: ValidationInfo) -> "AttributeFactor":
        signals = _signals_of(info)
        if signals is None:
            return self
        text = signals.drive[self.name].type == "string"
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
            raise ValueError("the column that opens a gate cannot have a gate or a factor")
        high = self.peak + 1 if self.high is None else self.high
        if not -limit_of(20) <= self.low < self.peak < high <= limit_of(20):
            raise ValueError("the knots of a gate must increase, within the range of a column")
        return self


class ParameterFactor(Config):
    """A calibration parameter of the car as a factor of a column.

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

    name: CalibrationParameterName
    grain: Annotated[Decimal, Field(gt=0)]
    less: Annotated[int, Field(ge=-COUNT_MAX, le=COUNT_MAX)] = 0
    alone: bool = False
    running: "Definition | None" = None

    @model_validator(mode="after")
    def _runs_plainly(self) -> "ParameterFactor":
        running = self.running
        if running and (
            running.over != "running_mean" or running.fact or running.number or self.less
        ):
            raise ValueError("running is a mean since the drive began, without factors")
        return self


class Combination(Config):
    """The estimate of a line, or any sum of columns: `(intercept + sum(c * column)) / divisor`.

    `line` names the line whose coefficients these are; "" where none has been fitted yet.
    """

    intercept: Whole = 0
    terms: tuple[tuple[Whole, "Definition"], ...] = ()
    divisor: Annotated[int, Field(ge=1, le=LARGEST_DIVISOR)] = 1
    line: Annotated[LineId | None, _LEFT_OUT] = None

    @property
    def columns(self) -> tuple["Definition", ...]:
        """The columns that it is made of."""
        return tuple(column for _, column in self.terms)


def _product_ratio(value: Fraction) -> Fraction:
    if not 0 < value.numerator <= 2**12 or value.denominator > 2**40:
        raise ValueError(f"the scale of its factors is {value} of its own: choose another")
    return value


class Product(Config):
    """The product of two columns times `ratio`; of one, it times `ratio`; of none, `ratio`."""

    of: tuple["Definition", ...] = Field(max_length=2)
    ratio: Annotated[Fraction, AfterValidator(_product_ratio)] = Fraction(1)

    @property
    def columns(self) -> tuple["Definition", ...]:
        """The columns that it is made of."""
        return self.of


def _weight(value: Fraction) -> Fraction:
    if not 0 < value <= 1 or value.denominator > LARGEST_WEIGHT:
        raise ValueError(
            f"a weight is above 0, at most 1, with a denominator up to {LARGEST_WEIGHT}"
        )
    return value


class Equation(Config):
    """What a column `y` is, but for noise, at each tick: a sum of unknowns times columns `x`.

    A whole number in `x` is a column that is always the same. `weight` is that of its products.
    """

    y: "Definition"
    x: tuple["Definition | Whole", ...] = Field(min_length=1, max_length=4)
    weight: Annotated[Fraction, AfterValidator(_weight)] = Fraction(1)

    @property
    def columns(self) -> tuple["Definition", ...]:
        """The columns that it is made of."""
        return (self.y, *(column for column in self.x if isinstance(column, Definition)))


class Slope(Config):
    """The first unknown of equations, by least squares over all ticks since the drive began.

    Products of columns, each a sixteenth and rounded, are summed up over the ticks that lack
    nothing, and `ridge` is added to each diagonal: Gaussian elimination of whole numbers then
    solves them (`fleet_slip.columns.lowering`). The unknown times `ratio` is rounded.
    """

    equations: tuple[Equation, ...] = Field(min_length=1, max_length=4)
    ridge: tuple[Annotated[int, Field(ge=1, le=2**40)], ...]
    ratio: Annotated[Fraction, Field(gt=0)] = Fraction(1)

    @model_validator(mode="after")
    def _consistent(self) -> "Slope":
        if any(len(equation.x) != len(self.ridge) for equation in self.equations):
            raise ValueError("each equation has as many columns as there are unknowns")
        if max(self.ratio.numerator, self.ratio.denominator) > LARGEST_SLOPE:
            raise ValueError(f"the ratio of a slope has no part above {LARGEST_SLOPE}")
        if any(equation.bits > COUNT_BITS for equation in self.columns):
            raise ValueError(f"the columns of a slope have {COUNT_BITS} bits")
        return self

    @property
    def columns(self) -> tuple["Definition", ...]:
        """The columns that it is made of."""
        return tuple(column for equation in self.equations for column in equation.columns)


Made = Combination | Product | Slope
"""What is made of other columns."""


class Definition(Config):
    """Everything that defines a column of counts over time, whatever it is called.

    Attributes:
        of: the signal, feature, or what is made of columns, that is looked back on.
        sql: integer SQL of that feature; empty for a logged signal.
        made: what is made of other columns, if that is looked back on.
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
    made: Annotated[Made | None, _LEFT_OUT] = None
    of_bits: Bits = COUNT_BITS
    over: Over | None = None
    ticks: int = Field(default=0, ge=0, le=LONGEST_TICKS)
    ratio: Ratio = Fraction(1)
    bits: Bits = 20
    fact: AttributeFactor | None = None
    gate: Annotated[Gate | None, _LEFT_OUT] = None
    number: Annotated[ParameterFactor | None, _LEFT_OUT] = None

    @model_validator(mode="after")
    def _ticks_fit(self) -> "Definition":
        if (self.over in {"mean", "sum", "lag", "change"}) != bool(self.ticks):
            raise ValueError("ticks is for mean, sum, lag and change, which must have it")
        return self

    @model_validator(mode="after")
    def _of_is_known(self, info: ValidationInfo) -> "Definition":
        logged = not (self.sql or self.made)
        if self.sql and self.made:
            raise ValueError(f"{self.of} is a feature, or made of columns, not both")
        signals = _signals_of(info)
        if signals is None:
            return self
        if logged and self.of not in signals.feature_inputs:
            raise ValueError(f"{self.of} is not an input signal")
        if not logged and self.of in {*signals.signals, *signals.drive, "tick", "day"}:
            raise ValueError(f"{self.of} is the name of a column of the logs")
        return self

    @property
    def signals(self) -> tuple[str, ...]:
        """The logged signals in it."""
        names: dict[str, None] = {}
        for row in self.rows():
            inputs = parse(row.sql).inputs if row.sql else () if row.made else (row.of,)
            names |= dict.fromkeys(inputs)
        return tuple(names)

    def rows(self, seen: "set[int] | None" = None) -> "Iterator[Definition]":
        """Yield what it and the columns in it look back on, each as a column of one row.

        What is made of columns is passed over if its identity was `seen`.
        """
        seen = set() if seen is None else seen
        if self.made is None or id(self.made) not in seen:
            seen.add(id(self.made))
            yield self.row
            for column in self.made.columns if self.made else ():
                yield from column.rows(seen)
        for beside in (self.gate and self.gate.by, self.number and self.number.running):
            if beside:
                yield from beside.rows(seen)

    @property
    def row(self) -> "Definition":
        """What it looks back on, as a column of one row."""
        return Definition.model_construct(
            of=self.of, sql=self.sql, made=self.made, of_bits=self.of_bits, bits=self.of_bits
        )

    @property
    def ungated(self) -> "Definition":
        """The same without its gate."""
        return self.model_copy(update={"gate": None})

    @property
    def components(self) -> tuple["Definition", ...]:
        """What it is made of, each without a gate: itself, or the gated column and the gate's."""
        return (self.ungated, self.gate.by) if self.gate else (self,)


def plain_column(name: str, sql: str = "", bits: int = COUNT_BITS) -> Definition:
    """Return the definition of a signal, or of a feature of so many bits, as a column itself."""
    return Definition.model_construct(of=name, sql=sql, of_bits=bits, bits=bits)


def rows_behind(definitions: Mapping[str, Definition]) -> dict[str, Definition]:
    """Return what columns look back on, each as a column of one row, by name.

    Raises `QuestionError` if a column has the name of a feature behind one and is something else,
    or a feature is defined in two ways.
    """
    rows: dict[str, Definition] = {}
    seen = set[int]()
    for row in (row for definition in definitions.values() for row in definition.rows(seen)):
        if rows.setdefault(row.of, row) != row:
            raise QuestionError(f"the feature {row.of} is defined in two ways.")
    for name, definition in definitions.items():
        computed = name in rows and (rows[name].sql or rows[name].made)
        if computed and (
            definition.over
            or definition.fact
            or definition.gate
            or definition.number
            or definition.of != name
        ):
            raise QuestionError(f"{name} is a column, and a feature that another looks back on.")
    return rows


# Which columns change sign, and nothing else, when left and right are exchanged: odd ones.
#
# The side-slip angle does. So a line without an intercept is one of odd columns: an even one, such
# as the longitudinal acceleration, has a mean that would stand in the place of the intercept.

OPPOSITE = frozenset(
    {"ay", "yaw_rate", "steering_wheel", "steer", "steer_fl", "steer_fr", "roll_rate"}
)
"""Signals of the other sign in the mirror. A front wheel's angle is nearly that of the other."""
EXCHANGED = {"wheel_fl": "wheel_fr", "wheel_rl": "wheel_rr"}
EXCHANGED |= {right_wheel: left_wheel for left_wheel, right_wheel in EXCHANGED.items()}
"""Signals that are those of the other side in the mirror; what is in neither stays."""
OFFSETS = frozenset({"yaw_rate_offset", "ay_offset", "steering_offset"})
"""Numbers of a car of the other sign in the mirror."""
TRIALS = 16
"""Rows that a definition is tried on."""


@cache
def parity(column: Definition) -> int:
    """Return -1 for an odd column, 1 for an even one, 0 for one that is neither.

    A gate must be opened by an even column: hats over an odd one differ from side to side.
    """
    if column.made:  # no set of changes has what is made of columns
        return 0
    if column.gate:
        return parity(column.ungated) if parity(column.gate.by) == 1 else 0
    if column.number:
        base_parity = (
            1 if column.number.alone else parity(column.model_copy(update={"number": None}))
        )
        return -base_parity if column.number.name in OFFSETS else base_parity
    values = [(_value(column, row), _value(column, _mirrored(row))) for row in _trial_rows(column)]
    if all(a == b for a, b in values):
        return 1
    return -1 if all(a is not None and b == -a for a, b in values) else 0


def _value(column: Definition, row: Mapping[str, int]) -> int | None:
    return evaluate(column.sql, row) if column.sql else row[column.of]


def _trial_rows(definition: Definition) -> tuple[Mapping[str, int], ...]:
    """Return counts of cars at speed, whose left and right wheels differ, the same every time."""
    draw = Random(1)  # noqa: S311 - no secret
    names = sorted({*definition.signals, *EXCHANGED})
    return tuple(
        {name: draw.randint(4000, 6000) for name in names}
        | {name: draw.choice((-1, 1)) * draw.randint(500, 3000) for name in sorted(OPPOSITE)}
        for _ in range(TRIALS)
    )


def _mirrored(row: Mapping[str, int]) -> Mapping[str, int]:
    return {
        name: -row[name] if name in OPPOSITE else row[EXCHANGED.get(name, name)] for name in row
    }
