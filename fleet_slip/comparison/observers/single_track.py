"""The linear single-track model in lateral velocity and yaw rate, on which the observers stand.

Riekert and Schunck (1940); in this form Rajamani, "Vehicle Dynamics and Control" (2012), 2.3.
With x = [vy, r], the steering angle δ of the front axle and C the cornering stiffness of an axle:

    v̇y = −(Cf + Cr)/(m v) vy − ((a Cf − b Cr)/(m v) + vx) r + Cf/m δ
    ṙ  = −(a Cf − b Cr)/(I v) vy − (a² Cf + b² Cr)/(I v) r + a Cf/I δ

where v = vx. Below `SLOWEST_MPS` slip is measured against that speed: v = SLOWEST_MPS, and the
steering of a wheel that hardly rolls counts by vx / v. So the poles stay finite at rest.
"""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.comparison.observers.drive_signals import DriveSignals, hold_last
from fleet_slip.comparison.observers.wheel_speeds import undriven_axle
from fleet_slip.vehicle.parameters import VehicleParameters, constants
from fleet_slip.vehicle.tyre import cornering_stiffness

SLOWEST_MPS = 5.0
"""Speed below which slip is measured against this speed; the poles stay within 100/s."""


@dataclass(frozen=True)
class SingleTrack:
    """Parameters of the model."""

    mass_kg: float
    yaw_inertia_kgm2: float
    front_m: float
    """From the centre of gravity to the front axle, a."""
    rear_m: float
    """From the centre of gravity to the rear axle, b."""
    stiffness_front_n: float
    """Cornering stiffness of the front axle at its load at rest, per unit of slip."""
    stiffness_rear_n: float
    grip_front_n: float
    """Largest lateral force of the front axle on a dry road."""
    grip_rear_n: float

    @classmethod
    def of(cls, car: VehicleParameters, stiffness_factor: float = 1.0) -> Self:
        """Return the model of a car on a dry road: both tyres of an axle in one, loaded as at rest.

        `stiffness_factor` multiplies the cornering stiffness of both axles.
        """
        c = constants(car, adhesion=1.0)
        front, rear = c.static_front, c.static_rear
        axle = 2 * stiffness_factor
        return cls(
            mass_kg=c.mass,
            yaw_inertia_kgm2=c.yaw_inertia,
            front_m=c.front,
            rear_m=c.rear,
            stiffness_front_n=axle * cornering_stiffness(front, c.stiffness_front, c),
            stiffness_rear_n=axle * cornering_stiffness(rear, c.stiffness_rear, c),
            grip_front_n=2 * (c.friction - c.friction_per_load * front) * front,
            grip_rear_n=2 * (c.friction - c.friction_per_load * rear) * rear,
        )


class StateSpace(NamedTuple):
    """ẋ = A x + B δ for every row of a drive, and the lateral acceleration C x + D δ.

    ay = v̇y + r vx gives C = [a11, a12 + vx] and D = b1.
    """

    a11: FloatArray
    a12: FloatArray
    a21: FloatArray
    a22: FloatArray
    b1: FloatArray
    b2: FloatArray
    vx_mps: FloatArray

    @property
    def c2(self) -> FloatArray:
        """Lateral acceleration per yaw rate."""
        return self.a12 + self.vx_mps


def state_space(model: SingleTrack, vx_mps: FloatArray) -> StateSpace:
    """Return the matrices of the model at each speed."""
    m, inertia = model.mass_kg, model.yaw_inertia_kgm2
    a, b = model.front_m, model.rear_m
    cf, cr = model.stiffness_front_n, model.stiffness_rear_n
    v = np.maximum(vx_mps, SLOWEST_MPS)
    rolling = np.clip(vx_mps, 0.0, None) / v
    return StateSpace(
        a11=-(cf + cr) / (m * v),
        a12=-(a * cf - b * cr) / (m * v) - vx_mps,
        a21=-(a * cf - b * cr) / (inertia * v),
        a22=-(a**2 * cf + b**2 * cr) / (inertia * v),
        b1=cf / m * rolling,
        b2=a * cf / inertia * rolling,
        vx_mps=vx_mps,
    )


def measured_speed_mps(drive: DriveSignals, car: VehicleParameters) -> FloatArray:
    """Return the longitudinal velocity from wheel speeds. Raises `DataError` without them."""
    return hold_last(undriven_axle(drive, car).vx_mps, "wheel speeds")


def measured_steer_rad(drive: DriveSignals) -> FloatArray:
    """Return the mean angle of the front wheels. Raises `DataError` without them."""
    return hold_last((drive.steer_fl_rad + drive.steer_fr_rad) / 2, "steer_fl and steer_fr")
