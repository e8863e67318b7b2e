"""The relation of a course to the motion of a car, from sums over its changes."""

from dataclasses import dataclass

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalog.course import COURSE, TURNED, YAW_RATE
from fleet_slip.quality.checks import Fault

# What changes of the course tell of a car: a few figures, whose usual values are known.
#
# Over some seconds the course changes by the integral of the yaw rate, `TURNED`, and by the change
# of the side-slip angle, which on roads is nearly that of a car whose rear axle is l behind the
# centre of gravity and gives way by K:
#
#     label = l Δ(yaw rate / speed) + K Δay + s TURNED + const,    l > 0, K < 0.
#
# Least squares finds l and K, the scale 1 + s, and a noise, which times speed is a receiver's. What
# is no course misses these places: a heading has neither l nor K, one of another sense a scale of
# -1, one that stands still of 0, an antenna elsewhere or a late fix moves l.

COLUMNS = ("curvature", "ay", YAW_RATE, TURNED)
"""Of a Gram row of changes, before the label."""

USUAL_LEVER_M, USUAL_COMPLIANCE = 1.35, 0.006
FEWEST_CHANGES = 100
LEAST_TURNED_RAD = 0.05
SCALES = (0.9, 1.1)
REVERSED, STILL = -0.5, 0.35
"""Scales below the first are of the other sense, those nearer to 0 than the second stand still."""
LEAST_SLIP = 0.3
MOST_NOISE_MPS, LEAST_EXPLAINED = 0.25, 0.15
"""At the limit of grip slip is not as the two columns say, and much is left; but not nearly all."""
HARDLY_A_COURSE_MPS = 0.8
LEVERS_M = (0.6, 2.6)
"""From a small car with the engine behind to a van."""


@dataclass(frozen=True)
class CourseRelation:
    """What the changes of a course come to.

    Attributes:
        scale: of the course's change to the yaw rate's integral.
        lever_m, compliance: l in m and K in rad per m/s².
        slip: standard deviation of the slip they make, over that of a usual car.
        slip_error: standard error of `slip`.
        noise_mps: of one fix, across the car.
        explained: part of what the yaw rate leaves that they explain.
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
        """What no course of a car does: the first of these."""
        turns = f"it turns {self.scale:+.2f} times as fast as the yaw rate"
        grows = f"the course turns {self.scale:.2f} times as fast as the yaw rate"
        errs = f"fixes have a lateral error of {self.noise_mps:.2f} m/s"
        slips = f"beyond the yaw rate it changes by {self.slip:.2f} times what a car slips"
        most = MOST_NOISE_MPS if self.explained < LEAST_EXPLAINED else HARDLY_A_COURSE_MPS
        scaled = not SCALES[0] < self.scale < SCALES[1]
        unslipping = self.slip + 2 * self.slip_error < LEAST_SLIP
        around = "Invert clockwise_from_north, or swap north and east."
        doubt = "Reflected signals? Exclude doubtful fixes with where."
        units = "Check both units, and the gyroscope."
        heading = "It is a heading, of a compass or the car: map the course over ground."
        still, course = "Map the course that moves.", (COURSE,)
        judged = (
            (self.scale < REVERSED, Fault("reversed", course, turns, around)),
            (abs(self.scale) < STILL, Fault("stuck", course, turns, still)),
            (self.noise_mps > most, Fault("noisy", course, errs, doubt)),
            (scaled, Fault("scaled", (YAW_RATE, COURSE), grows, units)),
            (unslipping, Fault("no slip", course, slips, heading)),
        )
        return next((fault for wrong, fault in judged if wrong), None)

    @property
    def misplaced(self) -> Fault | None:
        """Whether the course is that of a place where no car has its centre of gravity."""
        if LEVERS_M[0] <= self.lever_m <= LEVERS_M[1]:
            return None
        return Fault(
            "place",
            (COURSE,),
            f"it fits a point {self.lever_m:+.1f} m forward of the rear axle; the centre of "
            f"gravity of a car is {LEVERS_M[0]:g} to {LEVERS_M[1]:g} m forward of it",
            "Check antenna_x_m, delay_s, and whether the car drove backwards.",
        )


def relate(moments: FloatArray, delay_s: float = 0.0) -> CourseRelation | None:
    """Return what a matrix of sums of products tells, None if it is of too little driving.

    `moments` is of 1, `COLUMNS` and the label in SI units, shape (6, 6). A course that is known to
    be `delay_s` late is taken as on time: it lacks that times the change of the yaw rate.
    """
    changes = float(moments[0, 0])
    if changes < FEWEST_CHANGES:
        return None
    on_time = np.eye(6)
    on_time[5, 3] = delay_s
    about = on_time @ moments @ on_time.T / changes
    about = about - np.outer(about[0], about[0])
    variances = np.diag(about)
    if variances[4] < LEAST_TURNED_RAD**2 or not (variances[1:4] > 0).all():
        return None
    used = np.array([1, 2, 4])
    unit = np.sqrt(variances[used])
    inverse = np.linalg.pinv(about[np.ix_(used, used)] / np.outer(unit, unit), rcond=1e-9)
    inverse /= np.outer(unit, unit)
    lever, compliance, scale = inverse @ about[used, 5]
    fitted = np.array([lever, compliance, scale])
    left = max(float(variances[5] - fitted @ about[used, 5]), 0.0)
    turning = float(variances[5] - about[4, 5] ** 2 / variances[4])
    usual = USUAL_LEVER_M**2 * variances[1] + USUAL_COMPLIANCE**2 * variances[2]
    errors = left / changes * np.diag(inverse)
    speed = float(about[2, 3] / variances[3])  # lateral acceleration is yaw rate times speed
    return CourseRelation(
        1 + float(scale),
        float(lever),
        float(compliance),
        float(np.sqrt((lever**2 * variances[1] + compliance**2 * variances[2]) / usual)),
        float(np.sqrt((errors[0] * variances[1] + errors[1] * variances[2]) / usual)),
        float(np.sqrt(left / 2)) * abs(speed),
        1 - left / turning if turning > 0 else 0.0,
    )
