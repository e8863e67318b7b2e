"""What sensors make of the truth before bias and noise: place, tilt, delay, pulses, lasting errors.

A drive comes in blocks; what a block leaves behind is kept for the next.
"""

import math
from collections.abc import Mapping

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.compiling import kernel
from fleet_slip.simulation.imperfections import Imperfections
from fleet_slip.vehicle.driver import SAMPLE_S
from fleet_slip.vehicle.parameters import GRAVITY_MPS2

WHEELS = ("wheel_fl_rad_s", "wheel_fr_rad_s", "wheel_rl_rad_s", "wheel_rr_rad_s")
INERTIAL = ("ax_mps2", "ay_mps2", "yaw_rate_rad_s")
STEERING = ("steering_wheel_rad", "steer_fl_rad", "steer_fr_rad")
GPS = ("gps_vx_mps", "gps_vy_mps")
LABEL = "sideslip_rad"


class Distortion:
    """The sensors of one car in one drive."""

    def __init__(
        self,
        flaws: Imperfections,
        of_car: np.random.Generator,
        of_drive: np.random.Generator,
    ) -> None:
        """Begin a drive. The pulses' places come from the car's generator, all else from the
        drive's.
        """
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
        self._heading_rad, self._gps_x, self._gps_y = 0.0, 0.0, 0.0
        self._begun = False

    def apply(self, truth: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Return the next block as the sensors see it, with satellite velocity besides."""
        seen = dict(truth)
        seen |= self._accelerations(truth)
        seen |= self._angles(truth)
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

        At (x, y) from the centre of gravity a body that turns has the specific force
        ax − r² x − ṙ y, ay + ṙ x − r² y; tilted by roll φ and pitch θ it reads a part of the
        weight's reaction g sin φ, g sin θ (Kidambi et al. 2014).
        """
        sensors, car = self._flaws.sensors, self._flaws.car
        r, turning = truth["yaw_rate_rad_s"], truth["yaw_acceleration_rad_s2"]
        x, y = sensors.inertial_x_m, sensors.inertial_y_m
        ax = truth["ax_mps2"] - r * r * x - turning * y
        ay = truth["ay_mps2"] + turning * x - r * r * y
        per_ay = math.radians(car.roll_gradient_deg_per_g) / GRAVITY_MPS2
        per_ax = math.radians(car.pitch_gradient_deg_per_g) / GRAVITY_MPS2
        roll = per_ay * truth["leaning_ay_mps2"] + math.radians(sensors.inertial_roll_deg)
        pitch = per_ax * truth["leaning_ax_mps2"] + math.radians(sensors.inertial_pitch_deg)
        yaw = math.radians(sensors.inertial_yaw_deg)
        ax = _cosine(pitch) * ax + GRAVITY_MPS2 * _sine(pitch)
        ay = _cosine(roll) * ay + GRAVITY_MPS2 * _sine(roll)
        return {
            "ax_mps2": ax + yaw * ay,
            "ay_mps2": ay - yaw * ax,
            "yaw_rate_rad_s": _cosine(roll) * r,
        }

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
        ticks, correlation_s = len(vx), sensors.gps_correlation_s
        noise = self._generator.standard_normal((3, ticks))
        if not self._begun:
            self._heading_rad, self._gps_x, self._gps_y = self._generator.standard_normal(3)
            self._begun = True
        heading, self._heading_rad = _wander(noise[0], self._heading_rad, correlation_s)
        error_x, self._gps_x = _wander(noise[1], self._gps_x, correlation_s)
        error_y, self._gps_y = _wander(noise[2], self._gps_y, correlation_s)
        heading *= math.radians(sensors.gps_heading_std_deg)
        return {
            "gps_vx_mps": vx + heading * vy + sensors.gps_velocity_std_mps * error_x,
            "gps_vy_mps": vy - heading * vx + sensors.gps_velocity_std_mps * error_y,
        }


def _sine(angle: FloatArray) -> FloatArray:
    """Return the sine of angles below 0.3 rad to 2e-5, the same bits everywhere."""
    return angle * (1 - angle * angle / 6)


def _cosine(angle: FloatArray) -> FloatArray:
    return 1 - angle * angle / 2


class Delay:
    """A signal that comes late; between samples it is linear, before the first one constant."""

    def __init__(self, latency_s: float) -> None:
        """Take the latency."""
        self._ticks = latency_s / SAMPLE_S
        self._before: FloatArray | None = None

    def apply(self, values: FloatArray) -> FloatArray:
        """Return the next block, delayed."""
        if self._ticks == 0.0:
            return values
        whole = math.floor(self._ticks)
        part = self._ticks - whole
        if self._before is None:
            self._before = np.full(whole + 1, values[0])
        known = np.append(self._before, values)
        self._before = known[-(whole + 1) :]
        end = len(known)
        return (1 - part) * known[1 : end - whole] + part * known[: end - whole - 1]


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


class Pulses:
    """A wheel speed sensor that times the pulses of an encoder.

    At every sample it reports the pulses since the last report over their time; where none came, no
    more than that one comes right now. Pulses stand where the encoder's teeth are.
    """

    def __init__(self, places: FloatArray) -> None:
        """Take how far each pulse of a turn stands from its place, over their distance."""
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
def _wander(noise: FloatArray, start: float, correlation_s: float) -> tuple[FloatArray, float]:
    """Return a Gauss-Markov process of standard deviation 1, and where the next block starts."""
    decay = 1.0 - SAMPLE_S / correlation_s
    kick = math.sqrt(1.0 - decay * decay)
    values = np.empty(len(noise))
    value = start
    for i in range(len(noise)):
        values[i] = value
        value = decay * value + kick * noise[i]
    return values, value


@kernel
def _low_pass(values: FloatArray, before: float, output: float, gain: float) -> FloatArray:
    filtered = np.empty(len(values))
    for i in range(len(values)):
        output += gain * (values[i] + before - 2.0 * output)
        before = values[i]
        filtered[i] = output
    return filtered


@kernel
def _timed_pulses(speed: FloatArray, places: FloatArray, state: FloatArray) -> FloatArray:
    """Fill in what the sensor reports.

    `state` is the turned angle in pulses, the last pulse's number, the samples since it came, the
    speed before, and the report.
    """
    turned, last, since, before, report = state
    count = len(places)
    per_sample = count * SAMPLE_S / (2.0 * math.pi)
    reports = np.empty(len(speed))
    for i in range(len(speed)):
        step = 0.5 * (before + speed[i]) * per_sample
        turned += step
        since += 1.0
        pulse = math.floor(turned)
        while pulse > last and turned < pulse + places[int(pulse) % count]:
            pulse -= 1.0
        if pulse > last and step > 0.0:
            ago = (turned - pulse - places[int(pulse) % count]) / step
            report = (pulse - last) / (max(since - ago, 1e-3) * per_sample)
            last, since = pulse, ago
        elif since > 0.0:
            report = min(report, 1.0 / (since * per_sample))
        reports[i] = report
        before = speed[i]
    state[0], state[1], state[2], state[3], state[4] = turned, last, since, before, report
    return reports
