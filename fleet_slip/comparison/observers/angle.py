"""The side-slip angle of an estimated velocity."""

import numpy as np

from fleet_slip.arrays import FloatArray

SLOWEST_MPS = 1.0
"""Longitudinal velocity below which the angle is taken as if the car drove so fast."""


def sideslip_angle(vx_mps: FloatArray, vy_mps: FloatArray) -> FloatArray:
    """Return β = arctan(vy / vx) in rad, equations (12) and (13).

    At rest the quotient has no limit and noise would turn the angle by up to π. Below
    `SLOWEST_MPS`, and in reverse, vx is therefore replaced by `SLOWEST_MPS`: β stays continuous and
    goes to zero with vy. NaN stays NaN.
    """
    return np.arctan2(vy_mps, np.maximum(vx_mps, SLOWEST_MPS))
