"""The extended Kalman filter: tyre, Jacobian, algebra, and convergence on data of its own model."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_slip.arrays import FloatArray
from fleet_slip.observers import ekf
from fleet_slip.observers.ekf import Belief, EkfNoise, build_model, lateral_force, rates
from fleet_slip.observers.signals import STEP_S, DriveSignals
from fleet_slip.observers.single_track import SingleTrack
from fleet_slip.vehicle.parameters import load_vehicle
from tests.support.drives import rolling_drive, steady_sideslip_rad

CAR = load_vehicle("d_class_sedan")
TRACK = SingleTrack.of(CAR)
MODEL = build_model(TRACK, EkfNoise())
UNCERTAIN = np.array([[0.5, 0.02, 0.01], [0.02, 0.3, -0.05], [0.01, -0.05, 0.2]])


def belief(vx: float, vy: float, r: float, p: FloatArray = UNCERTAIN) -> Belief:
    return Belief(vx, vy, r, *p[np.triu_indices(3)])


def dense(x: Belief) -> FloatArray:
    upper = np.zeros((3, 3))
    upper[np.triu_indices(3)] = x[3:]
    return upper + np.triu(upper, 1).T


def fiala(alpha: float, stiffness: float, grip: float) -> float:
    """Hsu, Laws and Gerdes (2010), equation (4), in their signs."""
    t = np.tan(alpha)
    if abs(alpha) >= np.arctan(3 * grip / stiffness):
        return float(-grip * np.sign(alpha))
    cubic = stiffness**3 / (27 * grip**2) * t**3
    return float(-stiffness * t + stiffness**2 / (3 * grip) * abs(t) * t - cubic)


motions = {
    "vx": st.floats(6, 40),
    "vy": st.floats(-3, 3),
    "r": st.floats(-0.8, 0.8),
    "steer": st.floats(-0.3, 0.3),
}


@given(**motions)
def test_force_is_that_of_a_fiala_tyre(vx: float, vy: float, r: float, steer: float) -> None:
    alpha = np.arctan2(vy + TRACK.front_m * r, vx) - steer
    expected = np.cos(steer) * fiala(alpha, 9e4, 7e3)
    found = lateral_force(belief(vx, vy, r), steer, TRACK.front_m, 9e4, 7e3)
    if np.cos(alpha) * np.hypot(vx, vy + TRACK.front_m * r) > 5.0:
        assert found.force == pytest.approx(expected, rel=1e-9, abs=1e-6)


@given(**motions)
def test_derivatives_are_those_of_finite_differences(
    vx: float, vy: float, r: float, steer: float
) -> None:
    state = np.array([vx, vy, r])
    found = rates(belief(*state), steer, MODEL)
    h = 1e-6
    for i, (ay_slope, yaw_slope) in enumerate(
        [(found.ay_vx, found.yaw_vx), (found.ay_vy, found.yaw_vy), (found.ay_r, found.yaw_r)]
    ):
        step = np.eye(3)[i] * h
        above = rates(belief(*(state + step)), steer, MODEL)
        below = rates(belief(*(state - step)), steer, MODEL)
        assert ay_slope == pytest.approx((above.ay - below.ay) / (2 * h), rel=1e-4, abs=1e-3)
        assert yaw_slope == pytest.approx((above.yaw - below.yaw) / (2 * h), rel=1e-4, abs=1e-3)


def test_small_slip_gives_the_cornering_stiffness_and_large_slip_the_grip() -> None:
    slope = lateral_force(belief(20, 0, 0), 0.0, 0.0, 9e4, 7e3).per_vy
    assert slope == pytest.approx(-9e4 / 20, rel=1e-9)
    assert lateral_force(belief(20, -15, 0), 0.0, 0.0, 9e4, 7e3).force == pytest.approx(7e3)


def test_prediction_and_measurement_are_the_textbook_algebra() -> None:
    x = belief(20.0, -0.4, 0.3)
    steer, ax = 0.04, 1.2
    h = 1e-6

    def flow(state: FloatArray) -> FloatArray:
        d = rates(belief(*state), steer, MODEL)
        vx, vy, r = state
        return state + STEP_S * np.array([ax + r * vy, d.ay - r * vx, d.yaw])

    state = np.array(x[:3])
    columns = [(flow(state + e) - flow(state - e)) / (2 * h) for e in h * np.eye(3)]
    f = np.array(columns).T
    q = np.diag([MODEL.q_vx, MODEL.q_vy, MODEL.q_r])
    after = ekf.predict(x, ax, steer, STEP_S, MODEL)
    np.testing.assert_allclose(after[:3], flow(state), rtol=1e-14)
    np.testing.assert_allclose(dense(after), f @ UNCERTAIN @ f.T + q, rtol=0, atol=1e-8)

    row = np.array([0.3, -1.0, 2.0])
    gain = UNCERTAIN @ row / (row @ UNCERTAIN @ row + 0.1)
    found = ekf.condition(x, row[0], row[1], row[2], 0.7, 0.1)
    np.testing.assert_allclose(found[:3], state + gain * 0.7, rtol=0, atol=1e-14)
    expected = UNCERTAIN - np.outer(gain, row) @ UNCERTAIN
    np.testing.assert_allclose(dense(found), expected, rtol=0, atol=1e-14)


def drive_of_the_model(steer: FloatArray, vx: FloatArray) -> tuple[DriveSignals, FloatArray]:
    """Return what exact sensors read of the nonlinear model, and its side-slip."""
    vy, r = np.zeros(len(vx)), np.zeros(len(vx))
    for k in range(len(vx) - 1):
        d = rates(belief(vx[k], vy[k], r[k]), steer[k], MODEL)
        vy[k + 1] = vy[k] + STEP_S * (d.ay - r[k] * vx[k])
        r[k + 1] = r[k] + STEP_S * d.yaw
    return rolling_drive(CAR, vx, vy, r, steer), np.arctan2(vy, vx)


def test_converges_on_data_of_its_own_model_near_the_limit() -> None:
    time_s = np.arange(4000) * STEP_S
    steer = 0.055 * np.sin(1.2 * time_s)
    drive, truth = drive_of_the_model(steer, np.full(4000, 22.0))
    assert np.abs(drive.ay_mps2).max() > 6, "the tyres slide in part"
    error = (ekf.estimate(drive, CAR, EkfNoise()) - truth)[1000:]
    assert error.std() < 0.02 * truth.std()


def test_agrees_with_analytic_steady_cornering() -> None:
    drive, _ = drive_of_the_model(np.full(3000, 0.001), np.full(3000, 20.0))
    expected = steady_sideslip_rad(TRACK, 20.0, drive.yaw_rate_rad_s[-1])
    found = ekf.estimate(drive, CAR, EkfNoise())[-1]
    assert found == pytest.approx(expected, rel=0.02), "brush tyres are linear at small slip"


def test_covariance_stays_positive_definite() -> None:
    x = belief(20, 0, 0)
    for k in range(20_000):
        steer = 0.1 * np.sin(0.01 * k)
        x = ekf.predict(x, 0.0, steer, STEP_S, MODEL)
        x = ekf.update(x, 20.0, 0.2 * np.sin(0.01 * k), 4 * np.sin(0.01 * k), steer, MODEL)
    assert np.linalg.eigvalsh(dense(x)).min() > 0
