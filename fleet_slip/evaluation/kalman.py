"""The paper's Kalman filter (Section IV), the filter of its yaw rate, and what filters share.

Updates change a state in place: a filter takes millions of steps and allocates nothing in them.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from pydantic import Field, FiniteFloat

from fleet_slip.arrays import FloatArray
from fleet_slip.compiling import equation, kernel
from fleet_slip.config import Config
from fleet_slip.evaluation.evaluated_drives import STEP_S, DriveSignals, hold_last
from fleet_slip.evaluation.evaluator import MissingSignalError
from fleet_slip.vehicle.parameters import VehicleParameters

# Dead reckoning by wheel speeds: Carlson, Gerdes and Powell, "Error sources when land vehicle dead
# reckoning with differential wheelspeeds", Navigation 51 (2004): the axle without drive torque
# rolls with the least slip.


@dataclass(frozen=True)
class AxleSpeeds:
    """Rolling velocities of the wheels of an axle over cos δ, and their distance."""

    left_mps: FloatArray
    right_mps: FloatArray
    track_m: FloatArray | float
    turned_m: FloatArray | float = 0.0
    """Mean of tan δ times the axle's distance before the centre of gravity."""

    @property
    def is_one_speed(self) -> bool:
        """True if one speed of the car replaces both wheel speeds, which never differ."""
        return np.array_equal(self.left_mps, self.right_mps, equal_nan=True)

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
    taken off their mean. tan δ vy, a thousandth of vx, is neglected. A single speed of the car is
    no speed of front wheels: the angle of the road wheels does not change it.
    """
    radius, front = car.tyre.rolling_radius_m, car.body.front_axle_m
    if car.drivetrain.front_drive_share >= 0.5:
        return AxleSpeeds(
            radius * drive.wheel_rl_rad_s, radius * drive.wheel_rr_rad_s, car.body.track_rear_m
        )
    straight = AxleSpeeds(
        radius * drive.wheel_fl_rad_s, radius * drive.wheel_fr_rad_s, car.body.track_front_m
    )
    if straight.is_one_speed:
        return straight
    tan_left, tan_right = np.tan(drive.steer_fl_rad), np.tan(drive.steer_fr_rad)
    return AxleSpeeds(
        radius * drive.wheel_fl_rad_s / np.cos(drive.steer_fl_rad),
        radius * drive.wheel_fr_rad_s / np.cos(drive.steer_fr_rad),
        car.body.track_front_m + front * (tan_right - tan_left),
        front * (tan_left + tan_right) / 2,
    )


SLOWEST_ANGLE_MPS = 1.0
"""Longitudinal velocity that replaces a smaller one in the angle."""


def sideslip_angle(vx_mps: FloatArray, vy_mps: FloatArray) -> FloatArray:
    """Return β = arctan(vy / vx) in rad, equations (12) and (13).

    At rest the quotient has no limit and noise would turn the angle by up to π. Below
    `SLOWEST_MPS`, and in reverse, vx is therefore replaced by `SLOWEST_MPS`: β stays continuous and
    goes to zero with vy. NaN stays NaN.
    """
    return np.arctan2(vy_mps, np.maximum(vx_mps, SLOWEST_ANGLE_MPS))


def measured_speed_mps(drive: DriveSignals, car: VehicleParameters) -> FloatArray:
    """Return the longitudinal velocity from wheel speeds. Raises `MissingSignalError`."""
    return hold_last(undriven_axle(drive, car).vx_mps, "wheel speeds")


def measured_steer_rad(drive: DriveSignals) -> FloatArray:
    """Return the mean angle of the front wheels that are logged.

    Raises `MissingSignalError` without any.
    """
    wheels = (drive.steer_fl_rad, drive.steer_fr_rad)
    logged = [angle_rad for angle_rad in wheels if np.isfinite(angle_rad).any()]
    mean: FloatArray = np.mean(logged or wheels[:1], axis=0)
    return hold_last(mean, "steer_fl and steer_fr")


@kernel
def follow(values: FloatArray, gain: float) -> FloatArray:
    """Filter values with a lag, x ← x + gain (value − x), from the first value on."""
    lagged = np.empty(len(values))
    x = values[0]
    for k in range(len(values)):
        x += gain * (values[k] - x)
        lagged[k] = x
    return lagged


# Updates of a Gaussian state.

Row = tuple[Any, ...]
"""A row of a matrix, of a length that the compiler sees: it unrolls the loops over it."""


class GaussianState(NamedTuple):
    """Mean x, shape (n,), covariance P, shape (n, n), and a buffer for F P."""

    mean: FloatArray
    covariance: FloatArray
    buffer: FloatArray


@equation
def independent_state(mean: Row, variances: Row) -> GaussianState:
    """Return a state of independent components."""
    n = len(mean)
    state = GaussianState(np.empty(n), np.zeros((n, n)), np.empty((n, n)))
    for i in range(n):
        state.mean[i] = mean[i]
        state.covariance[i, i] = variances[i]
    return state


@equation
def predict_covariance(state: GaussianState, f: tuple[Row, ...], q: Row) -> None:
    """Update the covariance by one time step, P ← F P Fᵀ + diag(q)."""
    p, fp = state.covariance, state.buffer
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
def measurement_update(state: GaussianState, h: Row, innovation: float, variance: float) -> float:
    """Update by one measurement with the row H, in Joseph's form; return the innovation's variance.

        K = P Hᵀ / (H P Hᵀ + R)
        x ← x + K (z − H x)
        P ← (I − K H) P (I − K H)ᵀ + K R Kᵀ

    With u = P Hᵀ, P becomes P − K uᵀ + (K R − (u − K H u)) Kᵀ, whose last term is zero but for
    rounding. P (I − K H) alone would lose symmetry and definiteness to it. Measurements with
    independent noises may come one after the other.
    """
    x, p, u = state.mean, state.covariance, state.buffer[0]
    n = len(h)
    predicted = 0.0
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += p[i, j] * h[j]
        u[i] = total
        predicted += h[i] * total
    for i in range(n):
        gain = u[i] / (predicted + variance)
        residual = gain * variance - (u[i] - gain * predicted)
        x[i] += gain * innovation
        for j in range(i, n):
            p[i, j] = p[i, j] - gain * u[j] + residual * (u[j] / (predicted + variance))
            p[j, i] = p[i, j]
    return predicted + variance


# Yaw rate, which the paper's filter takes as given.
#
# The state is x = [r, b]: yaw rate and bias of the gyroscope, which Bevly, Ryu and Gerdes estimate
# against an absolute reference ("Integrating INS sensors with GPS measurements for continuous
# estimation of vehicle sideslip, roll, and tire cornering stiffness", IEEE Transactions on
# Intelligent Transportation Systems 7, 2006). The reference here is the difference of wheel speeds
# (`AxleSpeeds`): a log may lack the GPS heading, and no tunnel interrupts the wheels.
#
#     r(k) = r(k−1) + Δt w_r        gyroscope   z_g = r + b + w_g
#     b(k) = b(k−1)                 wheels      z_w = r + w_w
#
# Wheels that brake in a corner slip more on the unloaded side: rows of braking have no z_w.

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


YAW_RATE_TUNABLE = (
    "yaw_rate.gyro_std_rad_s",
    "yaw_rate.wheel_yaw_rate_std_rad_s",
    "yaw_rate.yaw_acceleration_std_rad_s2",
)
"""Parameters to tune of a filter's `yaw_rate: YawRateNoise`."""


