"""Relations between the sensors of a car, and the calibration parameters that follow from sums.

A car without side-slip of its own accord turns as fast as its velocity does, and a road that is
banked in bends takes a part of the lateral acceleration that grows with their curvature:
ay = d + rho v (r - b) + s r/v, with the offsets d and b, and the true speed rho v. On flat roads s
is zero, and what is left is a plane, r = b + (ay/v)/rho - (d/rho)/v. And a steering angle is one
of curvature and of ay (Ackermann angle and understeer). Means over drives make the changes of
side-slip vanish. The gyroscope's noise is in r and in r/v. Where both are inputs beside each other
it is taken out of their squares.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property

from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.course import TURNED, turned_scale
from fleet_slip.catalog.definitions import (
    BY_COURSE,
    BY_SATELLITE,
    CalibrationParameterName,
)
from fleet_slip.quality.course_relation import LEVERS_M, MIN_CHANGES, MIN_TURNED_RAD
from fleet_slip.regression.exact import solve_rational
from fleet_slip.regression.gram import Gram
from fleet_slip.regression.least_squares import ONE, ExactSums, Relation, Terms

NO_COURSE = "no row above 3 m/s has the yaw rate, ay and all four wheel speeds"
NO_STEERING = "no row above 3 m/s has both steering angles beside the other signals"
STRAIGHT = "it drove too straight: turns are hardly above noise"
EVEN = "its speed varied too little to separate the offsets of ay and of the yaw rate"
ALIKE = "its rows are too similar to separate the parameters"
NO_TYRE = (
    "no tyre has the wheel radius that fits: ay has too much noise or roll for such driving, or a "
    "signal has a wrong unit or sign. See: fleet-slip quality"
)
TIGHT_BENDS = "its bends are too tight to separate their banking: map satellite_speed"
"""Reasons for a missing parameter."""


@dataclass(frozen=True)
class CarEstimate:
    """Estimate of a parameter, its gradient by the unknowns, and by other parameters (`also`).

    `noise` is the variance of the gyroscope's noise that was subtracted, and `by_lean` the
    derivative by the camber of the road.
    """

    kind: str
    relation: Relation
    terms: Terms
    noise: Fraction
    value: Fraction
    gradient: tuple[float, ...]
    also: Mapping[CalibrationParameterName, float] = field(default_factory=dict)
    by_lean: Fraction = Fraction(0)


Estimates = dict[CalibrationParameterName, "CarEstimate | str"]
"""Estimates of the parameters that sums determine, or the reasons for missing ones."""

MIN_COURSE_RATE_STD_RAD_S = Fraction(2, 100)
"""Standard deviation of how fast the direction changes, below which a car drove too straight. The
noise of accelerometers is a third of it."""

MIN_SPEED_VARIATION = {False: Fraction(5, 100), True: Fraction(10, 100)}
"""Standard deviation of one over speed over its mean, below which a car drove too evenly to
separate the offsets of both sensors; on banked roads also the bank from speed."""

TIGHT_1PM = Fraction(1, 50)
"""Standard deviation of curvature beyond which bends are mostly so tight that their bank does not
grow with curvature any more: it looks like speed."""

OF_COURSE: tuple[CalibrationParameterName, ...] = ("yaw_rate_offset", "ay_offset", "speed_ratio")
OF_STEERING: tuple[CalibrationParameterName, ...] = (
    "steering_offset",
    "steer_per_curvature",
    "understeer",
)
OF_SLIP: tuple[CalibrationParameterName, ...] = ("slip_lever", "slip_compliance")
"""Parameters of each relation."""

MIN_CURVATURE_1PM = Fraction(1, 1000)
SPEED_RATIOS = {False: (Fraction(4, 5), Fraction(5, 4)), True: (Fraction(3, 4), Fraction(4, 3))}
"""Range of the wheel radii of tyres, and on banked roads of the roll of bodies. A ratio outside it
means that noise, not driving, determined the fit."""

FLAT = Relation.least_squares("yaw_rate", (ONE, "course_rate", "slowness"))
"""The yaw rate by 1, ay/v and 1/v: the unknowns b, 1/rho and -d/rho. Least squares."""

COURSE = Relation(
    instruments=(ONE, "slowness", "course_rate", "curvature"),
    products=(
        ((ONE, ONE), ("yaw_rate", "speed"), ("speed", ONE), ("curvature", ONE)),
        (("slowness", ONE), ("yaw_rate", ONE), (ONE, ONE), ("curvature", "slowness")),
        (("course_rate", ONE), ("yaw_rate", "ay"), ("ay", ONE), ("curvature", "course_rate")),
        (("curvature", ONE), ("yaw_rate", "yaw_rate"), ("yaw_rate", ONE), ("curvature",) * 2),
    ),
    response_products=(
        ("ay", ONE),
        ("course_rate", ONE),
        ("ay", "course_rate"),
        ("ay", "curvature"),
    ),
    noise={(3, 1): (ONE, ONE), (3, 3): ("slowness", "slowness")},
)
"""ay by 1, r v, v and r/v: the unknowns d, rho, -rho b and the bank of bends."""

STEERING = Relation.least_squares(
    "steer", (ONE, "bend", "ay"), noise={(1, 1): ("slowness", "slowness")}
)
"""The steering by 1, curvature without the gyroscope's offset, and ay."""

