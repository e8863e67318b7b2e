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
"""

import math
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction

from fleet_slip.catalogue.signals import HALF_TURN, SAMPLE_TIME_S, catalogue

COURSE, YAW_RATE = "course", "yaw_rate"
TURNED = "turned"
"""Column of a Gram row: J over `COARSER`, which a scale error of the gyroscope goes with."""
COARSER = 2**8
"""Keeps `TURNED` within 20 bits: 1.28e-4 rad a count."""
LONGEST_TICKS = 1000
LARGEST_RAD = Fraction(1, 2)
LARGEST_CHANGE_BITS = 21
"""A difference of two counts of 20 bits."""

HIDDEN = ("hidden_course", "hidden_turned")


@dataclass(frozen=True)
class CourseUnits:
    """Whole numbers that the scales of course, yaw rate and label come to.

    Attributes:
        turn: counts of J in a turn.
        divisor: of L, for a count of the label.
        largest: largest |L| that is a change of the side-slip angle.
    """

    turn: int
    divisor: int
    largest: int


def course_units() -> CourseUnits:
    """Return the numbers for the catalogue's scales."""
    known = catalogue()
    grain = known[YAW_RATE].exact_scale * SAMPLE_TIME_S / 2
    turn = round(Fraction(Decimal(2) * Decimal(math.pi)) / grain)
    divisor = round(2 * HALF_TURN * known[known.label].exact_scale / grain)
    return CourseUnits(turn, divisor, int(2 * HALF_TURN * LARGEST_RAD / grain))


def rounded(number: str, divisor: int) -> str:
    """Return SQL of an integer over another, to the nearest, halves away from zero."""
    return f"(2 * ({number}) + sign({number}) * {divisor}) // {2 * divisor}"


def with_changes(rows: str, columns: tuple[str, ...], ticks: int) -> str:
    """Return a subquery: columns less what they were so many ticks ago, `TURNED` and the label.

    Only rows that have a fix now and had one then, and the yaw rate all the time between; and the
    first of a drive, which has no change, so that a drive without a course is known to have none.
    `rows` has the columns, course and yaw rate, and the column `clipped`.
    """
    units, label = course_units(), catalogue().label
    ago = {name: f"(max({name}) OVER ago)::BIGINT" for name in (*columns, COURSE, YAW_RATE)}
    changes = ",\n            ".join(f"{name}::BIGINT - {ago[name]} AS {name}" for name in columns)
    turned = (
        f"CASE WHEN (count({YAW_RATE}) OVER since) = {ticks} THEN "
        f"2 * (sum({YAW_RATE}) OVER since)::BIGINT - {YAW_RATE} + {ago[YAW_RATE]} END"
    )
    left = f"({units.turn} * {HIDDEN[0]} - {2 * HALF_TURN} * {HIDDEN[1]})"
    whole = 2 * HALF_TURN * units.turn
    near = f"({left} - {whole} * ({rounded(left, whole)}))"
    return f"""(
        SELECT * EXCLUDE ({", ".join(HIDDEN)}) REPLACE ({rounded(label, units.divisor)} AS {label}),
            {rounded(HIDDEN[1], COARSER)} AS {TURNED}
        FROM (
            SELECT * REPLACE ({near} AS {label})
            FROM (
                SELECT * REPLACE (
            {changes},
            0::BIGINT AS {label}
                ),
                    {COURSE}::BIGINT - {ago[COURSE]} AS {HIDDEN[0]},
                    {turned} AS {HIDDEN[1]}
                FROM {rows}
                WINDOW ago AS (PARTITION BY drive_id ORDER BY tick
                        RANGE BETWEEN {ticks} PRECEDING AND {ticks} PRECEDING),
                    since AS (PARTITION BY drive_id ORDER BY tick
                        RANGE BETWEEN {ticks - 1} PRECEDING AND CURRENT ROW)
            )
        )
        WHERE abs({label}) <= {units.largest} OR tick = 0
    )"""
