"""A car by the textbook: a linear bicycle with four wheels, for tests of what drives look like."""

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.quality.drive_signals import RADIUS_M, TRACK_M

Car = dict[str, FloatArray]


def a_car(least_mps: float = 8.0) -> Car:
    """One minute of a linear bicycle without load transfer, driven on bends both ways."""
    time_s = np.arange(6000) / 100
    speed = least_mps + 6 + 4 * np.sin(0.3 * time_s)
    ax = np.gradient(speed, 0.01)
    curvature = (0.02 + 0.04 * (least_mps < 4)) * (
        np.sin(0.9 * time_s) + 0.4 * np.sin(2.3 * time_s)
    )
    yaw_rate, ay = curvature * speed, curvature * speed**2
    road_wheel = 2.7 * curvature + 0.003 * ay
    inner, right = (1 - curvature * TRACK_M / 2, 1 + curvature * TRACK_M / 2)
    longer = np.sqrt(1 + (2.7 * curvature) ** 2)
    return {
        "ax": ax,
        "ay": ay,
        "yaw_rate": yaw_rate,
        "steering_wheel": 15 * road_wheel,
        "wheel_fl": speed * inner * longer / RADIUS_M,
        "wheel_fr": speed * right * longer / RADIUS_M,
        "wheel_rl": speed * inner / RADIUS_M,
        "wheel_rr": speed * right / RADIUS_M,
        "sideslip": 1.4 * yaw_rate / speed - 0.004 * ay,
    }


def winding_car(seed: int = 1, seconds: float = 90.0) -> Car:
    """Return a car on a road without a period, as signals with noise."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(round(100 * seconds)) / 100
    waves = zip((0.3, 0.7, 1.1, 1.9), rng.uniform(0, 6, 4), strict=True)
    curvature = sum(0.006 * np.sin(rate * time_s + phase) for rate, phase in waves)
    speed = 14 + 4 * np.sin(0.11 * time_s)
    ay, yaw_rate = curvature * speed**2, curvature * speed
    car = {
        "ax": np.gradient(speed, 0.01),
        "ay": ay,
        "yaw_rate": yaw_rate,
        "steering_wheel": 15 * (2.7 * curvature + 0.003 * ay),
        "wheel_fl": (speed - 0.775 * yaw_rate) / 0.31,
        "wheel_fr": (speed + 0.775 * yaw_rate) / 0.31,
        "wheel_rl": (speed - 0.775 * yaw_rate) / 0.31,
        "wheel_rr": (speed + 0.775 * yaw_rate) / 0.31,
        "sideslip": 1.4 * curvature - 0.004 * ay,
    }
    return {name: v + 0.03 * v.std() * rng.normal(size=v.size) for name, v in car.items()}
