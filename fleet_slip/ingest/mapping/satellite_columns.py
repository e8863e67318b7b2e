"""Course and speed over ground in a mapping: an angle with a speed, or two velocities."""

from collections.abc import Mapping as Named
from typing import Any, Literal

from fleet_slip.catalogue.signals import HALF_TURN, Signal, catalogue
from fleet_slip.ingest.mapping.signal_column import SignalColumn

COURSE, SPEED = "course", "satellite_speed"
Component = Literal["north", "east"]


def split_components(signals: Any) -> Any:
    """Return the signals with `course = { north = …, east = … }` as a column for each of the two.

    Raises `ValueError` where a speed is given beside them.
    """
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
    """Return the signal as which a column is checked, and its smallest and largest count.

    A course may be told from 0 to a turn, or on from there; a component may be negative.
    """
    if column.component:
        speed = catalogue()[SPEED]
        return speed, -speed.max_count, speed.max_count
    signal = catalogue()[name]
    if name == COURSE:
        return signal, -4 * HALF_TURN, 4 * HALF_TURN
    return signal, signal.min_count, signal.max_count
