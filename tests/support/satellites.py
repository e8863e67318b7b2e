"""What a receiver logs of a made-up drive: `tests.support.cars`, whose label is its slip."""

import numpy as np
from numpy.typing import NDArray

from tests.support.cars import RADIUS_M, Signals

FIX = 10
NOISE_MPS = 0.03


def speed_of(signals: Signals) -> NDArray[np.float64]:
    wheels = ("wheel_fl", "wheel_fr", "wheel_rl", "wheel_rr")
    return np.asarray(np.mean([signals[name] for name in wheels], axis=0) * RADIUS_M)


def with_course(signals: Signals, rng: np.random.Generator, slip: float = 1.0) -> Signals:
    """Return the signals with course and speed, NaN between fixes; without slip it is a heading."""
    speed = speed_of(signals)
    course = np.cumsum(signals["yaw_rate"]) / 100 + slip * signals["sideslip"]
    course += NOISE_MPS / speed * rng.standard_normal(course.size)
    fixes = np.arange(course.size) % FIX == 0
    return {
        **signals,
        "course": np.where(fixes, (course + np.pi) % (2 * np.pi) - np.pi, np.nan),
        "satellite_speed": np.where(fixes, speed, np.nan),
    }
