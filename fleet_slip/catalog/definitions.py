"""Definitions of columns of counts over time, as types of a manifest.

A window covers past values of a logged signal or a feature within a drive. The same rules hold in
SQL, in the kernel and on board:

* A window of N ticks contains the values logged in the last N ticks, the current one included. At
  the start of a drive or after a gap there are fewer values; a mean divides by their number.
* If the current value is missing, mean and sum are missing.
* The value N ticks ago, and the change since, are missing if that tick was not logged.
* Everything is an integer. A quotient is rounded to the nearest, halves away from zero, once; then
  the count is clipped to its bits.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from functools import cache
from itertools import pairwise
from random import Random
from typing import Annotated, Literal

from pydantic import (
    AfterValidator,
    Field,
    FiniteFloat,
    StringConstraints,
    ValidationInfo,
    model_validator,
)

from fleet_slip.catalog.arithmetic import evaluate, nearest, parse
from fleet_slip.catalog.signals import COUNT_MAX, Identifier, SignalCatalog, SIUnit
from fleet_slip.config import Config
from fleet_slip.errors import QuestionError

# Calibration parameters: properties of a car that its own drives determine without a label.
#
# Each has a physical value. Models and cars use it as an integer count of its grain. A value beyond
# 16 bits is unknown.

CALIBRATION = "calibration"
"""Feature set whose Gram rows determine the parameters."""

BY_SATELLITE = "calibration_satellite"
"""Feature set that determines `speed_ratio` where the receiver logs the speed."""

BY_COURSE = "calibration_course"
"""Feature set that determines the slip parameters where the receiver logs the course."""

DELAY = "delay"
"""Feature set whose Gram rows determine the delay of a satellite receiver."""

CalibrationParameterName = Literal[
    "yaw_rate_offset",
    "ay_offset",
    "steering_offset",
    "speed_ratio",
    "steer_per_curvature",
    "understeer",
    "slip_lever",
    "slip_compliance",
]


@dataclass(frozen=True)
class CalibrationParameter:
    """One calibration parameter: its unit, grain and meaning."""

    unit: SIUnit
    grain: Decimal
    description: str

    def count(self, value: Fraction) -> int | None:
        """Return a value as an integer count of the grain; None beyond 16 bits."""
        return round_number(value, Fraction(self.grain))


def round_number(value: Fraction, grain: Fraction) -> int | None:
    """Return a value in counts, to the nearest, halves away from zero; None beyond 16 bits."""
    ratio = value / grain
    count = nearest(ratio.numerator, ratio.denominator)
    return count if abs(count) <= COUNT_MAX else None


_PARAMETERS: tuple[tuple[CalibrationParameterName, SIUnit, str, str], ...] = (
    ("yaw_rate_offset", "rad/s", "0.00000625",
     "What the gyroscope says when the car does not turn, by ay over speed"),
    ("ay_offset", "m/s^2", "0.0000625",
     "What the accelerometer says to the side when the car goes straight"),
    ("steering_offset", "rad", "0.00000625",
     "Mean steering angle of the front wheels when the car goes straight"),
    ("speed_ratio", "1", "0.0005",
     "Speed over that of wheels of 0.31 m: the tyres' radius"),
    ("steer_per_curvature", "m", "0.002",
     "Steering angle for each curvature by wheels of 0.31 m: the wheelbase over speed_ratio"),
    ("understeer", "rad*s^2/m", "0.00002",
     "Steering angle that each lateral acceleration takes beyond: the tyres and the load"),
    ("slip_lever", "m", "0.002",
     "Slip for each curvature by wheels of 0.31 m: how far the rear axle is behind"),
    ("slip_compliance", "rad*s^2/m", "0.000002",
     "Slip that each lateral acceleration adds: the rear tyres and the load"),
)  # fmt: skip

CALIBRATION_PARAMETERS: dict[CalibrationParameterName, CalibrationParameter] = {
    name: CalibrationParameter(unit, Decimal(grain), description)
    for name, unit, grain, description in _PARAMETERS
}
"""All parameters, in the order of display."""


# Definitions.

Over = Literal["mean", "sum", "lag", "change", "running_mean"]
"""Function of a window: mean or sum over the last ticks, value N ticks ago, change since then, mean
since the start of the drive."""

MAX_CHANGE_TICKS = 2**16
"""Longest window: eleven minutes."""

LARGEST_RATIO = 2**14
"""Largest numerator and denominator of a ratio of scales: keeps every quotient below 2^53."""

MAX_ATTRIBUTE = 2**16
"""Largest absolute value of a numeric vehicle attribute."""

COUNT_BITS = 16
"""Bits of a logged count, and by default of a feature."""

LARGEST_BITS = 20
"""Bits of a column over time by default."""

Bits = Annotated[int, Field(ge=COUNT_BITS, le=LARGEST_BITS)]

AttributeText = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_.-]{1,60}$")]

NO_CAR_KNOWS = frozenset({"adhesion", "lost_control_s", "speed_factor", "saturated"})
"""Drive columns that only a simulation knows, or that are known after the drive."""

NOT_ATTRIBUTES = NO_CAR_KNOWS | {
    *("drive_id", "drive_name", "source_file", "trip_id", "started_at", "duration_s", "rows"),
    *("vehicle_id", "source", "campaign", "track"),
}


def limit_of(bits: int) -> int:
    """Return the largest count of `bits`; the range is symmetric."""
    return int(2 ** (bits - 1) - 1)


def _bounded(largest_numerator: int, largest_denominator: int) -> AfterValidator:
    """Return a validator of a positive ratio with bounded numerator and denominator."""

    def validate(value: Fraction) -> Fraction:
        if not 0 < value.numerator <= largest_numerator or value.denominator > largest_denominator:
            raise ValueError(
                f"the scales are {value} to one: choose scales whose ratio has a numerator up to "
                f"{largest_numerator} and a denominator up to {largest_denominator}"
            )
        return value

    return AfterValidator(validate)


def _signals_of(info: ValidationInfo) -> SignalCatalog | None:
    """Return the signals of the validation context, to check names; None without them."""
    return info.context if isinstance(info.context, SignalCatalog) else None


def integer_arithmetic(sql: str, info: ValidationInfo) -> str:
    """Validate the SQL of a feature. Raises `ValueError` for more than integer arithmetic.

    With a `SignalCatalog` as context, its names must be input signals.
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


