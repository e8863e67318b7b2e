"""What the lane kernel knows of a drive's road, and where a station stands in the tables."""

import math
from typing import Any

import numpy as np

from fleet_slip.compiling import equation

ROUTE = np.dtype(
    [
        ("first", np.int64),  # index of the road's first entry in the table of all roads
        ("last", np.int64),
        ("inverse_spacing", np.float64),
        ("length_m", np.float64),
        ("closed", np.bool_),
        ("distance_m", np.float64),
        ("samples", np.int64),  # most that the drive may take
    ]
)
"""What the kernel knows of a drive."""


@equation
def place(route: Any, station: float) -> tuple[int, float]:
    """Return the entry at or before a station, and how far towards the next the station is.

    A closed road's entries are continued beyond its length by what a driver sees ahead.
    """
    entries = station * route.inverse_spacing
    entry = min(max(math.floor(entries), 0), route.last - route.first - 1)
    return route.first + entry, min(max(entries - entry, 0.0), 1.0)
