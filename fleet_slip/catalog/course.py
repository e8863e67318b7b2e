"""The change of the side-slip angle from course and yaw rate, in integers.

Over T ticks, with the course χ in counts of a turn over 65,536 and the yaw rate r in counts,

    J = 2 Σ r(k) − r(t) + r(t−T),  k = t−T+1 .. t,

is twice the integral of the yaw rate by trapezoids: a count of it is half a tick times a count of
r, 0.5e-6 rad, and a turn is `turn` of them, 12,566,371, which is wrong by 3 parts in 100 million.
In 65,536ths of that count

    L = turn (χ(t) − χ(t−T)) − 65536 J,

less the nearest multiple of 65536 turn, is the change of the side-slip angle; it is rounded once to
counts of the label. For T of 10 s at most |J| < 2^27, so that all of it stays below 2^53. A change
above `MAX_CHANGE_RAD` is none: the car spun, or a reflected signal made the course.

If a car drives straight at both fixes and hardly turns between them, its side-slip angle is zero
and L is the error of receiver and gyroscope: separate columns contain it.
"""

import math
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction

from fleet_slip.catalog.signals import HALF_TURN, SAMPLE_TIME_S, SignalCatalog

COURSE, YAW_RATE, SATELLITE_SPEED = "course", "yaw_rate", "satellite_speed"
TURNED = "turned"
"""Column of a Gram row: J over `TURNED_DIVISOR`, proportional to a scale error of the gyroscope."""
STRAIGHT, STRAIGHT_COURSE = "straight", "straight_course"
"""Columns of a Gram row: 1 and the label while the car drives straight, otherwise 0."""
AUXILIARY = (TURNED, STRAIGHT, STRAIGHT_COURSE)
"""Columns about the course that models do not use, in order."""
TURNED_DIVISOR = 2**8
"""Keeps `TURNED` within 20 bits: 1.28e-4 rad a count."""
MAX_CHANGE_TICKS = 1000
MAX_CHANGE_RAD = Fraction(1, 2)
STRAIGHT_RAD_S, STRAIGHT_RAD = Fraction(1, 50), Fraction(1, 20)
"""Largest yaw rate at both fixes, and largest turn between them, of a car that drives straight. The
offset of a gyroscope is up to 0.01 rad/s."""
LATE_PARTS = 4
"""Parts of a tick in which the course delay is counted, 2.5 ms: the yaw rate hardly changes in half
of that."""
MAX_COURSE_DELAY, MIN_COURSE_DELAY = 50, -10
"""Largest delays in ticks. A course is early if accelerometer and gyroscope are delayed more."""
COURSE_LATE = "course_late"
"""Column of `grams`: the corrected course delay in parts of a tick."""


@dataclass(frozen=True)
class CourseUnits:
    """Integer constants of the scales of course, yaw rate and label.

    Attributes
    ----------
    turn
        Counts of J per turn.
    divisor
        Counts of L per count of the label.
    largest
        Largest |L| that is accepted as a change of the side-slip angle.
    slow, unturned
        Largest |r| and |J| of a car that drives straight.
    """

    turn: int
    divisor: int
    largest: int
    slow: int
    unturned: int


def course_units(signals: SignalCatalog) -> CourseUnits:
    """Return the constants for the scales of a catalog."""
    grain = signals[YAW_RATE].exact_scale * SAMPLE_TIME_S / 2
    turn = round(Fraction(Decimal(2) * Decimal(math.pi)) / grain)
    divisor = round(2 * HALF_TURN * signals[signals.label].exact_scale / grain)
    return CourseUnits(
        turn,
        divisor,
        int(2 * HALF_TURN * MAX_CHANGE_RAD / grain),
        int(STRAIGHT_RAD_S / signals[YAW_RATE].exact_scale),
        int(STRAIGHT_RAD / grain),
    )


def split_late(late: int) -> tuple[int, int]:
    """Split a course delay into whole ticks and the label's correction per count of r."""
    ticks = (late + LATE_PARTS // 2) // LATE_PARTS
    return ticks, (late - ticks * LATE_PARTS) * 4 * HALF_TURN // LATE_PARTS


def turned_scale(signals: SignalCatalog) -> float:
    """Return the physical value of a count of `TURNED`, in rad."""
    return float(signals[YAW_RATE].exact_scale * SAMPLE_TIME_S / 2) * TURNED_DIVISOR