WHEEL_SPEEDS = ("wheel_fl", "wheel_fr", "wheel_rl", "wheel_rr")
STANDSTILL = "standstill"
"""The kind of sums over rows below 3 m/s."""
_COURSE = ("yaw_rate", "ay", *WHEEL_SPEEDS, "curvature", "course_rate", "slowness")
KINDS: Mapping[str, tuple[str, ...]] = {
    "course": _COURSE,
    "steering": (*_COURSE, "steer_fl", "steer_fr"),
    STANDSTILL: ("yaw_rate", *WHEEL_SPEEDS),
}
"""The columns of each kind of sums."""
EXCLUDED = {STANDSTILL: "slowness"}
"""Column whose rows do not belong to a kind."""


@dataclass(frozen=True)
class CarTerms:
    """The terms of the relations, in SI units: sums of columns of a catalog."""

    catalog: Catalog

    def si(self, **weights: int) -> dict[str, Fraction]:
        """Return the term of weighted columns."""
        scales = self.catalog.input_scales
        return {name: weight * scales[name] for name, weight in weights.items()}

    @cached_property
    def course(self) -> Terms:
        """The terms of the relations of course and wheels."""
        speed = self.catalog.input_scales["speed"] / 4
        return {
            **{name: self.si(**{name: 1}) for name in ("yaw_rate", "ay", *_COURSE[-3:])},
            "speed": dict.fromkeys(WHEEL_SPEEDS, speed),
            "wheels": self.si(wheel_rr=1, wheel_rl=-1, wheel_fr=1, wheel_fl=-1),
        }

    def steering(self, yaw_rate_offset: Fraction) -> Terms:
        """Return the terms of the relation of steering."""
        slowness = {name: -yaw_rate_offset * w for name, w in self.si(slowness=1).items()}
        steer = self.si(steer_fl=1, steer_fr=1)
        return {
            **self.course,
            "steer": {name: weight / 2 for name, weight in steer.items()},
            "bend": {**self.si(curvature=1), **slowness},
        }


def estimate_parameters(terms: CarTerms, sums: Mapping[str, Gram], banked: bool) -> Estimates:
    """Estimate the parameters of a car from the sums of its drives by kind, exactly.

    `banked` selects the relation of banked roads. A parameter is missing if its columns are, if the
    sums do not determine it, or if the car drove too straight or too evenly to separate it from
    noise. Estimates by satellite replace those by the car's sensors; the bias at standstill
    replaces both.
    """
    estimates = _by_own_sensors(terms, sums, banked)
    satellite = _speed_ratio(terms, sums) | _slip(terms, sums)
    return estimates | satellite | _standstill(terms, sums)


