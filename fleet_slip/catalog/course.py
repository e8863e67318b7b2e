"""The change of the side-slip angle as course and yaw rate tell it, in whole numbers.

Over T ticks, with the course χ in counts of a turn over 65,536 and the yaw rate r in counts,

    J = 2 Σ r(k) − r(t) + r(t−T),  k = t−T+1 .. t,

is twice the integral of the yaw rate by trapezoids: a count of it is half a tick times a count of
r, 0.5e-6 rad, and a turn is `turn` of them, 12,566,371, which is wrong by 3 parts in 100 million.
In 65,536ths of that count

    L = turn (χ(t) − χ(t−T)) − 65536 J,

less the nearest multiple of 65536 turn, is the change of the side-slip angle; it is rounded once to
counts of the label. For T of 10 s at most |J| < 2^27, so that all of it stays below 2^53. A change
above `LARGEST_RAD` is none: the car spun, or a reflected signal made the course.

Where a car goes straight on at both fixes and has hardly turned between them, its side-slip angle
is none, and L is what the receiver and the gyroscope are wrong by: columns of their own say it.
"""

import math
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction

from fleet_slip.catalog.signals import HALF_TURN, SAMPLE_TIME_S, SignalCatalog

COURSE, YAW_RATE, SATELLITE_SPEED = "course", "yaw_rate", "satellite_speed"
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
"""Column of `grams`: by how many parts of a tick the course was taken to be late."""


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


def course_units(signals: SignalCatalog) -> CourseUnits:
    """Return the numbers for the scales of a catalog."""
    grain = signals[YAW_RATE].exact_scale * SAMPLE_TIME_S / 2
    turn = round(Fraction(Decimal(2) * Decimal(math.pi)) / grain)
    divisor = round(2 * HALF_TURN * signals[signals.label].exact_scale / grain)
    return CourseUnits(
        turn,
        divisor,
        int(2 * HALF_TURN * LARGEST_RAD / grain),
        int(STRAIGHT_RAD_S / signals[YAW_RATE].exact_scale),
        int(STRAIGHT_RAD / grain),
    )


def split_late(late: int) -> tuple[int, int]:
    """Return how many whole ticks late a course is, and what its label gains per count of r."""
    ticks = (late + LATE_PARTS // 2) // LATE_PARTS
    return ticks, (late - ticks * LATE_PARTS) * 4 * HALF_TURN // LATE_PARTS


def turned_scale(signals: SignalCatalog) -> float:
    """Return the rad of a count of `TURNED`."""
    return float(signals[YAW_RATE].exact_scale * SAMPLE_TIME_S / 2) * COARSER
