"""An extended Kalman filter on the nonlinear single-track model, without GPS.

After Best, Gordon and Dixon, "An extended adaptive Kalman filter for real-time state estimation of
vehicle handling dynamics", Vehicle System Dynamics 34 (2000); instead of adapting the tyres it
follows the wheels' loads (`loaded_axles`). The state is x = [vx, vy, r, b], with b the bias of the
lateral accelerometer; ax and the steering angle δ drive it, and wheel speed, yaw rate and ay
correct it. With the lateral forces F of the axles:

    v̇x = ax + r vy                         z1 = vx
    v̇y = (Ff cos δ + Fr)/m − r vx          z2 = r
    ṙ  = (a Ff cos δ − b Fr)/I             z3 = (Ff cos δ + Fr)/m + b
    ḃ  = 0

The bias of the gyroscope is a state of the filter before it, `estimate_yaw_rate`. A drive may begin
in a bend: at first the rear wheels roll without slip, vy = b r. From vy = 0 the rear tyres would
slide there, where their force has no slope that leads back.
"""

from dataclasses import replace
from typing import NamedTuple, cast

import numpy as np
from pydantic import Field, FiniteFloat

from fleet_slip.arrays import FloatArray
from fleet_slip.compiling import kernel
from fleet_slip.config import Config
from fleet_slip.evaluation.evaluated_drives import STEP_S, DriveSignals, hold_last
from fleet_slip.evaluation.kalman import (
    YAW_RATE_TUNABLE,
    GaussianState,
    Row,
    YawRateNoise,
    estimate_yaw_rate,
    follow,
    independent_state,
    measured_speed_mps,
    measured_steer_rad,
    measurement_update,
    predict_covariance,
    sideslip_angle,
)
from fleet_slip.vehicle.dynamics import cornering_stiffness
from fleet_slip.vehicle.parameters import Constants, VehicleParameters, constants

# The single-track model, with the forces of its axles.
#
# The lateral forces follow the loads of the moment: bends load the outer wheels and braking the
# front ones. Two wheels with different loads hold less than two with their mean, because a tyre's
# stiffness and grip grow less than its load (Pacejka, "Tire and Vehicle Dynamics" (2012), sections
# 1.2.3 and 4.E25).

SLOWEST_MPS = 5.0
"""Speed below which slip is measured against this speed; the poles stay within 100/s."""

LEAST_LOAD = 0.05
"""Smallest load of a wheel over its load at rest, so that noise lifts no wheel."""


class Axles(NamedTuple):
    """Cornering stiffness and grip of both tyres of each axle together."""

    stiffness_front_n: float
    """Cornering stiffness per unit of slip."""
    stiffness_rear_n: float
    grip_front_n: float
    """Largest lateral force."""
    grip_rear_n: float


def loaded_axles(
    car: VehicleParameters, ax_mps2: FloatArray, ay_mps2: FloatArray, adhesion: float
) -> FloatArray:
    """Return the `Axles` of a car under accelerations of shape (rows,), as measured.

    The shape is (4, rows): a row for each of their fields. The body leans with the lag of its
    suspension, which takes the accelerations' noise away.
    """
    c = constants(car, adhesion)
    pitch = c.pitch_transfer * follow(ax_mps2, c.inverse_pitch_lag * STEP_S)
    leaning = follow(ay_mps2, c.inverse_roll_lag * STEP_S)

    def axle(mean: FloatArray, roll: FloatArray, peak: float) -> tuple[FloatArray, FloatArray]:
        loads = np.maximum(np.stack([mean - roll, mean + roll]), LEAST_LOAD * c.static_rear)
        stiffness = cast(FloatArray, cornering_stiffness(cast(float, loads), peak, c))
        grip = (c.friction - c.friction_per_load * loads) * loads
        return stiffness.sum(axis=0), grip.sum(axis=0)

    front = axle(c.static_front - pitch, c.roll_transfer_front * leaning, c.stiffness_front)
    rear = axle(c.static_rear + pitch, c.roll_transfer_rear * leaning, c.stiffness_rear)
    return np.stack([front[0], rear[0], front[1], rear[1]])


class LateralForce(NamedTuple):
    """Lateral force of an axle across the car, and its derivatives."""

    force: float
    per_vx: float
    per_vy: float
    per_r: float


