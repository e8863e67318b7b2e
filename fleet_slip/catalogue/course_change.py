"""The change of the side-slip angle as course and yaw rate tell it, in whole numbers.

Over T ticks, with the course χ in counts of a turn over 65,536 and the yaw rate r in counts,

    J = 2 Σ r(k) − r(t) + r(t−T),  k = t−T+1 .. t,

is twice the integral of the yaw rate by trapezoids: a count of it is half a tick times a count of
r, 0.5e-6 rad, and a turn is `turn` of them, 12,566,371, which is wrong by 3 parts in 100 million.
In 65,536ths of that count

    L = turn (χ(t) − χ(t−T)) − 65536 J,

less the nearest multiple of 65536 turn, is the change of the side-slip angle; it is rounded once to
counts of the label. For T of 10 s at most |J| < 2^27, so that all of it stays below 2^53. A change
above `LARGEST_RAD` is none: the car spun, or a reflected signal told the course.

Where a car goes straight on at both fixes and has hardly turned between them, its side-slip angle
is none, and L is what the receiver and the gyroscope are wrong by: columns of their own say it.
"""

import math
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction

from fleet_slip.catalogue.arithmetic import nearest_sql
from fleet_slip.catalogue.signals import HALF_TURN, SAMPLE_TIME_S, catalogue

COURSE, YAW_RATE = "course", "yaw_rate"
TURNED = "turned"
"""Column of a Gram row: J over `COARSER`, which a scale error of the gyroscope goes with."""
STRAIGHT, STRAIGHT_COURSE = "straight", "straight_course"
"""Columns of a Gram row: 1 where the car went straight on, and the label there, else 0."""
BESIDE = (TURNED, STRAIGHT, STRAIGHT_COURSE)
"""The columns that tell of the course and are none of a model, in their order."""
COARSER = 2**8
"""Keeps `TURNED` within 20 bits: 1.28e-4 rad a count."""
LONGEST_TICKS = 1000
LARGEST_RAD = Fraction(1, 2)
STRAIGHT_RAD_S, STRAIGHT_RAD = Fraction(1, 50), Fraction(1, 20)
"""Largest yaw rate at both fixes, and angle turned between them, of a car that goes straight on:
a gyroscope is off by up to 0.01 rad/s."""
LATE_PARTS = 4
"""A course's delay is a whole number of these parts of a tick, 2.5 ms: the yaw rate does not change
by enough in half of it to matter."""
MOST_LATE, MOST_EARLY = 50, -10
"""Ticks. A course is early where the accelerometer and gyroscope are later than it."""
COURSE_LATE = "course_late"
"""Column of `grams`: by how many parts of a tick the course was taken to be late. And the variable
of the SQL statement that tells it of each car."""

OVER = "hidden_over"
"""Column of changes: the place of their time among those of the set."""
HIDDEN = ("hidden_course", "hidden_turned", "hidden_rest", "hidden_rate")
HIDDEN_LATE = "hidden_late"
WHOLE_TICKS = (
    f"(({HIDDEN_LATE} + {LATE_PARTS // 2 - LATE_PARTS * MOST_EARLY}) // {LATE_PARTS} "
    f"+ {MOST_EARLY})"
)
"""Whole ticks in SQL, whose division is towards zero."""


@dataclass(frozen=True)
class CourseUnits:
    """Whole numbers that the scales of course, yaw rate and label come to.

    Attributes:
        turn: counts of J in a turn.
        divisor: of L, for a count of the label.
        largest: largest |L| that is a change of the side-slip angle.
        slow: largest |r|, in counts, of a car that goes straight on.
        unturned: largest |J| of it.
    """

    turn: int
    divisor: int
    largest: int
    slow: int
    unturned: int


def course_units() -> CourseUnits:
    """Return the numbers for the catalogue's scales."""
    known = catalogue()
    grain = known[YAW_RATE].exact_scale * SAMPLE_TIME_S / 2
    turn = round(Fraction(Decimal(2) * Decimal(math.pi)) / grain)
    divisor = round(2 * HALF_TURN * known[known.label].exact_scale / grain)
    return CourseUnits(
        turn,
        divisor,
        int(2 * HALF_TURN * LARGEST_RAD / grain),
        int(STRAIGHT_RAD_S / known[YAW_RATE].exact_scale),
        int(STRAIGHT_RAD / grain),
    )


