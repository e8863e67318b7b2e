"""What a car's sensors report: bias, white noise and lost GPS fixes, then integer counts."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, FiniteFloat, field_validator

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.catalog.signals import SAMPLE_TIME_S, Signal, SignalCatalog
from fleet_slip.compiling import equation, kernel
from fleet_slip.config import Config
from fleet_slip.simulation.imperfections import Imperfections
from fleet_slip.vehicle.driver import SAMPLE_S
from fleet_slip.vehicle.parameters import GRAVITY_MPS2

# Signals that come late, by a delay or a low-pass, and errors that last (Gauss-Markov).


class Delay:
    """A signal that comes late; between samples it is linear, before the first one constant."""

    def __init__(self, latency_s: float) -> None:
        self._ticks = latency_s / SAMPLE_S
        self._before: FloatArray | None = None

    def apply(self, values: FloatArray) -> FloatArray:
        """Return the next block, delayed."""
        if self._ticks == 0.0:
            return values
        whole = math.floor(self._ticks)
        if self._before is None:
            self._before = np.full(whole + 1, values[0])
        return _delayed(values, self._before, self._ticks - whole)


class LowPass:
    """A low-pass of first order, by the trapezoidal rule."""

    def __init__(self, bandwidth_hz: float) -> None:
        """Take the frequency at which the gain is −3 dB; 0 for no low-pass."""
        half = math.pi * bandwidth_hz * SAMPLE_S
        self._gain = half / (1 + half)
        self._last: tuple[float, float] | None = None

    def apply(self, values: FloatArray) -> FloatArray:
        """Return the next block, filtered."""
        if self._gain == 0.0:
            return values
        before, output = self._last or (values[0], values[0])
        filtered = _low_pass(values, float(before), float(output), self._gain)
        self._last = (values[-1], filtered[-1])
        return filtered


@kernel
def _delayed(values: FloatArray, before: FloatArray, part: float) -> FloatArray:
    """Return values `len(before) - 1 + part` samples late; `before` is the last block's end."""
    first, ticks = len(before), len(values)
    late = np.empty(ticks)
    for i in range(min(first, ticks)):
        newer = before[i + 1] if i + 1 < first else values[i + 1 - first]
        late[i] = (1.0 - part) * newer + part * before[i]
    for i in range(first, ticks):
        late[i] = (1.0 - part) * values[i + 1 - first] + part * values[i - first]
    if ticks < first:
        before[: first - ticks] = before[ticks:].copy()
        before[first - ticks :] = values
    else:
        before[:] = values[ticks - first :]
    return late


@kernel
def _low_pass(values: FloatArray, before: float, output: float, gain: float) -> FloatArray:
    filtered = np.empty(len(values))
    for i in range(len(values)):
        output += gain * (values[i] + before - 2.0 * output)
        before = values[i]
        filtered[i] = output
    return filtered


KNOT_TICKS = 10
"""Samples between the times for which an error is drawn; in between it is linear."""


class Wander:
    """Processes of mean 0 and deviation 1 that forget within a correlation time, block or not."""

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
    """Fill in values between the knots `ends`, shape (2, processes); return how far they reach."""
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


# What sensors make of the truth, block by block, before bias and noise: place, tilt, delay ...


class Pulses:
    """A wheel speed sensor that times the pulses of an encoder's teeth.

    It reports pulses over the time since the last report; without one, at most one just now.
    """

    def __init__(self, places: FloatArray) -> None:
        self._places = places
        self._state = np.zeros(5)
        self._begun = False

    def apply(self, speed_rad_s: FloatArray) -> FloatArray:
        """Return the next block as the sensor reports it."""
        if not self._begun:
            self._state[:] = 0.0, 0.0, 0.0, speed_rad_s[0], speed_rad_s[0]
            self._begun = True
        return _timed_pulses(speed_rad_s, self._places, self._state)


@kernel
def _timed_pulses(speed: FloatArray, places: FloatArray, state: FloatArray) -> FloatArray:
    """Fill in reports; `state`: turned pulses, last pulse, its age, speed before, report."""
    turned, last, since, before, report = state
    count = len(places)
    per_sample = count * SAMPLE_S / (2.0 * math.pi)
    reports = np.empty(len(speed))
    start = last - int(last) % count  # of the turn; a division for every pulse would take longest
    for i in range(len(speed)):
        step = 0.5 * (before + speed[i]) * per_sample
        turned += step
        since += 1.0
        pulse = math.floor(turned)
        while pulse >= start + count:
            start += count
        while pulse < start:
            start -= count
        tooth = int(pulse - start)
        while pulse > last and turned < pulse + places[tooth]:
            pulse -= 1.0
            tooth = tooth - 1 if tooth > 0 else count - 1
        if pulse > last and step > 0.0:
            ago = (turned - pulse - places[tooth]) / step
            report = (pulse - last) / (max(since - ago, 1e-3) * per_sample)
            last, since = pulse, ago
        elif since > 0.0:
            report = min(report, 1.0 / (since * per_sample))
        reports[i] = report
        before = speed[i]
    state[0], state[1], state[2], state[3], state[4] = turned, last, since, before, report
    return reports


