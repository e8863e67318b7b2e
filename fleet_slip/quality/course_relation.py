"""The relation of a course to the motion of a car, in a drive or in sums over its changes."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalog.course import (
    COURSE,
    MAX_CHANGE_RAD,
    SATELLITE_SPEED,
    TURNED,
    YAW_RATE,
)
from fleet_slip.catalog.signals import SAMPLE_TIME_S
from fleet_slip.quality.checks import CHECKS, Fault
from fleet_slip.quality.drive_signals import (
    MIN_CORRELATION,
    TICKS_PER_S,
    Signals,
    slope_of,
    wrap_angle,
)

# Over some seconds the course changes by the integral of the yaw rate, `TURNED`, and by the change
# of the side-slip angle. On roads this is nearly the angle of a car whose rear axle is l behind the
# centre of gravity and has the compliance K:
#
#     label = l Δ(yaw rate / speed) + K Δay + s TURNED + const,    l > 0, K < 0.
#
# Least squares estimates l and K, the scale 1 + s, and a noise; times speed it is the noise of the
# receiver. Wrong courses have other values: a heading has neither l nor K, a course of the other
# sense has the scale -1, and a stuck course has 0. A misplaced antenna or a late fix changes l.

COLUMNS = ("curvature", "ay", YAW_RATE, TURNED)
"""Columns of a Gram row of changes, before the label."""
USUAL_LEVER_M, USUAL_COMPLIANCE = 1.35, 0.006
"""Values of a passenger car: l in m and K in rad per m/s²."""
MIN_CHANGES = 100
MIN_TURNED_RAD = 0.05
LEVERS_M = (CHECKS["place of the antenna"].low, CHECKS["place of the antenna"].high)
MIN_EXPLAINED, MAX_EXPLAINED_NOISE_MPS = 0.15, 0.8
"""Explained share from which the relation may have this noise; below, only that of the check."""


@dataclass(frozen=True)
class CourseRelation:
    """The relation of a course's changes to those of the other signals.

    Attributes
    ----------
    scale
        Ratio of the course's change to the integral of the yaw rate.
    lever_m, compliance
        The estimates of l in m and of K in rad per m/s².
    slip
        Standard deviation of the side-slip by l and K, over that of a usual car.
    slip_error
        Standard error of `slip`.
    noise_mps
        Noise of one fix, across the car.
    explained
        Share by l and K of the variance that the yaw rate does not explain.
    """

    scale: float
    lever_m: float
    compliance: float
    slip: float
    slip_error: float
    noise_mps: float
    explained: float

    @property
    def fault(self) -> Fault | None:
        """Return the first relation of cars that the course contradicts."""
        explains = self.explained >= MIN_EXPLAINED
        is_tolerated = explains and self.noise_mps <= MAX_EXPLAINED_NOISE_MPS
        values = {
            "sense of the course": self.scale,
            "stuck course": abs(self.scale),
            "noise of the course": 0.0 if is_tolerated else self.noise_mps,
            "scale of the course": self.scale,
            "heading in place of a course": self.slip + 2 * self.slip_error,
        }
        for name, value in values.items():
            signals = (YAW_RATE, COURSE) if name == "scale of the course" else (COURSE,)
            for fault in CHECKS[name].test(value, *signals, **vars(self)):
                return fault
        return None

    @property
    def misplaced(self) -> Fault | None:
        """Return a fault if the course is measured outside of any car's centre of gravity."""
        check = CHECKS["place of the antenna"]
        return next(iter(check.test(self.lever_m, COURSE, lever_m=self.lever_m)), None)