def split_late(late: int) -> tuple[int, int]:
    """Return how many whole ticks late a course is, and what its label gains per count of r."""
    whole = (late + LATE_PARTS // 2) // LATE_PARTS
    return whole, (late - whole * LATE_PARTS) * 4 * HALF_TURN // LATE_PARTS


def _in_time(rows: str) -> str:
    """Return a subquery: each course on the tick that it is of, but for a rest, and `HIDDEN_LATE`.

    The variable `course_late` is a map from cars to the delays of their receivers.
    """
    after, before = f"greatest({WHOLE_TICKS}, 0)", f"greatest(-{WHOLE_TICKS}, 0)"
    course = f"max({COURSE}) OVER (PARTITION BY drive_id ORDER BY tick RANGE BETWEEN "
    return f"""(
            SELECT * REPLACE (CASE WHEN {HIDDEN_LATE} < 0
                THEN {course}{before} PRECEDING AND {before} PRECEDING)
                ELSE {course}{after} FOLLOWING AND {after} FOLLOWING) END AS {COURSE})
            FROM (
                SELECT *, coalesce(getvariable('{COURSE_LATE}')[vehicle_id], 0) AS {HIDDEN_LATE}
                FROM {rows}
            )
        )"""


def _as_logged(rows: str) -> str:
    return f"(SELECT *, 0 AS {HIDDEN_LATE} FROM {rows})"


def with_changes(
    rows: str, columns: tuple[str, ...], times: tuple[int, ...], *, in_time: bool
) -> str:
    """Return a subquery of the changes over each of some numbers of ticks, `OVER` which it is.

    `rows` has the columns, course and yaw rate, `vehicle_id` and the column `clipped`. With
    `in_time` the course is moved by what the variable `course_late` says of the car.
    """
    moved = _in_time(rows) if in_time else _as_logged(rows)
    changes = [
        f"SELECT *, {number} AS {OVER} FROM {_changes(moved, columns, ticks)}"
        for number, ticks in enumerate(times)
    ]
    return f"({' UNION ALL '.join(changes)})"


def _changes(rows: str, columns: tuple[str, ...], ticks: int) -> str:
    """Return a subquery: columns less what they were so many ticks ago, `BESIDE` and the label.

    Only rows that have a fix now and had one then, and the yaw rate all the time between; and the
    first of a drive, which has no change, so that a drive without a course is known to have none.
    `rows` has the columns, course and yaw rate, the column `clipped` and `HIDDEN_LATE`.
    """
    units, label = course_units(), catalogue().label
    ago = {name: f"(max({name}) OVER ago)::BIGINT" for name in (*columns, COURSE, YAW_RATE)}
    changes = ",\n            ".join(f"{name}::BIGINT - {ago[name]} AS {name}" for name in columns)
    turned = (
        f"CASE WHEN (count({YAW_RATE}) OVER since) = {ticks} THEN "
        f"2 * (sum({YAW_RATE}) OVER since)::BIGINT - {YAW_RATE} + {ago[YAW_RATE]} END"
    )
    left = f"({units.turn} * {HIDDEN[0]} - {2 * HALF_TURN} * {HIDDEN[1]} + {HIDDEN[2]})"
    gain = f"({HIDDEN_LATE} - {WHOLE_TICKS} * {LATE_PARTS}) * {4 * HALF_TURN // LATE_PARTS}"
    whole = 2 * HALF_TURN * units.turn
    near = f"({left} - {whole} * ({nearest_sql(left, str(whole))}))"
    change = nearest_sql(label, str(units.divisor))
    slow = f"{HIDDEN[3]} <= {units.slow} AND abs({HIDDEN[1]}) <= {units.unturned}"
    straight = f"CASE WHEN {HIDDEN[1]} IS NOT NULL THEN ({slow})::BIGINT END"
    hidden = ", ".join((*HIDDEN, HIDDEN_LATE))
    return f"""(
        SELECT * EXCLUDE ({hidden}) REPLACE ({change} AS {label}),
            {nearest_sql(HIDDEN[1], str(COARSER))} AS {TURNED},
            {straight} AS {STRAIGHT},
            {straight} * ({change}) AS {STRAIGHT_COURSE}
        FROM (
            SELECT * REPLACE ({near} AS {label})
            FROM (
                SELECT * REPLACE (
            {changes},
            0::BIGINT AS {label}
                ),
                    {COURSE}::BIGINT - {ago[COURSE]} AS {HIDDEN[0]},
                    {turned} AS {HIDDEN[1]},
                    {gain} * ({YAW_RATE}::BIGINT - {ago[YAW_RATE]}) AS {HIDDEN[2]},
                    greatest(abs({YAW_RATE}), abs({ago[YAW_RATE]})) AS {HIDDEN[3]}
                FROM {rows}
                WINDOW ago AS (PARTITION BY drive_id ORDER BY tick
                        RANGE BETWEEN {ticks} PRECEDING AND {ticks} PRECEDING),
                    since AS (PARTITION BY drive_id ORDER BY tick
                        RANGE BETWEEN {ticks - 1} PRECEDING AND CURRENT ROW)
            )
        )
        WHERE abs({label}) <= {units.largest} OR tick = 0
    )"""
