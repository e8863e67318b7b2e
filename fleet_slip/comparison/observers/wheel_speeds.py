"""What the undriven wheels tell of the car's motion: dead reckoning by wheel speeds.

Carlson, Gerdes and Powell, "Error sources when land vehicle dead reckoning with differential
wheelspeeds", Navigation 51 (2004): the axle without drive torque rolls with the least slip.
"""

from dataclasses import dataclass

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.comparison.observers.drive_signals import DriveSignals
from fleet_slip.vehicle.parameters import VehicleParameters


@dataclass(frozen=True)
class AxleSpeeds:
    """Rolling velocity of the two wheels of one axle over cos δ, and their distance."""

    left_mps: FloatArray
    right_mps: FloatArray
    track_m: FloatArray | float
    turned_m: FloatArray | float = 0.0
    """Mean of tan δ times the axle's distance before the centre of gravity."""

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
    taken off their mean. tan δ vy, a thousandth of vx, is neglected.
    """
    radius, front = car.tyre.rolling_radius_m, car.body.front_axle_m
    if car.drivetrain.front_drive_share >= 0.5:
        return AxleSpeeds(
            radius * drive.wheel_rl_rad_s, radius * drive.wheel_rr_rad_s, car.body.track_rear_m
        )
    left, right = np.tan(drive.steer_fl_rad), np.tan(drive.steer_fr_rad)
    return AxleSpeeds(
        radius * drive.wheel_fl_rad_s / np.cos(drive.steer_fl_rad),
        radius * drive.wheel_fr_rad_s / np.cos(drive.steer_fr_rad),
        car.body.track_front_m + front * (right - left),
        front * (left + right) / 2,
    )
