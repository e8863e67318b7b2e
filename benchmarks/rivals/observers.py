"""Observers on the linear single-track model: Luenberger's and one with a sliding mode.

The model, in x = [vy, r], with the steering angle δ and C the cornering stiffness of an axle
(Rajamani, "Vehicle Dynamics and Control" (2012), 2.3), where v = vx, at least `SLOWEST_MPS`:

    v̇y = −(Cf + Cr)/(m v) vy − ((a Cf − b Cr)/(m v) + vx) r + Cf/m δ
    ṙ  = −(a Cf − b Cr)/(I v) vy − (a² Cf + b² Cr)/(I v) r + a Cf/I δ

Luenberger's corrects by L (y − C x − D δ) with y = [r, ay]: "An introduction to observers", IEEE
Transactions on Automatic Control 16 (1971); on this model Stéphant, Charara and Meizel, "Virtual
sensor", IEEE Transactions on Industrial Electronics 51 (2004). The other corrects by K sat(ỹ / φ),
ỹ the errors of yaw rate and of vy as ay has it: Slotine, Hedrick and Misawa, "On sliding observers
for nonlinear systems", Journal of Dynamic Systems, Measurement, and Control 109 (1987).
"""

from typing import NamedTuple, Self

import numpy as np
from pydantic import Field, FiniteFloat, model_validator

from fleet_slip.arrays import FloatArray
from fleet_slip.compiling import kernel
from fleet_slip.config import Config
from fleet_slip.evaluation import belief
from fleet_slip.evaluation.belief import YawRateNoise
from fleet_slip.evaluation.single_track import (
    SLOWEST_MPS,
    STEP_S,
    DriveSignals,
    hold_last,
    measured_speed_mps,
    measured_steer_rad,
    sideslip_angle,
)
from fleet_slip.vehicle.parameters import VehicleParameters, constants
from fleet_slip.vehicle.tyre import cornering_stiffness


class StateSpace(NamedTuple):
    """ẋ = A x + B δ by row, and ay = v̇y + r vx = C x + D δ: C = [a11, a12 + vx] and D = b1."""

    a11: FloatArray
    a12: FloatArray
    a21: FloatArray
    a22: FloatArray
    b1: FloatArray
    b2: FloatArray
    vx_mps: FloatArray

    @property
    def c2(self) -> FloatArray:
        """Lateral acceleration per yaw rate."""
        return self.a12 + self.vx_mps


def state_space(car: VehicleParameters, vx_mps: FloatArray, factor: float = 1.0) -> StateSpace:
    """Return the model of a car on a dry road at each speed, its tyres stiffer by a factor."""
    c = constants(car, adhesion=1.0)
    m, inertia, a, b = c.mass, c.yaw_inertia, c.front, c.rear
    cf = 2 * factor * cornering_stiffness(c.static_front, c.stiffness_front, c)
    cr = 2 * factor * cornering_stiffness(c.static_rear, c.stiffness_rear, c)
    v = np.maximum(vx_mps, SLOWEST_MPS)
    rolling = np.clip(vx_mps, 0.0, None) / v
    return StateSpace(
        a11=-(cf + cr) / (m * v),
        a12=-(a * cf - b * cr) / (m * v) - vx_mps,
        a21=-(a * cf - b * cr) / (inertia * v),
        a22=-(a**2 * cf + b**2 * cr) / (inertia * v),
        b1=cf / m * rolling,
        b2=a * cf / inertia * rolling,
        vx_mps=vx_mps,
    )


class ObserverPoles(Config):
    """How fast the errors decay. At 100/s the observer would follow every sample's noise."""

    lateral_velocity_1ps: FiniteFloat = Field(default=5.0, gt=0, le=100)
    yaw_rate_1ps: FiniteFloat = Field(default=20.0, gt=0, le=100)
    stiffness_factor: FiniteFloat = Field(default=1.0, ge=0.5, le=1.5)
    """Cornering stiffness over that at rest: load transfer in corners softens an axle."""
    yaw_rate: YawRateNoise = YawRateNoise()


