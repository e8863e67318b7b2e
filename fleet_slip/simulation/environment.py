"""A gymnasium environment for stability controllers: `gymnasium.make("fleet_slip/SideSlip-v0")`.

A car is steered through a sine with dwell (FMVSS 126: 0.7 Hz, 0.5 s at the second peak). A
controller brakes single wheels and observes the signals that a fleet logs, with noise, biases and
rounding to counts. Importing this module registers the environment.
"""

import math
from dataclasses import dataclass
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from fleet_slip.catalog.catalog import Catalog, load_catalog
from fleet_slip.catalog.signals import SAMPLE_TIME_S
from fleet_slip.errors import UsageError
from fleet_slip.simulation.scenario import load_scenario
from fleet_slip.vehicle.dynamics import Wheels
from fleet_slip.vehicle.highway import FourWheelVehicle
from fleet_slip.vehicle.parameters import load_vehicle

Observation = NDArray[np.float32]
WHEELS = ("fl", "fr", "rl", "rr")

TICK_S = float(SAMPLE_TIME_S)
MAX_BRAKE_N = 5000.0
"""Brake force at the rim of a wheel for an action of 1, in N."""
BRAKE_LAG_S = 0.03
"""First-order lag of the hydraulic, in s."""
SINE_HZ = 0.7
DWELL_S = 0.5
START_S = 0.5
END_S = 5.0
LOST_SLIP_RAD = math.radians(60)
LOST_SPEED_MPS = 0.5
COMFORTABLE_SLIP_RAD = math.radians(5)
BRAKING_COSTS = 0.05


@dataclass(frozen=True)
class Trial:
    """A manoeuvre: speed, amplitude of the steering wheel, adhesion of the road."""

    speed_mps: float
    steering_rad: float
    adhesion: float

    def steering_at(self, time_s: float) -> float:
        """Return the angle of the steering wheel in rad at a time in s; the first half is left."""
        phase = (time_s - START_S) * SINE_HZ
        if phase >= 0.75:
            phase = max(0.75, phase - DWELL_S * SINE_HZ)
        return self.steering_rad * math.sin(2 * math.pi * phase) if 0 <= phase <= 1 else 0.0


