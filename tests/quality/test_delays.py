"""Delays of signals and labels, estimated in one drive."""

import numpy as np
import pytest

from fleet_slip.arrays import FloatArray
from fleet_slip.quality.checks import Fault
from fleet_slip.quality.drive_signals import WHEELS
from fleet_slip.quality.plausibility import check_plausibility
from fleet_slip.quality.turning import estimate_delay
from tests.support.catalog import SIGNALS
from tests.support.textbook_car import Car, winding_car


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
