"""From the sums of a car's drives to its numbers: three planes, each by least squares.

A car without side-slip of its own accord turns as fast as its velocity does, so that on the whole
yaw_rate - b = (ay - d) / v, with the offsets b and d of the sensors. The speed v is the wheels'
times a ratio. This is a plane in ay over the wheels' speed and in one over it. The same yaw rate
is one of the wheels' differences, and a steering angle is one of curvature and of ay (Ackermann
angle and understeer). Means over drives make the changes of side-slip vanish.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from functools import cache

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.car_numbers import NumberName
from fleet_slip.catalogue.features import input_scales
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.regression.exact.plane import Plane, PlaneShape, fit_plane

LEAST_TURNING_RAD_S = Fraction(2, 100)
"""Standard deviation of how fast the direction changes, below which a car drove too straight. The
noise of accelerometers is a third of it."""

LEAST_CHANGE_OF_SPEED = Fraction(5, 100)
"""Standard deviation of one over speed over its mean, below which a car drove too evenly to tell
the offset of one sensor from that of the other."""

LEAST_CURVATURE_1PM = Fraction(1, 1000)
SPEED_RATIOS = (Fraction(4, 5), Fraction(5, 4))
"""What tyres there are. A ratio beyond it says that noise, not driving, made the fit."""


def _si(**weights: int) -> dict[str, Fraction]:
    scales = input_scales()
    return {name: weight * scales[name] for name, weight in weights.items()}


@cache
def course_shape() -> PlaneShape:
    """Return yaw rate as a plane in ay over speed and in one over speed."""
    return PlaneShape(_si(yaw_rate=1), _si(course_rate=1), _si(slowness=1))


@cache
def wheels_shape() -> PlaneShape:
    """Return yaw rate as a plane in the differences of the rear and of the front wheels."""
    rear, front = _si(wheel_rr=1, wheel_rl=-1), _si(wheel_fr=1, wheel_fl=-1)
    return PlaneShape(_si(yaw_rate=1), rear, front)


def steering_shape(yaw_rate_offset: Fraction) -> PlaneShape:
    """Return steering as a plane in ay and in curvature without the offset of the yaw rate."""
    steer = {name: weight / 2 for name, weight in _si(steer_fl=1, steer_fr=1).items()}
    slowness = {name: -yaw_rate_offset * w for name, w in _si(slowness=1).items()}
    return PlaneShape(steer, {**_si(curvature=1), **slowness}, _si(ay=1))


KINDS: Mapping[str, tuple[str, ...]] = {
    "course": ("yaw_rate", "course_rate", "slowness"),
    "wheels": ("yaw_rate", "wheel_fl", "wheel_fr", "wheel_rl", "wheel_rr"),
    "steering": ("steer_fl", "steer_fr", "curvature", "slowness", "ay"),
}
"""The columns of each plane."""


@dataclass(frozen=True)
class Telling:
    """A number of a plane, its gradient by the coefficients, and by others that it depends on."""

    kind: str
    shape: PlaneShape
    plane: Plane
    value: Fraction
    gradient: tuple[float, float, float]
    also: Mapping[NumberName, float]


def tell_numbers(sums: Mapping[str, Gram | None]) -> dict[NumberName, Telling]:
    """Return the numbers that the sums of a car's drives tell, by kind of plane; exactly.

    A number is missing where its plane's columns are, where the sums do not determine it, or where
    the car drove too straight or too evenly to tell it from noise.
    """
    found: dict[NumberName, Telling] = {}
    _tell_course(found, sums.get("course"))
    _tell_wheels(found, sums.get("wheels"))
    _tell_steering(found, sums.get("steering"))
    return found


def _tell_course(found: dict[NumberName, Telling], gram: Gram | None) -> None:
    shape = course_shape()
    plane = fit_plane(gram, shape) if gram else None
    if plane is None or plane.first <= 0:
        return
    _, turning, change = plane.variances
    even = change < (LEAST_CHANGE_OF_SPEED * plane.means[2]) ** 2
    ratio = 1 / plane.first
    if turning < LEAST_TURNING_RAD_S**2 or even or not SPEED_RATIOS[0] <= ratio <= SPEED_RATIOS[1]:
        return
    first, second = float(plane.first), float(plane.second)

    def tell(name: NumberName, value: Fraction, *gradient: float) -> None:
        a, b, c = gradient
        found[name] = Telling("course", shape, plane, value, (a, b, c), {})

    tell("yaw_rate_offset", plane.intercept, 1.0, 0.0, 0.0)
    tell("ay_offset", -plane.second / plane.first, 0.0, second / first**2, -1 / first)
    tell("speed_ratio", ratio, 0.0, -1 / first**2, 0.0)


def _tell_wheels(found: dict[NumberName, Telling], gram: Gram | None) -> None:
    shape = wheels_shape()
    plane = fit_plane(gram, shape) if gram else None
    if plane is None or plane.variances[0] < LEAST_TURNING_RAD_S**2:
        return
    found["yaw_rate_offset_by_wheels"] = Telling(
        "wheels", shape, plane, plane.intercept, (1.0, 0.0, 0.0), {}
    )


def _tell_steering(found: dict[NumberName, Telling], gram: Gram | None) -> None:
    if gram is None or "ay_offset" not in found:
        return
    yaw_rate_offset, ay_offset = found["yaw_rate_offset"].value, found["ay_offset"].value
    shape = steering_shape(yaw_rate_offset)
    plane = fit_plane(gram, shape)
    if plane is None or plane.variances[1] < LEAST_CURVATURE_1PM**2:
        return
    mean_slowness = input_scales()["slowness"] * gram.sum("slowness") / gram.n
    also: dict[NumberName, float] = {
        "yaw_rate_offset": float(plane.first * mean_slowness),
        "ay_offset": float(plane.second),
    }
    value = plane.intercept + plane.second * ay_offset
    found["steering_offset"] = Telling(
        "steering", shape, plane, value, (1.0, 0.0, float(ay_offset)), also
    )
    found["steer_per_curvature"] = Telling(
        "steering", shape, plane, plane.first, (0.0, 1.0, 0.0), {}
    )
    found["understeer"] = Telling("steering", shape, plane, plane.second, (0.0, 0.0, 1.0), {})


def gradient_about(telling: Telling, signals: tuple[str, ...], origin: FloatArray) -> FloatArray:
    """Return the gradient by the coefficients of a plane in counts less an origin."""
    intercept, first, second = telling.gradient
    at = dict(zip(signals, origin.tolist(), strict=True))
    x1 = sum(float(w) * at[name] for name, w in telling.shape.x1.items())
    x2 = sum(float(w) * at[name] for name, w in telling.shape.x2.items())
    return np.array([intercept, first - intercept * x1, second - intercept * x2])
