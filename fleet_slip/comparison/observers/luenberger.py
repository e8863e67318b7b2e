"""A Luenberger observer on the linear single-track model, gains by pole placement at every speed.

    x̂˙ = A x̂ + B δ + L (y − C x̂ − D δ),     x = [vy, r],  y = [r, ay]

Luenberger, "An introduction to observers", IEEE Transactions on Automatic Control 16 (1971); on
this model Stéphant, Charara and Meizel, "Virtual sensor: application to vehicle sideslip angle and
transversal forces", IEEE Transactions on Industrial Electronics 51 (2004). Lateral acceleration is
a second output here: a car near neutral steer hardly shows vy in its yaw rate.
"""

import numpy as np
from pydantic import Field, FiniteFloat

from fleet_slip.arrays import FloatArray
from fleet_slip.comparison.observers import yaw_rate
from fleet_slip.comparison.observers.drive_signals import (
    STEP_S,
    DriveSignals,
    hold_last,
    sideslip_angle,
)
from fleet_slip.comparison.observers.single_track import (
    SingleTrack,
    StateSpace,
    measured_speed_mps,
    measured_steer_rad,
    state_space,
)
from fleet_slip.comparison.observers.yaw_rate import YawRateNoise
from fleet_slip.compiling import kernel
from fleet_slip.config import Config
from fleet_slip.vehicle.parameters import VehicleParameters


class ObserverPoles(Config):
    """How fast the errors decay. At 100/s the observer would follow every sample's noise."""

    lateral_velocity_1ps: FiniteFloat = Field(default=5.0, gt=0, le=100)
    yaw_rate_1ps: FiniteFloat = Field(default=20.0, gt=0, le=100)
    stiffness_factor: FiniteFloat = Field(default=1.0, ge=0.5, le=1.5)
    """Cornering stiffness over that at rest: load transfer in corners softens an axle."""
    yaw_rate: YawRateNoise = YawRateNoise()


TUNABLE = ("lateral_velocity_1ps", "yaw_rate_1ps", "stiffness_factor", *yaw_rate.TUNABLE)
"""The parameters that `tuning.tune` should search."""


def gains(space: StateSpace, poles: ObserverPoles) -> FloatArray:
    """Return L for every row, as rows [l11, l12, l21, l22] of shape (4, n).

    A − L C = diag(−p1, −p2) has one solution, because C = [[0, 1], [a11, a12 + vx]] is regular:
    L = (A − diag(−p1, −p2)) C⁻¹. The errors then obey ė = diag(−p1, −p2) e at changing speed too.
    """
    p1, p2 = poles.lateral_velocity_1ps, poles.yaw_rate_1ps
    l12 = 1.0 + p1 / space.a11
    l22 = space.a21 / space.a11
    return np.stack([space.a12 - l12 * space.c2, l12, space.a22 + p2 - l22 * space.c2, l22])


@kernel
def _observe(
    space: tuple[FloatArray, ...],
    gain: FloatArray,
    steer: FloatArray,
    yaw_rate: FloatArray,
    ay: FloatArray,
    rear_m: float,
) -> FloatArray:
    """Return vy, by Euler's forward step. The space is a `StateSpace` as a plain tuple."""
    a11, a12, a21, a22, b1, b2, vx_mps = space
    vy, r = rear_m * yaw_rate[0], yaw_rate[0]
    estimates = np.empty(len(ay))
    for k in range(len(ay)):
        force = a11[k] * vy + a12[k] * r + b1[k] * steer[k]
        error_r = yaw_rate[k] - r
        error_ay = ay[k] - (force + vx_mps[k] * r)
        vy_rate = force + gain[0, k] * error_r + gain[1, k] * error_ay
        moment = a21[k] * vy + a22[k] * r + b2[k] * steer[k]
        r += STEP_S * (moment + gain[2, k] * error_r + gain[3, k] * error_ay)
        vy += STEP_S * vy_rate
        estimates[k] = vy
    return estimates


def estimate(drive: DriveSignals, car: VehicleParameters, poles: ObserverPoles) -> FloatArray:
    """Estimate side-slip in rad at every row, gaps bridged. Raises `DataError` without a sensor."""
    vx_mps = measured_speed_mps(drive, car)
    space = state_space(SingleTrack.of(car, poles.stiffness_factor), vx_mps)
    vy_mps = _observe(
        tuple(space),
        gains(space, poles),
        measured_steer_rad(drive),
        yaw_rate.estimate(drive, car, poles.yaw_rate).yaw_rate_rad_s,
        hold_last(drive.ay_mps2, "ay"),
        car.body.rear_axle_m,
    )
    return sideslip_angle(vx_mps, vy_mps)
