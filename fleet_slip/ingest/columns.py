"""How one column of a file becomes a signal: unit, sign, gain, offset, table, delay.

Course and speed over ground are two columns: an angle with a speed, or two velocities.
"""

import operator
import re
import warnings
from collections.abc import Callable, Sequence
from collections.abc import Mapping as Named
from contextlib import suppress
from datetime import UTC, datetime
from functools import cache, reduce
from typing import Annotated, Any, Literal, TypeAlias
from zoneinfo import available_timezones

import pint
import polars as pl
from pydantic import Field, field_validator, model_validator

from fleet_slip.catalog.course import COURSE, SATELLITE_SPEED
from fleet_slip.catalog.signals import HALF_TURN, SAMPLE_TIME_S, Signal, SignalCatalog
from fleet_slip.config import Config, Name, PositiveFloat, added
from fleet_slip.ingest.formats.source import OWN_TIME

STEP_S = float(SAMPLE_TIME_S)
TIME_EPSILON_S = 1e-6
"""Times that differ by less are equal: a float64 of seconds since 1970 resolves 0.24 µs."""

_TERM = r"(?:°|[^\W\d]+\d?)(?:(?:\^|\*\*)-?\d)?"
_EXPRESSION = re.compile(rf"(?:1/)?{_TERM}(?:[*/ ]{_TERM})*")
_POWER = re.compile(r"(?<=[^\W\d_])([2-9])(?!\w)")
_GRAD = re.compile(r"(?<![^\W\d_])grad(?:e|s)?(?![^\W\d_])", re.IGNORECASE)
"""Gradians in English, degrees in German; with a capital letter pint reads 10^9 radians."""
_MAX_UNIT_CHARACTERS = 40

_NEEDS = {
    "rad": "an angle, such as 'deg'",
    "rad/s": "an angular velocity, such as 'deg/s' or 'rpm'",
    "m": "a length, such as 'm'",
    "m/s": "a velocity, such as 'km/h'",
    "m/s^2": "an acceleration, such as 'g' or 'm/s^2'",
    "s": "a time, such as 'ms'",
    "Pa": "a pressure, such as 'bar'",
    "1": "a number: '1', or '%'",
}
_NUMBERS = {"1": 1.0, "%": 0.01, "percent": 0.01}


@cache
def conversion_factor(unit: str, si_unit: str, quantity: str = "it") -> float:
    """Return f in `value in si_unit = f * value in unit`; messages name the `quantity`.

    In an acceleration `g` is standard gravity, 9.80665 m/s². The radian counts as a dimension, so
    that a ratio is no angle and Hz is not rad/s: that would be wrong by 2π or by 100.
    Raises `ValueError` with the unit that is needed.
    """
    needs = f"{quantity} needs {_NEEDS.get(si_unit, f'a unit like {si_unit!r}')}"
    if si_unit == "1" and unit in _NUMBERS:
        return _NUMBERS[unit]
    # The pattern keeps pint from evaluating arithmetic: '9^9^9^9' would never end.
    if len(unit) > _MAX_UNIT_CHARACTERS or not _EXPRESSION.fullmatch(unit):
        raise ValueError(f"has the invalid unit {unit[:_MAX_UNIT_CHARACTERS]!r}; {needs}")
    if _GRAD.search(unit):
        degrees, gradians = (_GRAD.sub(word, unit) for word in ("deg", "gon"))
        raise ValueError(
            f"has the ambiguous unit {unit!r}: write {degrees!r} for degrees (360 a turn), or "
            f"{gradians!r} for gradians (400 a turn)"
        )
    registry = pint.application_registry
    name = "standard_gravity" if unit == "g" and si_unit == "m/s^2" else unit
    if name not in registry:  # a digit after a letter is a power, as in m/s2
        name = _POWER.sub(r"^\1", name)
    try:
        root = registry.Quantity(1.0, name).to_root_units()
        target = registry.Quantity(1.0, si_unit).to_root_units()
    except (pint.PintError, ValueError, TypeError, AttributeError):
        raise ValueError(f"has the unknown unit {unit!r}; {needs}") from None
    if root.units != target.units:
        raise ValueError(f"is in {unit!r}, {needs}")
    return float(root.magnitude) / float(target.magnitude)


def measures(unit: str, si_unit: str) -> bool:
    """Return True if a unit has the dimension of an SI unit."""
    with suppress(ValueError):
        conversion_factor(unit, si_unit)
        return True
    return False


NAN_TEXT = r"(?i)^[+-]?(nan|1\.#(qnan|snan|ind))\b"
"""Pattern of texts by which programs write NaN, a missing value."""
_GROUPED = r"^[+-]?[1-9]\d{0,2}(\.\d{3})+(,\d*)?$"


