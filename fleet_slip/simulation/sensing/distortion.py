"""What sensors make of the truth, block by block, before bias and noise: place, tilt, delay ...

A wheel speed sensor that counts the pulses of an encoder.

What an uneven road adds to accelerations and wheel speeds.

ISO 8608: height has a power spectral density Gd (n0 / n)², n0 = 0.1 cycles/m, so that a wheel's
vertical velocity is white noise, of density (2π n0)² Gd v. Body and wheels answer as oscillators.
"""

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray
from fleet_slip.compiling import equation, kernel
from fleet_slip.simulation.imperfections import Imperfections
from fleet_slip.simulation.sensing.lags import Delay, LowPass, Wander
from fleet_slip.vehicle.driver import SAMPLE_S
from fleet_slip.vehicle.parameters import GRAVITY_MPS2


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


BODY = (1.5, 0.3)
"""Natural frequency in Hz and damping of a body's roll and pitch on its springs."""

WHEEL = (12.0, 0.15)
"""Of a wheel on its tyre (both: Mitschke and Wallentowitz 2014; Gillespie 1992, ch. 5)."""

TRACK_M, WHEELBASE_M, RADIUS_M = 1.5, 2.7, 0.32

UNIT_ABOVE_ROLL_AXIS_M = 0.3

AX, AY, FIRST_WHEEL = range(3)


class Vibration:
    """The vibration of one drive."""

    def __init__(self, roughness_cm3: float, generator: np.random.Generator) -> None:
        density = (2 * math.pi * 0.1) ** 2 * roughness_cm3 * 1e-6 / (2 * SAMPLE_S)
        body_1ps = 2 * math.pi * BODY[0]
        per_rad = GRAVITY_MPS2 + body_1ps**2 * UNIT_ABOVE_ROLL_AXIS_M  # it leans, and swings
        gains = [per_rad / WHEELBASE_M, per_rad / TRACK_M, *4 * (1 / (3 * RADIUS_M),)]
        self._gains = math.sqrt(density) * np.array(gains)
        self._oscillators = np.array([_oscillator(*kind) for kind in (BODY, BODY, *4 * (WHEEL,))])
        self._state = np.zeros((len(gains), 2))
        self._generator = generator

    def next(self, speed_mps: FloatArray) -> FloatArray:
        """Return ax and ay in m/s², and what wheel speeds change by, relative; (6, ticks)."""
        shape = (len(self._gains), len(speed_mps))
        noise = self._generator.standard_normal(shape, dtype=np.float32)
        return _answer(
            noise, np.sqrt(np.abs(speed_mps)), self._oscillators, self._state, self._gains
        )


def _oscillator(frequency_hz: float, damping: float) -> tuple[float, ...]:
    """Return the filter (b0, b1, b2, a1, a2) from the road's velocity to what a spring gives.

    −(s + b) / (s² + b s + ω²), b = 2 ζ ω, by the trapezoidal rule, s = k (1 − z⁻¹) / (1 + z⁻¹).
    """
    k, omega = 2 / SAMPLE_S, 2 * math.pi * frequency_hz
    b = 2 * damping * omega
    whole = k * k + b * k + omega * omega
    top = (-(k + b), -2 * b, k - b)
    below = (2 * (omega * omega - k * k), k * k - b * k + omega * omega)
    return *(one / whole for one in top), *(one / whole for one in below)


@kernel
def _answer(
    noise: NDArray[np.float32],
    swell: FloatArray,
    oscillators: FloatArray,
    state: FloatArray,
    gains: FloatArray,
) -> FloatArray:
    """Return what oscillators make of noise that swells with the speed; keep their state."""
    values = np.empty(noise.shape)
    for j in range(len(noise)):
        b0, b1, b2, a1, a2 = oscillators[j]
        first, second = state[j]
        for i in range(len(swell)):
            pushed = gains[j] * swell[i] * noise[j, i]
            value = b0 * pushed + first
            first = b1 * pushed - a1 * value + second
            second = b2 * pushed - a2 * value
            values[j, i] = value
        state[j, 0], state[j, 1] = first, second
    return values


