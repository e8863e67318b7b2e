"""An extended Kalman filter on the nonlinear single-track model, without GPS.

After Best, Gordon and Dixon, "An extended adaptive Kalman filter for real-time state estimation of
vehicle handling dynamics", Vehicle System Dynamics 34 (2000); instead of adapting the tyres it
follows the wheels' loads (`axle_forces`). The state is x = [vx, vy, r, b], with b the bias of the
lateral accelerometer; ax and the steering angle δ drive it, and wheel speed, yaw rate and ay
correct it. With the lateral forces F of the axles:

    v̇x = ax + r vy                         z1 = vx
    v̇y = (Ff cos δ + Fr)/m − r vx          z2 = r
    ṙ  = (a Ff cos δ − b Fr)/I             z3 = (Ff cos δ + Fr)/m + b
    ḃ  = 0

The gyroscope's bias is a state of the yaw rate filter (`yaw_rate`) before it.
"""

from typing import NamedTuple

import numpy as np
from pydantic import Field, FiniteFloat

from fleet_slip.arrays import FloatArray
from fleet_slip.comparison.observers import yaw_rate
from fleet_slip.comparison.observers.angle import sideslip_angle
from fleet_slip.comparison.observers.axle_forces import Axles, Chassis, loaded_axles, rates
from fleet_slip.comparison.observers.signals import STEP_S, DriveSignals, hold_last
from fleet_slip.comparison.observers.single_track import measured_speed_mps, measured_steer_rad
from fleet_slip.comparison.observers.yaw_rate import YawRateNoise
from fleet_slip.compiling import kernel
from fleet_slip.config import Config
from fleet_slip.vehicle.parameters import VehicleParameters

INITIAL_STD = (1.0, 1.0, 0.1)
"""Of vx, vy (m/s) and r (rad/s) at the first row."""


class EkfNoise(Config):
    """Standard deviations of the filter.

    Those of the sensors are the paper's initial noise; how far the model errs is judgement.
    """

    ax_std_mps2: FiniteFloat = Field(default=0.1, ge=0)
    lateral_model_std_mps2: FiniteFloat = Field(default=0.3, ge=0)
    yaw_model_std_rad_s2: FiniteFloat = Field(default=0.3, ge=0)
    wheel_speed_std_mps: FiniteFloat = Field(default=0.005, gt=0)
    yaw_rate_std_rad_s: FiniteFloat = Field(default=0.01, gt=0)
    ay_std_mps2: FiniteFloat = Field(default=0.1, gt=0)
    ay_bias_std_mps2: FiniteFloat = Field(default=0.15, ge=0)
    """Of the accelerometer's bias before the drive; 0 leaves it out of the state."""
    stiffness_front_factor: FiniteFloat = Field(default=1.0, ge=0.5, le=1.5)
    """Cornering stiffness of the front axle over what the car's parameters say."""
    stiffness_rear_factor: FiniteFloat = Field(default=1.0, ge=0.5, le=1.5)
    adhesion: FiniteFloat = Field(default=1.0, gt=0)
    """What the filter is told of the road."""
    yaw_rate: YawRateNoise = YawRateNoise()


TUNABLE = (
    "lateral_model_std_mps2",
    "yaw_model_std_rad_s2",
    "wheel_speed_std_mps",
    "yaw_rate_std_rad_s",
    "ay_std_mps2",
    "ay_bias_std_mps2",
    "stiffness_front_factor",
    "stiffness_rear_factor",
    *yaw_rate.TUNABLE,
)
"""The parameters that `tuning.tune` should search."""


class Variances(NamedTuple):
    """Variances of a step of the state, and of the measurements."""

    q_vx: float
    q_vy: float
    q_r: float
    r_vx: float
    r_r: float
    r_ay: float