def parse_numbers(text: pl.Expr, *, decimal_comma: bool) -> pl.Expr:
    """Return texts as float64, null for texts that are not numbers.

    With a decimal comma a point groups digits: 1.320 is 1320, and 0.5 is no number.
    """
    if decimal_comma:
        has_point = text.str.contains(".", literal=True)
        plain = pl.when(~has_point | text.str.contains(_GROUPED)).then(text)
        text = plain.str.replace_all(".", "", literal=True).str.replace(",", ".", literal=True)
    return text.cast(pl.Float64, strict=False)


def is_number(text: str) -> bool:
    """Return True if a text is a number, such as one that means "no value"."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def without_missing(text: pl.Expr, missing: Sequence[str]) -> pl.Expr:
    """Return a text without spaces around it; null for texts that mark a missing value."""
    text = text.str.strip_chars()
    return pl.when(~text.is_in(["", *missing])).then(text)


def as_number(
    column: str, raw: pl.Expr, kind: pl.DataType, missing: Sequence[str], *, decimal_comma: bool
) -> pl.Expr:
    """Return a column as float64: null for a missing value, NaN for a text that is no number.

    Raises `ValueError` for a column of another type.
    """
    if kind == pl.String:
        text = without_missing(raw, missing)
        number = parse_numbers(text, decimal_comma=decimal_comma)
        is_missing = text.is_null() | number.is_nan() | text.str.contains(NAN_TEXT)
        number = pl.when(~is_missing.fill_null(value=False)).then(number.fill_null(float("nan")))
    elif kind.is_numeric():
        number = raw.cast(pl.Float64)
    else:
        raise unfit_column(column, kind, "numbers")
    absent = [float(text) for text in missing if is_number(text)]
    return pl.when(~number.is_in(absent)).then(number) if absent else number


def unfit_column(column: str | None, kind: pl.DataType, needed: str) -> ValueError:
    """Return the error of a column whose type does not fit the mapping."""
    return ValueError(f"column {column!r} has the type {kind}; the mapping needs {needed}.")


FiniteFloat = Annotated[float, Field(allow_inf_nan=False)]
OffsetM = Annotated[FiniteFloat, Field(ge=-15, le=15)]
WHEEL_PREFIX = "wheel_"
"""How the names of wheel speeds begin."""
VELOCITY = "m/s"
CHOOSE = "choose"
"""Placeholder of a draft for a unit that the file does not contain."""

Component: TypeAlias = Literal["north", "east"]


class SignBit(Config):
    """The column with the sign of a column that has magnitudes only."""

    column: Name
    negative: int | Name = 1
    """The text of that column where the value is negative."""


class SignalColumn(Config):
    """One column of the file: `signal = factor(unit) * (±gain * value + offset) / radius`.

    Keys that came after the first release are not part of the mapping's identity at their default,
    so that an upgrade does not ingest a file twice.
    """

    column: Name
    unit: str
    negate: bool = False
    """For axes that are not ISO 8855, such as y to the right."""
    sign: SignBit | None = added(None)
    """The column of the sign, if that is separate, as on the buses of some cars."""
    offset: FiniteFloat = 0.0
    """Added after the sign, in the column's unit."""
    gain: FiniteFloat = added(1.0)
    """Multiplies the value, such as the ratio of a steering gear."""
    radius_m: Annotated[FiniteFloat, Field(ge=0.05, le=2)] | None = added(None)
    """Rolling radius of a wheel whose speed is logged as a velocity."""
    delay_s: FiniteFloat = added(0.0, ge=-10, le=10)
    """Delay of a value in the file after its measurement, in s."""
    interpolate: bool = added(True)
    """False: samples are moved to the nearest tick, and ticks between them have no value."""
    longest_gap_s: Annotated[FiniteFloat, Field(gt=0, le=10)] | None = added(None)
    """Replaces the mapping's `longest_gap_s` for a signal with another rate."""
    time: Name | None = added(None)
    """Column of this signal's times if the file has several, in the unit of `[time]`."""

    component: Component | None = added(None)
    """Component of the velocity over ground, for `course = { north = …, east = … }`."""
    clockwise_from_north: bool | None = added(None)
    """True if the course is clockwise from north, False if counterclockwise from east."""
    antenna_x_m: OffsetM | None = added(None)
    """Distance of the receiver's antenna before the centre of gravity, in m."""
    antenna_y_m: OffsetM | None = added(None)
    """Distance of the antenna to the left of the centre of gravity, in m."""

    @field_validator("unit")
    @classmethod
    def _unit_is_chosen(cls, unit: str) -> str:
        if unit == CHOOSE:
            raise ValueError("the file has no unit: write the right one")
        return unit

    @field_validator("gain")
    @classmethod
    def _gain_is_something(cls, gain: float) -> float:
        if gain == 0:
            raise ValueError("gain cannot be 0")
        return gain

    def require_unit_of(self, signal: str, si_unit: str) -> None:
        """Raise `ValueError` if the column cannot be this signal."""
        is_wheel = signal.startswith(WHEEL_PREFIX)
        if self.radius_m is not None and not is_wheel:
            raise ValueError("has radius_m, which is for wheel speeds only")
        if self.radius_m is None and is_wheel and measures(self.unit, VELOCITY):
            raise ValueError(
                f"is a velocity in {self.unit!r}; {signal} needs an angular velocity: add "
                "radius_m, the rolling radius of the wheel"
            )
        conversion_factor(self.unit, self._measured_in(si_unit), signal)

    def linear(self, si_unit: str) -> tuple[float, float]:
        """Return (gain, bias): `value in SI = gain * value in the file + bias`."""
        factor = conversion_factor(self.unit, self._measured_in(si_unit))
        if self.radius_m is not None:
            factor /= self.radius_m
        return (-factor if self.negate else factor) * self.gain, factor * self.offset

    def _measured_in(self, si_unit: str) -> str:
        return si_unit if self.radius_m is None and not self.component else VELOCITY


