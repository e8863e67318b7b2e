"""The extended Kalman filter: tyre, Jacobian, algebra, and convergence on data of its own model."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_slip.arrays import FloatArray
from fleet_slip.evaluation import ekf
from fleet_slip.evaluation.ekf import (
    Axles,
    EkfNoise,
    Rates,
    axles_of,
    lateral_force,
    loaded_axles,
    rates,
    variances,
)
from fleet_slip.evaluation.evaluated_drives import STEP_S, DriveSignals
from fleet_slip.evaluation.kalman import (
    GaussianState,
    independent_state,
    measurement_update,
)
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.vehicle.parameters import constants, load_vehicle
from tests.support.drives import noisy, rolling_drive, steady_sideslip_rad

CAR = load_vehicle("d_class_sedan", SHIPPED_CONFIGS)
FRONT_M = CAR.body.front_axle_m
CHASSIS = constants(CAR, 1.0)
Q, R = variances(EkfNoise())
AT_REST = Axles(*loaded_axles(CAR, np.zeros(1), np.zeros(1), adhesion=1.0)[:, 0].tolist())
UNCERTAIN = np.array(
    [
        [0.5, 0.02, 0.01, 0.03],
        [0.02, 0.3, -0.05, 0.04],
        [0.01, -0.05, 0.2, 0.01],
        [0.03, 0.04, 0.01, 0.1],
    ]
)


def gaussian(vx: float, vy: float, r: float, b: float = 0.1) -> GaussianState:
    uncertain = independent_state((vx, vy, r, b), (0.0, 0.0, 0.0, 0.0))
    uncertain.covariance[:] = UNCERTAIN
    return uncertain


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
    alpha = np.arctan2(vy + FRONT_M * r, vx) - steer
    expected = np.cos(steer) * fiala(alpha, 9e4, 7e3)
    force = lateral_force(vx, vy, r, steer, FRONT_M, 9e4, 7e3)
    if np.cos(alpha) * np.hypot(vx, vy + FRONT_M * r) > 5.0:
        assert force.force == pytest.approx(expected, rel=1e-9, abs=1e-6)


@given(**motions)
def test_derivatives_are_those_of_finite_differences(
    vx: float, vy: float, r: float, steer: float
) -> None:
    def at(state: FloatArray) -> Rates:
        return rates(state[0], state[1], state[2], steer, AT_REST, CHASSIS)

    state = np.array([vx, vy, r])
    derivatives = at(state)
    h = 1e-6
    for i, (ay_slope, yaw_slope) in enumerate(
        [
            (derivatives.ay_vx, derivatives.yaw_vx),
            (derivatives.ay_vy, derivatives.yaw_vy),
            (derivatives.ay_r, derivatives.yaw_r),
        ]
    ):
        step = np.eye(3)[i] * h
        above = at(state + step)
        below = at(state - step)
        assert ay_slope == pytest.approx((above.ay - below.ay) / (2 * h), rel=1e-4, abs=1e-3)
        assert yaw_slope == pytest.approx((above.yaw - below.yaw) / (2 * h), rel=1e-4, abs=1e-3)


def test_load_makes_axles_softer_in_bends_and_moves_grip_forward_in_braking() -> None:
    held = np.ones(500)
    bend = loaded_axles(CAR, 0 * held, 6 * held, adhesion=1.0)[:, -1]
    other = loaded_axles(CAR, 0 * held, -6 * held, adhesion=1.0)[:, -1]
    brake = Axles(*loaded_axles(CAR, -4 * held, 0 * held, adhesion=1.0)[:, -1].tolist())
    assert (bend < 0.99 * np.array(AT_REST)).all()
    np.testing.assert_allclose(bend, other, rtol=1e-12)
    assert brake.stiffness_front_n > AT_REST.stiffness_front_n
    assert brake.stiffness_rear_n < AT_REST.stiffness_rear_n
    # Load moves by m h ax / L, whatever else a car has.
    mass, height = CAR.body.mass_kg, CAR.body.height_m
    moved = mass * height * 4 / CAR.body.wheelbase_m
    flat = CAR.tyre.friction * 1.2
    assert brake.grip_front_n - AT_REST.grip_front_n < flat * moved


def test_prediction_and_measurement_are_the_textbook_algebra() -> None:
    x = gaussian(20.0, -0.4, 0.3)
    steer, ax = 0.04, 1.2
    h = 1e-6

    def flow(state: FloatArray) -> FloatArray:
        vx, vy, r, _ = state
        d = rates(vx, vy, r, steer, AT_REST, CHASSIS)
        return state + STEP_S * np.array([ax + r * vy, d.ay - r * vx, d.yaw, 0.0])

    state = x.mean.copy()
    columns = [(flow(state + e) - flow(state - e)) / (2 * h) for e in h * np.eye(4)]
    f = np.array(columns).T
    q = np.diag(Q)
    ekf.predict(x, ax, steer, STEP_S, AT_REST, CHASSIS, Q)
    np.testing.assert_allclose(x.mean, flow(state), rtol=1e-14)
    np.testing.assert_allclose(x.covariance, f @ UNCERTAIN @ f.T + q, rtol=0, atol=1e-8)

    row = np.array([0.3, -1.0, 2.0, 1.0])
    gain = UNCERTAIN @ row / (row @ UNCERTAIN @ row + 0.1)
    x = gaussian(*state)
    measurement_update(x, (0.3, -1.0, 2.0, 1.0), 0.7, 0.1)
    np.testing.assert_allclose(x.mean, state + gain * 0.7, rtol=0, atol=1e-14)
    expected = UNCERTAIN - np.outer(gain, row) @ UNCERTAIN
    np.testing.assert_allclose(x.covariance, expected, rtol=0, atol=1e-14)


def drive_of_the_model(steer: FloatArray, vx: FloatArray) -> tuple[DriveSignals, FloatArray]:
    """Return what exact sensors read of the nonlinear model, and its side-slip.

    The loads of the wheels follow ay, which follows from them: two passes.
    """
    still = np.zeros(len(vx))
    ay = still
    for _ in range(2):
        loaded = axles_of(CAR, still, ay, EkfNoise())
        vy, r = np.zeros(len(vx)), np.zeros(len(vx))
        for k in range(len(vx) - 1):
            d = rates(vx[k], vy[k], r[k], steer[k], Axles(*loaded[:, k]), CHASSIS)
            vy[k + 1] = vy[k] + STEP_S * (d.ay - r[k] * vx[k])
            r[k + 1] = r[k] + STEP_S * d.yaw
        drive = rolling_drive(CAR, vx, vy, r, steer)
        ay = drive.ay_mps2
    return drive, np.arctan2(vy, vx)


def test_converges_on_data_of_its_own_model_near_the_limit() -> None:
    time_s = np.arange(4000) * STEP_S
    steer = 0.055 * np.sin(1.2 * time_s)
    drive, truth = drive_of_the_model(steer, np.full(4000, 22.0))
    assert np.abs(drive.ay_mps2).max() > 6, "the tyres slide in part"
    error = (ekf.estimate(drive, CAR, EkfNoise()) - truth)[1000:]
    assert error.std() < 0.02 * truth.std()


def test_agrees_with_analytic_steady_cornering() -> None:
    drive, _ = drive_of_the_model(np.full(3000, 0.001), np.full(3000, 20.0))
    expected = steady_sideslip_rad(CAR, 20.0, drive.yaw_rate_rad_s[-1])
    estimate = ekf.estimate(drive, CAR, EkfNoise())[-1]
    assert estimate == pytest.approx(expected, rel=0.02), "brush tyres are linear at small slip"


def test_a_bias_of_the_accelerometer_is_found() -> None:
    """Through bends to both sides a bias cannot pass for side-slip, unless it is no state."""
    time_s = np.arange(12_000) * STEP_S
    drive, truth = drive_of_the_model(0.02 * np.sin(0.5 * time_s), np.full(12_000, 20.0))
    biased = noisy(drive, seed=6)  # 0.15 m/s²

    def bias_deg(noise: EkfNoise) -> float:
        error = ekf.estimate(biased, CAR, noise) - truth
        return abs(float(np.degrees(error[6000:].mean())))

    assert bias_deg(EkfNoise()) < 0.3 * bias_deg(EkfNoise(ay_bias_std_mps2=0.0))


def test_covariance_stays_positive_definite() -> None:
    x = gaussian(20.0, 0.0, 0.0)
    for k in range(20_000):
        steer = 0.1 * np.sin(0.01 * k)
        turning, ay = 0.2 * np.sin(0.01 * k), 4 * np.sin(0.01 * k)
        ekf.predict(x, 0.0, steer, STEP_S, AT_REST, CHASSIS, Q)
        ekf.update(x, 20.0, turning, ay, steer, AT_REST, CHASSIS, R)
    assert np.linalg.eigvalsh(x.covariance).min() > 0


def test_a_drive_that_begins_in_a_tight_bend_is_followed_from_the_start() -> None:
    still = np.zeros(200)
    vx, yaw_rate = still + 5.5, still + 0.8
    vy = CAR.body.rear_axle_m * yaw_rate - 0.1
    drive = rolling_drive(CAR, vx, vy, yaw_rate, still + 0.4)
    error_rad = ekf.estimate(drive, CAR, EkfNoise()) - np.arctan2(vy, vx)
    assert np.degrees(np.abs(error_rad)).max() < 2