Ratio = Annotated[Fraction, _bounded(LARGEST_RATIO, LARGEST_RATIO)]

LARGEST_DIVISOR = 2**46

LARGEST_WEIGHT = 2**10

LARGEST_SLOPE = 2**36
"""Largest numerator or denominator of a slope's ratio: times 25 bits it has 61."""

Whole = Annotated[int, Field(ge=-(2**62), le=2**62)]

LineId = Annotated[str, StringConstraints(pattern=r"^([0-9a-f]{12})?$")]
"""The first digits of a first-stage model's checksum."""


_LEFT_OUT = Field(exclude_if=lambda value: value is None)

Positive = Annotated[FiniteFloat, Field(ge=1e-9, le=1e9)]
NotNegativeFloat = Annotated[FiniteFloat, Field(ge=0, le=1e9)]
"""Numbers of a car: bounded, as a definition may come from anywhere."""


class AttributeFactor(Config):
    """A vehicle attribute, as a whole number, as a factor of a column.

    The factor is attribute `name`, rounded, minus `less`; with `equals`, 1 for cars of that value
    and 0 for others. Column times factor times `ratio` is rounded and clipped.
    """

    name: Annotated[Identifier, AfterValidator(_not_unknowable)]
    less: Annotated[int, Field(ge=-MAX_ATTRIBUTE, le=MAX_ATTRIBUTE)] = 0
    equals: AttributeText | None = None
    ratio: Ratio = Fraction(1)

    @model_validator(mode="after")
    def _fits_its_type(self, info: ValidationInfo) -> "AttributeFactor":
        signals = _signals_of(info)
        text = signals is not None and signals.drive[self.name].type == "string"
        if signals and text != (self.equals is not None):
            raise ValueError(f"{self.name} {'needs' if text else 'is a number without'} equals")
        return self


WEIGHT = 2**10
"""Full weight of a gate."""


