"""Delays of signals, and the label with the motion of its car, in one drive."""

import re
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from fleet_slip.arrays import FloatArray
from fleet_slip.quality.checks import CHECKS, Fault
from fleet_slip.quality.drive_signals import WHEELS
from fleet_slip.quality.plausibility import check_plausibility
from fleet_slip.quality.turning import estimate_delay
from tests.support.catalog import SIGNALS
from tests.support.relaxing_car import drive_relaxing_car
from tests.support.textbook_car import Car, a_car, winding_car


def late(values: FloatArray, ticks: int) -> FloatArray:
    return np.concatenate([np.full(ticks, np.nan), values[:-ticks]])


def delays_of(car: Car) -> list[Fault]:
    return [fault for fault in check_plausibility(SIGNALS, car) if fault.kind == "late"]


@pytest.mark.parametrize(("name", "ticks"), [("sideslip", 100), ("yaw_rate", 40), ("ay", 40)])
def test_a_signal_that_is_late_in_its_drive_is_named_with_its_delay(name: str, ticks: int) -> None:
    car = winding_car()
    (fault,) = check_plausibility(SIGNALS, {**car, name: late(car[name], ticks)})
    assert (fault.kind, fault.signals) == ("late", (name,))
    assert f"it is +{ticks / 100:.2f} s late" in fault.figure
    assert f"Add {ticks / 100:.2f} to its delay_s" in fault.remedy


@pytest.mark.parametrize("name", ["sideslip", "yaw_rate", "steering_wheel"])
def test_delays_of_buses_are_no_fault(name: str) -> None:
    car = winding_car()
    assert delays_of({**car, name: late(car[name], 12)}) == []
    after = {n: values if n == "steering_wheel" else late(values, 35) for n, values in car.items()}
    assert delays_of(after) == [], "the car follows the steering"


def test_two_signals_without_a_witness_are_both_named() -> None:
    car = {name: values for name, values in winding_car().items() if name in {"ay", "yaw_rate"}}
    (fault,) = delays_of({**car, "ay": late(car["ay"], 50)})
    assert fault.signals == ("ay", "yaw_rate")
    assert "the first is +0.50 s later" in fault.figure


def test_a_delay_has_a_standard_error_that_covers_it() -> None:
    errors = []
    for seed in range(12):
        car = winding_car(seed, seconds=60)
        delay = estimate_delay(
            late(car["sideslip"], 40),
            np.array([car["yaw_rate"], car["ay"]]),
            np.ones(6000, dtype=np.bool_),
        )
        assert delay is not None
        errors.append((delay.value_s - 0.4) / delay.error_s)
    assert np.sqrt(np.mean(np.square(errors))) < 3


def test_a_short_or_unrelated_signal_has_no_delay() -> None:
    rng, rows = np.random.default_rng(2), np.ones(9000, dtype=np.bool_)
    noise = rng.normal(size=(2, 9000))
    assert estimate_delay(noise[0], noise[1:], rows) is None
    assert estimate_delay(noise[0, :1500], noise[:1, :1500], rows[:1500]) is None


@pytest.mark.parametrize("name", ["ay", "yaw_rate"])
def test_the_label_decides_between_two_signals_that_contradict_each_other(name: str) -> None:
    car = winding_car()
    car = {"vx": 0.31 * np.mean([car[w] for w in WHEELS], axis=0)} | {
        name: car[name] for name in ("ay", "yaw_rate", "sideslip")
    }
    wrong = {**car, name: -car[name]}
    (fault,) = check_plausibility(SIGNALS, wrong)
    assert (fault.kind, fault.signals) == ("reversed", (name,))
    without = {name: values for name, values in wrong.items() if name != "sideslip"}
    (fault,) = check_plausibility(SIGNALS, without)
    assert (fault.kind, fault.signals) == ("reversed", ("ay", "yaw_rate"))
    assert "contradict each other" in fault.figure


def test_wheels_in_a_wrong_unit_are_compared_with_another_speed() -> None:
    """In rad/s taken for rpm they are below 2 m/s, where nothing seems to move."""
    car = winding_car()
    speed = 0.31 * np.mean([car[wheel] for wheel in WHEELS], axis=0)
    slow = {**car, "vx": speed} | {wheel: car[wheel] / 9.55 for wheel in WHEELS}
    (fault,) = check_plausibility(SIGNALS, slow)
    assert (fault.kind, fault.signals) == ("scaled", WHEELS)
    assert fault.figure == "vx is 9.55 times the speed of the wheels"
    (fault,) = check_plausibility(SIGNALS, {**car, "vx": 3.6 * speed})
    assert fault.signals == ("vx",)
    alone = {name: values for name, values in slow.items() if name not in {"ay", "sideslip"}}
    assert ("scaled", (*WHEELS, "vx")) in {
        (fault.kind, fault.signals) for fault in check_plausibility(SIGNALS, alone)
    }


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
