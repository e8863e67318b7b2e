"""Sensors of a car: imperfections, bias, white noise, outages, counts; and satellite receivers."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, FiniteFloat, field_validator

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.catalog.course import COURSE, SATELLITE_SPEED
from fleet_slip.catalog.signals import HALF_TURN, SAMPLE_TIME_S, Signal, SignalCatalog
from fleet_slip.compiling import kernel
from fleet_slip.config import Config, Name
from fleet_slip.simulation.imperfections import (
    Imperfections,
    Latency,
    NotNegative,
    Range,
    SensorImperfections,
)
from fleet_slip.vehicle.driver import SAMPLE_S
from fleet_slip.vehicle.dynamics import arctan2
from fleet_slip.vehicle.parameters import GRAVITY_MPS2


def delayed(values: FloatArray, latency_s: float) -> FloatArray:
    """Delay a signal, which is linear between samples and constant before the first."""
    if latency_s == 0.0:
        return values
    ticks = latency_s / SAMPLE_S
    full_ticks = math.floor(ticks)
    joined, fraction = np.append(np.full(full_ticks + 1, values[0]), values), ticks - full_ticks
    late: FloatArray = (1.0 - fraction) * joined[1:] + fraction * joined[:-1]
    return late[: len(values)]


@kernel
def low_pass(values: FloatArray, bandwidth_hz: float) -> FloatArray:
    """Filter by a low-pass of first order, -3 dB at the bandwidth, by the trapezoidal rule."""
    half = math.pi * bandwidth_hz * SAMPLE_S
    gain = half / (1 + half)
    filtered = np.empty(len(values))
    previous, output = values[0], values[0]
    for i in range(len(values)):
        output += gain * (values[i] + previous - 2.0 * output)
        previous = values[i]
        filtered[i] = output
    return filtered


KNOT_TICKS = 10
"""Samples between two drawn errors; in between, errors are linear."""


def correlated_noise(
    count: int, ticks: int, correlation_s: float, generator: np.random.Generator
) -> FloatArray:
    """Draw first-order Gauss-Markov processes of mean 0 and variance 1, shape (count, ticks)."""
    decay = 1.0 - KNOT_TICKS * SAMPLE_S / correlation_s
    knots = generator.standard_normal((2 + (ticks - 1) // KNOT_TICKS, count))
    knots[1:] *= math.sqrt(1.0 - decay * decay)
    for i in range(1, len(knots)):
        knots[i] += decay * knots[i - 1]
    before, phase = np.divmod(np.arange(ticks), KNOT_TICKS)
    changes = np.diff(knots, axis=0)
    return (knots[before] + (phase / KNOT_TICKS)[:, None] * changes[before]).T


@kernel
def timed_pulses(speed: FloatArray, offsets: FloatArray) -> FloatArray:
    """Measure a wheel's speed in rad/s by the time between the pulses of an encoder.

    A report is the number of pulses over the time since the previous report. Without a pulse, it
    is at most one pulse over the time since the last one. `offsets` are those of the teeth from
    their nominal positions, in pulses.
    """
    rotation, last, since, previous, report = 0.0, 0.0, 0.0, speed[0], speed[0]
    count = len(offsets)
    per_sample = count * SAMPLE_S / (2.0 * math.pi)
    reports = np.empty(len(speed))
    start = 0.0  # of the revolution; avoids a division for every pulse
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
    return reports


WHEELS = ("wheel_fl_rad_s", "wheel_fr_rad_s", "wheel_rl_rad_s", "wheel_rr_rad_s")
INERTIAL = ("ax_mps2", "ay_mps2", "yaw_rate_rad_s")
STEERING = ("steering_wheel_rad", "steer_fl_rad", "steer_fr_rad")
GPS = ("gps_vx_mps", "gps_vy_mps")
LABEL = "sideslip_rad"


def distort(
    truth: Mapping[str, FloatArray],
    flaws: Imperfections,
    car_rng: np.random.Generator,
    drive_rng: np.random.Generator,
) -> dict[str, FloatArray]:
    """Return a drive as imperfect sensors measure it, before bias and noise.

    The encoders of the wheels are drawn from the car's generator, other errors from the drive's.
    """
    sensors = flaws.sensors
    measured = {**truth, **_accelerations(truth, flaws)}
    measured |= _angles(truth, sensors) | _satellite(truth, sensors, drive_rng)
    for name in WHEELS if sensors.wheel_pulses_per_turn else ():
        teeth = car_rng.standard_normal(sensors.wheel_pulses_per_turn)
        measured[name] = timed_pulses(truth[name], sensors.wheel_pitch_error * teeth)
    for names, bandwidth_hz, latency_s in (
        (INERTIAL, sensors.inertial_bandwidth_hz, sensors.inertial_latency_s),
        ((LABEL,), sensors.label_bandwidth_hz, sensors.label_latency_s),
        (STEERING, 0.0, sensors.steering_latency_s),
        (WHEELS, 0.0, sensors.wheel_latency_s),
        (GPS, 0.0, sensors.gps_latency_s),
    ):
        for name in names:
            values = low_pass(measured[name], bandwidth_hz) if bandwidth_hz else measured[name]
            measured[name] = delayed(values, latency_s)
    return measured


def _accelerations(truth: Mapping[str, FloatArray], flaws: Imperfections) -> dict[str, FloatArray]:
    """Return the measurements of the inertial unit at its position on a rolling body.

    At (x, y) the specific force is ax − r² x − ṙ y, ay + ṙ x − r² y. Roll φ and pitch θ add the
    components g sin φ and g sin θ of gravity (Kidambi et al. 2014).
    """
    sensors, car = flaws.sensors, flaws.car
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


def _angles(truth: Mapping[str, FloatArray], sensors: SensorImperfections) -> dict[str, FloatArray]:
    scale = 1 + sensors.wheel_angle_scale_error
    angles = {
        "steering_wheel_rad": (1.0, sensors.steering_offset_deg),
        "steer_fl_rad": (scale, sensors.wheel_angle_offset_fl_deg),
        "steer_fr_rad": (scale, sensors.wheel_angle_offset_fr_deg),
        LABEL: (1.0, sensors.label_offset_deg),
    }
    return {
        name: factor * truth[name] + math.radians(offset_deg)
        for name, (factor, offset_deg) in angles.items()
    }


def _satellite(
    truth: Mapping[str, FloatArray], sensors: SensorImperfections, generator: np.random.Generator
) -> dict[str, FloatArray]:
    """Return satellite velocity in the car's frame, rotated by the error of the heading."""
    vx, vy = truth["vx_mps"], truth["vy_mps"]
    std_mps = sensors.gps_velocity_std_mps
    if not (sensors.gps_heading_std_deg or std_mps):
        return {"gps_vx_mps": vx, "gps_vy_mps": vy}
    errors = correlated_noise(3, len(vx), sensors.gps_correlation_s, generator)
    angle = errors[0] * math.radians(sensors.gps_heading_std_deg)
    return {
        "gps_vx_mps": vx + angle * vy + std_mps * errors[1],
        "gps_vy_mps": vy - angle * vx + std_mps * errors[2],
    }