WHEELS = ("wheel_fl_rad_s", "wheel_fr_rad_s", "wheel_rl_rad_s", "wheel_rr_rad_s")
INERTIAL = ("ax_mps2", "ay_mps2", "yaw_rate_rad_s")
STEERING = ("steering_wheel_rad", "steer_fl_rad", "steer_fr_rad")
GPS = ("gps_vx_mps", "gps_vy_mps")
LABEL = "sideslip_rad"

SLOWEST_LABEL_MPS = 1.0
"""The reference sensor's errors are those at this speed where the car is slower."""


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
        self._drift: Wander | None = None
        roughness_cm3 = flaws.road.roughness_cm3
        self._vibration = Vibration(roughness_cm3, of_drive) if roughness_cm3 else None
        self._latest: dict[str, float] = {}

    @property
    def held_ticks(self) -> dict[str, int]:
        """For how many ticks a value stands in the log, by column; those of every tick are not."""
        sensors = self._flaws.sensors
        groups = {
            INERTIAL: sensors.inertial_held_ticks,
            STEERING: sensors.steering_held_ticks,
            WHEELS: sensors.wheel_held_ticks,
        }
        return {name: ticks for names, ticks in groups.items() for name in names if ticks > 1}

    def apply(self, truth: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Return the next block as the sensors see it, with satellite velocity besides."""
        truth = self._shaken(truth)
        seen = dict(truth)
        seen |= self._accelerations(truth)
        self._let_drift(seen)
        seen |= self._angles(truth)
        for name, pulses in self._pulses.items():
            seen[name] = pulses.apply(truth[name])
        seen |= self._satellite(truth)
        for name, low_pass in self._filters.items():
            seen[name] = low_pass.apply(seen[name])
        for name, delay in self._delays.items():
            seen[name] = delay.apply(seen[name])
        if self._flaws.sensors.clock_jitter_s:
            for names in (INERTIAL, STEERING, WHEELS):
                self._jitter(seen, names)
        return seen

    def _shaken(self, truth: Mapping[str, FloatArray]) -> Mapping[str, FloatArray]:
        """Return what an uneven road makes of accelerations and wheel speeds."""
        if self._vibration is None:
            return truth
        shaken = self._vibration.next(truth["vx_mps"])
        wheels = {
            name: truth[name] * (1 + one)
            for name, one in zip(WHEELS, shaken[FIRST_WHEEL:], strict=True)
        }
        ax, ay = truth["ax_mps2"] + shaken[AX], truth["ay_mps2"] + shaken[AY]
        return {**truth, **wheels, "ax_mps2": ax, "ay_mps2": ay}

    def _let_drift(self, seen: dict[str, FloatArray]) -> None:
        """Let the biases of the inertial unit change within the drive."""
        sensors = self._flaws.sensors
        acceleration, rate = sensors.acceleration_drift_mps2, sensors.yaw_rate_drift_rad_s
        if acceleration or rate:
            self._drift = self._drift or Wander(3, sensors.drift_s, self._generator)
            errors = self._drift.next(len(seen[LABEL]))
            for name, std, error in zip(
                INERTIAL, (acceleration, acceleration, rate), errors, strict=True
            ):
                seen[name] = seen[name] + std * error

    def _jitter(self, seen: dict[str, FloatArray], names: tuple[str, ...]) -> None:
        """Make the values of one message older, up to the jitter, each by another time."""
        most = self._flaws.sensors.clock_jitter_s / SAMPLE_S
        late = most * self._generator.random(len(seen[LABEL]))
        for name in names:
            now = seen[name]
            before = np.concatenate([[self._latest.get(name, now[0])], now[:-1]])
            self._latest[name] = float(now[-1])
            seen[name] = now - late * (now - before)

    def _reference(self, truth: Mapping[str, FloatArray]) -> FloatArray:
        """Return the label's angle at its sensor: of the velocities there, by small angles."""
        sensors = self._flaws.sensors
        angle = truth[LABEL] + math.radians(sensors.label_offset_deg)
        if not (sensors.label_x_m or sensors.label_velocity_std_mps):
            return angle
        across = sensors.label_x_m * truth["yaw_rate_rad_s"]
        if sensors.label_velocity_std_mps:
            noise = self._generator.standard_normal(len(angle))
            across = across + sensors.label_velocity_std_mps * noise
        return angle + across / np.maximum(truth["vx_mps"], SLOWEST_LABEL_MPS)

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
            LABEL: self._reference(truth),
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