class Belief(NamedTuple):
    """Mean of [vx, vy, r, b] and its covariance, upper triangle."""

    vx: float
    vy: float
    r: float
    b: float
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
def predict(
    x: Belief, ax: float, steer: float, dt: float, axles: Axles, c: Chassis, v: Variances
) -> Belief:
    """Return the belief one step later: x ← x + Δt f(x), P ← F P Fᵀ + Q, F = I + Δt ∂f/∂x."""
    d = rates(x.vx, x.vy, x.r, steer, axles, c)
    f00, f01, f02 = 1.0, dt * x.r, dt * x.vy
    f10, f11, f12 = dt * (d.ay_vx - x.r), 1.0 + dt * d.ay_vy, dt * (d.ay_r - x.vx)
    f20, f21, f22 = dt * d.yaw_vx, dt * d.yaw_vy, 1.0 + dt * d.yaw_r
    a00 = f00 * x.p00 + f01 * x.p01 + f02 * x.p02
    a01 = f00 * x.p01 + f01 * x.p11 + f02 * x.p12
    a02 = f00 * x.p02 + f01 * x.p12 + f02 * x.p22
    a10 = f10 * x.p00 + f11 * x.p01 + f12 * x.p02
    a11 = f10 * x.p01 + f11 * x.p11 + f12 * x.p12
    a12 = f10 * x.p02 + f11 * x.p12 + f12 * x.p22
    a20 = f20 * x.p00 + f21 * x.p01 + f22 * x.p02
    a21 = f20 * x.p01 + f21 * x.p11 + f22 * x.p12
    a22 = f20 * x.p02 + f21 * x.p12 + f22 * x.p22
    return Belief(
        x.vx + dt * (ax + x.r * x.vy),
        x.vy + dt * (d.ay - x.r * x.vx),
        x.r + dt * d.yaw,
        x.b,
        a00 * f00 + a01 * f01 + a02 * f02 + v.q_vx,
        a00 * f10 + a01 * f11 + a02 * f12,
        a00 * f20 + a01 * f21 + a02 * f22,
        f00 * x.p03 + f01 * x.p13 + f02 * x.p23,
        a10 * f10 + a11 * f11 + a12 * f12 + v.q_vy,
        a10 * f20 + a11 * f21 + a12 * f22,
        f10 * x.p03 + f11 * x.p13 + f12 * x.p23,
        a20 * f20 + a21 * f21 + a22 * f22 + v.q_r,
        f20 * x.p03 + f21 * x.p13 + f22 * x.p23,
        x.p33,
    )


@kernel
def condition(
    x: Belief, h: tuple[float, float, float, float], innovation: float, variance: float
) -> Belief:
    """Return the belief given one measurement with the row H, in Joseph form.

    K = P Hᵀ / (H P Hᵀ + R). With u = P Hᵀ, Joseph's (I − K H) P (I − K H)ᵀ + K R Kᵀ is
    P − K uᵀ + (K R − (u − K H u)) Kᵀ, whose last term is zero but for rounding.
    """
    u0 = x.p00 * h[0] + x.p01 * h[1] + x.p02 * h[2] + x.p03 * h[3]
    u1 = x.p01 * h[0] + x.p11 * h[1] + x.p12 * h[2] + x.p13 * h[3]
    u2 = x.p02 * h[0] + x.p12 * h[1] + x.p22 * h[2] + x.p23 * h[3]
    u3 = x.p03 * h[0] + x.p13 * h[1] + x.p23 * h[2] + x.p33 * h[3]
    known = h[0] * u0 + h[1] * u1 + h[2] * u2 + h[3] * u3
    whole = known + variance
    k0, k1, k2, k3 = u0 / whole, u1 / whole, u2 / whole, u3 / whole
    e0 = k0 * variance - (u0 - k0 * known)
    e1 = k1 * variance - (u1 - k1 * known)
    e2 = k2 * variance - (u2 - k2 * known)
    e3 = k3 * variance - (u3 - k3 * known)
    return Belief(
        x.vx + k0 * innovation,
        x.vy + k1 * innovation,
        x.r + k2 * innovation,
        x.b + k3 * innovation,
        x.p00 - k0 * u0 + e0 * k0,
        x.p01 - k0 * u1 + e0 * k1,
        x.p02 - k0 * u2 + e0 * k2,
        x.p03 - k0 * u3 + e0 * k3,
        x.p11 - k1 * u1 + e1 * k1,
        x.p12 - k1 * u2 + e1 * k2,
        x.p13 - k1 * u3 + e1 * k3,
        x.p22 - k2 * u2 + e2 * k2,
        x.p23 - k2 * u3 + e2 * k3,
        x.p33 - k3 * u3 + e3 * k3,
    )


