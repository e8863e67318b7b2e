"""Satellite receivers as cars have them: course and speed over ground, now and then, and late."""

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
from fleet_slip.simulation.sensors import Delay, Gps, Measurement, Outages, Wander
from fleet_slip.vehicle.driver import SAMPLE_S
from fleet_slip.vehicle.tyre import arctan2

SATELLITE_SIGNALS = (COURSE, SATELLITE_SPEED)

Place = tuple[float, float]


class Receiver(Gps):
    """One car's receiver. White noise is of each fix and each of the velocity's two components."""

    name: Annotated[Name | None, Field(exclude=True)] = None
    """What the drive column `receiver` says. Not part of the digest, which is as it was."""
    wander_std_mps: NotNegative = 0.0
    """Of errors of velocity that last, in the directions of the earth."""
    wander_s: FiniteFloat = Field(default=10.0, ge=1)
    """Their correlation time."""
    delay_s: Latency = 0.0
    """How late a fix stands in the log."""
    antenna_x_m: FiniteFloat = Field(default=0.0, ge=-5, le=5)
    """How far before the place that the log's maker took it for the antenna is."""
    antenna_y_m: FiniteFloat = Field(default=0.0, ge=-5, le=5)
    """How far to the left of it."""


class Receivers(Config):
    """Which receivers the cars of a campaign have, each car one for good."""

    types: tuple[Receiver, ...] = Field(min_length=1)
    delay_error_s: Range = Range(min=0.0, max=0.0)
    """From car to car, besides the delay of the type."""
    antenna_error_m: Range = Range(min=0.0, max=0.0)
    """From car to car, along the car and across it."""

    def draw(self, of_car: np.random.Generator) -> Receiver:
        """Draw the receiver of a car."""
        one = self.types[of_car.integers(len(self.types))]
        drawn = {
            "delay_s": max(0.0, one.delay_s + self.delay_error_s.draw(of_car)),
            "antenna_x_m": one.antenna_x_m + self.antenna_error_m.draw(of_car),
            "antenna_y_m": one.antenna_y_m + self.antenna_error_m.draw(of_car),
        }
        return one.model_copy(update=drawn)


class ReceiverLog:
    """What the receiver of one car logs of one drive, recorded block by block.

    The velocity is the centre of gravity's, as a mapping makes it, with the antenna's error left.
    """

    def __init__(
        self, signals: SignalCatalog, receiver: Receiver, generator: np.random.Generator
    ) -> None:
        course, speed = (signals[name] for name in SATELLITE_SIGNALS)
        self._scales = float(course.scale), float(speed.scale)
        self._fastest = speed.max_count
        self._receiver, self._generator = receiver, generator
        direction = generator.standard_normal(2)
        self._heading = np.append(direction / np.sqrt((direction**2).sum()), np.nan)
        self._delays = [Delay(receiver.delay_s) for _ in range(2)]
        self._wander = Wander(2, receiver.wander_s, generator)
        self._outages = Outages(receiver, generator)
        self._ticks = 0
        self._blocks: list[tuple[NDArray[np.int16], NDArray[np.int16], BoolArray]] = []

    def record(self, truth: dict[str, FloatArray]) -> None:
        """Record the next block of a drive, given its true signals by their SI columns."""
        receiver, ticks = self._receiver, len(truth["vx_mps"])
        place = receiver.antenna_x_m, receiver.antenna_y_m
        moving = truth["vx_mps"], truth["vy_mps"], truth["yaw_rate_rad_s"]
        velocity = _over_ground(*moving, place, self._heading)
        late = [delay.apply(one) for delay, one in zip(self._delays, velocity, strict=True)]
        lasting = receiver.wander_std_mps * self._wander.next(ticks)
        white = receiver.velocity_std_mps * self._generator.standard_normal((2, ticks))
        east, north = np.stack(late) + lasting + white
        fix = self._outages.fixes(self._ticks, ticks)
        fix[: max(0, int(np.ceil(receiver.delay_s / SAMPLE_S)) - self._ticks)] = False
        course, speed = _counts(east, north, fix, self._scales, self._fastest)
        self._blocks.append((course, speed, fix))
        self._ticks += ticks

    def measurement(self) -> Measurement:
        """Return what was recorded: counts of `SATELLITE_SIGNALS`, valid where there is a fix."""
        course, speed, fix = (np.concatenate(parts) for parts in zip(*self._blocks, strict=True))
        return Measurement(dict(zip(SATELLITE_SIGNALS, (course, speed), strict=True)), fix, 0)


@equation
def _turn(heading: FloatArray, rate: float) -> None:
    """Turn a unit vector (cosine, sine, rate before) by a tick's trapezoid, by half tangents."""
    if not np.isnan(heading[2]):
        half = 0.25 * SAMPLE_S * (rate + heading[2])
        tangent = half + half * half * half / 3.0
        cosine = (1.0 - tangent * tangent) / (1.0 + tangent * tangent)
        sine = 2.0 * tangent / (1.0 + tangent * tangent)
        turned = heading[0] * cosine - heading[1] * sine
        heading[1] = heading[1] * cosine + heading[0] * sine
        heading[0] = turned
    heading[2] = rate


@kernel
def _over_ground(
    vx: FloatArray, vy: FloatArray, rate: FloatArray, place: Place, heading: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the velocity of a place of the car, east and north, and turn the heading with it."""
    east, north = np.empty(len(vx)), np.empty(len(vx))
    for i in range(len(vx)):
        _turn(heading, rate[i])
        along, across = vx[i] - rate[i] * place[1], vy[i] + rate[i] * place[0]
        east[i] = heading[0] * along - heading[1] * across
        north[i] = heading[1] * along + heading[0] * across
    return east, north


@kernel
def _counts(
    east: FloatArray, north: FloatArray, fix: BoolArray, scales: tuple[float, float], fastest: int
) -> tuple[NDArray[np.int16], NDArray[np.int16]]:
    """Return the counts of course and speed where there is a fix, and 0 elsewhere."""
    course, speed = np.zeros(len(fix), dtype=np.int16), np.zeros(len(fix), dtype=np.int16)
    for i in range(len(fix)):
        if fix[i]:
            angle = int(np.rint(arctan2(north[i], east[i]) / scales[0]))
            course[i] = -HALF_TURN if angle == HALF_TURN else angle
            size = np.sqrt(east[i] * east[i] + north[i] * north[i])
            speed[i] = min(int(np.rint(size / scales[1])), fastest)
    return course, speed
