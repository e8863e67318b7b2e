"""Satellite receivers of cars: course and speed over ground, at a low rate and with a delay."""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, FiniteFloat

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.catalog.course import COURSE, SATELLITE_SPEED
from fleet_slip.catalog.signals import HALF_TURN, SignalCatalog
from fleet_slip.compiling import equation, kernel
from fleet_slip.config import Config, Name
from fleet_slip.simulation.imperfections import Latency, NotNegative, Range
from fleet_slip.simulation.sensors import Delay, GaussMarkov, Gps, Measurement, Outages
from fleet_slip.vehicle.driver import SAMPLE_S
from fleet_slip.vehicle.tyre import arctan2

SATELLITE_SIGNALS = (COURSE, SATELLITE_SPEED)

Position = tuple[float, float]


class Receiver(Gps):
    """Receiver of a car. White noise applies to both components of the velocity of each fix."""

    name: Annotated[Name | None, Field(exclude=True)] = None
    """Value of the drive column `receiver`. Not part of the digest, which older campaigns have."""
    wander_std_mps: NotNegative = 0.0
    """Correlated errors of the velocity, east and north."""
    wander_s: FiniteFloat = Field(default=10.0, ge=1)
    """Correlation time of these errors."""
    delay_s: Latency = 0.0
    """Delay of a fix in the log."""
    antenna_x_m: FiniteFloat = Field(default=0.0, ge=-5, le=5)
    """Position of the antenna before the position that the mapping assumes."""
    antenna_y_m: FiniteFloat = Field(default=0.0, ge=-5, le=5)
    """Position of the antenna to the left of it."""


class Receivers(Config):
    """Receivers of a campaign's cars. Each car draws one and keeps it."""

    types: tuple[Receiver, ...] = Field(min_length=1)
    delay_error_s: Range = Range(min=0.0, max=0.0)
    """Variation between cars, added to the delay of the type."""
    antenna_error_m: Range = Range(min=0.0, max=0.0)
    """Variation between cars, along the car and across it."""

    def draw(self, generator: np.random.Generator) -> Receiver:
        """Draw the receiver of a car."""
        receiver = self.types[generator.integers(len(self.types))]
        drawn = {
            "delay_s": max(0.0, receiver.delay_s + self.delay_error_s.draw(generator)),
            "antenna_x_m": receiver.antenna_x_m + self.antenna_error_m.draw(generator),
            "antenna_y_m": receiver.antenna_y_m + self.antenna_error_m.draw(generator),
        }
        return receiver.model_copy(update=drawn)


class ReceiverLog:
    """Log of a car's receiver in one drive, recorded block by block.

    The velocity is that of the centre of gravity, as a mapping converts it. The error of the
    antenna's position remains.
    """

    def __init__(
        self, signals: SignalCatalog, receiver: Receiver, generator: np.random.Generator
    ) -> None:
        course, speed = (signals[name] for name in SATELLITE_SIGNALS)
        self._scales = float(course.scale), float(speed.scale)
        self._max_speed = speed.max_count
        self._receiver, self._generator = receiver, generator
        direction = generator.standard_normal(2)
        self._heading = np.append(direction / np.sqrt((direction**2).sum()), np.nan)
        self._delays = [Delay(receiver.delay_s) for _ in range(2)]
        self._wander = GaussMarkov(2, receiver.wander_s, generator)
        self._outages = Outages(receiver, generator)
        self._ticks = 0
        self._blocks: list[tuple[NDArray[np.int16], NDArray[np.int16], BoolArray]] = []

    def record(self, truth: dict[str, FloatArray]) -> None:
        """Record the next block of a drive, given its true signals by SI column."""
        receiver, ticks = self._receiver, len(truth["vx_mps"])
        position = receiver.antenna_x_m, receiver.antenna_y_m
        motion = truth["vx_mps"], truth["vy_mps"], truth["yaw_rate_rad_s"]
        velocity = _over_ground(*motion, position, self._heading)
        delayed = [delay.apply(v) for delay, v in zip(self._delays, velocity, strict=True)]
        correlated = receiver.wander_std_mps * self._wander.next(ticks)
        white = receiver.velocity_std_mps * self._generator.standard_normal((2, ticks))
        east, north = np.stack(delayed) + correlated + white
        fix = self._outages.fixes(self._ticks, ticks)
        fix[: max(0, int(np.ceil(receiver.delay_s / SAMPLE_S)) - self._ticks)] = False
        course, speed = _counts(east, north, fix, self._scales, self._max_speed)
        self._blocks.append((course, speed, fix))
        self._ticks += ticks

    def measurement(self) -> Measurement:
        """Return the counts of `SATELLITE_SIGNALS`, valid at ticks with a fix."""
        course, speed, fix = (np.concatenate(blocks) for blocks in zip(*self._blocks, strict=True))
        return Measurement(dict(zip(SATELLITE_SIGNALS, (course, speed), strict=True)), fix, 0)


@equation
def _turn(heading: FloatArray, rate: float) -> None:
    """Rotate a heading (cosine, sine, previous rate) by a tick, with half-angle formulas."""
    if not np.isnan(heading[2]):
        half = 0.25 * SAMPLE_S * (rate + heading[2])
        tangent = half + half * half * half / 3.0
        cosine = (1.0 - tangent * tangent) / (1.0 + tangent * tangent)
        sine = 2.0 * tangent / (1.0 + tangent * tangent)
        rotated = heading[0] * cosine - heading[1] * sine
        heading[1] = heading[1] * cosine + heading[0] * sine
        heading[0] = rotated
    heading[2] = rate


@kernel
def _over_ground(
    vx: FloatArray, vy: FloatArray, rate: FloatArray, position: Position, heading: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the velocity of a position of the car, east and north; rotate the heading."""
    east, north = np.empty(len(vx)), np.empty(len(vx))
    for i in range(len(vx)):
        _turn(heading, rate[i])
        along, across = vx[i] - rate[i] * position[1], vy[i] + rate[i] * position[0]
        east[i] = heading[0] * along - heading[1] * across
        north[i] = heading[1] * along + heading[0] * across
    return east, north


@kernel
def _counts(
    east: FloatArray, north: FloatArray, fix: BoolArray, scales: tuple[float, float], max_speed: int
) -> tuple[NDArray[np.int16], NDArray[np.int16]]:
    """Return the counts of course and speed at ticks with a fix, 0 at all others."""
    course, speed = np.zeros(len(fix), dtype=np.int16), np.zeros(len(fix), dtype=np.int16)
    for i in range(len(fix)):
        if fix[i]:
            angle = int(np.rint(arctan2(north[i], east[i]) / scales[0]))
            course[i] = -HALF_TURN if angle == HALF_TURN else angle
            size = np.sqrt(east[i] * east[i] + north[i] * north[i])
            speed[i] = min(int(np.rint(size / scales[1])), max_speed)
    return course, speed
