"""Each approximation of a function in the simulator, against the function, within its bound.

`docs/simulator.md` lists them.
"""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from fleet_slip.compiling import kernel
from fleet_slip.vehicle.driver import LARGEST_GRIP_USE, Handling, slip_growth
from fleet_slip.vehicle.integration import STEP_S, Pose, PoseSlopes, advance_pose, followed
from fleet_slip.vehicle.parameters import constants, load_vehicle
from fleet_slip.vehicle.tyre import arctan2, cornering_stiffness

CARS = ("compact_hatchback", "d_class_sedan", "rear_drive_sedan", "suv")


@kernel
def arctangents(y: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
    angles = np.empty_like(y)
    for i in range(len(y)):
        angles[i] = arctan2(y[i], x[i])
    return angles


def test_arctangent_over_a_million_ratios() -> None:
    """Below 1e-12 rad: everywhere within the fitted interval, and mapped to all octants."""
    ratio = np.concatenate([np.linspace(2e-6, 1.0, 500_000), np.geomspace(1e-300, 1.0, 20_001)])
    one = np.ones_like(ratio)
    for y, x in ((ratio, one), (one, ratio), (ratio, -one), (-one, ratio), (-ratio, -one)):
        assert np.abs(arctangents(y, x) - np.arctan2(y, x)).max() < 1e-12


@given(st.floats(1.0, 60_000.0), st.sampled_from(CARS))
def test_cornering_stiffness_without_sine_is_an_identity(load: float, name: str) -> None:
    c = constants(load_vehicle(name), adhesion=1.0)
    exact = c.stiffness_front * math.sin(2 * math.atan(load * c.inverse_stiffness_load))
    assert abs(cornering_stiffness(load, c.stiffness_front, c) - exact) < 1e-12 * c.stiffness_front


@given(st.floats(-math.pi, math.pi), st.floats(-20.0, 20.0))
def test_the_heading_keeps_its_length(angle: float, rate: float) -> None:
    """One Newton iteration for 1/√n leaves 3/8 (n − 1)² of the error; n − 1 = (rate · step)²."""
    cosine, sine = math.cos(angle), math.sin(angle)
    turning = PoseSlopes(0.0, 0.0, -rate * sine, rate * cosine)
    pose = advance_pose(Pose(0.0, 0.0, cosine, sine), turning, turning, STEP_S, 0.5)
    excess = (rate * STEP_S) ** 2
    assert abs(math.hypot(pose.cosine, pose.sine) - 1.0) <= 0.375 * excess**2 + 1e-15
    turned = math.atan2(pose.sine, pose.cosine) - angle
    wrapped = (turned - rate * STEP_S + math.pi) % (2 * math.pi) - math.pi
    assert abs(wrapped) <= abs(rate * STEP_S) ** 3 / 3 + 1e-14


@given(st.floats(-100.0, 100.0), st.floats(1.0, 1.0 / STEP_S))
def test_a_lag_is_followed_to_third_order(rate: float, inverse_lag: float) -> None:
    """Against rate · lag · (1 − exp(−h / lag)); the next term of the series bounds the error."""
    z = STEP_S * inverse_lag
    exact = rate / inverse_lag * -math.expm1(-z)
    assert abs(followed(rate, inverse_lag, STEP_S) - exact) <= abs(rate) * STEP_S * z**2 / 6 + 1e-15


def test_the_drivers_growth_of_slip_stays_below_the_brush_tyres() -> None:
    """3 / (3 − f) against 3 (1 − ∛(1 − f)) / f: 3.1 % low at half the grip, 20 % at 0.9 of it."""
    knows = Handling(2.8, 1.7, 0.0, 0.0, 1.0, 15.0)
    for use in np.linspace(1e-3, LARGEST_GRIP_USE, 500):
        exact = 3 * (1 - (1 - use) ** (1 / 3)) / use
        low = 1 - slip_growth(0.0, float(use), knows) / exact
        assert -1e-9 <= low <= (0.031 if use <= 0.5 else 0.201), use


def test_the_cars_lags_are_long_against_the_step() -> None:
    """So that the series of `followed` is short of the exponential by less than 0.05 %."""
    for name in CARS:
        c = constants(load_vehicle(name), adhesion=1.0)
        for inverse_lag in (c.inverse_steering_lag, c.inverse_drive_lag):
            exact = -math.expm1(-STEP_S * inverse_lag) / inverse_lag
            assert abs(followed(1.0, inverse_lag, STEP_S) / exact - 1) < 5e-4
