"""The single-track model of the extended Kalman filter, with the forces of its axles.

The lateral forces follow the loads of the moment: bends load the outer wheels and braking the front
ones. Two wheels with different loads hold less than two with their mean, because a tyre's stiffness
and grip grow less than its load (Pacejka, "Tire and Vehicle Dynamics" (2012), sections 1.2.3 and
4.E25).
"""

from dataclasses import dataclass
from typing import NamedTuple, cast

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.compiling import kernel
from fleet_slip.evaluation.labelled_drives import STEP_S, DriveSignals, hold_last
from fleet_slip.vehicle.dynamics import cornering_stiffness
from fleet_slip.vehicle.parameters import Constants, VehicleParameters, constants

# Dead reckoning by wheel speeds: Carlson, Gerdes and Powell, "Error sources when land vehicle dead
# reckoning with differential wheelspeeds", Navigation 51 (2004): the axle without drive torque
# rolls with the least slip.


@dataclass(frozen=True)
class AxleSpeeds:
    """Rolling velocities of the wheels of an axle over cos δ, and their distance."""

    left_mps: FloatArray
    right_mps: FloatArray
    track_m: FloatArray | float
    turned_m: FloatArray | float = 0.0
    """Mean of tan δ times the axle's distance before the centre of gravity."""

    @property
    def is_one_speed(self) -> bool:
        """True if one speed of the car replaces both wheel speeds, which never differ."""
        return np.array_equal(self.left_mps, self.right_mps, equal_nan=True)

    @property
    def vx_mps(self) -> FloatArray:
        """Longitudinal velocity of the centre of gravity."""
        return (self.left_mps + self.right_mps) / 2 - self.turned_m * self.yaw_rate_rad_s

    @property
    def yaw_rate_rad_s(self) -> FloatArray:
        """Yaw rate of the line through the wheels."""
        return (self.right_mps - self.left_mps) / self.track_m


def undriven_axle(drive: DriveSignals, car: VehicleParameters) -> AxleSpeeds:
    """Return the speeds of the axle that takes the smaller share of the drive torque.

    A wheel that rolls without slip at a hub with velocity (vx ∓ t/2 r, vy + a r), steered by δ, has

        R ω / cos δ = vx ∓ t/2 r + tan δ (vy + a r).

    At the rear δ = 0. At the front the wheels travel with the yaw of the car, too: tan δ a r is
    taken off their mean. tan δ vy, a thousandth of vx, is neglected. A single speed of the car is
    no speed of front wheels: the angle of the road wheels does not change it.
    """
    radius, front = car.tyre.rolling_radius_m, car.body.front_axle_m
    if car.drivetrain.front_drive_share >= 0.5:
        return AxleSpeeds(
            radius * drive.wheel_rl_rad_s, radius * drive.wheel_rr_rad_s, car.body.track_rear_m
        )
    straight = AxleSpeeds(
        radius * drive.wheel_fl_rad_s, radius * drive.wheel_fr_rad_s, car.body.track_front_m
    )
    if straight.is_one_speed:
        return straight
    tan_left, tan_right = np.tan(drive.steer_fl_rad), np.tan(drive.steer_fr_rad)
    return AxleSpeeds(
        radius * drive.wheel_fl_rad_s / np.cos(drive.steer_fl_rad),
        radius * drive.wheel_fr_rad_s / np.cos(drive.steer_fr_rad),
        car.body.track_front_m + front * (tan_right - tan_left),
        front * (tan_left + tan_right) / 2,
    )


SLOWEST_ANGLE_MPS = 1.0
"""Longitudinal velocity that replaces a smaller one in the angle."""


def sideslip_angle(vx_mps: FloatArray, vy_mps: FloatArray) -> FloatArray:
    """Return β = arctan(vy / vx) in rad, equations (12) and (13).

    At rest the quotient has no limit and noise would turn the angle by up to π. Below
    `SLOWEST_MPS`, and in reverse, vx is therefore replaced by `SLOWEST_MPS`: β stays continuous and
    goes to zero with vy. NaN stays NaN.
    """
    return np.arctan2(vy_mps, np.maximum(vx_mps, SLOWEST_ANGLE_MPS))


SLOWEST_MPS = 5.0
"""Speed below which slip is measured against this speed; the poles stay within 100/s."""


def measured_speed_mps(drive: DriveSignals, car: VehicleParameters) -> FloatArray:
    """Return the longitudinal velocity from wheel speeds. Raises `MissingSignalError`."""
    return hold_last(undriven_axle(drive, car).vx_mps, "wheel speeds")


def measured_steer_rad(drive: DriveSignals) -> FloatArray:
    """Return the mean angle of the front wheels that are logged.

    Raises `MissingSignalError` without any.
    """
    wheels = (drive.steer_fl_rad, drive.steer_fr_rad)
    logged = [angle_rad for angle_rad in wheels if np.isfinite(angle_rad).any()]
    mean = sum(logged, np.zeros(len(drive))) / max(len(logged), 1)
    return hold_last(mean if logged else drive.steer_fl_rad, "steer_fl and steer_fr")