@kernel
def _filter_yaw_rate(
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


def estimate_yaw_rate(
    drive: DriveSignals, car: VehicleParameters, noise: YawRateNoise
) -> FloatArray:
    """Estimate yaw rate and bias of the gyroscope in rad/s at every row, shape (2, rows).

    Gaps are bridged. Where one speed replaces both wheel speeds, only standstill is a measurement.
    """
    axle = undriven_axle(drive, car)
    rolling = drive.ax_mps2 > BRAKING_MPS2
    if axle.is_one_speed:
        rolling &= axle.left_mps == 0
    return _filter_yaw_rate(
        drive.yaw_rate_rad_s,
        np.where(rolling, axle.yaw_rate_rad_s, np.nan),
        noise.gyro_bias_std_rad_s**2,
        noise.gyro_std_rad_s**2,
        noise.wheel_yaw_rate_std_rad_s**2,
        (STEP_S * noise.yaw_acceleration_std_rad_s2) ** 2,
    )


# Fusion of the GPS velocity with the accelerometers.
#
# The state is x = [u_x, b_x, u_y, b_y]: velocity of the centre of gravity in the car's frame, and
# the biases a_x,bias and a_y,bias of the accelerometers. The paper's (6b) prints the term ψ̇ u_x Δt
# with a plus. It follows from (5b) with a minus, as do the mechanics, and has a minus here.


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
    *YAW_RATE_TUNABLE,
)
"""The parameters of Q, R and the first P to search."""