def split_components(signals: Any) -> Any:
    """Return the signals with `course = { north, east }` as a column each. Raises `ValueError`."""
    course = signals.get(COURSE) if isinstance(signals, dict) else None
    if not isinstance(course, dict) or not {"north", "east"} & set(course):
        return signals
    if missing := [key for key in ("north", "east") if key not in course]:
        raise ValueError(f"course: {missing[0]} is missing: it needs both velocities")
    if SATELLITE_SPEED in signals or "column" in course:
        raise ValueError("course: north and east give the speed too: leave the other columns out")
    shared = {key: value for key, value in course.items() if key not in {"north", "east"}}
    return {
        **signals,
        COURSE: {**shared, "column": course["north"], "component": "north"},
        SATELLITE_SPEED: {**shared, "column": course["east"], "component": "east"},
    }


def require_course_columns(signals: Named[str, SignalColumn]) -> None:
    """Raise `ValueError` if a key or a column that a course needs is missing."""
    for name, signal in signals.items():
        keys = (
            signal.clockwise_from_north,
            signal.antenna_x_m,
            signal.antenna_y_m,
            signal.component,
        )
        if name not in {COURSE, SATELLITE_SPEED} and any(key is not None for key in keys):
            raise ValueError(f"signals.{name}: antenna and direction are keys of the course")
    course, speed = signals.get(COURSE), signals.get(SATELLITE_SPEED)
    if course is None:
        return
    if course.component is None and course.clockwise_from_north is None:
        raise ValueError(
            "signals.course: set clockwise_from_north = true (as receivers give it) or false "
            "(counterclockwise from east)"
        )
    if course.antenna_x_m is None or course.antenna_y_m is None:
        raise ValueError(
            "signals.course: set antenna_x_m (forward of the centre of gravity) and antenna_y_m "
            "(left of it). A 1 m error costs about 1° in bends"
        )
    if speed is None or "yaw_rate" not in signals:
        needed = SATELLITE_SPEED if speed is None else "yaw_rate"
        raise ValueError(f"signals.course: needs {needed}, too")
    if (course.time, course.delay_s) != (speed.time, speed.delay_s):
        raise ValueError(
            "signals.course: give satellite_speed the same time and delay_s: it is one receiver"
        )


def count_range(signals: SignalCatalog, name: str, column: SignalColumn) -> tuple[Signal, int, int]:
    """Return the signal whose scale a column has, and its smallest and largest valid count.

    A velocity component has the scale of the satellite speed, and either sign. A course may be
    given in any turn from -2 to 2.
    """
    if column.component:
        speed = signals[SATELLITE_SPEED]
        return speed, -speed.max_count, speed.max_count
    signal = signals[name]
    if name == COURSE:
        return signal, -4 * HALF_TURN, 4 * HALF_TURN
    return signal, signal.min_count, signal.max_count


class DateColumn(Config):
    """The column of dates that belongs to a time of the day, and its strftime codes."""

    column: Name
    format: Name = "%Y-%m-%d"


