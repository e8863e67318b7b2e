"""What a satellite receiver tells of a car beyond its own sensors: its speed, and how it slips.

The satellite's speed over that of the wheels is the speed ratio, whatever a body that rolls or a
bank adds to the accelerometer. And the course changes by more than the yaw rate's integral as the
side-slip angle does, which on roads is l r/v + K ay: the rear axle is l behind the centre of
gravity, and gives way by K (`catalogue/course_relation.py`). Both are of speeds by wheels of .31 m.
"""

from collections.abc import Mapping
from fractions import Fraction

from fleet_slip.catalogue.car_numbers import BY_COURSE, BY_SATELLITE, NumberName
from fleet_slip.catalogue.course_change import TURNED
from fleet_slip.catalogue.course_relation import (
    FEWEST_CHANGES,
    LEAST_TURNED_RAD,
    LEVERS_M,
    turned_scale,
)
from fleet_slip.catalogue.features import input_scales
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.grams.calibration.tell_numbers import SPEED_RATIOS, WHEEL_SPEEDS
from fleet_slip.grams.calibration.telling import Telling, Told
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.regression.exact.moments_relation import ONE, ExactSums, Relation, Terms, solve

SATELLITE = "satellite_speed"
"""The kind of sums that tells the speed ratio, and its column."""
SLIP = "slip"
"""The kind of sums that tells how a car slips: changes over some seconds."""

LASTING_BY_SATELLITE: Mapping[str, Mapping[NumberName, float]] = {
    SATELLITE: {"speed_ratio": 0.0012},
    SLIP: {"slip_lever": 0.1, "slip_compliance": 0.0003},
}
"""Standard errors that no drive takes away, by kind: tyres slip and wear; a receiver of which we
know to 5 ms how late it is moves l by the way of that time."""

NO_RECEIVER = (
    "no course by satellite: none is logged, or its Gram rows are missing (fleet-slip gram "
    "--features calibration_course)"
)
FEW_TURNS = "its course by satellite has too few turns"
NO_CAR = "its course by satellite is none of a car: look at the receiver, and where its antenna is"
"""Why a number is missing."""

SPEED = Relation(instruments=(ONE,), left=((("speed", ONE),),), right=((SATELLITE, ONE),), noise={})
"""The satellite's speed by that of the wheels. Neither delay nor noise changes a mean."""

_BY = (ONE, "curvature", "ay", TURNED)
CHANGE = Relation(
    instruments=_BY,
    left=tuple(tuple((a, b) for b in _BY) for a in _BY),
    right=tuple((SLIP, a) for a in _BY),
    noise={},
)
"""The label's change by 1, r/v, ay and the angle turned: the gyroscope's bias, l, K and its scale.
Least squares."""


def kinds_by_set() -> dict[str, dict[str, tuple[str, ...]]]:
    """Return the columns of each kind of sums, by the feature set that has them."""
    return {
        BY_SATELLITE: {SATELLITE: (*WHEEL_SPEEDS, "slowness", SATELLITE)},
        BY_COURSE: {SLIP: ("curvature", "ay", TURNED, catalogue().label)},
    }


def tell_by_satellite(sums: Mapping[str, Gram], told: Told) -> None:
    """Add the numbers that satellites tell of a car, from the sums of its drives; exactly.

    They replace what its own sensors tell.
    """
    told.numbers.update(_speed_ratio(sums.get(SATELLITE)))
    told.take(("slip_lever", "slip_compliance"), _slip(sums.get(SLIP)))


def _speed_ratio(gram: Gram | None) -> dict[NumberName, Telling]:
    if gram is None or gram.n == 0:
        return {}
    scales = input_scales()
    terms = {
        "speed": dict.fromkeys(WHEEL_SPEEDS, scales["speed"] / 4),
        SATELLITE: {SATELLITE: catalogue()[SATELLITE].exact_scale},
    }
    solution = solve(SPEED.system(ExactSums(gram, terms), 0))
    least, most = SPEED_RATIOS[True]
    if solution is None or not least <= solution[0] <= most:
        return {}
    told = Telling(SATELLITE, SPEED, terms, Fraction(0), solution[0], (1.0,), {})
    return {"speed_ratio": told}


def _slip(gram: Gram | None) -> dict[NumberName, Telling] | str:
    if gram is None or gram.n == 0:
        return NO_RECEIVER
    terms = slip_terms()
    sums = ExactSums(gram, terms)
    if gram.n < FEWEST_CHANGES or sums.variance(TURNED) < Fraction(LEAST_TURNED_RAD) ** 2:
        return FEW_TURNS
    solution = solve(CHANGE.system(sums, 0))
    if solution is None or not LEVERS_M[0] <= solution[1] <= LEVERS_M[1]:
        return NO_CAR
    of_plane = (SLIP, CHANGE, terms, Fraction(0))
    return {
        "slip_lever": Telling(*of_plane, solution[1], (0.0, 1.0, 0.0, 0.0), {}),
        "slip_compliance": Telling(*of_plane, solution[2], (0.0, 0.0, 1.0, 0.0), {}),
    }


def slip_terms() -> Terms:
    """Return the terms of the relation of the course's changes."""
    scales = input_scales()
    return {
        "curvature": {"curvature": scales["curvature"]},
        "ay": {"ay": scales["ay"]},
        TURNED: {TURNED: Fraction(turned_scale())},
        SLIP: {catalogue().label: catalogue()[catalogue().label].exact_scale},
    }