STARTS = (FilterNoise(),)
"""Default parameters, with which a search begins."""


def variances(noise: FilterNoise) -> tuple[Row, Row, Row]:
    """Return the diagonals of P at the first fix, of Q = B1 W B1ᵀ, and of R.

    B1 multiplies the noise of the accelerometers by Δt.
    """
    bias, q_bias = noise.bias_std_mps2**2, noise.bias_walk_mps2_per_sqrt_s**2 * STEP_S
    q_ux, q_uy = (noise.ax_std_mps2 * STEP_S) ** 2, (noise.ay_std_mps2 * STEP_S) ** 2
    r_ux, r_uy = noise.gps_vx_std_mps**2, noise.gps_vy_std_mps**2
    return (r_ux, bias, r_uy, bias), (q_ux, q_bias, q_uy, q_bias), (r_ux, r_uy)


@kernel
def predict(x: GaussianState, ax: float, ay: float, yaw_rate: float, dt: float, q: Row) -> None:
    """Time update, equations (6), (7) and (9); `q` is the diagonal of Q.

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
    predict_covariance(x, f, q)


@kernel
def update(x: GaussianState, gps_vx: float, gps_vy: float, r: Row) -> None:
    """Measurement update by the two velocities of a fix, equations (10) and (11)."""
    measurement_update(x, (1.0, 0.0, 0.0, 0.0), gps_vx - x.mean[0], r[0])
    measurement_update(x, (0.0, 0.0, 1.0, 0.0), gps_vy - x.mean[2], r[1])


@kernel
def _filter(
    ax: FloatArray,
    ay: FloatArray,
    yaw_rate: FloatArray,
    gps_vx: FloatArray,
    gps_vy: FloatArray,
    first_fix: int,
    first_variances: Row,
    q: Row,
    r: Row,
) -> FloatArray:
    means = np.full((4, len(ax)), np.nan)
    state = independent_state((gps_vx[first_fix], 0.0, gps_vy[first_fix], 0.0), first_variances)
    for k in range(first_fix, len(ax)):
        if k > first_fix:
            predict(state, ax[k], ay[k], yaw_rate[k], STEP_S, q)
            if not np.isnan(gps_vx[k] + gps_vy[k]):
                update(state, gps_vx[k], gps_vy[k], r)
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
        *variances(noise),
    )


def estimate(drive: DriveSignals, car: VehicleParameters, noise: FilterNoise) -> FloatArray:
    """Estimate side-slip in rad at every row, NaN before the first fix. Raises as `fuse`.

    Only the geometry of the car matters, which turns wheel speeds into a yaw rate. The filter is
    compiled and releases the interpreter's lock: many drives run on threads, as in
    `executor.map(partial(estimate, car=car, noise=noise), drives)`.
    """
    yaw_rate_rad_s, _ = estimate_yaw_rate(drive, car, noise.yaw_rate)
    vx_mps, _, vy_mps, _ = fuse(drive, yaw_rate_rad_s, noise)
    return sideslip_angle(vx_mps, vy_mps)
