"""Where a drive has no GPS fix: in a city's streets, or a tunnel.

The pattern is drawn from a generator that the caller seeds, so that every estimator meets the same.
"""

import numpy as np

from fleet_slip.arrays import BoolArray
from fleet_slip.comparison.observers.signals import STEP_S

URBAN_FIX_S = 15.0
URBAN_LOST_S = 10.0
"""Mean times with and without a fix between high buildings, each exponentially distributed."""

TUNNEL_S = 20.0
"""Time in the tunnel."""


def urban(rows: int, generator: np.random.Generator) -> BoolArray:
    """Return where a drive through a city has no fix; it begins with one."""
    lost = np.zeros(rows, dtype=np.bool_)
    end_s = 0.0
    while end_s < rows * STEP_S:
        begin_s = end_s + generator.exponential(URBAN_FIX_S)
        end_s = begin_s + generator.exponential(URBAN_LOST_S)
        lost[int(begin_s / STEP_S) : int(end_s / STEP_S)] = True
    return lost


def tunnel(rows: int, begin_s: float) -> BoolArray:
    """Return where a drive with one tunnel of `TUNNEL_S` has no fix."""
    time_s = np.arange(rows) * STEP_S
    lost: BoolArray = (time_s >= begin_s) & (time_s < begin_s + TUNNEL_S)
    return lost