WHEELS = ("wheel_fl_rad_s", "wheel_fr_rad_s", "wheel_rl_rad_s", "wheel_rr_rad_s")
INERTIAL = ("ax_mps2", "ay_mps2", "yaw_rate_rad_s")
STEERING = ("steering_wheel_rad", "steer_fl_rad", "steer_fr_rad")
GPS = ("gps_vx_mps", "gps_vy_mps")
LABEL = "sideslip_rad"


class Distortion:
    """The sensors of one car in one drive."""

    def __init__(
        self, flaws: Imperfections, of_car: np.random.Generator, of_drive: np.random.Generator
    ) -> None:
        """Draw the pulses' places from the car's generator, all else from the drive's."""
        sensors = flaws.sensors
        self._flaws = flaws
        self._generator = of_drive
        self._delays = {name: Delay(sensors.inertial_latency_s) for name in INERTIAL}
        self._delays |= {name: Delay(sensors.steering_latency_s) for name in STEERING}
        self._delays |= {name: Delay(sensors.wheel_latency_s) for name in WHEELS}
        self._delays |= {name: Delay(sensors.gps_latency_s) for name in GPS}
        self._delays[LABEL] = Delay(sensors.label_latency_s)
        self._filters = {name: LowPass(sensors.inertial_bandwidth_hz) for name in INERTIAL}
        self._filters[LABEL] = LowPass(sensors.label_bandwidth_hz)
        pulses = sensors.wheel_pulses_per_turn
        self._pulses = {
            name: Pulses(sensors.wheel_pitch_error * of_car.standard_normal(pulses))
            for name in WHEELS
            if pulses
        }
        self._gps: Wander | None = None

    def apply(self, truth: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Return the next block as the sensors see it, with satellite velocity besides."""
        seen = {**truth, **self._accelerations(truth), **self._angles(truth)}
        for name, pulses in self._pulses.items():
            seen[name] = pulses.apply(truth[name])
        seen |= self._satellite(truth)
        for name, low_pass in self._filters.items():
            seen[name] = low_pass.apply(seen[name])
        for name, delay in self._delays.items():
            seen[name] = delay.apply(seen[name])
        return seen

    def _accelerations(self, truth: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Return what the inertial unit feels at its place on a leaning body.

        At (x, y): ax − r² x − ṙ y, ay + ṙ x − r² y, and for roll φ and pitch θ a part of the
        weight's reaction, g sin φ, g sin θ (Kidambi et al. 2014).
        """
        sensors, car = self._flaws.sensors, self._flaws.car
        r, turning = truth["yaw_rate_rad_s"], truth["yaw_acceleration_rad_s2"]
        place = sensors.inertial_x_m, sensors.inertial_y_m
        turned = (
            math.radians(sensors.inertial_roll_deg),
            math.radians(sensors.inertial_pitch_deg),
            math.radians(sensors.inertial_yaw_deg),
        )
        lean = (
            math.radians(car.roll_gradient_deg_per_g) / GRAVITY_MPS2,
            math.radians(car.pitch_gradient_deg_per_g) / GRAVITY_MPS2,
        )
        moving = truth["ax_mps2"], truth["ay_mps2"], r, turning
        leaning = truth["leaning_ax_mps2"], truth["leaning_ay_mps2"]
        return dict(zip(INERTIAL, _feel(moving, leaning, place, turned, lean), strict=True))

    def _angles(self, truth: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        sensors = self._flaws.sensors
        scale = 1 + sensors.wheel_angle_scale_error
        left, right = sensors.wheel_angle_offset_fl_deg, sensors.wheel_angle_offset_fr_deg
        return {
            "steering_wheel_rad": truth["steering_wheel_rad"]
            + math.radians(sensors.steering_offset_deg),
            "steer_fl_rad": scale * truth["steer_fl_rad"] + math.radians(left),
            "steer_fr_rad": scale * truth["steer_fr_rad"] + math.radians(right),
            LABEL: truth[LABEL] + math.radians(sensors.label_offset_deg),
        }

    def _satellite(self, truth: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Return satellite velocity in the car's frame, turned by the error of the heading."""
        sensors = self._flaws.sensors
        vx, vy = truth["vx_mps"], truth["vy_mps"]
        if not (sensors.gps_heading_std_deg or sensors.gps_velocity_std_mps):
            return {"gps_vx_mps": vx, "gps_vy_mps": vy}
        self._gps = self._gps or Wander(3, sensors.gps_correlation_s, self._generator)
        errors = self._gps.next(len(vx))
        std = math.radians(sensors.gps_heading_std_deg), sensors.gps_velocity_std_mps
        return dict(zip(GPS, _turned_velocity(vx, vy, errors, std), strict=True))


@equation
def _sine(angle: float) -> float:
    """Return the sine of an angle below 0.3 rad to 2e-5, the same bits everywhere."""
    return angle * (1.0 - angle * angle / 6.0)


@equation
def _cosine(angle: float) -> float:
    return 1.0 - angle * angle / 2.0


@kernel
def _feel(
    moving: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    leaning: tuple[FloatArray, FloatArray],
    place: tuple[float, float],
    turned: tuple[float, float, float],
    lean: tuple[float, float],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the accelerations and the yaw rate that the unit feels, see `_accelerations`."""
    ax, ay, rate, turning = moving
    leaning_ax, leaning_ay = leaning
    (x, y), (roll, pitch, yaw), (per_ay, per_ax) = place, turned, lean
    ticks = len(ax)
    felt_ax, felt_ay, felt_rate = np.empty(ticks), np.empty(ticks), np.empty(ticks)
    for i in range(ticks):
        r = rate[i]
        here_x = ax[i] - r * r * x - turning[i] * y
        here_y = ay[i] + turning[i] * x - r * r * y
        phi, theta = per_ay * leaning_ay[i] + roll, per_ax * leaning_ax[i] + pitch
        level_x = _cosine(theta) * here_x + GRAVITY_MPS2 * _sine(theta)
        level_y = _cosine(phi) * here_y + GRAVITY_MPS2 * _sine(phi)
        felt_ax[i] = level_x + yaw * level_y
        felt_ay[i] = level_y - yaw * level_x
        felt_rate[i] = _cosine(phi) * r
    return felt_ax, felt_ay, felt_rate


@kernel
def _turned_velocity(
    vx: FloatArray, vy: FloatArray, errors: FloatArray, std: tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    """Return velocity with errors of heading and of both components, given their deviations."""
    heading, error_x, error_y = errors
    heading_std, velocity_std = std
    seen_x, seen_y = np.empty(len(vx)), np.empty(len(vx))
    for i in range(len(vx)):
        angle = heading[i] * heading_std
        seen_x[i] = vx[i] + angle * vy[i] + velocity_std * error_x[i]
        seen_y[i] = vy[i] - angle * vx[i] + velocity_std * error_y[i]
    return seen_x, seen_y


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
    """One drive in counts: an int16 array per signal in catalog order, one value a tick.

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
        """Measure the next block, float64 by SI column but GPS; a missing one is not measured."""
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
            self._keep(name, *noisy_counts(truth[signal.column], noise, error, signal))
        self._record_gps(truth, ticks)
        self._ticks += ticks

    def _record_gps(self, truth: Mapping[str, FloatArray], ticks: int) -> None:
        fix = self._outages.fixes(self._ticks, ticks)
        self._gps_fix.append(fix)
        for name, column in GPS_SIGNALS.items():
            if name not in self._signals.signals:
                continue
            seen = truth.get(self._signals[name].column)
            fixed = (truth[column] if seen is None else seen)[fix]
            noise = self._generator.standard_normal(len(fixed), dtype=np.float32)
            std = self._sensors.gps.velocity_std_mps
            counts = np.zeros(ticks, dtype=np.int16)
            counts[fix], clipped = noisy_counts(fixed, noise, (0.0, std), self._signals[name])
            self._keep(name, counts, clipped)

    def _keep(self, name: str, counts: NDArray[np.int16], clipped: int) -> None:
        self._counts.setdefault(name, []).append(counts)
        self._saturated += clipped

    def measurement(self) -> Measurement:
        """Return all blocks as one measurement, once, at the end: their memory is given back."""
        return Measurement(
            {
                name: _joined(self._counts.pop(name))
                for name in self._signals.signals
                if name in self._counts
            },
            _joined(self._gps_fix),
            self._saturated,
        )


def _joined(parts: list[NDArray[Scalar]]) -> NDArray[Scalar]:
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


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