def _by_own_sensors(terms: CarTerms, sums: Mapping[str, Gram], banked: bool) -> Estimates:
    course, steering = sums.get("course"), sums.get("steering")
    names = (*OF_COURSE, *OF_STEERING)
    if course is None or course.n == 0:
        return dict.fromkeys(names, NO_COURSE)
    of_course = ExactSums(course, terms.course)
    noise = gyroscope_noise(terms, course, steering)
    if of_course.variance("course_rate") < MIN_COURSE_RATE_STD_RAD_S**2 or noise is None:
        return dict.fromkeys(names, STRAIGHT)
    change = MIN_SPEED_VARIATION[banked] * of_course.mean("slowness")
    if of_course.variance("slowness") < change**2:
        return dict.fromkeys(names, EVEN)
    of_plane = _estimate_course(terms, of_course, noise if banked else None)
    if isinstance(of_plane, str):
        return dict.fromkeys(names, of_plane)
    estimates: Estimates = {**of_plane}
    if steering is None or steering.n == 0:
        estimates |= dict.fromkeys(OF_STEERING, NO_STEERING)
    else:
        error = noise if banked else Fraction(0)
        estimates |= _estimate_steering(terms, of_plane, steering, error)
    if of_course.variance("curvature") > TIGHT_1PM**2:
        estimates["speed_ratio"] = TIGHT_BENDS
    return estimates


def bank_of_bends(terms: CarTerms, sums: Mapping[str, Gram]) -> Fraction | None:
    """Return s, the derivative of ay by curvature in m^2/s^2; None if undetermined."""
    course = sums.get("course")
    if course is None or (noise := gyroscope_noise(terms, course, sums.get("steering"))) is None:
        return None
    solution = solve_rational(COURSE.system(ExactSums(course, terms.course), noise))
    return solution[-1] if solution else None


def gyroscope_noise(terms: CarTerms, course: Gram, steering: Gram | None) -> Fraction | None:
    """Return the variance of the yaw rate that no other sensor explains: the gyroscope's noise."""
    inputs = ("wheels", "speed", "course_rate")
    if steering is None:
        return ExactSums(course, terms.course).residual_variance("yaw_rate", inputs)
    sums = ExactSums(steering, terms.steering(Fraction(0)))
    return sums.residual_variance("yaw_rate", (*inputs, "steer"))


def _estimate_course(
    terms: CarTerms, sums: ExactSums, noise: Fraction | None
) -> dict[CalibrationParameterName, CarEstimate] | str:
    """Estimate by the relation of flat roads, or with a noise by that of banked roads."""
    relation, noise = (FLAT, Fraction(0)) if noise is None else (COURSE, noise)
    solution = solve_rational(relation.system(sums, noise))
    if solution is None or not solution[1]:
        return ALIKE
    gradients: dict[CalibrationParameterName, tuple[float, ...]]
    if relation is FLAT:
        yaw_rate_offset, slope, of_slowness = solution
        ay_offset, ratio = -of_slowness / slope, 1 / slope
        gradients = {
            "yaw_rate_offset": (1.0, 0.0, 0.0),
            "ay_offset": (0.0, float(of_slowness / slope**2), float(-ratio)),
            "speed_ratio": (0.0, float(-(ratio**2)), 0.0),
        }
    else:
        ay_offset, ratio, of_speed, _ = solution
        yaw_rate_offset = -of_speed / ratio
        gradients = {
            "yaw_rate_offset": (0.0, float(of_speed / ratio**2), float(-1 / ratio), 0.0),
            "ay_offset": (1.0, 0.0, 0.0, 0.0),
            "speed_ratio": (0.0, 1.0, 0.0, 0.0),
        }
    lowest, highest = SPEED_RATIOS[relation is COURSE]
    if not lowest <= ratio <= highest:
        return NO_TYRE
    values = (yaw_rate_offset, ay_offset, ratio)
    common = ("course", relation, terms.course, noise)
    return {
        name: CarEstimate(*common, value, gradient, by_lean=Fraction(name == "ay_offset"))
        for (name, gradient), value in zip(gradients.items(), values, strict=True)
    }