def relate(moments: FloatArray, delay_s: float = 0.0) -> CourseRelation | None:
    """Return the relation in a matrix of sums of products, None if there is too little driving.

    `moments` has the shape (6, 6): 1, `COLUMNS` and the label, in SI units. The correction of a
    course that is `delay_s` late is this delay times the change of the yaw rate.
    """
    changes = float(moments[0, 0])
    if changes < MIN_CHANGES:
        return None
    on_time = np.eye(6)
    on_time[5, 3] = delay_s
    about = on_time @ moments @ on_time.T / changes
    about = about - np.outer(about[0], about[0])
    variances = np.diag(about)
    if variances[4] < MIN_TURNED_RAD**2 or not (variances[1:4] > 0).all():
        return None
    used = np.array([1, 2, 4])
    unit = np.sqrt(variances[used])
    inverse = np.linalg.pinv(about[np.ix_(used, used)] / np.outer(unit, unit), rcond=1e-9)
    inverse /= np.outer(unit, unit)
    lever, compliance, scale = inverse @ about[used, 5]
    fitted = np.array([lever, compliance, scale])
    residual = max(float(variances[5] - fitted @ about[used, 5]), 0.0)
    turning = float(variances[5] - about[4, 5] ** 2 / variances[4])
    usual = USUAL_LEVER_M**2 * variances[1] + USUAL_COMPLIANCE**2 * variances[2]
    errors = residual / changes * np.diag(inverse)
    speed = float(about[2, 3] / variances[3])  # lateral acceleration is yaw rate times speed
    return CourseRelation(
        1 + float(scale),
        float(lever),
        float(compliance),
        float(np.sqrt((lever**2 * variances[1] + compliance**2 * variances[2]) / usual)),
        float(np.sqrt((errors[0] * variances[1] + errors[1] * variances[2]) / usual)),
        float(np.sqrt(residual / 2)) * abs(speed),
        1 - residual / turning if turning > 0 else 0.0,
    )


# The course changes as the car turns and slips.

COURSE_CHANGE_TICKS = 4 * TICKS_PER_S
MIN_COURSE_MPS = 3.0
"""Minimum speed: fixes of receivers are too noisy below it."""


def check_course(signals: Signals) -> Iterator[Fault]:
    """Compare a course with the yaw rate and the side-slip of cars; the first fault decides."""
    if not {"course", "yaw_rate"} <= set(signals):
        return
    course, turned = signals["course"], np.cumsum(signals["yaw_rate"]) * float(SAMPLE_TIME_S)
    change = wrap_angle(course[TICKS_PER_S:] - course[:-TICKS_PER_S])
    scale, correlation = slope_of(
        change, turned[TICKS_PER_S:] - turned[:-TICKS_PER_S], np.isfinite(change)
    )
    if correlation:
        if correlation < -MIN_CORRELATION:
            yield CHECKS["sense of the course"].fault(COURSE, scale=scale)
        check = CHECKS["course of another car"]
        yield from check.test(correlation, COURSE, correlation=correlation)
        yield from CHECKS["unit of the course"].test(scale, COURSE, scale=scale)
    fast = signals.get(SATELLITE_SPEED, np.zeros(0)) > MIN_COURSE_MPS
    share = 1 - float(np.isfinite(course[fast]).mean()) if fast.any() else 0.0
    yield from CHECKS["repeated fixes"].test(share, COURSE, share=share)
    relation = _relation(signals, turned)
    if relation and (fault := relation.fault or relation.misplaced):
        yield Fault(fault.kind, (COURSE,), fault.figure, fault.remedy)
    elif relation:
        check = CHECKS["scale of the gyroscope"]
        yield from check.test(relation.scale, COURSE, scale=relation.scale)


def _relation(signals: Signals, turned: FloatArray) -> CourseRelation | None:
    """Return the relation of changes over some seconds, with the speed of the receiver."""
    if not {"ay", SATELLITE_SPEED} <= set(signals):
        return None
    yaw_rate, speed = signals["yaw_rate"], signals[SATELLITE_SPEED]
    fast = np.where(speed > MIN_COURSE_MPS, speed, np.nan)
    series = np.array([yaw_rate / fast, signals["ay"], yaw_rate, turned, signals["course"]])
    changes = series[:, COURSE_CHANGE_TICKS:] - series[:, :-COURSE_CHANGE_TICKS]
    changes[4] = wrap_angle(changes[4] - changes[3])
    sound = np.isfinite(changes).all(axis=0) & (np.abs(changes[4]) <= float(MAX_CHANGE_RAD))
    rows = np.vstack([np.ones(int(sound.sum())), changes[:, sound]])
    return relate(rows @ rows.T)
