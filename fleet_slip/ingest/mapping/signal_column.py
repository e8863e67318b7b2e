"""How one column of a file becomes a signal: unit, sign, gain, offset, table, delay.

Course and speed over ground are two columns: an angle with a speed, or two velocities.
"""

import itertools
from collections.abc import Mapping as Named
from typing import Annotated, Any, Literal

import numpy as np
import polars as pl
from pydantic import AfterValidator, Field, model_validator

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.signals import HALF_TURN, Signal, catalogue
from fleet_slip.config import Config, Name, added
from fleet_slip.ingest.mapping.units import conversion_factor, require_unit

FiniteFloat = Annotated[float, Field(allow_inf_nan=False)]
Place = Annotated[FiniteFloat, Field(ge=-15, le=15)]
WHEELS = "wheel_"
"""How the names of wheel speeds begin."""
VELOCITY = "m/s"
MAX_TABLE = 10_000

COURSE, SPEED = "course", "satellite_speed"


def _increasing(table: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    if table and len(table) < 2:
        raise ValueError("needs two points at least")
    if any(left >= right for (left, _), (right, _) in itertools.pairwise(table)):
        raise ValueError("needs points in ascending order of their first number, each once")
    return table


Table = Annotated[
    tuple[tuple[FiniteFloat, FiniteFloat], ...],
    Field(max_length=MAX_TABLE),
    AfterValidator(_increasing),
]


class SignBit(Config):
    """The column that says the sign of another one, which has the magnitude alone."""

    column: Name
    negative: int | Name = 1
    """What stands there where the value is negative."""


class SignalColumn(Config):
    """One column of the file: `signal = factor(unit) * (±gain * table(value) + offset) / radius`.

    Keys at their default are left out of the mapping's identity where they came after the first
    release, so that a file is not ingested twice because a program learned a word.
    """

    column: Name
    unit: str
    negate: bool = False
    """For axes that are not ISO 8855, such as y to the right."""
    sign: SignBit | None = added(None)
    """Where a column of its own says the sign, as on the buses of some cars."""
    offset: FiniteFloat = 0.0
    """Added after the sign, in the column's unit."""
    gain: FiniteFloat = added(1.0)
    """Multiplies the value, such as the ratio of a steering gear."""
    radius_m: Annotated[FiniteFloat, Field(ge=0.05, le=2)] | None = added(None)
    """Rolling radius of a wheel whose speed is logged as a velocity."""
    table: Table = added(())
    """Points (value, value in `unit`), straight lines between them; outside is out of range."""
    delay_s: FiniteFloat = added(0.0, ge=-10, le=10)
    """How much later than it happened a value stands in the file."""
    interpolate: bool = added(True)
    """False: samples stand at the nearest tick, and ticks between them have no value."""
    longest_gap_s: Annotated[FiniteFloat, Field(gt=0, le=10)] | None = added(None)
    """Instead of the mapping's, for a signal with a rate of its own."""
    time: Name | None = added(None)
    """The column of this signal's times, where the file has several, in the unit of the others."""

    component: Literal["north", "east"] | None = added(None)
    """Of the velocity over ground, if it is one: set for `course = { north = …, east = … }`."""
    clockwise_from_north: bool | None = added(None)
    """Whether the course is told so; False: counterclockwise from east."""
    antenna_x_m: Place | None = added(None)
    """How far the receiver's antenna is before the centre of gravity."""
    antenna_y_m: Place | None = added(None)
    """How far it is to the left of the centre of gravity."""

    @property
    def is_of_satellites(self) -> bool:
        """Whether it has keys that are for the course."""
        told = (self.clockwise_from_north, self.antenna_x_m, self.antenna_y_m, self.component)
        return any(one is not None for one in told)

    @model_validator(mode="after")
    def _gain_is_something(self) -> "SignalColumn":
        if self.gain == 0:
            raise ValueError("gain cannot be 0")
        return self

    def require_unit_of(self, signal: str, si_unit: str) -> None:
        """Raise `ValueError` if the column cannot be this signal."""
        is_wheel = signal.startswith(WHEELS)
        if self.radius_m is not None and not is_wheel:
            raise ValueError("has a radius_m, and radius_m is for wheel speeds")
        if self.radius_m is None and is_wheel and self._is_velocity():
            raise ValueError(
                f"is a velocity in {self.unit!r}; {signal} needs an angular velocity: add "
                "radius_m, the rolling radius of the wheel"
            )
        require_unit(self.unit, self._measured_in(si_unit), signal)

    def linear(self, si_unit: str) -> tuple[float, float]:
        """Return (gain, bias): `value in SI = gain * table(value in the file) + bias`."""
        factor = conversion_factor(self.unit, self._measured_in(si_unit))
        if self.radius_m is not None:
            factor /= self.radius_m
        return (-factor if self.negate else factor) * self.gain, factor * self.offset

    def looked_up(self, number: pl.Expr) -> pl.Expr:
        """Return table(value), NaN outside of the table; the value itself without one."""
        return number.map_batches(self._interpolate, pl.Float64) if self.table else number

    def is_outside_table(self, number: pl.Expr) -> pl.Expr:
        """Whether a value is below or above all that the table has."""
        if not self.table:
            return pl.lit(value=False)
        return (number < self.table[0][0]) | (number > self.table[-1][0])

    def _interpolate(self, numbers: pl.Series) -> pl.Series:
        points: FloatArray = np.array(self.table)
        values = numbers.to_numpy().astype(np.float64)
        found = np.interp(values, points[:, 0], points[:, 1], left=np.nan, right=np.nan)
        found[np.isnan(values)] = np.nan
        return pl.Series(numbers.name, found).set(numbers.is_null(), None)

    def _measured_in(self, si_unit: str) -> str:
        return si_unit if self.radius_m is None and not self.component else VELOCITY

    def _is_velocity(self) -> bool:
        try:
            require_unit(self.unit, VELOCITY)
        except ValueError:
            return False
        return True


Component = Literal["north", "east"]


def split_components(signals: Any) -> Any:
    """Return the signals with `course = { north, east }` as a column each. Raises `ValueError`."""
    course = signals.get(COURSE) if isinstance(signals, dict) else None
    if not isinstance(course, dict) or not {"north", "east"} & set(course):
        return signals
    if missing := [key for key in ("north", "east") if key not in course]:
        raise ValueError(f"course: {missing[0]} is missing: it needs both velocities")
    if SPEED in signals or "column" in course:
        raise ValueError("course: north and east tell the speed too: leave the other columns out")
    shared = {key: value for key, value in course.items() if key not in {"north", "east"}}
    return {
        **signals,
        COURSE: {**shared, "column": course["north"], "component": "north"},
        SPEED: {**shared, "column": course["east"], "component": "east"},
    }


def require_satellites(signals: Named[str, SignalColumn]) -> None:
    """Raise `ValueError` unless the course, if there is one, comes with all that it needs."""
    for name, column in signals.items():
        if column.is_of_satellites and name not in {COURSE, SPEED}:
            raise ValueError(f"signals.{name}: antenna and direction are keys of the course")
    course = signals.get(COURSE)
    if course is None:
        return
    if course.component is None and course.clockwise_from_north is None:
        raise ValueError(
            "signals.course: say whether it is clockwise_from_north = true, as receivers tell it, "
            "or false, counterclockwise from east"
        )
    if course.antenna_x_m is None or course.antenna_y_m is None:
        raise ValueError(
            "signals.course: say where the antenna is, in m: antenna_x_m before the centre of "
            "gravity, antenna_y_m to the left of it. A metre that is forgotten is a degree in bends"
        )
    for needed in (SPEED, "yaw_rate"):
        if needed not in signals:
            raise ValueError(f"signals.course: it needs {needed} beside it")
    speed = signals[SPEED]
    if (course.time, course.delay_s) != (speed.time, speed.delay_s):
        raise ValueError("signals.course: time and delay_s are one receiver's: give both alike")


def count_range(name: str, column: SignalColumn) -> tuple[Signal, int, int]:
    """Return the signal as which a column is checked, a course in any turn, and its counts."""
    if column.component:
        speed = catalogue()[SPEED]
        return speed, -speed.max_count, speed.max_count
    signal = catalogue()[name]
    if name == COURSE:
        return signal, -4 * HALF_TURN, 4 * HALF_TURN
    return signal, signal.min_count, signal.max_count