class SideSlipEnv(gymnasium.Env[Observation, Observation]):
    """A sine with dwell; actions brake wheels.

    The observation contains `signals` in SI units, float32 of shape (10,). An action contains the
    brakes fl, fr, rl, rr from 0 to 1 for 10 ms, float32 of shape (4,). The reward is minus the
    squared side-slip angle in units of 5 degrees, with a small penalty for braking. An episode ends
    when the car has spun or stopped, or after 5 s. `info` contains what no series sensor measures:
    `sideslip_rad`, `vx_mps`, `vy_mps`, `adhesion`, `time_s` and the true `yaw_rate_rad_s`.

    Parameters
    ----------
    vehicle
        Name of the car, or path of its file.
    speed_mps, steering_rad, adhesion
        Ranges of the trials: speed, amplitude of the steering wheel, adhesion.
    sensors
        False: the signals are the true ones.
    catalog
        Signals and configs; by default the shipped ones.

    Raises
    ------
    ConfigError
        If the car is unknown.
    UsageError
        If a range is not valid.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 - as gymnasium declares it

    def __init__(
        self,
        vehicle: str = "d_class_sedan",
        speed_mps: tuple[float, float] = (20.0, 30.0),
        steering_rad: tuple[float, float] = (1.0, 3.5),
        adhesion: tuple[float, float] = (0.4, 1.0),
        sensors: bool = True,
        catalog: Catalog | None = None,
    ) -> None:
        ranges = {"speed_mps": speed_mps, "steering_rad": steering_rad, "adhesion": adhesion}
        for name, (low, high) in ranges.items():
            if not 0 < low <= high < math.inf:
                raise UsageError(
                    f"{name} = ({low}, {high}): give a minimum and a maximum, both above 0."
                )
        catalog = catalog or load_catalog()
        signals = [catalog.signals[name] for name in catalog.signals.inputs]
        self.signals = tuple(catalog.signals.inputs)
        self._scales = np.array([float(signal.scale) for signal in signals])
        self._limits = np.array([float(signal.max) for signal in signals])
        # Noise as in section III.A of the paper. Its biases are standard deviations between cars.
        errors = load_scenario("nominal", catalog.configs).sensors.bias_and_std
        self._bias_std, self._noise = np.array([errors[name] for name in self.signals]).T
        limits = self._limits.astype(np.float32)
        self.observation_space = Box(-limits, limits, dtype=np.float32)
        self.action_space = Box(0.0, 1.0, (len(WHEELS),), np.float32)
        self._ranges = (speed_mps, steering_rad, adhesion)
        self._vehicle, self._sensors = load_vehicle(vehicle, catalog.configs), sensors

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Draw a trial; `options` may set `speed_mps`, `steering_rad` and `adhesion`."""
        super().reset(seed=seed)
        speed, steering, adhesion = (self.np_random.uniform(*bounds) for bounds in self._ranges)
        side = 1.0 if self.np_random.random() < 0.5 else -1.0
        drawn = {"speed_mps": speed, "steering_rad": side * steering, "adhesion": adhesion}
        self.trial = Trial(**{**drawn, **(options or {})})
        self._car = FourWheelVehicle(
            None, [0.0, 0.0], 0.0, self.trial.speed_mps, self._vehicle, self.trial.adhesion
        )
        self._car.MAX_SPEED = math.inf
        self._brakes = np.zeros(len(WHEELS))
        self._bias = self._bias_std * self.np_random.standard_normal(len(self.signals))
        self._ticks = 0
        return self._observe(), self._info()

    def step(
        self, action: Observation
    ) -> tuple[Observation, SupportsFloat, bool, bool, dict[str, Any]]:
        """Advance by 10 ms."""
        demanded = np.clip(np.asarray(action, dtype=float), 0.0, 1.0)
        self._brakes += (demanded - self._brakes) * (1 - math.exp(-TICK_S / BRAKE_LAG_S))
        self._car.brakes = Wheels(*(MAX_BRAKE_N * self._brakes).tolist())
        angle = self.trial.steering_at(self._time_s) / self._vehicle.steering.ratio
        self._car.act({"steering": math.atan(angle), "acceleration": 0.0})
        self._car.step(TICK_S)
        self._ticks += 1
        slip = self._car.sideslip
        lost = abs(slip) > LOST_SLIP_RAD or self._car.motion.vx < LOST_SPEED_MPS
        reward = -((slip / COMFORTABLE_SLIP_RAD) ** 2) - BRAKING_COSTS * float(np.mean(demanded))
        truncated = self._time_s >= END_S
        return self._observe(), reward, bool(lost), bool(truncated), self._info()

    @property
    def _time_s(self) -> float:
        return self._ticks * TICK_S

    def _observe(self) -> Observation:
        """Return the signals with bias, noise and rounding to counts, within their ranges."""
        x, c = self._car.motion, self._car.constants
        tangent = c.steer_per_wheel * x.steering_wheel
        true = {
            "ax": self._car.last_motion.force[0],
            "ay": self._car.last_motion.force[1],
            "yaw_rate": x.yaw_rate,
            "steering_wheel": x.steering_wheel,
            "steer_fl": math.atan2(tangent, 1 - c.ackermann * tangent),
            "steer_fr": math.atan2(tangent, 1 + c.ackermann * tangent),
            **{f"wheel_{wheel}": getattr(x, f"wheel_{wheel}") for wheel in WHEELS},
        }
        values = np.array([true[name] for name in self.signals])
        if self._sensors:
            values += self._bias + self._noise * self.np_random.standard_normal(len(values))
            values = np.round(values / self._scales) * self._scales
        observed: Observation = np.clip(values, -self._limits, self._limits).astype(np.float32)
        return observed

    def _info(self) -> dict[str, Any]:
        return {
            "sideslip_rad": self._car.sideslip,
            "vx_mps": self._car.motion.vx,
            "vy_mps": self._car.motion.vy,
            "yaw_rate_rad_s": self._car.motion.yaw_rate,
            "adhesion": self.trial.adhesion,
            "time_s": self._time_s,
        }


gymnasium.register("fleet_slip/SideSlip-v0", f"{__name__}:{SideSlipEnv.__name__}")