LEAST_LOAD = 0.05
"""Smallest load of a wheel over its load at rest, so that noise lifts no wheel."""


class Axles(NamedTuple):
    """Cornering stiffness and grip of both tyres of each axle together."""

    stiffness_front_n: float
    """Cornering stiffness per unit of slip."""
    stiffness_rear_n: float
    grip_front_n: float
    """Largest lateral force."""
    grip_rear_n: float


def loaded_axles(
    car: VehicleParameters, ax_mps2: FloatArray, ay_mps2: FloatArray, adhesion: float
) -> FloatArray:
    """Return the `Axles` of a car under accelerations of shape (rows,), as measured.

    The shape is (4, rows): a row for each of their fields. The body leans with the lag of its
    suspension, which takes the accelerations' noise away.
    """
    c = constants(car, adhesion)
    pitch = c.pitch_transfer * follow(ax_mps2, c.inverse_pitch_lag * STEP_S)
    leaning = follow(ay_mps2, c.inverse_roll_lag * STEP_S)

    def axle(mean: FloatArray, roll: FloatArray, peak: float) -> tuple[FloatArray, FloatArray]:
        loads = np.maximum(np.stack([mean - roll, mean + roll]), LEAST_LOAD * c.static_rear)
        stiffness = cast(FloatArray, cornering_stiffness(cast(float, loads), peak, c))
        grip = (c.friction - c.friction_per_load * loads) * loads
        return stiffness.sum(axis=0), grip.sum(axis=0)

    front = axle(c.static_front - pitch, c.roll_transfer_front * leaning, c.stiffness_front)
    rear = axle(c.static_rear + pitch, c.roll_transfer_rear * leaning, c.stiffness_rear)
    return np.stack([front[0], rear[0], front[1], rear[1]])


@kernel
def follow(values: FloatArray, gain: float) -> FloatArray:
    """Filter values with a lag, x ← x + gain (value − x), from the first value on."""
    lagged = np.empty(len(values))
    x = values[0]
    for k in range(len(values)):
        x += gain * (values[k] - x)
        lagged[k] = x
    return lagged


class LateralForce(NamedTuple):
    """Lateral force of an axle across the car, and its derivatives."""

    force: float
    per_vx: float
    per_vy: float
    per_r: float


@kernel
def lateral_force(
    vx: float, vy: float, r: float, steer: float, lever: float, stiffness: float, grip: float
) -> LateralForce:
    """Return the force of an axle at the distance `lever` before the centre of gravity.

    With slip σ = −across / along of the axle's velocity in the wheel's frame, the brush tyre of
    Fiala gives, up to the slip where all of it slides,

        F = C σ − C² |σ| σ / (3 G) + C³ σ³ / (27 G²),   dF/dσ = C (1 − C |σ| / (3 G))²

    and beyond it ±G (Pacejka, "Tire and Vehicle Dynamics" (2012), section 3.2.1).
    """
    cosine, sine = np.cos(steer), np.sin(steer)
    side = vy + lever * r
    across = cosine * side - sine * vx
    along = cosine * vx + sine * side
    rolling = max(along, SLOWEST_MPS)
    turning = 1.0 if along > SLOWEST_MPS else 0.0
    slip = -across / rolling
    use = stiffness * slip / (3.0 * grip)
    stuck = max(1.0 - abs(use), 0.0)
    force = 3.0 * grip * use * (1.0 - abs(use) + use * use / 3.0)
    if stuck == 0.0:
        force = grip if slip > 0.0 else -grip
    per_slip = stiffness * stuck * stuck / rolling
    # dσ = −(d across + σ d along) / rolling
    per_side = -per_slip * (cosine + turning * slip * sine) * cosine
    per_vx = -per_slip * (-sine + turning * slip * cosine) * cosine
    return LateralForce(cosine * force, per_vx, per_side, lever * per_side)


class Rates(NamedTuple):
    """Lateral acceleration and yaw acceleration, with their derivatives."""

    ay: float
    ay_vx: float
    ay_vy: float
    ay_r: float
    yaw: float
    yaw_vx: float
    yaw_vy: float
    yaw_r: float


@kernel
def rates(vx: float, vy: float, r: float, steer: float, axles: Axles, c: Constants) -> Rates:
    """Return (Ff cos δ + Fr)/m and (a Ff cos δ − b Fr)/I, linearised."""
    f = lateral_force(vx, vy, r, steer, c.front, axles.stiffness_front_n, axles.grip_front_n)
    b = lateral_force(vx, vy, r, 0.0, -c.rear, axles.stiffness_rear_n, axles.grip_rear_n)
    return Rates(
        (f.force + b.force) / c.mass,
        (f.per_vx + b.per_vx) / c.mass,
        (f.per_vy + b.per_vy) / c.mass,
        (f.per_r + b.per_r) / c.mass,
        (c.front * f.force - c.rear * b.force) / c.yaw_inertia,
        (c.front * f.per_vx - c.rear * b.per_vx) / c.yaw_inertia,
        (c.front * f.per_vy - c.rear * b.per_vy) / c.yaw_inertia,
        (c.front * f.per_r - c.rear * b.per_r) / c.yaw_inertia,
    )
