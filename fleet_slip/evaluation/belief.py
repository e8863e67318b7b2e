"""What a Kalman filter believes of its state, and the algebra that all filters here share.

Functions change a belief in place: a filter takes millions of steps, and allocates nothing in them.
"""

from typing import Any, NamedTuple

import numpy as np
from pydantic import Field, FiniteFloat

from fleet_slip.arrays import FloatArray
from fleet_slip.compiling import equation, kernel
from fleet_slip.config import Config
from fleet_slip.evaluation.single_track import STEP_S, DriveSignals, undriven_axle
from fleet_slip.vehicle.parameters import VehicleParameters

Row = tuple[Any, ...]
"""A row of a matrix, of a length that the compiler knows: it unrolls the loops over it."""


class Belief(NamedTuple):
    """Mean x of a state, shape (n,), its covariance P, shape (n, n), and room for F P."""

    mean: FloatArray
    covariance: FloatArray
    room: FloatArray


@equation
def belief_of(mean: Row, variances: Row) -> Belief:
    """Return a belief whose states are independent of one another."""
    n = len(mean)
    belief = Belief(np.empty(n), np.zeros((n, n)), np.empty((n, n)))
    for i in range(n):
        belief.mean[i] = mean[i]
        belief.covariance[i, i] = variances[i]
    return belief


@equation
def spread(belief: Belief, f: tuple[Row, ...], q: Row) -> None:
    """Carry the covariance one step on, P ← F P Fᵀ + diag(q)."""
    p, fp = belief.covariance, belief.room
    n = len(q)
    for i in range(n):
        for j in range(n):
            total = 0.0
            for k in range(n):
                total += f[i][k] * p[k, j]
            fp[i, j] = total
    for i in range(n):
        for j in range(i, n):
            total = 0.0
            for k in range(n):
                total += fp[i, k] * f[j][k]
            p[i, j] = total
            p[j, i] = total
        p[i, i] += q[i]


@equation
def condition(belief: Belief, h: Row, innovation: float, variance: float) -> float:
    """Take in one measurement with the row H, in Joseph's form; return the innovation's variance.

        K = P Hᵀ / (H P Hᵀ + R)
        x ← x + K (z − H x)
        P ← (I − K H) P (I − K H)ᵀ + K R Kᵀ

    With u = P Hᵀ, P becomes P − K uᵀ + (K R − (u − K H u)) Kᵀ, whose last term is zero but for
    rounding. P (I − K H) alone would lose symmetry and definiteness to it. Measurements with
    independent noises may come one after the other.
    """
    x, p, u = belief.mean, belief.covariance, belief.room[0]
    n = len(h)
    known = 0.0
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += p[i, j] * h[j]
        u[i] = total
        known += h[i] * total
    for i in range(n):
        gain = u[i] / (known + variance)
        rest = gain * variance - (u[i] - gain * known)
        x[i] += gain * innovation
        for j in range(i, n):
            p[i, j] = p[i, j] - gain * u[j] + rest * (u[j] / (known + variance))
            p[j, i] = p[i, j]
    return known + variance


# The yaw rate by a Kalman filter of its own, which the paper's filter assumes to be there.
#
# The state is x = [r, b]: yaw rate and bias of the gyroscope, as Bevly, Ryu and Gerdes
# ("Integrating INS sensors with GPS measurements for continuous estimation of vehicle sideslip,
# roll, and tire cornering stiffness", IEEE Transactions on Intelligent Transportation Systems 7,
# 2006) estimate a gyroscope's bias against an absolute reference. The reference here is not the
# GPS heading, which a log has not, but the difference of wheel speeds (`AxleSpeeds`), which no
# tunnel takes away:
#
#     r(k) = r(k−1) + Δt w_r        gyroscope   z_g = r + b + w_g
#     b(k) = b(k−1)                 wheels      z_w = r + w_w
#
# Wheels that brake in a corner slip more on the unloaded side: rows of braking give no z_w.

INITIAL_STD_RAD_S = 1.0
"""Of the yaw rate before the first measurement: nothing is known."""


BRAKING_MPS2 = -0.5
"""Longitudinal acceleration below which wheels are taken to brake; a coasting car stays above."""


class YawRateNoise(Config):
    """Standard deviations of the yaw rate filter; the defaults are the paper's initial noise."""

    gyro_std_rad_s: FiniteFloat = Field(default=0.01, gt=0)
    gyro_bias_std_rad_s: FiniteFloat = Field(default=0.01, gt=0)
    """Of the bias before the drive."""
    wheel_yaw_rate_std_rad_s: FiniteFloat = Field(default=0.006, gt=0)
    """Of the yaw rate from wheel speeds: √2 R σ_ω / track with σ_ω of 0.02 rad/s."""
    yaw_acceleration_std_rad_s2: FiniteFloat = Field(default=0.5, gt=0)
    """How fast the yaw rate may change."""


TUNABLE = (
    "yaw_rate.gyro_std_rad_s",
    "yaw_rate.wheel_yaw_rate_std_rad_s",
    "yaw_rate.yaw_acceleration_std_rad_s2",
)
"""What is worth tuning of an estimator's `yaw_rate: YawRateNoise`."""


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
    x = belief_of((0.0, 0.0), (INITIAL_STD_RAD_S**2, bias_var))
    for k in range(len(gyro)):
        x.covariance[0, 0] += step_var
        if not np.isnan(gyro[k]):
            condition(x, (1.0, 1.0), gyro[k] - x.mean[0] - x.mean[1], gyro_var)
        if not np.isnan(wheels[k]):
            condition(x, (1.0, 0.0), wheels[k] - x.mean[0], wheel_var)
        estimates[:, k] = x.mean
    return estimates


def estimate(drive: DriveSignals, car: VehicleParameters, noise: YawRateNoise) -> FloatArray:
    """Estimate yaw rate and bias of the gyroscope in rad/s at every row, shape (2, rows).

    It is of what was measured up to it; gaps are bridged. One speed in the place of both wheels
    tells of no turn but where the car stands still.
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