def _estimate_steering(
    terms: CarTerms,
    course: Mapping[CalibrationParameterName, CarEstimate],
    gram: Gram,
    noise: Fraction,
) -> Estimates:
    yaw_rate_offset, ay_offset = course["yaw_rate_offset"].value, course["ay_offset"].value
    columns = terms.steering(yaw_rate_offset)
    sums = ExactSums(gram, columns)
    solution = solve_rational(STEERING.system(sums, noise))
    if solution is None or sums.variance("bend") < MIN_CURVATURE_1PM**2:
        return dict.fromkeys(OF_STEERING, STRAIGHT)
    straight, by_bend, understeer = solution

    also: dict[CalibrationParameterName, float] = {
        "yaw_rate_offset": float(by_bend * sums.mean("slowness")),
        "ay_offset": float(understeer),
    }
    of_plane = ("steering", STEERING, columns, noise)
    value = straight + understeer * ay_offset
    gradient = (1.0, 0.0, float(ay_offset))
    return {
        "steering_offset": CarEstimate(*of_plane, value, gradient, also, by_lean=understeer),
        "steer_per_curvature": CarEstimate(*of_plane, by_bend, (0.0, 1.0, 0.0)),
        "understeer": CarEstimate(*of_plane, understeer, (0.0, 0.0, 1.0)),
    }


# Bias of the gyroscope at standstill.
#
# Rows below 3 m/s lack the quotients by speed, and have a Gram row of their own. The turning that
# the wheels measure is subtracted.

MAX_ROLL_MPS, MIN_STILL_ROWS = Fraction(1, 2), 1000
"""Maximum mean speed of slow rows that are mostly at standstill, and minimum number of them."""
STILL = Relation.least_squares("yaw_rate", (ONE, "wheels"))
"""The yaw rate by 1 and the wheels' differences: b, and one over the tracks. Least squares."""


def _standstill(terms: CarTerms, sums: Mapping[str, Gram]) -> Estimates:
    """Estimate the bias of the gyroscope of a standing car, which replaces that from driving.

    It replaces that from the course, too, which contains a part of the scale error if a car turns
    to one side only.
    """
    gram = sums.get(STANDSTILL)
    if gram is None or gram.n < MIN_STILL_ROWS:
        return {}
    columns = {name: terms.course[name] for name in ("yaw_rate", "speed", "wheels")}
    still = ExactSums(gram, columns)
    solution = solve_rational(STILL.system(still, 0))
    if solution is None or still.mean("speed") >= MAX_ROLL_MPS:
        return {}
    bias = CarEstimate(STANDSTILL, STILL, columns, Fraction(0), solution[0], (1.0, 0.0))
    return {"yaw_rate_offset": bias}


# Speed ratio and slip of a car from a satellite receiver.
#
# The satellite's speed over that of the wheels is the speed ratio, whatever a body that rolls or a
# bank adds to the accelerometer. And the course changes by more than the yaw rate's integral as
# the side-slip angle does, which on roads is l r/v + K ay: the rear axle is l behind the centre of
# gravity, and gives way by K (`catalog/course.py`). Both are of speeds by wheels of .31
# m.

SATELLITE = "satellite_speed"
"""The kind of sums that determines the speed ratio, and its column."""
SLIP = "slip"
"""The kind of sums that determines how a car slips: changes over some seconds."""

