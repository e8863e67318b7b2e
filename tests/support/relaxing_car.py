"""A single-track car whose tyres build up their forces along the way, at a given speed."""

import numpy as np

from fleet_slip.arrays import FloatArray

MASS_KG, INERTIA_KGM2, FRONT_M, REAR_M = 1500.0, 2400.0, 1.15, 1.75
FRONT_N, REAR_N, RELAXATION_M = 9e4, 1.1e5, 0.8
STEPS = 5


def drive_relaxing_car(steer: FloatArray, speed: FloatArray) -> dict[str, FloatArray]:
    """Return the signals of a car that steers its road wheels as given, at 100 Hz."""
    step_s = 0.01 / STEPS
    vy = yaw_rate = front = rear = 0.0
    states = np.zeros((steer.size, 3))
    for i, (angle, v) in enumerate(zip(steer.tolist(), speed.tolist(), strict=True)):
        for _ in range(STEPS):
            relax = step_s * v / RELAXATION_M
            front += relax * (FRONT_N * (angle - (vy + FRONT_M * yaw_rate) / v) - front)
            rear += relax * (-REAR_N * (vy - REAR_M * yaw_rate) / v - rear)
            vy += step_s * ((front + rear) / MASS_KG - v * yaw_rate)
            yaw_rate += step_s * (FRONT_M * front - REAR_M * rear) / INERTIA_KGM2
        states[i] = vy, yaw_rate, (front + rear) / MASS_KG
    return {
        "ay": states[:, 2],
        "yaw_rate": states[:, 1],
        "steer_fl": steer,
        "steer_fr": steer,
        "vx": speed,
        "sideslip": np.arctan2(states[:, 0], speed),
    }
