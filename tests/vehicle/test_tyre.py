"""The brush tyre against its closed forms, and each approximation against its function."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from fleet_slip.compiling import kernel
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.vehicle.driver import MAX_GRIP_USE, Handling, slip_growth
from fleet_slip.vehicle.dynamics import TyreForce, arctan2, brush_force, cornering_stiffness
from fleet_slip.vehicle.integration import STEP_S, Pose, PoseSlopes, advance_pose, lag_step
from fleet_slip.vehicle.parameters import Constants, constants, load_vehicle
from tests.support.rolling import CAR

PEAK = CAR.stiffness_rear
SPEED = 20.0


@kernel
def force(
    along: float, across: float, rolling: float, load: float, peak: float, c: Constants
) -> TyreForce:
    return brush_force(along, across, rolling, load, peak, c)


LOADS = st.floats(1.0, 15000.0)
SPEEDS = st.floats(-70.0, 70.0)


@pytest.mark.parametrize("load", [500.0, 3000.0, 8000.0])
def test_small_slips_meet_the_stiffnesses(load: float) -> None:
    stiffness = cornering_stiffness(load, PEAK, CAR)
    sideways = force(SPEED, 1e-5 * SPEED, SPEED, load, PEAK, CAR)
    driven = force(SPEED, 0.0, SPEED * (1 + 1e-5), load, PEAK, CAR)
    assert sideways.y == pytest.approx(-1e-5 * stiffness, rel=1e-3)
    assert driven.x == pytest.approx(1e-5 * CAR.stiffness_ratio * stiffness, rel=1e-3)


@pytest.mark.parametrize("slip", [0.01, 0.05, 0.1, 0.15])
def test_pure_side_slip_is_the_brush_formula(slip: float) -> None:
    """F = μ Fz (1 − (1 − C σ / (3 μ Fz))³), Pacejka (2012) 3.2, without friction decay."""
    c = CAR._replace(inverse_decay_speed=0.0)
    load = 3000.0
    limit = (c.friction - c.friction_per_load * load) * load
    stiffness = cornering_stiffness(load, PEAK, c)
    expected = limit * (1 - max(0.0, 1 - stiffness * slip / (3 * limit)) ** 3)
    assert -force(SPEED, slip * SPEED, SPEED, load, PEAK, c).y == pytest.approx(expected)


def test_a_locked_wheel_slides_against_its_velocity() -> None:
    load = 4000.0
    slide = force(12.0, 9.0, 0.0, load, PEAK, CAR)
    assert slide.x / slide.y == pytest.approx(12.0 / 9.0)
    friction = (CAR.friction - CAR.friction_per_load * load) / (1 + 15.0 * CAR.inverse_decay_speed)
    assert math.hypot(slide.x, slide.y) == pytest.approx(friction * load)


def test_force_peaks_and_then_falls_with_sliding() -> None:
    slips = np.linspace(0.0, 0.6, 200)
    forces = [-force(SPEED, slip * SPEED, SPEED, 4000.0, PEAK, CAR).y for slip in slips]
    peak = int(np.argmax(forces))
    assert 0.1 < slips[peak] < 0.2
    assert forces[-1] < 0.92 * forces[peak]


@given(along=SPEEDS, across=SPEEDS, rolling=SPEEDS, load=LOADS)
def test_force_stays_in_the_friction_circle_and_opposes_sliding(
    along: float, across: float, rolling: float, load: float
) -> None:
    f = force(along, across, rolling, load, PEAK, CAR)
    limit = (CAR.friction - CAR.friction_per_load * load) * load
    assert math.hypot(f.x, f.y) <= limit * (1 + 1e-9)
    assert f.x * (rolling - along) - f.y * across >= -1e-9


@given(along=SPEEDS, across=SPEEDS, rolling=SPEEDS, load=LOADS)
def test_damping_bounds_the_slope_of_the_force(
    along: float, across: float, rolling: float, load: float
) -> None:
    """The implicit step of the wheels needs 0 ≤ −∂Fx/∂v < 4/3 of what it takes for it."""
    h = 1e-6
    f = force(along, across, rolling, load, PEAK, CAR)
    if abs(rolling - along) + abs(across) > 1e-3:
        slope = (
            force(along - h, across, rolling, load, PEAK, CAR).x
            - force(along + h, across, rolling, load, PEAK, CAR).x
        ) / (2 * h)
        assert slope <= 4 / 3 * f.damping + 1e-3 * load


@pytest.mark.parametrize("load", [1000.0, 4000.0, 7000.0])
def test_friction_falls_with_load(load: float) -> None:
    c = CAR._replace(inverse_decay_speed=0.0)
    friction = force(10.0, 0.0, 0.0, load, PEAK, c).x / -load
    assert friction == pytest.approx(1.0 - 0.1 * (load / 4000.0 - 1.0))


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
    ones = np.ones_like(ratio)
    for y, x in ((ratio, ones), (ones, ratio), (ratio, -ones), (-ones, ratio), (-ratio, -ones)):
        assert np.abs(arctangents(y, x) - np.arctan2(y, x)).max() < 1e-12


@given(st.floats(1.0, 60_000.0), st.sampled_from(CARS))
def test_cornering_stiffness_without_sine_is_an_identity(load: float, name: str) -> None:
    c = constants(load_vehicle(name, SHIPPED_CONFIGS), adhesion=1.0)
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
    assert abs(lag_step(rate, inverse_lag, STEP_S) - exact) <= abs(rate) * STEP_S * z**2 / 6 + 1e-15


def test_the_drivers_growth_of_slip_stays_below_the_brush_tyres() -> None:
    """3 / (3 − f) against 3 (1 − ∛(1 − f)) / f: 3.1 % low at half the grip, 20 % at 0.9 of it."""
    knows = Handling(2.8, 1.7, 0.0, 0.0, 1.0, 15.0)
    for use in np.linspace(1e-3, MAX_GRIP_USE, 500):
        exact = 3 * (1 - (1 - use) ** (1 / 3)) / use
        low = 1 - slip_growth(0.0, float(use), knows) / exact
        assert -1e-9 <= low <= (0.031 if use <= 0.5 else 0.201), use


def test_the_cars_lags_are_long_against_the_step() -> None:
    """So that the series of `lag_step` is short of the exponential by less than 0.05 %."""
    for name in CARS:
        c = constants(load_vehicle(name, SHIPPED_CONFIGS), adhesion=1.0)
        for inverse_lag in (c.inverse_steering_lag, c.inverse_drive_lag):
            exact = -math.expm1(-STEP_S * inverse_lag) / inverse_lag
            assert abs(lag_step(1.0, inverse_lag, STEP_S) / exact - 1) < 5e-4
