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
    left, right = (1 - curvature * TRACK_M / 2, 1 + curvature * TRACK_M / 2)
    longer = np.sqrt(1 + (2.7 * curvature) ** 2)
    return {
        "ax": ax,
        "ay": ay,
        "yaw_rate": yaw_rate,
        "steering_wheel": 15 * road_wheel,
        "wheel_fl": speed * left * longer / RADIUS_M,
        "wheel_fr": speed * right * longer / RADIUS_M,
        "wheel_rl": speed * left / RADIUS_M,
        "wheel_rr": speed * right / RADIUS_M,
        "sideslip": 1.4 * yaw_rate / speed - 0.004 * ay,
    }