@kernel
def lateral_force(
    vx: float, vy: float, r: float, steer: float, lever: float, stiffness: float, grip: float
) -> LateralForce:
    """Return the force of an axle at the distance `lever` before the centre of gravity.

    With slip σ = −across / along of the axle's velocity in the wheel's frame, the brush tyre of
    Fiala gives, up to the slip where all of it slides,

        F = C σ − C² |σ| σ / (3 G) + C³ σ³ / (27 G²),   dF/dσ = C (1 − C |σ| / (3 G))²

    and beyond it ±G (Pacejka, "Tire and Vehicle Dynamics" (2012), section 3.2.1).
    """
    cosine, sine = np.cos(steer), np.sin(steer)
    side = vy + lever * r
    across = cosine * side - sine * vx
    along = cosine * vx + sine * side
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
def rates(vx: float, vy: float, r: float, steer: float, axles: Axles, c: Constants) -> Rates:
    """Return (Ff cos δ + Fr)/m and (a Ff cos δ − b Fr)/I, linearised."""
    f = lateral_force(vx, vy, r, steer, c.front, axles.stiffness_front_n, axles.grip_front_n)
    b = lateral_force(vx, vy, r, 0.0, -c.rear, axles.stiffness_rear_n, axles.grip_rear_n)
    return Rates(
        (f.force + b.force) / c.mass,
        (f.per_vx + b.per_vx) / c.mass,
        (f.per_vy + b.per_vy) / c.mass,
        (f.per_r + b.per_r) / c.mass,
        (c.front * f.force - c.rear * b.force) / c.yaw_inertia,
        (c.front * f.per_vx - c.rear * b.per_vx) / c.yaw_inertia,
        (c.front * f.per_vy - c.rear * b.per_vy) / c.yaw_inertia,
        (c.front * f.per_r - c.rear * b.per_r) / c.yaw_inertia,
    )


# The filter.

INITIAL_STD = (1.0, 1.0, 0.1)
"""Standard deviations of vx, vy (m/s) and r (rad/s) at the first row."""


class SensorErrors(Config):
    """Gain and offset errors of a car's steering and lateral acceleration."""

    steer_gain: FiniteFloat = Field(default=1.0, ge=0.5, le=2)
    """Gain of the road wheels' angle, often logged as the steering wheel's over a ratio."""
    steer_offset_rad: FiniteFloat = Field(default=0.0, ge=-0.2, le=0.2)
    """Angle of the road wheels when the car drives straight."""
    ay_gain: FiniteFloat = Field(default=1.0, ge=0.7, le=1.5)
    """In a bend the body rolls, which adds g times an angle that grows with the acceleration."""
    ay_offset_mps2: FiniteFloat = Field(default=0.0, ge=-2, le=2)

    def corrected(self, drive: DriveSignals, car: VehicleParameters) -> DriveSignals:
        """Correct the signals of a drive; derive missing road wheels from the steering wheel."""
        steer_fl, steer_fr = drive.steer_fl_rad, drive.steer_fr_rad
        if not drive.has_road_wheels:
            steer_fl = steer_fr = drive.steering_wheel_rad / car.steering.ratio
        return replace(
            drive,
            steer_fl_rad=(steer_fl - self.steer_offset_rad) / self.steer_gain,
            steer_fr_rad=(steer_fr - self.steer_offset_rad) / self.steer_gain,
            ay_mps2=(drive.ay_mps2 - self.ay_offset_mps2) / self.ay_gain,
        )


class EkfNoise(Config):
    """Standard deviations: the paper's initial noise, and judgement for errors of the model."""

    ax_std_mps2: FiniteFloat = Field(default=0.1, ge=0)
    lateral_model_std_mps2: FiniteFloat = Field(default=0.3, ge=0)
    yaw_model_std_rad_s2: FiniteFloat = Field(default=0.3, ge=0)
    wheel_speed_std_mps: FiniteFloat = Field(default=0.005, gt=0)
    yaw_rate_std_rad_s: FiniteFloat = Field(default=0.01, gt=0)
    ay_std_mps2: FiniteFloat = Field(default=0.1, gt=0)
    ay_bias_std_mps2: FiniteFloat = Field(default=0.15, ge=0)
    """Accelerometer's bias before the drive; 0 removes it from the state."""
    stiffness_front_factor: FiniteFloat = Field(default=1.0, ge=0.5, le=1.5)
    """Cornering stiffness of the front axle over that of the car's parameters."""
    stiffness_rear_factor: FiniteFloat = Field(default=1.0, ge=0.5, le=1.5)
    adhesion: FiniteFloat = Field(default=1.0, gt=0)
    """Adhesion of the road, as the filter assumes it."""
    yaw_rate: YawRateNoise = YawRateNoise()
    sensors: SensorErrors = SensorErrors()


TUNABLE = (
    "lateral_model_std_mps2",
    "yaw_model_std_rad_s2",
    "wheel_speed_std_mps",
    "yaw_rate_std_rad_s",
    "ay_std_mps2",
    "ay_bias_std_mps2",
    "stiffness_front_factor",
    "stiffness_rear_factor",
    *YAW_RATE_TUNABLE,
)
"""The parameters to search."""


STARTS = (
    EkfNoise(),
    EkfNoise(lateral_model_std_mps2=2.0, yaw_model_std_rad_s2=2.0, ay_bias_std_mps2=0.01),
)
"""Parameters with which a search begins: the default, and no bias and large errors of the model, as
suits cars that differ from their class."""


