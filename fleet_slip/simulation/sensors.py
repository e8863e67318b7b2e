"""Sensors of a car: imperfections, bias, white noise, outages, counts; and satellite receivers."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, FiniteFloat, field_validator

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.catalog.course import COURSE, SATELLITE_SPEED
from fleet_slip.catalog.signals import HALF_TURN, SAMPLE_TIME_S, Signal, SignalCatalog
from fleet_slip.compiling import equation, kernel
from fleet_slip.config import Config, Name
from fleet_slip.simulation.imperfections import Imperfections, Latency, NotNegative, Range
from fleet_slip.vehicle.driver import SAMPLE_S
from fleet_slip.vehicle.dynamics import arctan2
from fleet_slip.vehicle.parameters import GRAVITY_MPS2


class Delay:
    """A delay. The signal is linear between samples and constant before the first."""

    def __init__(self, latency_s: float) -> None:
        self._ticks = latency_s / SAMPLE_S
        self._previous: FloatArray | None = None

    def apply(self, values: FloatArray) -> FloatArray:
        """Return the next block, delayed."""
        if self._ticks == 0.0:
            return values
        full_ticks = math.floor(self._ticks)
        if self._previous is None:
            self._previous = np.full(full_ticks + 1, values[0])
        joined, fraction = np.concatenate([self._previous, values]), self._ticks - full_ticks
        self._previous = joined[len(values) :]
        delayed: FloatArray = (1.0 - fraction) * joined[1:] + fraction * joined[:-1]
        return delayed[: len(values)]


class LowPass:
    """A low-pass filter of first order, by the trapezoidal rule."""

    def __init__(self, bandwidth_hz: float) -> None:
        """Design the filter with a gain of −3 dB at `bandwidth_hz`; 0: no filter."""
        half = math.pi * bandwidth_hz * SAMPLE_S
        self._gain = half / (1 + half)
        self._last: tuple[float, float] | None = None

    def apply(self, values: FloatArray) -> FloatArray:
        """Return the next block, filtered."""
        if self._gain == 0.0:
            return values
        previous, output = self._last or (values[0], values[0])
        filtered = _low_pass(values, float(previous), float(output), self._gain)
        self._last = (values[-1], filtered[-1])
        return filtered


@kernel
def _low_pass(values: FloatArray, previous: float, output: float, gain: float) -> FloatArray:
    filtered = np.empty(len(values))
    for i in range(len(values)):
        output += gain * (values[i] + previous - 2.0 * output)
        previous = values[i]
        filtered[i] = output
    return filtered


KNOT_TICKS = 10
"""Samples between two drawn errors; in between, errors are linear."""


class GaussMarkov:
    """Correlated noise: first-order Gauss-Markov processes of mean 0 and standard deviation 1."""

    def __init__(self, count: int, correlation_s: float, generator: np.random.Generator) -> None:
        decay = 1.0 - KNOT_TICKS * SAMPLE_S / correlation_s
        self._step = (decay, math.sqrt(1.0 - decay * decay))
        self._generator = generator
        self._ends = np.tile(generator.standard_normal(count), (2, 1))
        self._phase = KNOT_TICKS

    def next(self, ticks: int) -> FloatArray:
        """Return the next block, shape (processes, ticks)."""
        knots = (self._phase + ticks - 1) // KNOT_TICKS
        drawn = self._generator.standard_normal((knots, self._ends.shape[1]))
        values = np.empty((self._ends.shape[1], ticks))
        self._phase = _wander(drawn, self._ends, self._phase, self._step, values)
        return values


@kernel
def _wander(
    drawn: FloatArray, ends: FloatArray, phase: int, step: tuple[float, float], values: FloatArray
) -> int:
    """Interpolate between the knots `ends`, shape (2, processes); return the new phase."""
    decay, kick = step
    knot = 0
    for i in range(values.shape[1]):
        if phase == KNOT_TICKS:
            phase = 0
            ends[0] = ends[1]
            ends[1] = decay * ends[1] + kick * drawn[knot]
            knot += 1
        share = phase / KNOT_TICKS
        for j in range(len(values)):
            values[j, i] = ends[0, j] + share * (ends[1, j] - ends[0, j])
        phase += 1
    return phase


class Pulses:
    """A wheel speed sensor that measures the time between the pulses of an encoder.

    It reports the number of pulses over the time since the previous report. Without a pulse, the
    report is at most one pulse over the time since the last one.
    """

    def __init__(self, offsets: FloatArray) -> None:
        """Take the offsets of the teeth from their nominal positions, in pulses."""
        self._offsets = offsets
        self._state = np.zeros(5)
        self._started = False

    def apply(self, speed_rad_s: FloatArray) -> FloatArray:
        """Return the reports of the next block."""
        if not self._started:
            self._state[:] = 0.0, 0.0, 0.0, speed_rad_s[0], speed_rad_s[0]
            self._started = True
        return _timed_pulses(speed_rad_s, self._offsets, self._state)


@kernel
def _timed_pulses(speed: FloatArray, offsets: FloatArray, state: FloatArray) -> FloatArray:
    """Compute reports. `state`: rotation in pulses, last pulse, its age, previous speed, report."""
    rotation, last, since, previous, report = state
    count = len(offsets)
    per_sample = count * SAMPLE_S / (2.0 * math.pi)
    reports = np.empty(len(speed))
    start = last - int(last) % count  # of the revolution; avoids a division for every pulse
    for i in range(len(speed)):
        step = 0.5 * (previous + speed[i]) * per_sample
        rotation += step
        since += 1.0
        pulse = math.floor(rotation)
        while pulse >= start + count:
            start += count
        while pulse < start:
            start -= count
        tooth = int(pulse - start)
        while pulse > last and rotation < pulse + offsets[tooth]:
            pulse -= 1.0
            tooth = tooth - 1 if tooth > 0 else count - 1
        if pulse > last and step > 0.0:
            ago = (rotation - pulse - offsets[tooth]) / step
            report = (pulse - last) / (max(since - ago, 1e-3) * per_sample)
            last, since = pulse, ago
        elif since > 0.0:
            report = min(report, 1.0 / (since * per_sample))
        reports[i] = report
        previous = speed[i]
    state[0], state[1], state[2], state[3], state[4] = rotation, last, since, previous, report
    return reports


WHEELS = ("wheel_fl_rad_s", "wheel_fr_rad_s", "wheel_rl_rad_s", "wheel_rr_rad_s")
INERTIAL = ("ax_mps2", "ay_mps2", "yaw_rate_rad_s")
STEERING = ("steering_wheel_rad", "steer_fl_rad", "steer_fr_rad")
GPS = ("gps_vx_mps", "gps_vy_mps")
LABEL = "sideslip_rad"


class Distortion:
    """Imperfect sensors of a car in one drive, block by block, before bias and noise."""

    def __init__(
        self, flaws: Imperfections, car_rng: np.random.Generator, drive_rng: np.random.Generator
    ) -> None:
        """Draw the encoders from the car's generator; other errors come from the drive's."""
        sensors = flaws.sensors
        self._flaws = flaws
        self._generator = drive_rng
        self._delays = {name: Delay(sensors.inertial_latency_s) for name in INERTIAL}
        self._delays |= {name: Delay(sensors.steering_latency_s) for name in STEERING}
        self._delays |= {name: Delay(sensors.wheel_latency_s) for name in WHEELS}
        self._delays |= {name: Delay(sensors.gps_latency_s) for name in GPS}
        self._delays[LABEL] = Delay(sensors.label_latency_s)
        self._filters = {name: LowPass(sensors.inertial_bandwidth_hz) for name in INERTIAL}
        self._filters[LABEL] = LowPass(sensors.label_bandwidth_hz)
        pulses = sensors.wheel_pulses_per_turn
        self._pulses = {
            name: Pulses(sensors.wheel_pitch_error * car_rng.standard_normal(pulses))
            for name in WHEELS
            if pulses
        }
        self._gps: GaussMarkov | None = None

    def apply(self, truth: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Return the next block as the sensors measure it, with satellite velocity."""
        measured = {**truth, **self._accelerations(truth), **self._angles(truth)}
        for name, pulses in self._pulses.items():
            measured[name] = pulses.apply(truth[name])
        measured |= self._satellite(truth)
        for steps in (self._filters, self._delays):
            for name, step in steps.items():
                measured[name] = step.apply(measured[name])
        return measured

    def _accelerations(self, truth: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Return the measurements of the inertial unit at its position on a rolling body.

        At (x, y) the specific force is ax − r² x − ṙ y, ay + ṙ x − r² y. Roll φ and pitch θ add the
        components g sin φ and g sin θ of gravity (Kidambi et al. 2014).
        """
        sensors, car = self._flaws.sensors, self._flaws.car
        ax, ay, r, turning = (truth[name] for name in (*INERTIAL, "yaw_acceleration_rad_s2"))
        x, y = sensors.inertial_x_m, sensors.inertial_y_m
        per_ay = math.radians(car.roll_gradient_deg_per_g) / GRAVITY_MPS2
        per_ax = math.radians(car.pitch_gradient_deg_per_g) / GRAVITY_MPS2
        phi = per_ay * truth["leaning_ay_mps2"] + math.radians(sensors.inertial_roll_deg)
        theta = per_ax * truth["leaning_ax_mps2"] + math.radians(sensors.inertial_pitch_deg)
        yaw = math.radians(sensors.inertial_yaw_deg)
        local_x = ax - r * r * x - turning * y
        local_y = ay + turning * x - r * r * y
        level_x = _cosine(theta) * local_x + GRAVITY_MPS2 * _sine(theta)
        level_y = _cosine(phi) * local_y + GRAVITY_MPS2 * _sine(phi)
        measured = level_x + yaw * level_y, level_y - yaw * level_x, _cosine(phi) * r
        return dict(zip(INERTIAL, measured, strict=True))

    def _angles(self, truth: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        sensors = self._flaws.sensors
        scale = 1 + sensors.wheel_angle_scale_error
        offset_fl = math.radians(sensors.wheel_angle_offset_fl_deg)
        offset_fr = math.radians(sensors.wheel_angle_offset_fr_deg)
        return {
            "steering_wheel_rad": truth["steering_wheel_rad"]
            + math.radians(sensors.steering_offset_deg),
            "steer_fl_rad": scale * truth["steer_fl_rad"] + offset_fl,
            "steer_fr_rad": scale * truth["steer_fr_rad"] + offset_fr,
            LABEL: truth[LABEL] + math.radians(sensors.label_offset_deg),
        }

    def _satellite(self, truth: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Return satellite velocity in the car's frame, rotated by the error of the heading."""
        sensors = self._flaws.sensors
        vx, vy = truth["vx_mps"], truth["vy_mps"]
        if not (sensors.gps_heading_std_deg or sensors.gps_velocity_std_mps):
            return {"gps_vx_mps": vx, "gps_vy_mps": vy}
        self._gps = self._gps or GaussMarkov(3, sensors.gps_correlation_s, self._generator)
        heading, error_x, error_y = self._gps.next(len(vx))
        angle, std_mps = (
            heading * math.radians(sensors.gps_heading_std_deg),
            sensors.gps_velocity_std_mps,
        )
        seen = vx + angle * vy + std_mps * error_x, vy - angle * vx + std_mps * error_y
        return dict(zip(GPS, seen, strict=True))


def _sine(angle: FloatArray) -> FloatArray:
    """Return the sine of angles below 0.3 rad with an error of 2e-5, portable to the bit."""
    return angle * (1.0 - angle * angle / 6.0)


def _cosine(angle: FloatArray) -> FloatArray:
    return 1.0 - angle * angle / 2.0


SAMPLE_RATE_HZ = int(1 / SAMPLE_TIME_S)
GPS_SIGNALS = {"gps_vx": "vx_mps", "gps_vy": "vy_mps"}
"""Signals that are null between fixes, with the column of the truth that each measures."""

Scalar = TypeVar("Scalar", bound=np.generic)

EXACT = (0.0, 0.0)
"""Bias and standard deviation of a signal without errors."""


class Gps(Config):
    """Satellite navigation: velocity at a rate of its own, with outages.

    Durations of outages, and times between them, are exponentially distributed.
    """

    rate_hz: int = Field(gt=0)
    velocity_std_mps: FiniteFloat = Field(ge=0)
    time_between_outages_s: FiniteFloat = Field(ge=1)
    outage_duration_s: FiniteFloat = Field(gt=0)

    @field_validator("rate_hz")
    @classmethod
    def _rate_divides_sample_rate(cls, rate_hz: int) -> int:
        if SAMPLE_RATE_HZ % rate_hz:
            raise ValueError(f"give a divisor of {SAMPLE_RATE_HZ} Hz, not {rate_hz} Hz")
        return rate_hz


class Sensors(Config):
    """Bias and white noise of a car's sensors."""

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
        """Bias and standard deviation of the signals at the full rate, in SI units."""
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
    """A drive in counts."""

    counts: dict[str, NDArray[np.int16]]
    """One array for each signal, in the order of the catalog, with one value for each tick."""
    gps_fix: BoolArray
    """Ticks with a valid GPS fix."""
    saturated: int
    """Number of values that were clipped to the signal's valid range."""


class Recorder:
    """Records the reports of a car's sensors in one drive, block by block.

    For each block, white noise is drawn signal by signal, then GPS outages, then GPS noise, so that
    counts depend on the size of the blocks. Signals without an entry in `Sensors.bias_and_std` have
    no errors.
    """

    def __init__(
        self,
        signals: SignalCatalog,
        sensors: Sensors,
        generator: np.random.Generator,
        distortion: Distortion | None = None,
    ) -> None:
        self._signals = signals
        self._distortion = distortion
        self._sensors = sensors
        self._generator = generator
        self._outages = Outages(sensors.gps, generator)
        self._ticks = 0
        self._counts: dict[str, list[NDArray[np.int16]]] = {}
        self._gps_fix: list[BoolArray] = []
        self._saturated = 0

    def record(self, truth: Mapping[str, FloatArray]) -> None:
        """Measure the next block of true values by SI column; skip signals without a column."""
        ticks = len(next(iter(truth.values())))
        if self._distortion is not None:
            truth = self._distortion.apply(truth)
        noise = np.zeros(ticks, dtype=np.float32)
        errors = self._sensors.bias_and_std
        for name, signal in self._signals.signals.items():
            if name in GPS_SIGNALS or signal.column not in truth:
                continue
            if name in errors:
                self._generator.standard_normal(out=noise, dtype=np.float32)
            error = errors.get(name, EXACT)
            self._append(name, *noisy_counts(truth[signal.column], noise, error, signal))
        self._record_gps(truth, ticks)
        self._ticks += ticks

    def _record_gps(self, truth: Mapping[str, FloatArray], ticks: int) -> None:
        fix = self._outages.fixes(self._ticks, ticks)
        self._gps_fix.append(fix)
        for name, column in GPS_SIGNALS.items():
            if name not in self._signals.signals:
                continue
            distorted = truth.get(self._signals[name].column)
            fixed = (truth[column] if distorted is None else distorted)[fix]
            noise = self._generator.standard_normal(len(fixed), dtype=np.float32)
            std = self._sensors.gps.velocity_std_mps
            counts = np.zeros(ticks, dtype=np.int16)
            counts[fix], clipped = noisy_counts(fixed, noise, (0.0, std), self._signals[name])
            self._append(name, counts, clipped)

    def _append(self, name: str, counts: NDArray[np.int16], clipped: int) -> None:
        self._counts.setdefault(name, []).append(counts)
        self._saturated += clipped

    def measurement(self) -> Measurement:
        """Join all blocks to one measurement and release them. Call it once, at the end."""
        return Measurement(
            {
                name: _joined(self._counts.pop(name))
                for name in self._signals.signals
                if name in self._counts
            },
            _joined(self._gps_fix),
            self._saturated,
        )


def _joined(blocks: list[NDArray[Scalar]]) -> NDArray[Scalar]:
    return blocks[0] if len(blocks) == 1 else np.concatenate(blocks)


def noisy_counts(
    physical: FloatArray,
    noise: NDArray[np.float32],
    bias_and_std: tuple[float, float],
    signal: Signal,
) -> tuple[NDArray[np.int16], int]:
    """Quantise `(physical + bias + std * noise) / scale`, halves to even; count clipped values."""
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
    """Write `counts` in one pass over memory; return the number of clipped values and NaN."""
    bias, std = bias_and_std
    lowest, highest = valid
    clipped = 0
    for i in range(len(physical)):
        count = np.rint((physical[i] + (bias + std * noise[i])) / scale)
        within = lowest <= count <= highest
        # A comparison with NaN is false: NaN becomes the lower bound and never reaches the cast.
        inside = min(count, highest) if count >= lowest else lowest
        counts[i] = np.int16(inside)
        clipped += 0 if within else 1
    return clipped


class Outages:
    """GPS fixes of a drive: one each period, none in an outage."""

    def __init__(self, gps: Gps, generator: np.random.Generator) -> None:
        self._gps = gps
        self._generator = generator
        self._start_s = 0.0
        self._end_s = 0.0

    def fixes(self, first: int, ticks: int) -> BoolArray:
        """Return which of the next ticks have a fix; `first` is the number of the first."""
        period = SAMPLE_RATE_HZ // self._gps.rate_hz
        fix = np.zeros(ticks, dtype=np.bool_)
        fix[-first % period :: period] = True
        self._clear(fix, first)
        while self._end_s * SAMPLE_RATE_HZ < first + ticks:
            self._start_s = self._end_s + self._generator.exponential(
                self._gps.time_between_outages_s
            )
            self._end_s = self._start_s + self._generator.exponential(self._gps.outage_duration_s)
            self._clear(fix, first)
        return fix

    def _clear(self, fix: BoolArray, first: int) -> None:
        start, end = (int(s * SAMPLE_RATE_HZ) - first for s in (self._start_s, self._end_s))
        fix[max(start, 0) : max(end, 0)] = False


# Satellite receivers: course and speed over ground, at a low rate and with a delay.

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
