"""Signals that tell which way a car turns."""

from collections.abc import Mapping

WITNESSES: Mapping[str, Mapping[str, int]] = {
    "ay": {"ay": 1},
    "yaw_rate": {"yaw_rate": 1},
    "steering_wheel": {"steering_wheel": 1},
    "steer_fl": {"steer_fl": 1},
    "steer_fr": {"steer_fr": 1},
    "front wheels": {"wheel_fl": -1, "wheel_fr": 1},
    "rear wheels": {"wheel_rl": -1, "wheel_rr": 1},
}
"""What is positive in a left turn (ISO 8855), as a combination of signals: right wheels run faster
than left ones."""
