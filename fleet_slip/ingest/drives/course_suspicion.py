"""What looks wrong in a course: it turns as the yaw rate does, and slips as a car does."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.course_change import COURSE, LARGEST_RAD
from fleet_slip.catalogue.course_relation import CourseFault, CourseRelation, relate
from fleet_slip.catalogue.signals import SAMPLE_TIME_S
from fleet_slip.ingest.drives.relations import slope_of

SECOND = round(1 / float(SAMPLE_TIME_S))
APART = 4 * SECOND
LEAST_CORRELATION = 0.6
SOUND = (0.8, 1.25)
"""Of the course's change to the yaw rate's integral, and of the receiver's speed to the wheels'."""
LEAST_OF_THEIR_OWN = 0.9
MOST_SCALE_ERROR = 0.02
LEAST_SPEED_MPS = 3.0
SPEED = "satellite_speed"


def course_fault(
    signals: Mapping[str, FloatArray], speed: FloatArray | None = None
) -> CourseFault | None:
    """Return what fault the course of a drive seems to have; `speed` is that of the wheels."""
    if not {"course", "yaw_rate"} <= set(signals):
        return None
    course, turned = signals["course"], np.cumsum(signals["yaw_rate"]) * float(SAMPLE_TIME_S)
    change = _wrapped(course[SECOND:] - course[:-SECOND])
    slope, correlation = slope_of(
        change, turned[SECOND:] - turned[:-SECOND], np.ones(change.size, dtype=np.bool_)
    )
    if (slope, correlation) != (1.0, 0.0):  # else it is too little to tell
        figure = f"over a second it changes by {slope:+.2f} times what the yaw rate adds up to"
        if correlation < -LEAST_CORRELATION:
            remedy = "Turn clockwise_from_north, or swap north and east."
            return CourseFault("reversed", (COURSE,), figure, remedy)
        if correlation < LEAST_CORRELATION:
            figure = f"over a second its change hardly goes with the yaw rate ({correlation:+.2f})"
            remedy = "Is it a course over ground, and of this car?"
            return CourseFault("values", (COURSE,), figure, remedy)
        if not SOUND[0] <= slope <= SOUND[1]:
            remedy = "Check its unit, and that of the yaw rate."
            return CourseFault("scaled", (COURSE,), figure, remedy)
    return _of_fixes(signals, speed) or _of_relation(_relation(signals, turned))


def _of_fixes(signals: Mapping[str, FloatArray], speed: FloatArray | None) -> CourseFault | None:
    """Return what is wrong with the receiver's speed, or with how many fixes have a course."""
    told = signals.get("satellite_speed")
    if told is None:
        return None
    fast = told > LEAST_SPEED_MPS
    own = float(np.isfinite(signals["course"][fast]).mean()) if fast.any() else 1.0
    if own < LEAST_OF_THEIR_OWN:
        figure = f"{1 - own:.0%} of its fixes repeat it while the car turns, or are of backwards"
        remedy = "They are left out. Map it as the receiver tells it."
        return CourseFault("values", (COURSE,), figure, remedy)
    both = fast & (speed > LEAST_SPEED_MPS) if speed is not None else fast
    if speed is not None and both.sum() >= SECOND:
        ratio = float(np.median(told[both] / speed[both]))
        if not SOUND[0] <= ratio <= SOUND[1]:
            figure = f"it is {ratio:.2f} times the speed of the wheels"
            remedy = "Check both units: the antenna's place is by it."
            return CourseFault("scaled", (SPEED,), figure, remedy)
    return None


def _of_relation(relation: CourseRelation | None) -> CourseFault | None:
    if relation is None:
        return None
    if fault := relation.fault or relation.misplaced:
        return replace(fault, signals=(COURSE,))
    if abs(relation.scale - 1) > MOST_SCALE_ERROR:
        figure = f"it turns {relation.scale:.3f} times as the yaw rate adds up to"
        remedy = "The gyroscope's is off, which learning allows for."
        return CourseFault("scale", (COURSE,), figure, remedy)
    return None


def _relation(signals: Mapping[str, FloatArray], turned: FloatArray) -> CourseRelation | None:
    """Return what changes over some seconds come to, by the receiver's own speed."""
    if not {"ay", "satellite_speed"} <= set(signals):
        return None
    yaw_rate, speed = signals["yaw_rate"], signals["satellite_speed"]
    fast = np.where(speed > LEAST_SPEED_MPS, speed, np.nan)
    series = np.array([yaw_rate / fast, signals["ay"], yaw_rate, turned, signals["course"]])
    changes = series[:, APART:] - series[:, :-APART]
    changes[4] = _wrapped(changes[4] - changes[3])
    sound = np.isfinite(changes).all(axis=0) & (np.abs(changes[4]) <= float(LARGEST_RAD))
    rows = np.vstack([np.ones(int(sound.sum())), changes[:, sound]])
    return relate(rows @ rows.T)


def _wrapped(angle: FloatArray) -> FloatArray:
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)
