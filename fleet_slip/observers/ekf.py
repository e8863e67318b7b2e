"""An extended Kalman filter on the nonlinear single-track model, without GPS.

After Best, Gordon and Dixon, "An extended adaptive Kalman filter for real-time state estimation of
vehicle handling dynamics", Vehicle System Dynamics 34 (2000), without the adaptation of the tyres.
The state is x = [vx, vy, r]; ax and the steering angle δ drive it, and wheel speed, yaw rate and ay
correct it. With the lateral forces F of the axles:

    v̇x = ax + r vy                         z1 = vx
    v̇y = (Ff cos δ + Fr)/m − r vx          z2 = r
    ṙ  = (a Ff cos δ − b Fr)/I             z3 = (Ff cos δ + Fr)/m
"""

from typing import NamedTuple

import numpy as np
from pydantic import Field, FiniteFloat

from fleet_slip.arrays import FloatArray
from fleet_slip.compiling import kernel
from fleet_slip.config import Config
from fleet_slip.observers import yaw_rate
from fleet_slip.observers.angle import sideslip_angle
from fleet_slip.observers.signals import STEP_S, DriveSignals, hold_last
from fleet_slip.observers.single_track import (
    SLOWEST_MPS,
    SingleTrack,
    measured_speed_mps,
    measured_steer_rad,
)
from fleet_slip.observers.yaw_rate import YawRateNoise
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
    stiffness_factor: FiniteFloat = Field(default=1.0, ge=0.5, le=1.5)
    """Cornering stiffness over that at rest: load transfer in corners softens an axle."""
    yaw_rate: YawRateNoise = YawRateNoise()


TUNABLE = (
    "lateral_model_std_mps2",
    "yaw_model_std_rad_s2",
    "wheel_speed_std_mps",
    "yaw_rate_std_rad_s",
    "ay_std_mps2",
    "stiffness_factor",
    *yaw_rate.TUNABLE,
)
"""The parameters that `tuning.tune` should search."""


class Model(NamedTuple):
    """The single-track model and the filter's variances, for compiled code."""

    mass: float
    inertia: float
    front: float
    rear: float
    stiffness_front: float
    stiffness_rear: float
    grip_front: float
    grip_rear: float
    q_vx: float
    q_vy: float
    q_r: float
    r_vx: float
    r_r: float
    r_ay: float


class Belief(NamedTuple):
    """Mean of [vx, vy, r] and its covariance, upper triangle."""

    vx: float
    vy: float
    r: float
    p00: float
    p01: float
    p02: float
    p11: float
    p12: float
    p22: float


class LateralForce(NamedTuple):
    """Lateral force of an axle across the car, and its derivatives."""

    force: float
    per_vx: float
    per_vy: float
    per_r: float


@kernel
def lateral_force(
    x: Belief, steer: float, lever: float, stiffness: float, grip: float
) -> LateralForce:
    """Return the force of an axle at the distance `lever` before the centre of gravity.

    With slip σ = −across / along of the axle's velocity in the wheel's frame, the brush tyre of
    Fiala gives, up to the slip where all of it slides,

        F = C σ − C² |σ| σ / (3 G) + C³ σ³ / (27 G²),   dF/dσ = C (1 − C |σ| / (3 G))²

    and beyond it ±G (Pacejka, "Tire and Vehicle Dynamics" (2012), section 3.2.1).
    """
    cosine, sine = np.cos(steer), np.sin(steer)
    side = x.vy + lever * x.r
    across = cosine * side - sine * x.vx
    along = cosine * x.vx + sine * side
    rolling = max(along, SLOWEST_MPS)
    turning = 1.0 if along > SLOWEST_MPS else 0.0
    slip = -across / rolling
    use = stiffness * slip / (3.0 * grip)
    stuck = max(1.0 - abs(use), 0.0)
    force = 3.0 * grip * use * (1.0 - abs(use) + use * use / 3.0)
    if stuck == 0.0:
        force = grip if slip > 0.0 else -grip
    per_slip = stiffness * stuck * stuck / rolling
    # dσ = −(d across + σ d along) / rolling
    per_side = -per_slip * (cosine + turning * slip * sine) * cosine
    per_vx = -per_slip * (-sine + turning * slip * cosine) * cosine
    return LateralForce(cosine * force, per_vx, per_side, lever * per_side)


class Rates(NamedTuple):
    """Lateral acceleration and yaw acceleration, with their derivatives."""

    ay: float
    ay_vx: float
    ay_vy: float
    ay_r: float
    yaw: float
    yaw_vx: float
    yaw_vy: float
    yaw_r: float


@kernel
def rates(x: Belief, steer: float, m: Model) -> Rates:
    """Return (Ff cos δ + Fr)/m and (a Ff cos δ − b Fr)/I, linearised."""
    f = lateral_force(x, steer, m.front, m.stiffness_front, m.grip_front)
    r = lateral_force(x, 0.0, -m.rear, m.stiffness_rear, m.grip_rear)
    return Rates(
        (f.force + r.force) / m.mass,
        (f.per_vx + r.per_vx) / m.mass,
        (f.per_vy + r.per_vy) / m.mass,
        (f.per_r + r.per_r) / m.mass,
        (m.front * f.force - m.rear * r.force) / m.inertia,
        (m.front * f.per_vx - m.rear * r.per_vx) / m.inertia,
        (m.front * f.per_vy - m.rear * r.per_vy) / m.inertia,
        (m.front * f.per_r - m.rear * r.per_r) / m.inertia,
    )


