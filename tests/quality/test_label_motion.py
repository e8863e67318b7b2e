"""The label with the motion of its car, in one drive."""

import re
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from fleet_slip.arrays import FloatArray
from fleet_slip.quality.checks import CHECKS
from fleet_slip.quality.plausibility import check_plausibility
from tests.support.catalog import SIGNALS
from tests.support.relaxing_car import drive_relaxing_car
from tests.support.textbook_car import Car, a_car

TIME_S = np.arange(4000) / 100


@cache
def at_one_speed() -> Car:
    """Return a sine of 0.5 Hz at 7 m/s: ay and curvature differ by phase alone."""
    steer = 0.03 * np.sin(2 * np.pi * 0.5 * TIME_S) * (TIME_S > 2)
    return drive_relaxing_car(steer, 7 + 0.03 * np.sin(0.4 * TIME_S))


def faults_of(car: Car, *, from_velocities: bool = False) -> list[tuple[str, tuple[str, ...]]]:
    faults = check_plausibility(SIGNALS, car, from_velocities=from_velocities)
    return [(fault.kind, fault.signals) for fault in faults]


def test_a_sine_at_one_speed_is_no_fault() -> None:
    assert faults_of(at_one_speed()) == []


@pytest.mark.parametrize(
    ("change", "kind"),
    [(lambda angle: -angle, "reversed"), (lambda angle: np.degrees(angle) * 0.2, "scaled")],
)
def test_sign_and_unit_show_at_one_speed_too(
    change: Callable[[FloatArray], FloatArray], kind: str
) -> None:
    car = at_one_speed()
    assert faults_of({**car, "sideslip": change(car["sideslip"])}) == [(kind, ("sideslip",))]


@pytest.mark.parametrize("wheelbase_m", [2.7, 3.2])
def test_the_bound_of_the_message_is_the_bound_that_is_used(wheelbase_m: float) -> None:
    """Road wheels of a longer car allow a longer lever; the message names it."""
    car = a_car()
    curvature = car["yaw_rate"] / (0.5 * (car["wheel_rl"] + car["wheel_rr"]) * 0.31)
    steer = wheelbase_m * curvature + 0.003 * car["ay"]
    highest = 0.75 * wheelbase_m
    for lever_m in (highest - 0.1, highest + 0.1):
        label = lever_m * curvature - 0.004 * car["ay"]
        faults = check_plausibility(SIGNALS, {**car, "steer": steer, "sideslip": label})
        if lever_m < highest:
            assert faults == []
        else:
            (fault,) = faults
            low, high = map(float, re.findall(r"be \+(\S+) to \+(\S+) m", fault.figure)[0])
            assert low == CHECKS["scale of the label"].low
            assert high == pytest.approx(highest, abs=0.006)


@pytest.mark.parametrize(
    ("factor", "kind", "remedy"),
    [(3.6, "scaled", "units of vx and vy"), (-1, "reversed", "Negate vy")],
)
def test_a_wrong_vy_is_named_as_the_source_of_the_label(
    factor: float, kind: str, remedy: str
) -> None:
    car = a_car()
    speed = 0.31 * np.mean([car[f"wheel_{w}"] for w in ("fl", "fr", "rl", "rr")], axis=0)
    vy = speed * np.tan(car["sideslip"])
    label = np.arctan2(factor * vy, speed)
    (fault,) = check_plausibility(SIGNALS, {**car, "sideslip": label}, from_velocities=True)
    assert (fault.kind, fault.signals) == (kind, ("sideslip",))
    assert remedy in fault.remedy
