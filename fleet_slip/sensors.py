"""What a car's sensors report: bias, white noise and lost GPS fixes, then integer counts."""

from collections.abc import Mapping
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, FiniteFloat, field_validator

from fleet_slip.config import Config
from fleet_slip.signals import SAMPLE_TIME_S, Signal, catalogue

SAMPLE_RATE_HZ = int(1 / SAMPLE_TIME_S)
GPS_SIGNALS = {"gps_vx": "vx_mps", "gps_vy": "vy_mps"}
"""The signals that are null between fixes, each with the true column that it measures."""

EXACT = (0.0, 0.0)
"""Bias and standard deviation of a signal that is not measured but known."""


class Gps(Config):
    """Satellite navigation: velocity at its own rate, and stretches without a fix.

    Outages begin at random with a mean time from the end of one to the beginning of the next,
    and last for exponentially distributed times.
    """

    rate_hz: int = Field(gt=0)
    velocity_std_mps: FiniteFloat = Field(ge=0)
    time_between_outages_s: FiniteFloat = Field(ge=1)
    outage_duration_s: FiniteFloat = Field(gt=0)

    @field_validator("rate_hz")
    @classmethod
    def _rate_divides_sample_rate(cls, rate_hz: int) -> int:
        if SAMPLE_RATE_HZ % rate_hz:
            raise ValueError(f"{rate_hz} Hz does not divide {SAMPLE_RATE_HZ} Hz")
        return rate_hz


class Sensors(Config):
    """Bias and standard deviation of white noise of one car's sensors."""

    ax_bias_mps2: FiniteFloat
    ay_bias_mps2: FiniteFloat
    acceleration_std_mps2: FiniteFloat = Field(ge=0)
    yaw_rate_bias_rad_s: FiniteFloat
    yaw_rate_std_rad_s: FiniteFloat = Field(ge=0)
    wheel_speed_std_rad_s: FiniteFloat = Field(ge=0)
    steering_wheel_std_rad: FiniteFloat = Field(ge=0)
    steer_std_rad: FiniteFloat = Field(ge=0)
    sideslip_std_rad: FiniteFloat = Field(ge=0)
    gps: Gps

    @property
    def bias_and_std(self) -> dict[str, tuple[float, float]]:
        """Bias and standard deviation of the signals at the full rate, in their SI units."""
        wheel, steer = (0.0, self.wheel_speed_std_rad_s), (0.0, self.steer_std_rad)
        return {
            "ax": (self.ax_bias_mps2, self.acceleration_std_mps2),
            "ay": (self.ay_bias_mps2, self.acceleration_std_mps2),
            "yaw_rate": (self.yaw_rate_bias_rad_s, self.yaw_rate_std_rad_s),
            "steering_wheel": (0.0, self.steering_wheel_std_rad),
            "wheel_fl": wheel,
            "wheel_fr": wheel,
            "wheel_rl": wheel,
            "wheel_rr": wheel,
            "steer_fl": steer,
            "steer_fr": steer,
            "sideslip": (0.0, self.sideslip_std_rad),
        }


@dataclass(frozen=True)
class Measurement:
    """One drive in counts: an int16 array per signal in catalogue order, one value a tick.

    `gps_fix` is true where the GPS signals are valid. `saturated` counts the values that were
    clipped to their signal's valid range.
    """

    counts: dict[str, NDArray[np.int16]]
    gps_fix: NDArray[np.bool_]
    saturated: int


def measure(
    truth: Mapping[str, NDArray[np.float64]], sensors: Sensors, generator: np.random.Generator
) -> Measurement:
    """Measure one drive.

    `truth` holds a float64 array of one length for the SI column of every signal but GPS; a
    signal without one is not measured, as by a car that lacks the sensor. The draws come in a fixed
    order: white noise signal by signal in catalogue order, then the GPS outages, then the GPS
    noise. Signals without an entry in `Sensors.bias_and_std` are exact.
    """
    ticks = len(next(iter(truth.values())))
    noise = np.zeros(ticks, dtype=np.float32)
    errors = sensors.bias_and_std
    counts = {}
    saturated = 0
    for name, signal in catalogue().signals.items():
        if name in GPS_SIGNALS or signal.column not in truth:
            continue
        if name in errors:
            generator.standard_normal(out=noise, dtype=np.float32)
        counts[name], clipped = _noisy_counts(
            truth[signal.column], noise, errors.get(name, EXACT), signal
        )
        saturated += clipped
    gps_fix = _gps_fixes(ticks, sensors.gps, generator)
    for name, column in GPS_SIGNALS.items():
        if name not in catalogue().signals:
            continue
        fixed = truth[column][gps_fix]
        drawn = generator.standard_normal(len(fixed), dtype=np.float32)
        counts[name] = np.zeros(ticks, dtype=np.int16)
        counts[name][gps_fix], clipped = _noisy_counts(
            fixed, drawn, (0.0, sensors.gps.velocity_std_mps), catalogue()[name]
        )
        saturated += clipped
    return Measurement(
        {name: counts[name] for name in catalogue().signals if name in counts}, gps_fix, saturated
    )


def quantise(physical: NDArray[np.float64], signal: Signal) -> tuple[NDArray[np.int16], int]:
    """Return `physical / scale` as counts, and how many values were clipped to the valid range.

    Halves round to even. NaN is clipped as well, to the lower end.
    """
    return _noisy_counts(physical, np.zeros(len(physical), dtype=np.float32), EXACT, signal)


def _noisy_counts(
    physical: NDArray[np.float64],
    noise: NDArray[np.float32],
    bias_and_std: tuple[float, float],
    signal: Signal,
) -> tuple[NDArray[np.int16], int]:
    counts = np.empty(len(physical), dtype=np.int16)
    valid = (float(signal.min_count), float(signal.max_count))
    clipped = _quantise(physical, noise, bias_and_std, float(signal.scale), valid, counts)
    return counts, int(clipped)


@numba.njit(cache=True, nogil=True)
def _quantise(
    physical: NDArray[np.float64],
    noise: NDArray[np.float32],
    bias_and_std: tuple[float, float],
    scale: float,
    valid: tuple[float, float],
    counts: NDArray[np.int16],
) -> int:
    """Fill `counts` in one pass over memory and return how many were clipped."""
    bias, std = bias_and_std
    lowest, highest = valid
    clipped = 0
    for i in range(len(physical)):
        count = np.rint((physical[i] + (bias + std * noise[i])) / scale)
        within = lowest <= count <= highest
        # A comparison with NaN is false: NaN takes the lower end and never reaches the cast.
        inside = min(count, highest) if count >= lowest else lowest
        counts[i] = np.int16(inside)
        clipped += 0 if within else 1
    return clipped


def _gps_fixes(ticks: int, gps: Gps, generator: np.random.Generator) -> NDArray[np.bool_]:
    """Return for each tick whether there is a fix: one a period, none in an outage."""
    fix = np.zeros(ticks, dtype=np.bool_)
    fix[:: SAMPLE_RATE_HZ // gps.rate_hz] = True
    means_s = (gps.time_between_outages_s, gps.outage_duration_s)
    end_s = 0.0
    while end_s * SAMPLE_RATE_HZ < ticks:
        begin_s = end_s + generator.exponential(means_s[0])
        end_s = begin_s + generator.exponential(means_s[1])
        fix[int(begin_s * SAMPLE_RATE_HZ) : int(end_s * SAMPLE_RATE_HZ)] = False
    return fix
