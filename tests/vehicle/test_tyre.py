"""The brush tyre against its closed forms."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_slip.compiling import kernel
from fleet_slip.vehicle.parameters import Constants
from fleet_slip.vehicle.tyre import TyreForce, brush_force, cornering_stiffness
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
