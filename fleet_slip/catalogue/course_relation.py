"""What changes of the course tell of a car: a few figures, whose usual values are known.

Over some seconds the course changes by the integral of the yaw rate, `TURNED`, and by the change of
the side-slip angle, which on roads is nearly that of a car whose rear axle is l behind the centre
of gravity and gives way by K:

    label = l Δ(yaw rate / speed) + K Δay + s TURNED + const,    l > 0, K < 0.

Least squares finds l and K, the scale 1 + s, and a noise, which times speed is a receiver's. What
is no course misses these places: a heading has neither l nor K, one of another sense has a scale of
-1, one that stands still of 0, an antenna elsewhere or a late fix moves l.
"""

from dataclasses import dataclass

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.course_change import COARSER, COURSE, TURNED, YAW_RATE
from fleet_slip.catalogue.signals import SAMPLE_TIME_S, catalogue

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


def turned_scale() -> float:
    """Return the rad of a count of `TURNED`."""
    return float(catalogue()[YAW_RATE].exact_scale * SAMPLE_TIME_S / 2) * COARSER


@dataclass(frozen=True)
class CourseFault:
    """What is wrong with a course: a kind of fault, the signals, what shows it, what to try."""

    kind: str
    signals: tuple[str, ...]
    figure: str
    remedy: str


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
    def fault(self) -> CourseFault | None:
        """What no course of a car does."""
        if self.scale < REVERSED:
            return CourseFault(
                "reversed",
                (COURSE,),
                f"it turns {self.scale:+.2f} times as the yaw rate does",
                "Turn clockwise_from_north round, or swap north and east.",
            )
        if abs(self.scale) < STILL:
            return CourseFault(
                "stuck",
                (COURSE,),
                f"it turns {self.scale:+.2f} times as the yaw rate does",
                "Map the course that moves.",
            )
        most = MOST_NOISE_MPS if self.explained < LEAST_EXPLAINED else HARDLY_A_COURSE_MPS
        if self.noise_mps > most:
            return CourseFault(
                "noisy",
                (COURSE,),
                f"a fix errs by {self.noise_mps:.2f} m/s across the car",
                "Reflected signals? Leave out fixes that the receiver doubts, by where.",
            )
        if not SCALES[0] < self.scale < SCALES[1]:
            return CourseFault(
                "scaled",
                (YAW_RATE, COURSE),
                f"the course turns {self.scale:.2f} times as the yaw rate does",
                "Check both units, and the gyroscope.",
            )
        if self.slip + 2 * self.slip_error < LEAST_SLIP:
            return CourseFault(
                "no slip",
                (COURSE,),
                f"beyond the yaw rate it changes by {self.slip:.2f} times what a car slips",
                "It is a heading, of a compass or the car: map the course over ground.",
            )
        return None

    @property
    def misplaced(self) -> CourseFault | None:
        """Whether the course is that of a place where no car has its centre of gravity."""
        if LEVERS_M[0] <= self.lever_m <= LEVERS_M[1]:
            return None
        return CourseFault(
            "place",
            (COURSE,),
            f"it is that of a place {self.lever_m:+.1f} m before the rear axle, "
            f"and a car's centre of gravity is {LEVERS_M[0]:g} to {LEVERS_M[1]:g} m before it",
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
