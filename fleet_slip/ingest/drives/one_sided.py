"""Finds what turns to one side alone, though the car turns to both: a magnitude without its sign.

Some buses send a rate or an angle as a magnitude, and its sign as a bit of its own.
"""

from collections.abc import Iterator, Mapping

import numpy as np

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.catalogue.signals import SAMPLE_TIME_S

TURNING = ("ay", "yaw_rate", "steering_wheel", "steer", "steer_fl", "steer_fr", "sideslip")
LEAST_S = 60.0
"""Who drives for less may well turn to one side."""
_SMALL = 0.02
"""Part of the usual largest value that noise and zero points reach on the other side."""


def find_one_sided(
    signals: Mapping[str, FloatArray], moving: BoolArray | None
) -> Iterator[tuple[str, str]]:
    """Yield the signals that never change their sign, and the figure that shows it.

    `moving` are the ticks to look at, None for all. Nothing is said of a car whose rear wheels tell
    that it does turn to one side, as on an oval.
    """
    if {"wheel_rl", "wheel_rr"} <= set(signals) and _side(
        signals["wheel_rr"] - signals["wheel_rl"], moving
    ):
        return
    for name in TURNING:
        if name in signals and (side := _side(signals[name], moving)):
            never, minutes = ("negative" if side > 0 else "positive"), signals[name].size / 6000
            yield name, f"it is never {never} in {minutes:.0f} min"


def _side(values: FloatArray, moving: BoolArray | None) -> int:
    """Return +1 or -1 for values on one side of zero alone, 0 for others, or too few."""
    looked_at = np.isfinite(values) if moving is None else np.isfinite(values) & moving
    present = values[looked_at]
    if present.size * float(SAMPLE_TIME_S) < LEAST_S:
        return 0
    low, high = np.quantile(present, [0.001, 0.999])
    if max(-low, high) <= 0:
        return 0
    if low >= -_SMALL * high:
        return 1
    return -1 if high <= -_SMALL * low else 0
