"""What a car's sensors report: bias, white noise and lost GPS fixes, then integer counts."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, FiniteFloat, field_validator

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.catalogue.signals import SAMPLE_TIME_S, Signal, catalogue
from fleet_slip.compiling import kernel
from fleet_slip.config import Config
from fleet_slip.simulation.sensing.distortion import Distortion

SAMPLE_RATE_HZ = int(1 / SAMPLE_TIME_S)
GPS_SIGNALS = {"gps_vx": "vx_mps", "gps_vy": "vy_mps"}
"""The signals that are null between fixes, each with the true column that it measures."""

Scalar = TypeVar("Scalar", bound=np.generic)

EXACT = (0.0, 0.0)
"""Bias and standard deviation of a signal that is not measured but known."""


class Gps(Config):
    """Satellite navigation: velocity at its own rate, and stretches without a fix.

    Outages, and the times between them, are exponentially distributed.
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

    `gps_fix`: where GPS is valid; `saturated`: values clipped to the signal's valid range.
    """

    counts: dict[str, NDArray[np.int16]]
    gps_fix: BoolArray
    saturated: int


class Recorder:
    """What the sensors of one car report of one drive, recorded block by block.

    For every block white noise is drawn by signal, then GPS outages, then GPS noise: counts depend
    on the cut. Signals without an entry in `Sensors.bias_and_std` are exact.
    """

    def __init__(
        self, sensors: Sensors, generator: np.random.Generator, distortion: Distortion | None = None
    ) -> None:
        self._distortion = distortion
        self._sensors = sensors
        self._generator = generator
        self._outages = Outages(sensors.gps, generator)
        self._ticks = 0
        self._counts: dict[str, list[NDArray[np.int16]]] = {}
        self._gps_fix: list[BoolArray] = []
        self._saturated = 0
        self._held = {} if distortion is None else distortion.held_ticks

    def record(self, truth: Mapping[str, FloatArray]) -> None:
        """Measure the next block, float64 by SI column but GPS; a missing one is not measured."""
        ticks = len(next(iter(truth.values())))
        if self._distortion is not None:
            truth = self._distortion.apply(truth)
        noise = np.zeros(ticks, dtype=np.float32)
        errors = self._sensors.bias_and_std
        for name, signal in catalogue().signals.items():
            if name in GPS_SIGNALS or signal.column not in truth:
                continue
            if name in errors:
                self._generator.standard_normal(out=noise, dtype=np.float32)
            self._add(name, truth[signal.column], noise, errors.get(name, EXACT))
        self._record_gps(truth, ticks)
        self._ticks += ticks

    def _record_gps(self, truth: Mapping[str, FloatArray], ticks: int) -> None:
        fix = self._outages.fixes(self._ticks, ticks)
        self._gps_fix.append(fix)
        for name, column in GPS_SIGNALS.items():
            if name not in catalogue().signals:
                continue
            seen = truth.get(catalogue()[name].column)
            fixed = (truth[column] if seen is None else seen)[fix]
            noise = self._generator.standard_normal(len(fixed), dtype=np.float32)
            self._add(name, fixed, noise, (0.0, self._sensors.gps.velocity_std_mps))
            counts = np.zeros(ticks, dtype=np.int16)
            counts[fix] = self._counts[name].pop()
            self._counts[name].append(counts)

    def _add(
        self,
        name: str,
        physical: FloatArray,
        noise: NDArray[np.float32],
        bias_and_std: tuple[float, float],
    ) -> None:
        counts, clipped = noisy_counts(physical, noise, bias_and_std, catalogue()[name])
        if ticks := self._held.get(catalogue()[name].column):
            earlier = self._counts.get(name)
            counts = held(counts, ticks, self._ticks, earlier[-1][-1] if earlier else counts[0])
        self._counts.setdefault(name, []).append(counts)
        self._saturated += clipped

    def measurement(self) -> Measurement:
        """Return all blocks as one measurement, once, at the end: their memory is given back."""
        return Measurement(
            {
                name: _joined(self._counts.pop(name))
                for name in catalogue().signals
                if name in self._counts
            },
            _joined(self._gps_fix),
            self._saturated,
        )


def _joined(parts: list[NDArray[Scalar]]) -> NDArray[Scalar]:
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def held(counts: NDArray[np.int16], ticks: int, first: int, before: np.int16) -> NDArray[np.int16]:
    """Return counts as a log has them that takes a value every so many ticks from tick 0 on."""
    begun = -first % ticks
    values = np.repeat(counts[begun::ticks], ticks)
    return np.concatenate([np.full(begun, before), values])[: len(counts)]


def noisy_counts(
    physical: FloatArray,
    noise: NDArray[np.float32],
    bias_and_std: tuple[float, float],
    signal: Signal,
) -> tuple[NDArray[np.int16], int]:
    """Return `(physical + bias + std * noise) / scale`, halves to even; count clipped and NaN."""
    counts = np.empty(len(physical), dtype=np.int16)
    valid = (float(signal.min_count), float(signal.max_count))
    clipped = _quantise(physical, noise, bias_and_std, float(signal.scale), valid, counts)
    return counts, int(clipped)


@kernel
def _quantise(
    physical: FloatArray,
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


class Outages:
    """When a drive has a GPS fix: once a period, and never in an outage."""

    def __init__(self, gps: Gps, generator: np.random.Generator) -> None:
        self._gps = gps
        self._generator = generator
        self._begin_s = 0.0
        self._end_s = 0.0

    def fixes(self, first: int, ticks: int) -> BoolArray:
        """Return for so many ticks from a first one, the next ones, whether there is a fix."""
        period = SAMPLE_RATE_HZ // self._gps.rate_hz
        fix = np.zeros(ticks, dtype=np.bool_)
        fix[-first % period :: period] = True
        self._clear(fix, first)
        while self._end_s * SAMPLE_RATE_HZ < first + ticks:
            self._begin_s = self._end_s + self._generator.exponential(
                self._gps.time_between_outages_s
            )
            self._end_s = self._begin_s + self._generator.exponential(self._gps.outage_duration_s)
            self._clear(fix, first)
        return fix

    def _clear(self, fix: BoolArray, first: int) -> None:
        begin, end = (int(s * SAMPLE_RATE_HZ) - first for s in (self._begin_s, self._end_s))
        fix[max(begin, 0) : max(end, 0)] = False
