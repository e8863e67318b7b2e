"""What looks wrong in a course: over a second it changes as the yaw rate's integral does."""

from collections.abc import Mapping

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.signals import SAMPLE_TIME_S
from fleet_slip.ingest.drives.relations import slope_of

SECOND = round(1 / float(SAMPLE_TIME_S))
LEAST_CORRELATION = 0.6
SOUND = (0.8, 1.25)


def course_fault(signals: Mapping[str, FloatArray]) -> tuple[str, str, str] | None:
    """Return what kind of fault the course of a drive seems to have, its figure and a remedy."""
    if not {"course", "yaw_rate"} <= set(signals):
        return None
    course, turned = signals["course"], np.cumsum(signals["yaw_rate"]) * float(SAMPLE_TIME_S)
    change = course[SECOND:] - course[:-SECOND]
    change = (change + np.pi) % (2 * np.pi) - np.pi
    slope, correlation = slope_of(
        change, turned[SECOND:] - turned[:-SECOND], np.ones(change.size, dtype=np.bool_)
    )
    if (slope, correlation) == (1.0, 0.0):  # too little to tell
        return None
    figure = f"over a second it changes by {slope:+.2f} times what the yaw rate adds up to"
    if correlation < -LEAST_CORRELATION:
        return "sign", figure, "Turn clockwise_from_north round, or swap north and east."
    if correlation < LEAST_CORRELATION:
        figure = f"over a second its change hardly goes with the yaw rate ({correlation:+.2f})"
        return "values", figure, "Is it a course over ground, and of this car?"
    if not SOUND[0] <= slope <= SOUND[1]:
        return "unit", figure, "Check its unit, and that of the yaw rate."
    return None
