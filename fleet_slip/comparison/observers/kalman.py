"""The paper's Kalman filter: GPS velocity fused with the accelerometers, Section IV.

The state is x = [u_x, b_x, u_y, b_y]: velocity of the centre of gravity in the car's frame and the
biases a_x,bias and a_y,bias of the accelerometers. The paper's (6b) prints the term ψ̇ u_x Δt with a
plus; (5b), from which it follows, and the mechanics ask for a minus, which stands here.
"""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from pydantic import Field, FiniteFloat

from fleet_slip.arrays import FloatArray
from fleet_slip.comparison.observers import yaw_rate
from fleet_slip.comparison.observers.angle import sideslip_angle
from fleet_slip.comparison.observers.signals import STEP_S, DriveSignals, hold_last
from fleet_slip.comparison.observers.yaw_rate import YawRateNoise
from fleet_slip.compiling import kernel
from fleet_slip.config import Config
from fleet_slip.errors import DataError
from fleet_slip.simulation.sensors import Sensors
from fleet_slip.vehicle.parameters import VehicleParameters


class FilterNoise(Config):
    """Standard deviations that make Q and R; the defaults are the paper's initial noise."""

    ax_std_mps2: FiniteFloat = Field(default=0.1, ge=0)
    ay_std_mps2: FiniteFloat = Field(default=0.1, ge=0)
    bias_std_mps2: FiniteFloat = Field(default=0.15, gt=0)
    """Of the accelerometers' biases before the drive."""
    bias_walk_mps2_per_sqrt_s: FiniteFloat = Field(default=0.0, ge=0)
    """How much a bias wanders in 1 s. The paper has no noise on biases."""
    gps_vx_std_mps: FiniteFloat = Field(default=0.05, gt=0)
    gps_vy_std_mps: FiniteFloat = Field(default=0.05, gt=0)
    yaw_rate: YawRateNoise = YawRateNoise()

    @classmethod
    def of(
        cls,
        sensors: Sensors,
        car: VehicleParameters,
        *,
        bias_std_mps2: float,
        gyro_bias_std_rad_s: float,
    ) -> Self:
        """Return the noise that the sensors of a car state, with the size of their biases."""
        return cls(
            ax_std_mps2=sensors.acceleration_std_mps2,
            ay_std_mps2=sensors.acceleration_std_mps2,
            bias_std_mps2=bias_std_mps2,
            gps_vx_std_mps=sensors.gps.velocity_std_mps,
            gps_vy_std_mps=sensors.gps.velocity_std_mps,
            yaw_rate=YawRateNoise.of(sensors, car, gyro_bias_std_rad_s),
        )


TUNABLE = (
    "ax_std_mps2",
    "ay_std_mps2",
    "gps_vx_std_mps",
    "gps_vy_std_mps",
    "bias_std_mps2",
    *yaw_rate.TUNABLE,
)
"""The parameters of Q, R and the first P that `tuning.tune` should search."""


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


class Belief(NamedTuple):
    """Mean x of the state and its covariance P, whose upper triangle is all of it."""

    ux: float
    bx: float
    uy: float
    by: float
    p00: float
    p01: float
    p02: float
    p03: float
    p11: float
    p12: float
    p13: float
    p22: float
    p23: float
    p33: float


@kernel
def first_belief(gps_vx: float, gps_vy: float, c: Covariances) -> Belief:
    """Return the belief at the first fix: its velocity, and biases around zero."""
    return Belief(
        gps_vx, 0.0, gps_vy, 0.0, c.r_ux, 0.0, 0.0, 0.0, c.bias, 0.0, 0.0, c.r_uy, 0.0, c.bias
    )


@kernel
def predict(x: Belief, ax: float, ay: float, yaw_rate: float, dt: float, c: Covariances) -> Belief:
    """Return the belief one step later, equations (6), (7) and (9).

        | 1      −Δt  ψ̇Δt   0  |            | Δt  0 |
    F = | 0       1    0    0  |   B1, B2 = | 0   0 |   x ← F x + B2 u
        | −ψ̇Δt    0    1   −Δt |            | 0  Δt |   P ← F P Fᵀ + Q
        | 0       0    0    1  |            | 0   0 |
    """
    turn = yaw_rate * dt
    # Rows of F P; those of the biases are rows of P.
    a00 = x.p00 - dt * x.p01 + turn * x.p02
    a01 = x.p01 - dt * x.p11 + turn * x.p12
    a02 = x.p02 - dt * x.p12 + turn * x.p22
    a03 = x.p03 - dt * x.p13 + turn * x.p23
    a21 = x.p12 - turn * x.p01 - dt * x.p13
    a20 = x.p02 - turn * x.p00 - dt * x.p03
    a22 = x.p22 - turn * x.p02 - dt * x.p23
    a23 = x.p23 - turn * x.p03 - dt * x.p33
    return Belief(
        x.ux + dt * (ax - x.bx) + turn * x.uy,
        x.bx,
        x.uy + dt * (ay - x.by) - turn * x.ux,
        x.by,
        a00 - dt * a01 + turn * a02 + c.q_ux,
        a01,
        a02 - turn * a00 - dt * a03,
        a03,
        x.p11 + c.q_bias,
        a21,
        x.p13,
        a22 - turn * a20 - dt * a23 + c.q_uy,
        a23,
        x.p33 + c.q_bias,
    )


@kernel
def _gain(p0: float, p2: float, x: Belief, c: Covariances) -> tuple[float, float]:
    """Return one row of K from the row of P Hᵀ."""
    s00, s02, s22 = x.p00 + c.r_ux, x.p02, x.p22 + c.r_uy
    determinant = s00 * s22 - s02 * s02
    return (p0 * s22 - p2 * s02) / determinant, (p2 * s00 - p0 * s02) / determinant