@kernel
def predict(
    x: GaussianState, ax: float, steer: float, dt: float, axles: Axles, c: Constants, q: Row
) -> None:
    """Time update: x ← x + Δt f(x), P ← F P Fᵀ + Q, F = I + Δt ∂f/∂x; `q` is Q's diagonal."""
    vx, vy, r, _ = x.mean
    d = rates(vx, vy, r, steer, axles, c)
    x.mean[0] = vx + dt * (ax + r * vy)
    x.mean[1] = vy + dt * (d.ay - r * vx)
    x.mean[2] = r + dt * d.yaw
    f = (
        (1.0, dt * r, dt * vy, 0.0),
        (dt * (d.ay_vx - r), 1.0 + dt * d.ay_vy, dt * (d.ay_r - vx), 0.0),
        (dt * d.yaw_vx, dt * d.yaw_vy, 1.0 + dt * d.yaw_r, 0.0),
        (0.0, 0.0, 0.0, 1.0),
    )
    predict_covariance(x, f, q)


@kernel
def update(
    x: GaussianState,
    vx: float,
    yaw_rate: float,
    ay: float,
    steer: float,
    axles: Axles,
    c: Constants,
    variances: Row,
) -> None:
    """Measurement update by wheel speed, yaw rate and lateral acceleration."""
    measurement_update(x, (1.0, 0.0, 0.0, 0.0), vx - x.mean[0], variances[0])
    measurement_update(x, (0.0, 0.0, 1.0, 0.0), yaw_rate - x.mean[2], variances[1])
    d = rates(x.mean[0], x.mean[1], x.mean[2], steer, axles, c)
    measurement_update(x, (d.ay_vx, d.ay_vy, d.ay_r, 1.0), ay - d.ay - x.mean[3], variances[2])


class Inputs(NamedTuple):
    """Inputs of the filter: measurements by row, `Axles` by row, initial state, car and noise."""

    ax_mps2: FloatArray
    ay_mps2: FloatArray
    yaw_rate_rad_s: FloatArray
    vx_mps: FloatArray
    steer_rad: FloatArray
    axles: FloatArray
    first_mean: Row
    first_variances: Row
    q: Row
    """Diagonal of Q."""
    variances: Row
    """Variances of wheel speed, yaw rate and lateral acceleration."""
    constants: Constants


@kernel
def _filter(u: Inputs) -> FloatArray:
    velocities = np.empty((2, len(u.ax_mps2)))
    x = independent_state(u.first_mean, u.first_variances)
    for k in range(len(u.ax_mps2)):
        loaded, steer = u.axles[:, k], u.steer_rad[k]
        axles = Axles(loaded[0], loaded[1], loaded[2], loaded[3])
        if k > 0:
            predict(x, u.ax_mps2[k], steer, STEP_S, axles, u.constants, u.q)
        measured = u.vx_mps[k], u.yaw_rate_rad_s[k], u.ay_mps2[k]
        update(x, *measured, steer, axles, u.constants, u.variances)
        velocities[:, k] = x.mean[:2]
    return velocities


def variances(noise: EkfNoise) -> tuple[Row, Row]:
    """Return the diagonal of Q, and the variances of wheel speed, yaw rate and ay."""
    model = noise.ax_std_mps2, noise.lateral_model_std_mps2, noise.yaw_model_std_rad_s2
    measured = noise.wheel_speed_std_mps, noise.yaw_rate_std_rad_s, noise.ay_std_mps2
    return (*((std * STEP_S) ** 2 for std in model), 0.0), (*(std**2 for std in measured),)


def axles_of(
    car: VehicleParameters, ax_mps2: FloatArray, ay_mps2: FloatArray, noise: EkfNoise
) -> FloatArray:
    """Return `loaded_axles` with the stiffness factors of the parameters."""
    axles = loaded_axles(car, ax_mps2, ay_mps2, noise.adhesion)
    axles[0] *= noise.stiffness_front_factor
    axles[1] *= noise.stiffness_rear_factor
    return axles


def estimate(drive: DriveSignals, car: VehicleParameters, noise: EkfNoise) -> FloatArray:
    """Estimate side-slip in rad by row. Raises `MissingSignalError`."""
    vx_mps, vy_mps = _filter(inputs_of(drive, car, noise))
    return sideslip_angle(vx_mps, vy_mps)


def inputs_of(drive: DriveSignals, car: VehicleParameters, noise: EkfNoise) -> Inputs:
    """Return the inputs of the filter for a drive, gaps bridged. Raises `MissingSignalError`."""
    drive = noise.sensors.corrected(drive, car)
    yaw_rate_rad_s, _ = estimate_yaw_rate(drive, car, noise.yaw_rate)
    vx_mps = measured_speed_mps(drive, car)
    ax_mps2, ay_mps2 = hold_last(drive.ax_mps2, "ax"), hold_last(drive.ay_mps2, "ay")
    return Inputs(
        ax_mps2,
        ay_mps2,
        yaw_rate_rad_s,
        vx_mps,
        measured_steer_rad(drive),
        axles_of(car, ax_mps2, ay_mps2, noise),
        # vy: the rear wheels roll without slip
        (vx_mps[0], car.body.rear_axle_m * yaw_rate_rad_s[0], yaw_rate_rad_s[0], 0.0),
        (*(std**2 for std in INITIAL_STD), noise.ay_bias_std_mps2**2),
        *variances(noise),
        constants(car, noise.adhesion),
    )