SYSTEMATIC_STD_BY_SATELLITE: Mapping[str, Mapping[CalibrationParameterName, float]] = {
    STANDSTILL: {"yaw_rate_offset": 0.0003},
    SATELLITE: {"speed_ratio": 0.0012},
    SLIP: {"yaw_rate_offset": 0.0001, "slip_lever": 0.1, "slip_compliance": 0.0003},
}
"""Standard errors that drives do not average out, by kind. A gyroscope warms up, tyres slip and
wear, and 5 ms of error in the delay of a receiver shift l by the distance driven in that time."""

NO_RECEIVER = (
    "no course by satellite: none is logged, or its Gram rows are missing (fleet-slip gram "
    "--features calibration_course)"
)
FEW_TURNS = "its course by satellite has too few turns"
NO_CAR = "its satellite course is implausible: check the receiver and the antenna's position"
"""Reasons for a missing parameter."""

SPEED = Relation(
    instruments=(ONE,), products=((("speed", ONE),),), response_products=((SATELLITE, ONE),)
)
"""The satellite's speed by that of the wheels. Neither delay nor noise changes a mean."""

CHANGE = Relation.least_squares(SLIP, (ONE, "curvature", "ay", TURNED))
"""The label's change by 1, r/v, ay and the angle turned: the gyroscope's bias, l, K and its scale.
Least squares."""


def kinds_by_set(label: str) -> dict[str, dict[str, tuple[str, ...]]]:
    """Return the columns of each kind of sums by feature set."""
    return {
        BY_SATELLITE: {SATELLITE: (*WHEEL_SPEEDS, "slowness", SATELLITE)},
        BY_COURSE: {SLIP: ("curvature", "ay", TURNED, label)},
    }


def _speed_ratio(terms: CarTerms, sums: Mapping[str, Gram]) -> Estimates:
    gram = sums.get(SATELLITE)
    if gram is None or gram.n == 0:
        return {}
    columns = {"speed": terms.course["speed"], SATELLITE: terms.si(**{SATELLITE: 1})}
    solution = solve_rational(SPEED.system(ExactSums(gram, columns), 0))
    lowest, highest = SPEED_RATIOS[True]
    if solution is None or not lowest <= solution[0] <= highest:
        return {}
    ratio = CarEstimate(SATELLITE, SPEED, columns, Fraction(0), solution[0], (1.0,))
    return {"speed_ratio": ratio}


def _slip(terms: CarTerms, sums: Mapping[str, Gram]) -> Estimates:
    gram = sums.get(SLIP)
    if gram is None or gram.n == 0:
        return dict.fromkeys(OF_SLIP, NO_RECEIVER)
    catalog = terms.catalog
    columns = {
        **{name: terms.si(**{name: 1}) for name in ("curvature", "ay")},
        TURNED: {TURNED: Fraction(turned_scale(catalog.signals))},
        SLIP: terms.si(**{catalog.signals.label: 1}),
    }
    exact = ExactSums(gram, columns)
    if gram.n < MIN_CHANGES or exact.variance(TURNED) < Fraction(MIN_TURNED_RAD) ** 2:
        return dict.fromkeys(OF_SLIP, FEW_TURNS)
    solution = solve_rational(CHANGE.system(exact, 0))
    if solution is None or not LEVERS_M[0] <= solution[1] <= LEVERS_M[1]:
        return dict.fromkeys(OF_SLIP, NO_CAR)
    common = (SLIP, CHANGE, columns, Fraction(0))
    # The bias times the duration adds to the heading, and is missing in the label.
    by_bias = -1 / Fraction(catalog.feature_set(BY_COURSE).change_s[0])
    of_bias = (float(by_bias), 0.0, 0.0, 0.0)
    return {
        "yaw_rate_offset": CarEstimate(*common, by_bias * solution[0], of_bias),
        "slip_lever": CarEstimate(*common, solution[1], (0.0, 1.0, 0.0, 0.0)),
        "slip_compliance": CarEstimate(*common, solution[2], (0.0, 0.0, 1.0, 0.0)),
    }