@kernel
def _residual(
    p0: float, p2: float, k: tuple[float, float], x: Belief, c: Covariances
) -> tuple[float, float]:
    """Return one row of K R − (I − K H) P Hᵀ, which is zero but for rounding."""
    return (
        k[0] * c.r_ux - (p0 - k[0] * x.p00 - k[1] * x.p02),
        k[1] * c.r_uy - (p2 - k[0] * x.p02 - k[1] * x.p22),
    )


@kernel
def _joseph(
    p: float,
    p0: float,
    p2: float,
    k: tuple[float, float],
    residual: tuple[float, float],
    across: tuple[float, float],
) -> float:
    """Return one element of (I − K H) P (I − K H)ᵀ + K R Kᵀ.

    p is that of P, p0 and p2 those of H P in its column; k and residual belong to its row and
    `across` is the row of K that belongs to its column.
    """
    return p - k[0] * p0 - k[1] * p2 + residual[0] * across[0] + residual[1] * across[1]


@kernel
def update(x: Belief, gps_vx: float, gps_vy: float, c: Covariances) -> Belief:
    """Return the belief given a fix, equations (10) and (11), H selecting u_x and u_y.

        K = P Hᵀ (H P Hᵀ + R)⁻¹
        x ← x + K (z − H x)
        P ← (I − K H) P (I − K H)ᵀ + K R Kᵀ

    The paper's P (I − K H) loses symmetry and definiteness to rounding. This is Joseph's form of
    it, of which the upper triangle alone is computed.
    """
    k0 = _gain(x.p00, x.p02, x, c)
    k1 = _gain(x.p01, x.p12, x, c)
    k2 = _gain(x.p02, x.p22, x, c)
    k3 = _gain(x.p03, x.p23, x, c)
    e0 = _residual(x.p00, x.p02, k0, x, c)
    e1 = _residual(x.p01, x.p12, k1, x, c)
    e2 = _residual(x.p02, x.p22, k2, x, c)
    e3 = _residual(x.p03, x.p23, k3, x, c)
    dx, dy = gps_vx - x.ux, gps_vy - x.uy
    return Belief(
        x.ux + k0[0] * dx + k0[1] * dy,
        x.bx + k1[0] * dx + k1[1] * dy,
        x.uy + k2[0] * dx + k2[1] * dy,
        x.by + k3[0] * dx + k3[1] * dy,
        _joseph(x.p00, x.p00, x.p02, k0, e0, k0),
        _joseph(x.p01, x.p01, x.p12, k0, e0, k1),
        _joseph(x.p02, x.p02, x.p22, k0, e0, k2),
        _joseph(x.p03, x.p03, x.p23, k0, e0, k3),
        _joseph(x.p11, x.p01, x.p12, k1, e1, k1),
        _joseph(x.p12, x.p02, x.p22, k1, e1, k2),
        _joseph(x.p13, x.p03, x.p23, k1, e1, k3),
        _joseph(x.p22, x.p02, x.p22, k2, e2, k2),
        _joseph(x.p23, x.p03, x.p23, k2, e2, k3),
        _joseph(x.p33, x.p03, x.p23, k3, e3, k3),
    )


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
    belief = first_belief(gps_vx[first_fix], gps_vy[first_fix], c)
    for k in range(first_fix, len(ax)):
        if k > first_fix:
            belief = predict(belief, ax[k], ay[k], yaw_rate[k], dt, c)
            if not np.isnan(gps_vx[k] + gps_vy[k]):
                belief = update(belief, gps_vx[k], gps_vy[k], c)
        means[0, k] = belief.ux
        means[1, k] = belief.bx
        means[2, k] = belief.uy
        means[3, k] = belief.by
    return means


@dataclass(frozen=True)
class KalmanEstimate:
    """The filter's mean at every row; NaN before the first fix."""

    vx_mps: FloatArray
    ax_bias_mps2: FloatArray
    vy_mps: FloatArray
    ay_bias_mps2: FloatArray


def fuse(drive: DriveSignals, yaw_rate_rad_s: FloatArray, noise: FilterNoise) -> KalmanEstimate:
    """Run the filter over a drive with a yaw rate that is known.

    It begins at the first GPS fix, predicts at every row and updates at every fix. Gaps of the
    accelerometers are bridged by the value before. Raises `DataError` if the drive has no fix.
    """
    fixes = np.flatnonzero(np.isfinite(drive.gps_vx_mps) & np.isfinite(drive.gps_vy_mps))
    if not len(fixes):
        raise DataError(
            "the drive has no GPS fix, which the Kalman filter begins with. Choose drives with GPS."
        )
    means = _filter(
        hold_last(drive.ax_mps2, "ax"),
        hold_last(drive.ay_mps2, "ay"),
        yaw_rate_rad_s,
        drive.gps_vx_mps,
        drive.gps_vy_mps,
        fixes[0],
        STEP_S,
        covariances(noise),
    )
    return KalmanEstimate(*means)


def estimate(drive: DriveSignals, car: VehicleParameters, noise: FilterNoise) -> FloatArray:
    """Estimate side-slip in rad at every row, NaN before the first fix. Raises as `fuse`.

    Of the car, only the geometry counts that turns wheel speeds into a yaw rate. All of it is
    compiled and releases the interpreter's lock: many drives run on threads, as in
    `executor.map(partial(estimate, car=car, noise=noise), drives)`.
    """
    turning = yaw_rate.estimate(drive, car, noise.yaw_rate)
    motion = fuse(drive, turning.yaw_rate_rad_s, noise)
    return sideslip_angle(motion.vx_mps, motion.vy_mps)