POLES_TUNABLE = ("lateral_velocity_1ps", "yaw_rate_1ps", "stiffness_factor", *belief.TUNABLE)
"""What to tune."""


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
def _luenberger(
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


def luenberger(drive: DriveSignals, car: VehicleParameters, poles: ObserverPoles) -> FloatArray:
    """Estimate side-slip in rad at every row. Raises `DataError` without a sensor."""
    vx_mps = measured_speed_mps(drive, car)
    space = state_space(car, vx_mps, poles.stiffness_factor)
    vy_mps = _luenberger(
        tuple(space),
        gains(space, poles),
        measured_steer_rad(drive),
        belief.estimate(drive, car, poles.yaw_rate).yaw_rate_rad_s,
        hold_last(drive.ay_mps2, "ay"),
        car.body.rear_axle_m,
    )
    return sideslip_angle(vx_mps, vy_mps)


class SlidingGains(Config):
    """Gains K and boundary layers φ.

    Within the layer the observer is linear with the pole −K/φ; outside it corrects by no more than
    K, which is the disturbance that it withstands.
    """

    lateral_gain_mps2: FiniteFloat = Field(default=0.5, gt=0)
    lateral_layer_mps: FiniteFloat = Field(default=0.1, gt=0)
    yaw_gain_rad_s2: FiniteFloat = Field(default=1.0, gt=0)
    yaw_layer_rad_s: FiniteFloat = Field(default=0.05, gt=0)
    stiffness_factor: FiniteFloat = Field(default=1.0, ge=0.5, le=1.5)
    """Cornering stiffness over that at rest: load transfer in corners softens an axle."""
    yaw_rate: YawRateNoise = YawRateNoise()

    @model_validator(mode="after")
    def _one_step_does_not_overshoot(self) -> Self:
        for gain, layer in (
            (self.lateral_gain_mps2, self.lateral_layer_mps),
            (self.yaw_gain_rad_s2, self.yaw_layer_rad_s),
        ):
            if gain * STEP_S > layer:
                raise ValueError(f"a gain of {gain} crosses the layer {layer} in one step")
        return self


GAINS_TUNABLE = (
    "lateral_gain_mps2",
    "lateral_layer_mps",
    "yaw_gain_rad_s2",
    "yaw_layer_rad_s",
    "stiffness_factor",
    *belief.TUNABLE,
)
"""What to tune."""


@kernel
def saturate(value: float) -> float:
    """Return the value within ±1."""
    return min(max(value, -1.0), 1.0)


@kernel
def _sliding(
    space: tuple[FloatArray, ...],
    steer: FloatArray,
    yaw_rate: FloatArray,
    measured_vy: FloatArray,
    gains: tuple[float, float],
    layers: tuple[float, float],
    rear_m: float,
) -> FloatArray:
    """Return vy, by Euler's forward step. The space is a `StateSpace` as a plain tuple."""
    a11, a12, a21, a22, b1, b2, _ = space
    vy, r = rear_m * yaw_rate[0], yaw_rate[0]
    estimates = np.empty(len(steer))
    for k in range(len(steer)):
        slide_vy = gains[0] * saturate((measured_vy[k] - vy) / layers[0])
        slide_r = gains[1] * saturate((yaw_rate[k] - r) / layers[1])
        vy_rate = a11[k] * vy + a12[k] * r + b1[k] * steer[k] + slide_vy
        r += STEP_S * (a21[k] * vy + a22[k] * r + b2[k] * steer[k] + slide_r)
        vy += STEP_S * vy_rate
        estimates[k] = vy
    return estimates


def sliding_mode(drive: DriveSignals, car: VehicleParameters, gains: SlidingGains) -> FloatArray:
    """Estimate side-slip in rad at every row. Raises `DataError` without a sensor."""
    vx_mps = measured_speed_mps(drive, car)
    space = state_space(car, vx_mps, gains.stiffness_factor)
    steer = measured_steer_rad(drive)
    turning = belief.estimate(drive, car, gains.yaw_rate).yaw_rate_rad_s
    ay_mps2 = hold_last(drive.ay_mps2, "ay")
    vy_mps = _sliding(
        tuple(space),
        steer,
        turning,
        (ay_mps2 - space.b1 * steer - space.c2 * turning) / space.a11,
        (gains.lateral_gain_mps2, gains.yaw_gain_rad_s2),
        (gains.lateral_layer_mps, gains.yaw_layer_rad_s),
        car.body.rear_axle_m,
    )
    return sideslip_angle(vx_mps, vy_mps)