def _sine(angle: FloatArray) -> FloatArray:
    """Return the sine of angles below 0.3 rad with an error of 2e-5, portable to the bit."""
    return angle * (1.0 - angle * angle / 6.0)


def _cosine(angle: FloatArray) -> FloatArray:
    return 1.0 - angle * angle / 2.0


SAMPLE_RATE_HZ = int(1 / SAMPLE_TIME_S)
GPS_SIGNALS = {"gps_vx": "vx_mps", "gps_vy": "vy_mps"}
"""Signals that are null between fixes, with the column of the truth that each measures."""

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
        return {
            "ax": (self.ax_bias_mps2, self.acceleration_std_mps2),
            "ay": (self.ay_bias_mps2, self.acceleration_std_mps2),
            "yaw_rate": (self.yaw_rate_bias_rad_s, self.yaw_rate_std_rad_s),
            "steering_wheel": (0.0, self.steering_wheel_std_rad),
            **dict.fromkeys(("steer_fl", "steer_fr"), (0.0, self.steer_std_rad)),
            **{name.removesuffix("_rad_s"): (0.0, self.wheel_speed_std_rad_s) for name in WHEELS},
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


def measure(
    signals: SignalCatalog,
    sensors: Sensors,
    generator: np.random.Generator,
    truth: Mapping[str, FloatArray],
) -> Measurement:
    """Measure a drive, given its values by SI column; skip signals without a column.

    White noise is drawn signal by signal, then GPS outages, then GPS noise. Signals without an
    entry in `Sensors.bias_and_std` have no errors.
    """
    ticks = len(truth["vx_mps"])
    noise = np.zeros(ticks, dtype=np.float32)
    errors = sensors.bias_and_std
    measured: dict[str, tuple[NDArray[np.int16], int]] = {}
    for name, signal in signals.signals.items():
        if name in GPS_SIGNALS or signal.column not in truth:
            continue
        if name in errors:
            generator.standard_normal(out=noise, dtype=np.float32)
        error = errors.get(name, EXACT)
        measured[name] = noisy_counts(truth[signal.column], noise, error, signal)
    fix = gps_fixes(sensors.gps, ticks, generator)
    for name, column in GPS_SIGNALS.items():
        if name in signals.signals:
            signal = signals[name]
            fixed = truth.get(signal.column, truth[column])[fix]
            noise = generator.standard_normal(len(fixed), dtype=np.float32)
            error = (0.0, sensors.gps.velocity_std_mps)
            counts = np.zeros(ticks, dtype=np.int16)
            counts[fix], clipped = noisy_counts(fixed, noise, error, signal)
            measured[name] = counts, clipped
    return Measurement(
        {name: measured[name][0] for name in signals.signals if name in measured},
        fix,
        sum(clipped for _, clipped in measured.values()),
    )


def noisy_counts(
    physical: FloatArray,
    noise: NDArray[np.float32],
    bias_and_std: tuple[float, float],
    signal: Signal,
) -> tuple[NDArray[np.int16], int]:
    """Quantise `(physical + bias + std * noise) / scale`, halves to even; count clipped values."""
    bias, std = bias_and_std
    count = np.rint((physical + (bias + std * noise.astype(np.float64))) / float(signal.scale))
    # A comparison with NaN is false: NaN becomes the lower bound, and counts as clipped.
    is_above = count >= signal.min_count
    valid = np.where(is_above, np.minimum(count, signal.max_count), signal.min_count)
    return valid.astype(np.int16), int((valid != count).sum())


def gps_fixes(gps: Gps, ticks: int, generator: np.random.Generator) -> BoolArray:
    """Return which ticks of a drive have a fix: one each period, none in an outage."""
    fix = np.zeros(ticks, dtype=np.bool_)
    fix[:: SAMPLE_RATE_HZ // gps.rate_hz] = True
    end_s = 0.0
    while end_s * SAMPLE_RATE_HZ < ticks:
        start_s = end_s + generator.exponential(gps.time_between_outages_s)
        end_s = start_s + generator.exponential(gps.outage_duration_s)
        fix[int(start_s * SAMPLE_RATE_HZ) : int(end_s * SAMPLE_RATE_HZ)] = False
    return fix


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


def receive(
    signals: SignalCatalog,
    receiver: Receiver,
    generator: np.random.Generator,
    truth: Mapping[str, FloatArray],
) -> Measurement:
    """Return the log of a car's receiver in a drive: `SATELLITE_SIGNALS`, valid at fixes.

    The velocity is that of the centre of gravity, as a mapping converts it. The error of the
    antenna's position remains.
    """
    course, speed = (signals[name] for name in SATELLITE_SIGNALS)
    direction = generator.standard_normal(2)
    east_north = _over_ground(
        truth["vx_mps"],
        truth["vy_mps"],
        truth["yaw_rate_rad_s"],
        (receiver.antenna_x_m, receiver.antenna_y_m),
        direction / np.sqrt((direction**2).sum()),
    )
    ticks = len(truth["vx_mps"])
    wander = correlated_noise(2, ticks, receiver.wander_s, generator)
    white = generator.standard_normal((2, ticks))
    velocity = np.stack([delayed(component, receiver.delay_s) for component in east_north])
    velocity += receiver.wander_std_mps * wander
    velocity += receiver.velocity_std_mps * white
    fix = gps_fixes(receiver, ticks, generator)
    fix[: math.ceil(receiver.delay_s / SAMPLE_S)] = False
    scales = float(course.scale), float(speed.scale)
    counts = _counts(velocity[0], velocity[1], fix, scales, speed.max_count)
    return Measurement(dict(zip(SATELLITE_SIGNALS, counts, strict=True)), fix, 0)


@kernel
def _over_ground(
    vx: FloatArray, vy: FloatArray, rate: FloatArray, position: Position, heading: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the velocity of a position of the car, east and north.

    The heading (cosine, sine) rotates by the yaw rate, with half-angle formulas.
    """
    east, north = np.empty(len(vx)), np.empty(len(vx))
    x, y = heading
    for i in range(len(vx)):
        if i > 0:
            half = 0.25 * SAMPLE_S * (rate[i] + rate[i - 1])
            tangent = half + half * half * half / 3.0
            cosine = (1.0 - tangent * tangent) / (1.0 + tangent * tangent)
            sine = 2.0 * tangent / (1.0 + tangent * tangent)
            x, y = x * cosine - y * sine, y * cosine + x * sine
        along, across = vx[i] - rate[i] * position[1], vy[i] + rate[i] * position[0]
        east[i] = x * along - y * across
        north[i] = y * along + x * across
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
