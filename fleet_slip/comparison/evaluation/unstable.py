"""Where a car is unstable on a drive, and how far its axles slip.

It is unstable where the tyres of an axle slip beyond their peak. Past the slip at which its lateral
force is largest, an axle gives less force the more it slips: a front axle no longer turns the car
into its path, a rear axle no longer holds it from spinning (Pacejka 2012, section 1.3). The slip
angles follow from the true velocity, the yaw rate and the road wheel angles:

    tan(alpha_rear) = (vy - b r) / vx,    alpha_front = arctan((vy + a r) / vx) - delta.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.comparison.evaluation.evaluated_drives import EvaluatedDrive
from fleet_slip.simulation.sensing.sensors import SAMPLE_RATE_HZ
from fleet_slip.vehicle.parameters import VehicleParameters, constants
from fleet_slip.vehicle.tyre import brush_force

SMALLEST_GAP_S = 1.0
"""Unstable stretches with less time between them are one."""

PEAK_SPEED_MPS = 15.0
"""Rolling speed at which the peak is looked up; from 10 to 30 m/s it moves by a tenth."""

SLIPS = np.linspace(0.0, 0.5, 2001)

CRITERION = (
    "an axle's tyres slip beyond the peak of their lateral force (brush tyre, static load, "
    f"stretches less than {SMALLEST_GAP_S:g} s apart joined)"
)


@dataclass(frozen=True)
class PeakSlip:
    """Slip angles at which the axles' lateral forces are largest, in rad."""

    front_rad: float
    rear_rad: float


@dataclass(frozen=True)
class Stretch:
    """A stretch of a drive, in time and along the track."""

    from_s: float
    until_s: float
    from_m: float
    until_m: float


@cache
def peak_slip(vehicle: VehicleParameters, adhesion: float) -> PeakSlip:
    """Return the slip angles of the peaks, both wheels at their static load, without drive."""
    c = constants(vehicle, adhesion)

    def peak(load: float, stiffness: float) -> float:
        v = PEAK_SPEED_MPS
        forces = [abs(brush_force(v, slip * v, v, load, stiffness, c).y) for slip in SLIPS]
        return float(np.arctan(SLIPS[np.argmax(forces)]))

    return PeakSlip(peak(c.static_front, c.stiffness_front), peak(c.static_rear, c.stiffness_rear))


def slip_angles(drive: EvaluatedDrive) -> tuple[FloatArray, FloatArray]:
    """Return the slip angles of front and rear axle in rad, positive when sliding to the left.

    The yaw rate is the gyroscope's, less the bias that the scenario states; where it is null there
    is no slip angle.
    """
    body, sensors = drive.scenario.car.body, drive.scenario.sensors
    yaw_rate = drive.signals["yaw_rate_rad_s"] - sensors.yaw_rate_bias_rad_s
    steer = (drive.signals["steer_fl_rad"] + drive.signals["steer_fr_rad"]) / 2
    front = np.arctan2(drive.vy_mps + body.front_axle_m * yaw_rate, drive.vx_mps) - steer
    rear = np.arctan2(drive.vy_mps - body.rear_axle_m * yaw_rate, drive.vx_mps)
    return front, rear


def find_unstable(drive: EvaluatedDrive) -> BoolArray:
    """Return for each tick whether the car is within an unstable stretch."""
    peak = peak_slip(drive.scenario.car, drive.scenario.adhesion)
    front, rear = slip_angles(drive)
    beyond = (np.abs(front) > peak.front_rad) | (np.abs(rear) > peak.rear_rad)
    return join(beyond & drive.evaluated, round(SMALLEST_GAP_S * SAMPLE_RATE_HZ))


def join(mask: BoolArray, gap: int) -> BoolArray:
    """Return a mask with the gaps between its runs filled that are shorter than so many entries."""
    joined = mask.copy()
    runs = list(_runs(mask))
    for (_, end), (begin, _) in pairwise(runs):
        if begin - end < gap:
            joined[end:begin] = True
    return joined


def find_stretches(drive: EvaluatedDrive, mask: BoolArray) -> tuple[Stretch, ...]:
    """Return where a mask over the ticks of a drive is true."""
    return tuple(
        Stretch(
            from_s=float(drive.time_s[begin]),
            until_s=float(drive.time_s[end - 1]),
            from_m=float(drive.station_m[begin]),
            until_m=float(drive.station_m[end - 1]),
        )
        for begin, end in _runs(mask)
    )


def _runs(mask: BoolArray) -> Iterator[tuple[int, int]]:
    """Yield begin and end (exclusive) of each run of true entries."""
    edges = np.flatnonzero(np.diff(mask.astype(np.int8), prepend=0, append=0))
    yield from zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)


def rear_compliance(drive: EvaluatedDrive) -> float:
    """Return the rear slip angle per lateral acceleration, rad s²/m, fitted through the origin."""
    rear = -slip_angles(drive)[1]
    ay = drive.signals["ay_mps2"] - drive.scenario.sensors.ay_bias_mps2
    there = drive.evaluated & np.isfinite(rear) & np.isfinite(ay)
    return float(rear[there] @ ay[there] / (ay[there] @ ay[there]))
