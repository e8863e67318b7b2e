"""Which fixes of a satellite receiver tell where the car goes: not all that have a course do."""

import numpy as np

from fleet_slip.arrays import BoolArray, FloatArray, IntArray
from fleet_slip.catalogue.signals import SAMPLE_TIME_S

STEP_S = float(SAMPLE_TIME_S)
SAME_RAD = 1e-6
"""A course is finer; of two velocities one that stands still differs by rounding."""
HELD_RAD = 0.005
"""What a car may turn while its course stays the same: half a degree is a coarse receiver's."""
BACKWARDS_MPS = 8.0
"""Nobody drives backwards faster."""
LEAST_TURNING_RAD_S = 0.1
"""An accelerometer that is off by 0.15 m/s² seems to drive backwards at 1.5 m/s then, no faster."""


def is_held(course: FloatArray, yaw_rate: FloatArray, place: IntArray) -> BoolArray:
    """Return which fixes repeat a course from before the car turned on.

    Receivers hold the course when they are slow, or tell it less often than the speed. `place` says
    at which tick each fix is; `course` is of the fixes, and `yaw_rate` of the ticks.
    """
    if not course.size:
        return np.zeros(0, dtype=np.bool_)
    heading = np.cumsum(np.nan_to_num(yaw_rate))[place] * STEP_S
    new = np.append(True, np.abs(np.diff(course)) > SAME_RAD)
    first = np.maximum.accumulate(np.where(new, np.arange(course.size), 0))
    held: BoolArray = ~new & (np.abs(heading - heading[first]) > HELD_RAD)
    return held


def is_backwards(
    yaw_rate: FloatArray, ay: FloatArray, speed: FloatArray, place: IntArray
) -> BoolArray:
    """Return at which fixes the car drives backwards: it is pushed to the outside of its bend.

    The lateral acceleration is the yaw rate times the forward speed, here by least squares over the
    second around a fix. Straight on it does not tell, and the course is right all the same.
    """
    second = np.ones(2 * round(0.5 / STEP_S) + 1)
    if not place.size:
        return np.zeros(0, dtype=np.bool_)
    squares, products = (
        np.convolve(np.nan_to_num(one), second)[second.size // 2 :][place]
        for one in (yaw_rate**2, yaw_rate * ay)
    )
    turning = squares > second.size * LEAST_TURNING_RAD_S**2
    backwards: BoolArray = turning & (speed < BACKWARDS_MPS) & (products < -0.5 * speed * squares)
    return backwards
