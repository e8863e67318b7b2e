"""The driver: follows a line by preview and feedback, and a speed profile by feed-forward.

Steering is a demand for curvature, as in pure pursuit (Coulter 1992), with the road's own fed
forward, turned into an angle by the car's handling on a dry road (Kapania and Gerdes 2015, "Design
of a feedback-feedforward steering controller ..."): on a slippery one he is wrong.
"""

import math
from typing import NamedTuple

from fleet_slip.compiling import equation
from fleet_slip.vehicle.integration import Path, Pose
from fleet_slip.vehicle.parameters import (
    GRAVITY_MPS2,
    Constants,
    Controls,
    State,
    VehicleParameters,
    constants,
)
from fleet_slip.vehicle.tyre import cornering_stiffness

SAMPLE_S = 0.01
"""Time between two decisions of the driver, and between two samples."""

STEERING_PREVIEW_S = 0.15
"""How far ahead the curvature is taken: what steering and yaw take to follow."""

SPEED_PREVIEW_S = 0.1
"""How far ahead the target speed is taken: the drivetrain's lag."""

PURSUIT_TIME_S = 0.55
"""An offset from the line is steered away towards a point so far ahead."""

SHORTEST_PURSUIT_M = 6.0
LARGEST_CURVATURE_1PM = 0.15
STEERING_RATE_RAD_S = 12.0
"""Fastest turn of the steering wheel: what test drivers reach."""

SPEED_GAIN_1PS = 1.2
STRONGEST_DRIVE_MPS2 = 6.0
STRONGEST_BRAKE_MPS2 = 10.0
LOST_BRAKE_MPS2 = 5.0
"""Braking of a driver who has lost the car."""

LARGEST_GRIP_USE = 0.9
"""Share of the friction beyond which the handling curve is not followed further."""


class Handling(NamedTuple):
    """What the driver knows of his car on a dry road."""

    wheelbase: float
    rear: float
    understeer: float
    """Understeer gradient: further steering per lateral acceleration, in rad s²/m."""
    rear_slip: float
    """Slip angle of the rear axle per lateral acceleration, in rad s²/m."""
    inverse_grip: float
    """One over the lateral acceleration at the limit."""
    steering_ratio: float


def handling(vehicle: VehicleParameters, compliance_rad_per_n: float = 0.0) -> Handling:
    """Return the linear handling on a dry road; `compliance_rad_per_n` is of the front wheels."""
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
    """Return the value within ±limit."""
    return min(max(value, -limit), limit)


@equation
def slip_growth(ax: float, ay: float, h: Handling) -> float:
    """Return how much more a brush tyre slips than a linear one, at an acceleration.

    With the share f of friction in use, 3 (1 − ∛(1 − f)) / f; 3 / (3 − f) has its slope, no root.
    """
    use = min(math.sqrt(ax * ax + ay * ay) * h.inverse_grip, LARGEST_GRIP_USE)
    return 3.0 / (3.0 - use)


@equation
def wanted_steering(x: State, pose: Pose, path: Path, h: Handling) -> float:
    """Return the steering wheel angle back to the line, headed as a slipping rear axle asks."""
    v2 = x.vx * x.vx
    ay = path.curvature * v2
    steady_slip = h.rear * path.curvature - h.rear_slip * ay * slip_growth(x.traction, ay, h)
    distance = max(PURSUIT_TIME_S * abs(x.vx), SHORTEST_PURSUIT_M)
    miss = pose.offset + distance * (pose.sine + steady_slip * pose.cosine)
    curvature = path.curvature_ahead - 2.0 * miss / (distance * distance)
    curvature = clip(curvature, LARGEST_CURVATURE_1PM)
    ay = clip(curvature * v2, LARGEST_GRIP_USE / h.inverse_grip)
    tangent = h.wheelbase * curvature + h.understeer * ay * slip_growth(x.traction, ay, h)
    return h.steering_ratio * tangent


@equation
def wanted_traction(x: State, path: Path, c: Constants) -> float:
    """Return the tractive force per mass that keeps to the speed profile against resistance."""
    resistance = c.drag_per_mass * x.vx * x.vx + c.rolling_resistance * GRAVITY_MPS2
    wanted = path.target_acceleration + SPEED_GAIN_1PS * (path.target_speed - x.vx) + resistance
    wanted = min(max(wanted, -STRONGEST_BRAKE_MPS2), STRONGEST_DRIVE_MPS2)
    return -LOST_BRAKE_MPS2 if path.lost > 0.0 else wanted


@equation
def decide(
    x: State, pose: Pose, path: Path, before: Controls, h: Handling, c: Constants
) -> Controls:
    """Return the driver's demands for the next sample time."""
    turn = clip(
        wanted_steering(x, pose, path, h) - before.steering_wheel, STEERING_RATE_RAD_S * SAMPLE_S
    )
    return Controls(
        clip(before.steering_wheel + turn, c.steering_limit), wanted_traction(x, path, c)
    )
