"""The driver: follows a line by preview and feedback, and a speed profile by feed-forward.

Steering is a demand for curvature, as in pure pursuit, with the curvature of the road fed forward.
The car's handling on a dry road turns it into an angle; on a slippery road the driver is wrong.

References
----------
R. C. Coulter, "Implementation of the pure pursuit path tracking algorithm" (1992).
N. R. Kapania, J. C. Gerdes, "Design of a feedback-feedforward steering controller for accurate path
tracking and stability at the limits of handling" (2015).
"""

import math
from typing import NamedTuple

from fleet_slip.compiling import equation
from fleet_slip.vehicle.dynamics import cornering_stiffness
from fleet_slip.vehicle.integration import Path, Pose
from fleet_slip.vehicle.parameters import (
    GRAVITY_MPS2,
    Constants,
    Controls,
    State,
    VehicleParameters,
    constants,
)

SAMPLE_S = 0.01
"""Time between two decisions of the driver, and between two samples, in s."""

STEERING_PREVIEW_S = 0.15
"""Preview of the curvature, in s: the response time of steering and yaw."""

SPEED_PREVIEW_S = 0.1
"""Preview of the target speed, in s: the lag of the drivetrain."""

PURSUIT_TIME_S = 0.55
"""Time ahead of the point that an offset is steered towards, in s."""

MIN_PURSUIT_M = 6.0
MAX_CURVATURE_1PM = 0.15
MAX_STEERING_RATE_RAD_S = 12.0
"""Fastest turn of the steering wheel, in rad/s: the rate that test drivers reach."""

SPEED_GAIN_1PS = 1.2
MAX_DRIVE_MPS2 = 6.0
MAX_BRAKE_MPS2 = 10.0
LOST_BRAKE_MPS2 = 5.0
"""Braking of a driver who has lost the car, in m/s²."""

MAX_GRIP_USE = 0.9
"""Share of the friction at which the handling curve ends: it is steep beyond."""


class Handling(NamedTuple):
    """Handling of the car on a dry road, as the driver assumes it."""

    wheelbase: float
    rear: float
    understeer: float
    """Understeer gradient: steering angle per lateral acceleration, in rad s²/m."""
    rear_slip: float
    """Slip angle of the rear axle per lateral acceleration, in rad s²/m."""
    inverse_grip: float
    """Inverse of the lateral acceleration at the limit, in s²/m."""
    steering_ratio: float


def handling(vehicle: VehicleParameters, compliance_rad_per_n: float = 0.0) -> Handling:
    """Compute the linear handling of a car on a dry road.

    Parameters
    ----------
    vehicle
        The car.
    compliance_rad_per_n
        Angle that the front wheels yield per lateral force of their axle, in rad/N.

    Returns
    -------
    Handling
        Understeer gradient and related constants.
    """
    c = constants(vehicle, adhesion=1.0)
    front = c.static_front / cornering_stiffness(c.static_front, c.stiffness_front, c)
    rear = c.static_rear / cornering_stiffness(c.static_rear, c.stiffness_rear, c)
    return Handling(
        wheelbase=c.front + c.rear,
        rear=c.rear,
        understeer=(front + 2 * c.static_front * compliance_rad_per_n - rear) / GRAVITY_MPS2,
        rear_slip=rear / GRAVITY_MPS2,
        inverse_grip=1 / (vehicle.tyre.friction * GRAVITY_MPS2),
        steering_ratio=vehicle.steering.ratio,
    )


@equation
def clip(value: float, limit: float) -> float:
    """Limit a value to ±limit."""
    return min(max(value, -limit), limit)


@equation
def slip_growth(ax: float, ay: float, h: Handling) -> float:
    """Compute the slip of a brush tyre over that of a linear tyre, at an acceleration.

    With the share f of friction in use it is 3 (1 − ∛(1 − f)) / f. The approximation 3 / (3 − f)
    has the same slope at 0 and needs no root.

    Parameters
    ----------
    ax, ay
        Accelerations of the car, in m/s².
    h
        Handling of the car.
    """
    use = min(math.sqrt(ax * ax + ay * ay) * h.inverse_grip, MAX_GRIP_USE)
    return 3.0 / (3.0 - use)


@equation
def demanded_steering(x: State, pose: Pose, path: Path, h: Handling) -> float:
    """Compute the steering wheel angle that leads back to the line, in rad.

    The heading that the driver aims for includes the slip of the rear axle in the bend.
    """
    v2 = x.vx * x.vx
    ay = path.curvature * v2
    steady_slip = h.rear * path.curvature - h.rear_slip * ay * slip_growth(x.traction, ay, h)
    distance = max(PURSUIT_TIME_S * abs(x.vx), MIN_PURSUIT_M)
    miss = pose.offset + distance * (pose.sine + steady_slip * pose.cosine)
    curvature = path.curvature_ahead - 2.0 * miss / (distance * distance)
    curvature = clip(curvature, MAX_CURVATURE_1PM)
    ay = clip(curvature * v2, MAX_GRIP_USE / h.inverse_grip)
    tangent = h.wheelbase * curvature + h.understeer * ay * slip_growth(x.traction, ay, h)
    return h.steering_ratio * tangent


@equation
def demanded_traction(x: State, path: Path, c: Constants) -> float:
    """Compute the tractive force per mass that follows the speed profile, in m/s²."""
    resistance = c.drag_per_mass * x.vx * x.vx + c.rolling_resistance * GRAVITY_MPS2
    demand = path.target_acceleration + SPEED_GAIN_1PS * (path.target_speed - x.vx) + resistance
    demand = min(max(demand, -MAX_BRAKE_MPS2), MAX_DRIVE_MPS2)
    return -LOST_BRAKE_MPS2 if path.lost > 0.0 else demand


@equation
def decide(
    x: State, pose: Pose, path: Path, previous: Controls, h: Handling, c: Constants
) -> Controls:
    """Compute the driver's demands for the next sample time.

    Parameters
    ----------
    x, pose
        State of the car, and its position on the road.
    path
        The road as the driver sees it.
    previous
        Demands at the previous sample.
    h, c
        Handling and constants of the car.

    Returns
    -------
    Controls
        Steering wheel angle in rad, and traction in m/s².
    """
    turn = clip(
        demanded_steering(x, pose, path, h) - previous.steering_wheel,
        MAX_STEERING_RATE_RAD_S * SAMPLE_S,
    )
    return Controls(
        clip(previous.steering_wheel + turn, c.steering_limit), demanded_traction(x, path, c)
    )