class Gate(Config):
    """The weight of a column: a hat function of another column.

    The weight is 0 up to `low`, `WEIGHT` at `peak`, and 0 from `high`, linear in between. It is
    rounded down on the way up, so that neighbouring weights add up to `WEIGHT`. Without `high` it
    stays full. Column times weight over `WEIGHT` is rounded.

    Attributes
    ----------
    by
        The column that determines the weight; it has no gate or factor.
    low, peak, high
        Counts of it, increasing.
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

    The product with the parameter's count minus `less` is neither rounded nor clipped. If the
    parameter is unknown, the mean since the start of the drive replaces it, `running`; without that
    the factor is 0, as of a typical car.

    Attributes
    ----------
    name, grain
        The parameter, and the physical value of one count.
    less
        Count of a typical car.
    alone
        True if the column is the factor itself, wherever the base column has a value.
    running
        Column that replaces an unknown parameter.
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


class Composite(Config):
    """A column that is made of others."""

    @property
    def columns(self) -> tuple["Definition", ...]:
        """The columns that it is made of, in the order of its fields."""

        def definitions(part: object) -> Iterator["Definition"]:
            if isinstance(part, Definition):
                yield part
            elif isinstance(part, Config | tuple):
                for value in part if isinstance(part, tuple) else vars(part).values():
                    yield from definitions(value)

        return tuple(definitions(self))


class Combination(Composite):
    """A linear combination of columns: `(intercept + sum(c * column)) / divisor`.

    `line` is the digest of its first-stage model, "" if that has not been fitted yet.
    """

    intercept: Whole = 0
    terms: tuple[tuple[Whole, "Definition"], ...] = ()
    divisor: Annotated[int, Field(ge=1, le=LARGEST_DIVISOR)] = 1
    line: Annotated[LineId | None, _LEFT_OUT] = None


class Product(Composite):
    """The product of up to two columns and `ratio`."""

    of: tuple["Definition", ...] = Field(max_length=2)
    ratio: Annotated[Fraction, _bounded(2**12, 2**40)] = Fraction(1)


class Equation(Config):
    """A linear equation at each tick: `y` is the sum of unknowns times columns `x`, plus noise.

    An integer in `x` is a constant column. `weight` multiplies its products.
    """

    y: "Definition"
    x: tuple["Definition | Whole", ...] = Field(min_length=1, max_length=4)
    weight: Annotated[Fraction, Field(le=1), _bounded(LARGEST_WEIGHT, LARGEST_WEIGHT)] = Fraction(1)


class Slope(Composite):
    """The first unknown of equations, by least squares over all ticks since the drive's start.

    Products of columns, each a sixteenth and rounded, are summed up over the ticks that lack
    nothing, and `ridge` is added to each diagonal: Gaussian elimination of whole numbers then
    solves them (`fleet_slip.columns.lowering`). The unknown times `ratio` is rounded.
    """

    equations: tuple[Equation, ...] = Field(min_length=1, max_length=4)
    ridge: tuple[Annotated[int, Field(ge=1, le=2**40)], ...]
    ratio: Annotated[Fraction, _bounded(LARGEST_SLOPE, LARGEST_SLOPE)] = Fraction(1)

    @model_validator(mode="after")
    def _consistent(self) -> "Slope":
        if any(len(equation.x) != len(self.ridge) for equation in self.equations):
            raise ValueError("each equation has as many columns as there are unknowns")
        if any(equation.bits > COUNT_BITS for equation in self.columns):
            raise ValueError(f"the columns of a slope have {COUNT_BITS} bits")
        return self


class ObserverInput(Config):
    """A measured quantity: `scale` times the sum of columns, or their difference, minus `offset`.

    The scale is that of the count in SI units, with the gain of the sensor.
    """

    of: tuple["Definition", ...] = Field(min_length=1, max_length=2)
    scale: Annotated[FiniteFloat, Field(ge=-1e6, le=1e6)]
    adds: bool = True
    offset: Annotated[FiniteFloat, Field(ge=-100, le=100)] = 0.0


class ObserverCar(Config):
    """Car and noise of an observer, in SI units; stiffnesses are the peaks of one tyre."""

    mass_kg: Positive
    yaw_inertia_kgm2: Positive
    front_axle_m: Positive
    rear_axle_m: Positive
    height_m: Positive
    track_front_m: Positive
    track_rear_m: Positive
    front_roll_share: Positive
    roll_lag_s: Positive
    pitch_lag_s: Positive
    stiffness_front_n: Positive
    stiffness_rear_n: Positive
    stiffness_load_n: Positive
    friction: Positive
    friction_load_sensitivity: NotNegativeFloat
    nominal_load_n: Positive
    ax_std_mps2: NotNegativeFloat
    lateral_model_std_mps2: NotNegativeFloat
    yaw_model_std_rad_s2: NotNegativeFloat
    wheel_speed_std_mps: Positive
    yaw_rate_std_rad_s: Positive
    ay_std_mps2: Positive
    ay_bias_std_mps2: NotNegativeFloat
    gyro_std_rad_s: Positive
    gyro_bias_std_rad_s: Positive
    wheel_yaw_rate_std_rad_s: Positive
    yaw_acceleration_std_rad_s2: Positive


class Observer(Composite):
    """An extended Kalman filter of the single-track model (`fleet_slip.columns.observer`).

    Its value is the side-slip angle in 2⁻¹⁶ rad.

    Attributes
    ----------
    speed, wheels
        Speed of the wheels, and the right wheel's minus the left one's; without `wheels` a single
        speed replaces those of all wheels.
    ax
        None if it is not logged: the change of the speed replaces it.
    axle
        The axle of `speed` and `wheels`: front wheels turn.
    """

    ay: ObserverInput
    yaw_rate: ObserverInput
    speed: ObserverInput
    steer: ObserverInput
    ax: Annotated[ObserverInput | None, _LEFT_OUT] = None
    wheels: Annotated[ObserverInput | None, _LEFT_OUT] = None
    axle: Literal["front", "rear"] = "rear"
    car: ObserverCar


class Blend(Composite):
    """The filter plus a share of the clipped difference to the line, in 2⁻¹⁶ rad.

    See `fleet_slip.regression.combination`; `shares` are in 2⁻¹⁶, `limits` in 2⁻¹⁶ rad, at `knots`
    in counts of the column `lateral`. Where the line has no value it is the filter.
    """

    filter: "Definition"
    line: "Annotated[Definition | None, _LEFT_OUT]" = None
    anchor: Literal["line", "filter"] = "filter"
    shares: tuple[Annotated[int, Field(ge=0, le=2**16)], ...] = (0,)
    limits: tuple[Annotated[int, Field(ge=0, lt=2**19)], ...] = (0,)
    lateral: "Annotated[Definition | None, _LEFT_OUT]" = None
    knots: tuple[Annotated[int, Field(ge=0, lt=2**20)], ...] = (0,)

    @model_validator(mode="after")
    def _consistent(self) -> "Blend":
        if not len(self.shares) == len(self.limits) == len(self.knots):
            raise ValueError("shares, limits and knots have the same number of values")
        if any(a >= b for a, b in pairwise(self.knots)):
            raise ValueError("the knots increase")
        if (self.lateral is None) != (len(self.knots) == 1):
            raise ValueError("several knots need a column lateral, a single one has none")
        return self


Made = Combination | Product | Slope | Observer | Blend
"""Composites of other columns."""


class Definition(Config):
    """The definition of a column of counts over time, independent of its name.

    Attributes
    ----------
    of
        Name of its source: a signal, a feature or a composite of columns.
    sql
        Integer SQL of a feature; empty for a logged signal.
    made
        Composite of columns, if that is the source.
    of_bits
        Bits to which the source is clipped.
    over, ticks
        The window; `ticks` is 0 for all since the start of the drive. Without `over` it is the
        current value.
    ratio
        Counts of the column per count of the source.
    bits
        Bits to which the column is clipped.
    fact, gate, number
        A vehicle attribute, a weight and a calibration parameter that multiply it.
    """

    of: Identifier
    sql: Annotated[str, AfterValidator(integer_arithmetic)] = ""
    made: Annotated[Made | None, _LEFT_OUT] = None
    of_bits: Bits = COUNT_BITS
    over: Over | None = None
    ticks: int = Field(default=0, ge=0, le=MAX_CHANGE_TICKS)
    ratio: Ratio = Fraction(1)
    bits: Bits = 20
    fact: AttributeFactor | None = None
    gate: Annotated[Gate | None, _LEFT_OUT] = None
    number: Annotated[ParameterFactor | None, _LEFT_OUT] = None

    @model_validator(mode="after")
    def _consistent(self, info: ValidationInfo) -> "Definition":
        if (self.over in {"mean", "sum", "lag", "change"}) != bool(self.ticks):
            raise ValueError("ticks is for mean, sum, lag and change, which must have it")
        if self.sql and self.made:
            raise ValueError(f"{self.of} is a feature, or made of columns, not both")
        logged, signals = not (self.sql or self.made), _signals_of(info)
        if signals and logged and self.of not in signals.feature_inputs:
            raise ValueError(f"{self.of} is not an input signal")
        if signals and not logged and self.of in {*signals.signals, *signals.drive, "tick", "day"}:
            raise ValueError(f"{self.of} is the name of a column of the logs")
        return self

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of its logged signals."""
        names: dict[str, None] = {}
        for row in self.rows():
            inputs = parse(row.sql).inputs if row.sql else () if row.made else (row.of,)
            names |= dict.fromkeys(inputs)
        return tuple(names)

    def rows(self, seen: "set[int] | None" = None) -> "Iterator[Definition]":
        """Yield the sources of it and its columns, each as a column of one row.

        Skips composites whose identity was `seen`.
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
        """Its source, as a column of one row."""
        return Definition.model_construct(
            of=self.of, sql=self.sql, made=self.made, of_bits=self.of_bits, bits=self.of_bits
        )

    @property
    def ungated(self) -> "Definition":
        """The same without its gate."""
        return self.model_copy(update={"gate": None})

    @property
    def components(self) -> tuple["Definition", ...]:
        """Its components without gates and parameters: itself, and those that these refer to."""
        base = self.model_copy(update={"number": None}) if self.number else self
        components = (base.ungated, base.gate.by) if base.gate else (base,)
        running = self.number.running if self.number else None
        return (*components, running) if running else components


def plain_column(name: str, sql: str = "", bits: int = COUNT_BITS) -> Definition:
    """Return the definition of a signal or feature as a column of one row."""
    return Definition.model_construct(of=name, sql=sql, of_bits=bits, bits=bits)


def rows_behind(definitions: Mapping[str, Definition]) -> dict[str, Definition]:
    """Return the sources of columns, each as a column of one row, by name.

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
        changed = definition.over or definition.fact or definition.gate or definition.number
        if computed and (changed or definition.of != name):
            raise QuestionError(f"{name} is a column, and a feature that another looks back on.")
    return rows


