"""A sliding-mode observer on the linear single-track model.

    x̂˙ = A x̂ + B δ + K sat(ỹ / φ),     x = [vy, r]

Slotine, Hedrick and Misawa, "On sliding observers for nonlinear systems", Journal of Dynamic
Systems, Measurement, and Control 109 (1987), with their boundary layer φ in place of the sign,
which would chatter; on this model Stéphant, Charara and Meizel, "Evaluation of a sliding mode
observer for vehicle sideslip angle", Control Engineering Practice 15 (2007). The output errors
ỹ = x_y − x̂ are those of yaw rate and lateral acceleration solved for the state, which the model
allows at any speed: r_y = r and vy_y = (ay − D δ − (a12 + vx) r) / a11.
"""

from typing import Self

import numpy as np
from pydantic import Field, FiniteFloat, model_validator

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
    measured_speed_mps,
    measured_steer_rad,
    state_space,
)
from fleet_slip.comparison.observers.yaw_rate import YawRateNoise
from fleet_slip.compiling import kernel
from fleet_slip.config import Config
from fleet_slip.vehicle.parameters import VehicleParameters


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


TUNABLE = (
    "lateral_gain_mps2",
    "lateral_layer_mps",
    "yaw_gain_rad_s2",
    "yaw_layer_rad_s",
    "stiffness_factor",
    *yaw_rate.TUNABLE,
)
"""The parameters that `tuning.tune` should search."""


@kernel
def saturate(value: float) -> float:
    """Return the value within ±1."""
    return min(max(value, -1.0), 1.0)


@kernel
def _observe(
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


def estimate(drive: DriveSignals, car: VehicleParameters, gains: SlidingGains) -> FloatArray:
    """Estimate side-slip in rad at every row, gaps bridged. Raises `DataError` without a sensor."""
    vx_mps = measured_speed_mps(drive, car)
    space = state_space(SingleTrack.of(car, gains.stiffness_factor), vx_mps)
    steer = measured_steer_rad(drive)
    turning = yaw_rate.estimate(drive, car, gains.yaw_rate).yaw_rate_rad_s
    ay_mps2 = hold_last(drive.ay_mps2, "ay")
    vy_mps = _observe(
        tuple(space),
        steer,
        turning,
        (ay_mps2 - space.b1 * steer - space.c2 * turning) / space.a11,
        (gains.lateral_gain_mps2, gains.yaw_gain_rad_s2),
        (gains.lateral_layer_mps, gains.yaw_layer_rad_s),
        car.body.rear_axle_m,
    )
    return sideslip_angle(vx_mps, vy_mps)
