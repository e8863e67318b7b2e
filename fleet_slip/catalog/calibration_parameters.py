"""Calibration parameters: properties of a car that its own drives determine without a label.

Each has a physical value. Models and cars use it as an integer count of its grain. A value beyond
16 bits is unknown.
"""

from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from typing import Literal

from fleet_slip.catalog.arithmetic import nearest
from fleet_slip.catalog.signals import COUNT_MAX, SIUnit

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

ColumnUnit = SIUnit | Literal["1"]
"""An SI unit, or "1"."""


@dataclass(frozen=True)
class CalibrationParameter:
    """One calibration parameter: its unit, grain and meaning."""

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


_PARAMETERS: tuple[tuple[CalibrationParameterName, ColumnUnit, str, str], ...] = (
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