# Odd columns change sign, and nothing else, when left and right are exchanged.
#
# The side-slip angle is odd. So a model without an intercept uses odd columns: the mean of an even
# one, such as the longitudinal acceleration, would replace the intercept.

OPPOSITE = frozenset(
    {"ay", "yaw_rate", "steering_wheel", "steer", "steer_fl", "steer_fr", "roll_rate"}
)
"""Signals that change sign in the mirror. Both front wheels have nearly the same angle."""
EXCHANGED = {"wheel_fl": "wheel_fr", "wheel_rl": "wheel_rr"}
EXCHANGED |= {right_wheel: left_wheel for left_wheel, right_wheel in EXCHANGED.items()}
"""Signals that the mirror exchanges; it does not change the others."""
OFFSETS = frozenset({"yaw_rate_offset", "ay_offset", "steering_offset"})
"""Calibration parameters that change sign in the mirror."""
TRIALS = 16
"""Rows on which a definition is evaluated."""


@cache
def parity(column: Definition) -> int:
    """Return -1 for an odd column, 1 for an even one, 0 for one that is neither.

    The column of a gate must be even: weights by an odd one differ from side to side.
    """
    if column.made:  # no set of changes has what is made of columns
        return 0
    if column.gate:
        return parity(column.ungated) if parity(column.gate.by) == 1 else 0
    if column.number:
        sign = -1 if column.number.name in OFFSETS else 1
        base = column.model_copy(update={"number": None})
        return sign if column.number.alone else sign * parity(base)
    pairs = []
    for row in _trial_rows(column):
        mirrored = {
            name: -row[name] if name in OPPOSITE else row[EXCHANGED.get(name, name)] for name in row
        }
        pairs.append(
            [evaluate(column.sql, r) if column.sql else r[column.of] for r in (row, mirrored)]
        )
    if all(a == b for a, b in pairs):
        return 1
    return -1 if all(a is not None and b == -a for a, b in pairs) else 0


def _trial_rows(definition: Definition) -> list[dict[str, int]]:
    """Return reproducible counts of moving cars with different left and right wheels."""
    draw = Random(1)  # noqa: S311 - no secret
    names = sorted({*definition.signals, *EXCHANGED})
    return [
        {name: draw.randint(4000, 6000) for name in names}
        | {name: draw.choice((-1, 1)) * draw.randint(500, 3000) for name in sorted(OPPOSITE)}
        for _ in range(TRIALS)
    ]
