"""Drives of a made-up car: kinematics with noise, quick to make and easy to break."""

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from fleet_slip.regression.gram import Gram
from tests.support.catalog import SIGNALS

Signals = dict[str, NDArray[np.float64]]

TICKS = 3000
WHEELBASE_M, TRACK_M, RADIUS_M = 2.8, 1.5, 0.32
NOISE = {
    "ax": 0.1,
    "ay": 0.1,
    "yaw_rate": 0.01,
    "steering_wheel": 0.002,
    "steer_fl": 2e-4,
    "steer_fr": 2e-4,
    "sideslip": 5e-4,
}
WHEEL_NOISE = 0.02


def drive(rng: np.random.Generator, gentleness: float = 1.0) -> Signals:
    """Return the SI signals of one drive: slow changes of speed and of curvature.

    Some are wilder than sensors can tell; with a `gentleness` of 2, none.
    """
    speed = 15 + 5 * _wander(rng) / gentleness
    curvature = 0.02 * _wander(rng) / gentleness
    yaw_rate = speed * curvature
    steer = np.arctan(WHEELBASE_M * curvature) + 0.002 * yaw_rate * speed
    half = TRACK_M / 2
    wheels = {
        f"wheel_{end}{side}": (speed + sign * half * yaw_rate) / RADIUS_M
        for end in "fr"
        for side, sign in (("l", -1), ("r", 1))
    }
    true = {
        "ax": np.gradient(speed) * 100,
        "ay": yaw_rate * speed,
        "yaw_rate": yaw_rate,
        "steering_wheel": 16 * steer,
        "steer_fl": steer + half / WHEELBASE_M * steer**2,
        "steer_fr": steer - half / WHEELBASE_M * steer**2,
        "sideslip": curvature * 1.3 - 0.003 * yaw_rate * speed,
        **wheels,
    }
    return {
        name: values + NOISE.get(name, WHEEL_NOISE) * rng.standard_normal(TICKS)
        for name, values in true.items()
    }


def counts(signals: Mapping[str, NDArray[np.float64]]) -> dict[str, NDArray[np.int16]]:
    """Return signals in counts."""
    return {
        name: np.rint(values / float(SIGNALS[name].scale)).astype(np.int16)
        for name, values in signals.items()
    }


def gram_of(counts: Mapping[str, NDArray[np.int16]]) -> Gram:
    """Return the Gram of a drive's counts."""
    names = SIGNALS.gram_signals
    return Gram.from_counts(names, np.column_stack([counts[n].astype(np.int64) for n in names]))


def broken(signals: Signals, change: Callable[[Signals], None]) -> Signals:
    """Return the signals with a fault, which `change` makes in place."""
    copy = {name: values.copy() for name, values in signals.items()}
    change(copy)
    return copy


def _wander(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a smooth random course of about unit size."""
    time_s = np.arange(TICKS) / 100
    periods_s = rng.uniform(4, 20, 5)
    phases = rng.uniform(0, 2 * np.pi, 5)
    waves = np.sin(2 * np.pi * time_s[:, None] / periods_s + phases)
    return np.asarray(waves.sum(axis=1) / np.sqrt(2.5))


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
