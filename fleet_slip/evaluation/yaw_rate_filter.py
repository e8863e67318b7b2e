"""A Kalman filter of the yaw rate, which the paper's filter takes as given.

The state is x = [r, b]: yaw rate and bias of the gyroscope, as Bevly, Ryu and Gerdes ("Integrating
INS sensors with GPS measurements for continuous estimation of vehicle sideslip, roll, and tire
cornering stiffness", IEEE Transactions on Intelligent Transportation Systems 7, 2006) estimate a
gyroscope's bias against an absolute reference. The reference here is not the GPS heading, which a
log may lack, but the difference of wheel speeds (`AxleSpeeds`), which no tunnel interrupts:

    r(k) = r(k−1) + Δt w_r        gyroscope   z_g = r + b + w_g
    b(k) = b(k−1)                 wheels      z_w = r + w_w

Wheels that brake in a corner slip more on the unloaded side: rows of braking have no z_w.
"""

import numpy as np
from pydantic import Field, FiniteFloat

from fleet_slip.arrays import FloatArray
from fleet_slip.compiling import kernel
from fleet_slip.config import Config
from fleet_slip.evaluation.gaussian_state import independent_state, measurement_update
from fleet_slip.evaluation.single_track import STEP_S, DriveSignals, undriven_axle
from fleet_slip.vehicle.parameters import VehicleParameters

INITIAL_STD_RAD_S = 1.0
"""Standard deviation of the yaw rate before the first measurement: uninformative."""

BRAKING_MPS2 = -0.5
"""Longitudinal acceleration below which wheels brake; a coasting car stays above."""


class YawRateNoise(Config):
    """Standard deviations of the yaw rate filter; the defaults are the paper's initial noise."""

    gyro_std_rad_s: FiniteFloat = Field(default=0.01, gt=0)
    gyro_bias_std_rad_s: FiniteFloat = Field(default=0.01, gt=0)
    """Bias before the drive."""
    wheel_yaw_rate_std_rad_s: FiniteFloat = Field(default=0.006, gt=0)
    """Yaw rate from wheel speeds: √2 R σ_ω / track with σ_ω of 0.02 rad/s."""
    yaw_acceleration_std_rad_s2: FiniteFloat = Field(default=0.5, gt=0)
    """Change of the yaw rate per second."""


TUNABLE = (
    "yaw_rate.gyro_std_rad_s",
    "yaw_rate.wheel_yaw_rate_std_rad_s",
    "yaw_rate.yaw_acceleration_std_rad_s2",
)
"""Parameters to tune of an estimator's `yaw_rate: YawRateNoise`."""


@kernel
def _filter(
    gyro: FloatArray,
    wheels: FloatArray,
    bias_var: float,
    gyro_var: float,
    wheel_var: float,
    step_var: float,
) -> FloatArray:
    estimates = np.empty((2, len(gyro)))
    x = independent_state((0.0, 0.0), (INITIAL_STD_RAD_S**2, bias_var))
    for k in range(len(gyro)):
        x.covariance[0, 0] += step_var
        if not np.isnan(gyro[k]):
            measurement_update(x, (1.0, 1.0), gyro[k] - x.mean[0] - x.mean[1], gyro_var)
        if not np.isnan(wheels[k]):
            measurement_update(x, (1.0, 0.0), wheels[k] - x.mean[0], wheel_var)
        estimates[:, k] = x.mean
    return estimates


def estimate(drive: DriveSignals, car: VehicleParameters, noise: YawRateNoise) -> FloatArray:
    """Estimate yaw rate and bias of the gyroscope in rad/s at every row, shape (2, rows).

    Gaps are bridged. Where one speed stands in for both wheels, only standstill is a measurement.
    """
    axle = undriven_axle(drive, car)
    rolling = drive.ax_mps2 > BRAKING_MPS2
    if np.array_equal(axle.left_mps, axle.right_mps, equal_nan=True):
        rolling &= axle.left_mps == 0
    return _filter(
        drive.yaw_rate_rad_s,
        np.where(rolling, axle.yaw_rate_rad_s, np.nan),
        noise.gyro_bias_std_rad_s**2,
        noise.gyro_std_rad_s**2,
        noise.wheel_yaw_rate_std_rad_s**2,
        (STEP_S * noise.yaw_acceleration_std_rad_s2) ** 2,
    )
