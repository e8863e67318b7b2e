"""The paper's Kalman filter: GPS velocity fused with the accelerometers, Section IV.

The state is x = [u_x, b_x, u_y, b_y]: velocity of the centre of gravity in the car's frame and the
biases a_x,bias and a_y,bias of the accelerometers. The paper's (6b) prints the term ψ̇ u_x Δt with a
plus; (5b), from which it follows, and the mechanics ask for a minus, which stands here.
"""

from typing import NamedTuple

import numpy as np
from pydantic import Field, FiniteFloat

from fleet_slip.arrays import FloatArray
from fleet_slip.compiling import kernel
from fleet_slip.config import Config
from fleet_slip.evaluation import yaw_rate_filter
from fleet_slip.evaluation.evaluator import MissingSignalError
from fleet_slip.evaluation.gaussian_state import (
    GaussianState,
    independent_state,
    measurement_update,
    predict_covariance,
)
from fleet_slip.evaluation.single_track import STEP_S, DriveSignals, hold_last, sideslip_angle
from fleet_slip.evaluation.yaw_rate_filter import YawRateNoise
from fleet_slip.vehicle.parameters import VehicleParameters


class FilterNoise(Config):
    """Standard deviations that make Q and R; the defaults are the paper's initial noise."""

    ax_std_mps2: FiniteFloat = Field(default=0.1, ge=0)
    ay_std_mps2: FiniteFloat = Field(default=0.1, ge=0)
    bias_std_mps2: FiniteFloat = Field(default=0.15, gt=0)
    """Accelerometers' biases before the drive."""
    bias_walk_mps2_per_sqrt_s: FiniteFloat = Field(default=0.0, ge=0)
    """Random walk of a bias over 1 s. The paper has no noise on biases."""
    gps_vx_std_mps: FiniteFloat = Field(default=0.05, gt=0)
    gps_vy_std_mps: FiniteFloat = Field(default=0.05, gt=0)
    yaw_rate: YawRateNoise = YawRateNoise()


TUNABLE = (
    "ax_std_mps2",
    "ay_std_mps2",
    "gps_vx_std_mps",
    "gps_vy_std_mps",
    "bias_std_mps2",
    *yaw_rate_filter.TUNABLE,
)
"""The parameters of Q, R and the first P that `identify.tune` should search."""


class Covariances(NamedTuple):
    """The diagonals of Q and R, and of P at the first fix, as variances per step."""

    q_ux: float
    q_uy: float
    q_bias: float
    r_ux: float
    r_uy: float
    bias: float


def covariances(noise: FilterNoise) -> Covariances:
    """Return Q = B1 W B1ᵀ, where B1 multiplies the acceleration noise by Δt, and R."""
    return Covariances(
        q_ux=(noise.ax_std_mps2 * STEP_S) ** 2,
        q_uy=(noise.ay_std_mps2 * STEP_S) ** 2,
        q_bias=noise.bias_walk_mps2_per_sqrt_s**2 * STEP_S,
        r_ux=noise.gps_vx_std_mps**2,
        r_uy=noise.gps_vy_std_mps**2,
        bias=noise.bias_std_mps2**2,
    )


@kernel
def initial_state(gps_vx: float, gps_vy: float, c: Covariances) -> GaussianState:
    """Return the state at the first fix: its velocity, and biases around zero."""
    return independent_state((gps_vx, 0.0, gps_vy, 0.0), (c.r_ux, c.bias, c.r_uy, c.bias))


@kernel
def predict(
    x: GaussianState, ax: float, ay: float, yaw_rate: float, dt: float, c: Covariances
) -> None:
    """Time update, equations (6), (7) and (9).

        | 1      −Δt  ψ̇Δt   0  |            | Δt  0 |
    F = | 0       1    0    0  |   B1, B2 = | 0   0 |   x ← F x + B2 u
        | −ψ̇Δt    0    1   −Δt |            | 0  Δt |   P ← F P Fᵀ + Q
        | 0       0    0    1  |            | 0   0 |
    """
    turn = yaw_rate * dt
    ux, bx, uy, by = x.mean
    x.mean[0] = ux + dt * (ax - bx) + turn * uy
    x.mean[2] = uy + dt * (ay - by) - turn * ux
    f = ((1.0, -dt, turn, 0.0), (0.0, 1.0, 0.0, 0.0), (-turn, 0.0, 1.0, -dt), (0.0, 0.0, 0.0, 1.0))
    predict_covariance(x, f, (c.q_ux, c.q_bias, c.q_uy, c.q_bias))


@kernel
def update(x: GaussianState, gps_vx: float, gps_vy: float, c: Covariances) -> None:
    """Measurement update by the two velocities of a fix, equations (10) and (11)."""
    measurement_update(x, (1.0, 0.0, 0.0, 0.0), gps_vx - x.mean[0], c.r_ux)
    measurement_update(x, (0.0, 0.0, 1.0, 0.0), gps_vy - x.mean[2], c.r_uy)


@kernel
def _filter(
    ax: FloatArray,
    ay: FloatArray,
    yaw_rate: FloatArray,
    gps_vx: FloatArray,
    gps_vy: FloatArray,
    first_fix: int,
    dt: float,
    c: Covariances,
) -> FloatArray:
    means = np.full((4, len(ax)), np.nan)
    state = initial_state(gps_vx[first_fix], gps_vy[first_fix], c)
    for k in range(first_fix, len(ax)):
        if k > first_fix:
            predict(state, ax[k], ay[k], yaw_rate[k], dt, c)
            if not np.isnan(gps_vx[k] + gps_vy[k]):
                update(state, gps_vx[k], gps_vy[k], c)
        means[:, k] = state.mean
    return means


def fuse(drive: DriveSignals, yaw_rate_rad_s: FloatArray, noise: FilterNoise) -> FloatArray:
    """Return vx in m/s, the bias of ax in m/s², vy and the bias of ay, shape (4, rows).

    The filter starts at the first GPS fix, NaN before it, predicts at every row and updates at
    every fix. Gaps of the accelerometers are bridged by the last value. Raises
    `MissingSignalError` if the drive has no fix.
    """
    fixes = np.flatnonzero(np.isfinite(drive.gps_vx_mps) & np.isfinite(drive.gps_vy_mps))
    if not len(fixes):
        raise MissingSignalError(
            "the drive has no GPS fix, from which the Kalman filter starts. Choose drives with GPS."
        )
    return _filter(
        hold_last(drive.ax_mps2, "ax"),
        hold_last(drive.ay_mps2, "ay"),
        yaw_rate_rad_s,
        drive.gps_vx_mps,
        drive.gps_vy_mps,
        fixes[0],
        STEP_S,
        covariances(noise),
    )


def estimate(drive: DriveSignals, car: VehicleParameters, noise: FilterNoise) -> FloatArray:
    """Estimate side-slip in rad at every row, NaN before the first fix. Raises as `fuse`.

    Only the geometry of the car matters, which turns wheel speeds into a yaw rate. The filter is
    compiled and releases the interpreter's lock: many drives run on threads, as in
    `executor.map(partial(estimate, car=car, noise=noise), drives)`.
    """
    yaw_rate_rad_s, _ = yaw_rate_filter.estimate(drive, car, noise.yaw_rate)
    vx_mps, _, vy_mps, _ = fuse(drive, yaw_rate_rad_s, noise)
    return sideslip_angle(vx_mps, vy_mps)
