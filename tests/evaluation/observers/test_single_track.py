"""The linear model of the two observers: steady cornering and poles."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.rivals.observers import (
    ObserverPoles,
    gains,
    state_space,
)
from fleet_slip.vehicle.parameters import load_vehicle
from tests.support.drives import axle_stiffness_n, steady_sideslip_rad

CAR = load_vehicle("d_class_sedan")


def steady_state(vx: float, steer: float) -> tuple[float, float]:
    """Return vy and r of steady cornering."""
    s = state_space(CAR, np.array([vx]))
    a = np.array([[s.a11[0], s.a12[0]], [s.a21[0], s.a22[0]]])
    vy, rate = np.linalg.solve(a, -steer * np.array([s.b1[0], s.b2[0]]))
    return float(vy), float(rate)


@given(vx=st.floats(6, 45), steer=st.floats(-0.1, 0.1))
def test_steady_sideslip_of_the_model_is_the_textbook_one(vx: float, steer: float) -> None:
    vy, rate = steady_state(vx, steer)
    assert np.arctan2(vy, vx) == pytest.approx(steady_sideslip_rad(CAR, vx, rate), abs=1e-12)
    # The kinematic radius, stretched by the understeer gradient.
    body, (front_n, rear_n) = CAR.body, axle_stiffness_n(CAR)
    wheelbase = body.wheelbase_m
    front, rear = body.rear_axle_m / front_n, body.front_axle_m / rear_n
    understeer = body.mass_kg * (front - rear) / wheelbase
    assert rate == pytest.approx(vx * steer / (wheelbase + understeer * vx**2), rel=1e-9, abs=1e-12)


@given(vx=st.floats(0, 60), p1=st.floats(0.1, 100), p2=st.floats(0.1, 100))
def test_gains_place_the_poles_at_every_speed(vx: float, p1: float, p2: float) -> None:
    s = state_space(CAR, np.array([vx]))
    poles = ObserverPoles(lateral_velocity_1ps=p1, yaw_rate_1ps=p2)
    gain = gains(s, poles)[:, 0].reshape(2, 2)
    a = np.array([[s.a11[0], s.a12[0]], [s.a21[0], s.a22[0]]])
    c = np.array([[0, 1], [s.a11[0], s.c2[0]]])
    scale = np.abs(a).max() + p1 + p2
    expected = np.diag([-p1, -p2])
    np.testing.assert_allclose(a - gain @ c, expected, rtol=0, atol=1e-12 * scale)