@kernel
def update(
    x: Belief,
    vx: float,
    yaw_rate: float,
    ay: float,
    steer: float,
    axles: Axles,
    c: Chassis,
    v: Variances,
) -> Belief:
    """Return the belief given wheel speed, yaw rate and lateral acceleration, one after the other.

    Their noises are independent, so that the order does not matter but for the linearisation.
    """
    x = condition(x, (1.0, 0.0, 0.0, 0.0), vx - x.vx, v.r_vx)
    x = condition(x, (0.0, 0.0, 1.0, 0.0), yaw_rate - x.r, v.r_r)
    d = rates(x.vx, x.vy, x.r, steer, axles, c)
    return condition(x, (d.ay_vx, d.ay_vy, d.ay_r, 1.0), ay - d.ay - x.b, v.r_ay)


@kernel
def _filter(
    ax: FloatArray,
    ay: FloatArray,
    yaw_rate: FloatArray,
    vx: FloatArray,
    steer: FloatArray,
    loaded: FloatArray,
    model_noise: FloatArray,
    x: Belief,
    c: Chassis,
    v: Variances,
) -> FloatArray:
    means = np.empty((2, len(ax)))
    for k in range(len(ax)):
        axles = Axles(loaded[0, k], loaded[1, k], loaded[2, k], loaded[3, k])
        if k > 0:
            noise = model_noise[k]
            w = Variances(v.q_vx, noise * v.q_vy, noise * v.q_r, v.r_vx, v.r_r, v.r_ay)
            x = predict(x, ax[k], steer[k], STEP_S, axles, c, w)
        x = update(x, vx[k], yaw_rate[k], ay[k], steer[k], axles, c, v)
        means[0, k] = x.vx
        means[1, k] = x.vy
    return means


def variances(noise: EkfNoise) -> Variances:
    """Return the variances per step."""
    return Variances(
        q_vx=(noise.ax_std_mps2 * STEP_S) ** 2,
        q_vy=(noise.lateral_model_std_mps2 * STEP_S) ** 2,
        q_r=(noise.yaw_model_std_rad_s2 * STEP_S) ** 2,
        r_vx=noise.wheel_speed_std_mps**2,
        r_r=noise.yaw_rate_std_rad_s**2,
        r_ay=noise.ay_std_mps2**2,
    )


def chassis(car: VehicleParameters) -> Chassis:
    """Return what the filter knows of a car beside its tyres."""
    body = car.body
    return Chassis(body.mass_kg, body.yaw_inertia_kgm2, body.front_axle_m, body.rear_axle_m)


def axles_of(
    car: VehicleParameters, ax_mps2: FloatArray, ay_mps2: FloatArray, noise: EkfNoise
) -> FloatArray:
    """Return the axles under the measured accelerations, as stiff as the parameters say.

    The shape is that of `loaded_axles`.
    """
    axles = loaded_axles(car, ax_mps2, ay_mps2, noise.adhesion)
    axles[0] *= noise.stiffness_front_factor
    axles[1] *= noise.stiffness_rear_factor
    return axles


def estimate(
    drive: DriveSignals,
    car: VehicleParameters,
    noise: EkfNoise,
    model_noise: FloatArray | None = None,
) -> FloatArray:
    """Estimate side-slip in rad at every row. Gaps of a sensor are bridged by the value before.

    `model_noise`, shape (rows,), multiplies the variances of the model's errors in each row.
    Raises `DataError` if a sensor is absent.
    """
    turning = yaw_rate.estimate(drive, car, noise.yaw_rate).yaw_rate_rad_s
    vx_mps = measured_speed_mps(drive, car)
    ax_mps2, ay_mps2 = hold_last(drive.ax_mps2, "ax"), hold_last(drive.ay_mps2, "ay")
    p0, p1, p2 = (std**2 for std in INITIAL_STD)
    first = Belief(
        vx_mps[0], 0.0, turning[0], 0.0,
        p0, 0.0, 0.0, 0.0, p1, 0.0, 0.0, p2, 0.0, noise.ay_bias_std_mps2**2,
    )  # fmt: skip
    means = _filter(
        ax_mps2,
        ay_mps2,
        turning,
        vx_mps,
        measured_steer_rad(drive),
        axles_of(car, ax_mps2, ay_mps2, noise),
        np.ones(len(drive)) if model_noise is None else model_noise,
        first,
        chassis(car),
        variances(noise),
    )
    return sideslip_angle(means[0], means[1])