class TimeBase(Config):
    """The source of time, and the gaps that are interpolated or end a drive.

    One of three keys states it:

    * `column`, with a `unit` for numbers, or a `format` (strftime codes) for timestamps as text.
      Timestamps without a zone are UTC, or of the `zone`. A `date` may be a separate column. A
      timestamp column of Parquet needs no format.
    * `rate_hz`, for equally spaced rows.
    * `own_clock`, for a format that stores the times of samples.
    """

    column: Name | None = None
    unit: str | None = None
    format: Name | None = None
    date: DateColumn | None = added(None)
    rate_hz: Annotated[float, Field(ge=1, le=100_000)] | None = None
    epoch: bool = added(False)
    """Numbers are counted from 1970, in UTC, so that they have the date."""
    zone: str | None = added(None)
    """Time zone of timestamps, or of a file's clock, without one, such as `Europe/Berlin`."""
    assumed: bool = added(False)
    """The rate is a guess; each ingest reports it."""
    own_clock: bool = added(False)
    longest_gap_s: Annotated[PositiveFloat, Field(le=10)] = 0.1
    """Samples of a signal that lie further apart are not interpolated between."""
    split_gap_s: Annotated[PositiveFloat, Field(le=60)] = 1.0
    """A step in time larger than this, forward or back, begins a new drive."""

    @field_validator("format")
    @classmethod
    def _format_is_known(cls, text: str | None) -> str | None:
        if text is not None and not (_reads_back(text) or reads_clock(text)):
            raise ValueError(f"{text!r} is not a strftime format with date and time, or with time")
        return text

    @field_validator("zone")
    @classmethod
    def _zone_is_known(cls, zone: str | None) -> str | None:
        if zone is not None and zone not in available_timezones():
            raise ValueError(f"{zone!r} is not a time zone. Write it as 'Europe/Berlin'")
        return zone

    @model_validator(mode="after")
    def _consistent(self) -> "TimeBase":
        if [self.column is None, self.rate_hz is None, not self.own_clock].count(False) != 1:
            raise ValueError("needs either 'column', 'rate_hz', or 'own_clock' for files as MDF")
        has_unit, has_format = self.unit is not None, self.format is not None
        has_clock = has_format and reads_clock(str(self.format))
        if self.column is None and (has_unit or has_format):
            raise ValueError("'unit' and 'format' need a 'column'")
        if has_unit and has_format:
            raise ValueError("'unit' is for numbers and 'format' for timestamps: give one of them")
        if self.epoch and not has_unit:
            raise ValueError("'epoch' is for numbers: give their 'unit'")
        if self.assumed and self.rate_hz is None:
            raise ValueError("'assumed' is for an unknown rate_hz")
        if self.date is not None and not has_clock:
            raise ValueError("'date' needs a column whose 'format' has the time of day alone")
        if self.date is not None and not _reads_back(str(self.moment_format)):
            raise ValueError(f"{self.date.format!r} is not a strftime format of a date")
        if self.zone and (has_unit or self.rate_hz or "%z" in (self.format or "")):
            raise ValueError("'zone' is for timestamps or a clock without a time zone")
        if self.longest_gap_s > self.split_gap_s:
            raise ValueError("longest_gap_s cannot be larger than split_gap_s")
        if self.unit is not None:
            try:
                conversion_factor(self.unit, "s")
            except ValueError as error:
                raise ValueError(f"{self.column} {error}") from None
        return self

    @property
    def is_dated(self) -> bool:
        """True if times have the date."""
        if self.unit is not None or self.rate_hz is not None:
            return self.epoch
        if self.date is not None:
            return True
        return self.format is None or not reads_clock(self.format)

    @property
    def moment_format(self) -> str | None:
        """The format of a text, preceded by the date if that is a separate column."""
        return self.format if self.date is None else f"{self.date.format} {self.format}"

    def to_seconds(
        self,
        raw: pl.Expr,
        kind: pl.DataType,
        *,
        missing: Sequence[str] = (),
        decimal_comma: bool = False,
        dates: pl.Expr | None = None,
        later: pl.Expr | None = None,
    ) -> pl.Expr:
        """Return times in s, since 1970 if they have a date.

        Null for a missing time, NaN for other texts. `dates` is a separate column of dates; for
        `later` see `to_utc`. Raises `ValueError` for a column of another type.
        """
        if self.unit is not None:
            number = as_number(str(self.column), raw, kind, missing, decimal_comma=decimal_comma)
            return number * conversion_factor(self.unit, "s")
        text = moment = raw
        if kind == pl.String and self.format is not None:
            text = without_missing(raw, missing)
            if not self.is_dated:
                clock_s = as_clock_s(text, self.format)
                return clock_s.fill_null(pl.when(text.is_not_null()).then(float("nan")))
            dated = text if dates is None else dates + " " + text
            moment = as_moments(dated, str(self.moment_format))
        elif not isinstance(kind, pl.Datetime):
            needed = "a time: add 'unit' for numbers, 'format' for timestamps as text"
            raise unfit_column(self.column, kind, needed)
        time_s = self.to_utc(moment, kind, later).dt.epoch("us") / 1e6
        return time_s.fill_null(pl.when(text.is_not_null()).then(float("nan")))

    def to_utc(self, moment: pl.Expr, kind: pl.DataType, later: pl.Expr | None = None) -> pl.Expr:
        """Return timestamps without a zone as those of `zone`.

        An hour occurs twice when clocks are set back: `later` is true in the second one.
        """
        if self.zone is None or getattr(kind, "time_zone", None) is not None:
            return moment
        is_later = pl.lit(value=False) if later is None else later
        ambiguous = pl.when(is_later).then(pl.lit("latest")).otherwise(pl.lit("earliest"))
        return moment.dt.replace_time_zone(self.zone, ambiguous=ambiguous, non_existent="null")

    @property
    def batch_column(self) -> str | None:
        """The column of a batch that contains the times, None if rows are equally spaced."""
        return OWN_TIME if self.own_clock else self.column


