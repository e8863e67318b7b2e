"""What a car's own drives tell of it without a label: its numbers, by name.

Each is a physical value; models and boards use it as an integer count of its grain, rounded to the
nearest, halves away from zero. A number that 16 bits cannot count is not known.
"""

from decimal import Decimal
from fractions import Fraction
from typing import Final, Literal

from fleet_slip.catalog.arithmetic import nearest
from fleet_slip.catalog.signals import COUNT_MAX, SIUnit
from fleet_slip.config import Config

CALIBRATION = "calibration"
"""The feature set whose Gram rows tell the numbers."""

BY_SATELLITE = "calibration_satellite"
"""The feature set that tells the speed ratio of cars whose receivers log the speed."""

BY_COURSE = "calibration_course"
"""The feature set that tells how cars slip whose receivers log the course."""

DELAY = "delay"
"""The feature set whose Gram rows tell how late a satellite receiver is."""

NumberName = Literal[
    "yaw_rate_offset",
    "ay_offset",
    "steering_offset",
    "speed_ratio",
    "steer_per_curvature",
    "understeer",
    "slip_lever",
    "slip_compliance",
]


ColumnUnit = SIUnit | Literal["1"]
"""A unit, or none."""


class CarNumber(Config):
    """One number of a car: its unit, its grain and what it means."""

    unit: ColumnUnit
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


_NUMBERS: tuple[tuple[NumberName, ColumnUnit, str, str], ...] = (
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

CAR_NUMBERS: dict[NumberName, CarNumber] = {
    name: CarNumber(unit=unit, grain=Decimal(grain), description=description)
    for name, unit, grain, description in _NUMBERS
}
"""The numbers, in the order in which they are shown."""


# Where a drive comes from, as the column `source` says it, and which drives may train a model.

SCENARIO: Final = "scenario"
"""Source of the drives that models are evaluated on, and must never be trained on."""

MEASURED: Final = "measured"
"""Source of the drives that logs of real cars hold."""

RECEIVED: Final = "received"
"""Source of the drives whose cars sent Gram rows, and no log."""

RECEIVED_FILES: Final = "received/"
"""What stands before a digest in the column `file` of Gram rows without a log file."""

RECEIVER: Final = "receiver"
"""The drive column that says of which type a satellite receiver is."""

LONGEST_PAUSE_S: Final = 600
"""A pause that is longer begins another trip: road, load and warmth of the tyres may be others."""

ALL_DRIVES: Final = "true"
TRAINING_DRIVES: Final = f"source <> '{SCENARIO}'"