@kernel
def predict(x: Belief, ax: float, steer: float, dt: float, m: Model) -> Belief:
    """Return the belief one step later: x ← x + Δt f(x), P ← F P Fᵀ + Q, F = I + Δt ∂f/∂x."""
    d = rates(x, steer, m)
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
        a00 * f00 + a01 * f01 + a02 * f02 + m.q_vx,
        a00 * f10 + a01 * f11 + a02 * f12,
        a00 * f20 + a01 * f21 + a02 * f22,
        a10 * f10 + a11 * f11 + a12 * f12 + m.q_vy,
        a10 * f20 + a11 * f21 + a12 * f22,
        a20 * f20 + a21 * f21 + a22 * f22 + m.q_r,
    )


@kernel
def condition(
    x: Belief, h0: float, h1: float, h2: float, innovation: float, variance: float
) -> Belief:
    """Return the belief given one measurement with the row H = [h0, h1, h2], in Joseph form.

    K = P Hᵀ / (H P Hᵀ + R). With u = P Hᵀ, Joseph's (I − K H) P (I − K H)ᵀ + K R Kᵀ is
    P − K uᵀ + (K R − (u − K H u)) Kᵀ, whose last term is zero but for rounding.
    """
    u0 = x.p00 * h0 + x.p01 * h1 + x.p02 * h2
    u1 = x.p01 * h0 + x.p11 * h1 + x.p12 * h2
    u2 = x.p02 * h0 + x.p12 * h1 + x.p22 * h2
    known = h0 * u0 + h1 * u1 + h2 * u2
    k0, k1, k2 = u0 / (known + variance), u1 / (known + variance), u2 / (known + variance)
    e0 = k0 * variance - (u0 - k0 * known)
    e1 = k1 * variance - (u1 - k1 * known)
    e2 = k2 * variance - (u2 - k2 * known)
    return Belief(
        x.vx + k0 * innovation,
        x.vy + k1 * innovation,
        x.r + k2 * innovation,
        x.p00 - k0 * u0 + e0 * k0,
        x.p01 - k0 * u1 + e0 * k1,
        x.p02 - k0 * u2 + e0 * k2,
        x.p11 - k1 * u1 + e1 * k1,
        x.p12 - k1 * u2 + e1 * k2,
        x.p22 - k2 * u2 + e2 * k2,
    )


@kernel
def update(x: Belief, vx: float, yaw_rate: float, ay: float, steer: float, m: Model) -> Belief:
    """Return the belief given wheel speed, yaw rate and lateral acceleration, one after the other.

    Their noises are independent, so that the order does not matter but for the linearisation.
    """
    x = condition(x, 1.0, 0.0, 0.0, vx - x.vx, m.r_vx)
    x = condition(x, 0.0, 0.0, 1.0, yaw_rate - x.r, m.r_r)
    d = rates(x, steer, m)
    return condition(x, d.ay_vx, d.ay_vy, d.ay_r, ay - d.ay, m.r_ay)


@kernel
def _filter(
    ax: FloatArray,
    ay: FloatArray,
    yaw_rate: FloatArray,
    vx: FloatArray,
    steer: FloatArray,
    x: Belief,
    m: Model,
) -> FloatArray:
    means = np.empty((2, len(ax)))
    for k in range(len(ax)):
        if k > 0:
            x = predict(x, ax[k], steer[k], STEP_S, m)
        x = update(x, vx[k], yaw_rate[k], ay[k], steer[k], m)
        means[0, k] = x.vx
        means[1, k] = x.vy
    return means


def build_model(track: SingleTrack, noise: EkfNoise) -> Model:
    """Return the model with the variances per step."""
    return Model(
        track.mass_kg,
        track.yaw_inertia_kgm2,
        track.front_m,
        track.rear_m,
        track.stiffness_front_n,
        track.stiffness_rear_n,
        track.grip_front_n,
        track.grip_rear_n,
        q_vx=(noise.ax_std_mps2 * STEP_S) ** 2,
        q_vy=(noise.lateral_model_std_mps2 * STEP_S) ** 2,
        q_r=(noise.yaw_model_std_rad_s2 * STEP_S) ** 2,
        r_vx=noise.wheel_speed_std_mps**2,
        r_r=noise.yaw_rate_std_rad_s**2,
        r_ay=noise.ay_std_mps2**2,
    )


def estimate(drive: DriveSignals, car: VehicleParameters, noise: EkfNoise) -> FloatArray:
    """Estimate side-slip in rad at every row. Gaps of a sensor are bridged by the value before.

    Raises `DataError` if a sensor is absent.
    """
    turning = yaw_rate.estimate(drive, car, noise.yaw_rate).yaw_rate_rad_s
    vx_mps = measured_speed_mps(drive, car)
    p0, p1, p2 = (std**2 for std in INITIAL_STD)
    means = _filter(
        hold_last(drive.ax_mps2, "ax"),
        hold_last(drive.ay_mps2, "ay"),
        turning,
        vx_mps,
        measured_steer_rad(drive),
        Belief(vx_mps[0], 0.0, turning[0], p0, 0.0, 0.0, p1, 0.0, p2),
        build_model(SingleTrack.of(car, noise.stiffness_factor), noise),
    )
    return sideslip_angle(means[0], means[1])