def as_moments(text: pl.Expr, timestamp_format: str) -> pl.Expr:
    """Return texts as timestamps, null where they are none.

    Polars warns of `%f` with a place in our code; ingest reports the result of a wrong format.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", pl.exceptions.ChronoFormatWarning)
        return text.str.to_datetime(timestamp_format, time_unit="us", strict=False)


_DIGITS_ALONE = "%H%M%S"


def as_clock_s(text: pl.Expr, clock_format: str) -> pl.Expr:
    """Return times of the day in s, null for other texts.

    The hour of digits alone may lack its leading zeros: 91430.5 is 09:14:30.5.
    """
    if clock_format.startswith(_DIGITS_ALONE):
        digits = text.str.extract(r"^(\d*)", 1).str.len_chars()
        text = text.str.zfill(6 + text.str.len_chars() - digits)
    return text.str.to_time(clock_format, strict=False).cast(pl.Int64) / 1e9


def _reads_back(timestamp_format: str) -> bool:
    """Return True if a moment that is written in this format can be read, to the minute."""
    moment = datetime(2024, 5, 31, 12, 34, tzinfo=UTC)
    try:
        written = pl.Series([moment]).dt.to_string(timestamp_format)
        read = written.to_frame().select(as_moments(pl.col(written.name), timestamp_format))[0, 0]
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException):
        return False
    return isinstance(read, datetime) and read.replace(tzinfo=UTC) == moment


@cache
def reads_clock(timestamp_format: str) -> bool:
    """Return True if a format has the time of day and no date."""
    if _reads_back(timestamp_format):
        return False
    try:
        written = pl.Series(["12:34:00"]).str.to_time("%H:%M:%S").dt.to_string(timestamp_format)
        return bool(written.str.to_time(timestamp_format, strict=False).is_not_null().all())
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException):
        return False


# Conditions on rows.

Bound = Annotated[float, Field(allow_inf_nan=False)]
_BOUNDS: dict[str, Callable[[pl.Expr, float], Any]] = {
    "at_least": operator.ge,
    "at_most": operator.le,
    "above": operator.gt,
    "below": operator.lt,
    "other_than": operator.ne,
}


class RowCondition(Config):
    """A condition on one column, in the column's own unit; a missing value does not meet it."""

    column: Name
    at_least: Bound | None = None
    at_most: Bound | None = None
    above: Bound | None = added(None)
    below: Bound | None = added(None)
    other_than: Bound | None = added(None)
    one_of: tuple[Name, ...] = ()
    """Allowed texts, such as states of a fix. For a column of numbers: the numbers as text."""

    @model_validator(mode="after")
    def _says_something(self) -> "RowCondition":
        if bool(self.one_of) == bool(self.bounds):
            raise ValueError("needs either 'one_of', or bounds such as 'at_least' and 'at_most'")
        return self

    @property
    def bounds(self) -> dict[str, float]:
        """The limits that are given, by their key."""
        bounds = {key: getattr(self, key) for key in _BOUNDS}
        return {key: bound for key, bound in bounds.items() if bound is not None}

    def is_met(self, value: pl.Expr) -> pl.Expr:
        """Return where rows meet the condition; `value` is text for `one_of`, else a number."""
        if self.one_of:
            return value.is_in(self.one_of).fill_null(value=False)
        met = (_BOUNDS[key](value, bound) for key, bound in self.bounds.items())
        return reduce(operator.and_, met, value.is_finite()).fill_null(value=False)
