"""The paper's filter against textbook algebra, the joint Gaussian, and what its model must give."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray
from fleet_slip.compiling import kernel
from fleet_slip.errors import DataError
from fleet_slip.evaluation import kalman
from fleet_slip.evaluation.evaluated_drives import STEP_S, DriveSignals
from fleet_slip.evaluation.kalman import (
    FilterNoise,
    GaussianState,
    fuse,
    independent_state,
    predict,
    update,
    variances,
)
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.vehicle.parameters import load_vehicle
from tests.support.drives import (
    GPS_EVERY,
    noisy,
    rolling_drive,
    slalom,
    tunnel,
    without_fixes,
)

CAR = load_vehicle("d_class_sedan", SHIPPED_CONFIGS)
H = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0]])
NOISE = FilterNoise(ax_std_mps2=0.1, ay_std_mps2=0.2, bias_walk_mps2_per_sqrt_s=0.02)


def transition(yaw_rate: float) -> FloatArray:
    """F(k), from equation (5) by the paper's differences."""
    kinematics = np.array([[0, -1, yaw_rate, 0], [0] * 4, [-yaw_rate, 0, 0, -1], [0] * 4])
    return np.eye(4) + STEP_S * kinematics


def matrices(noise: FilterNoise) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Q, R and the first P."""
    b1 = STEP_S * H.T
    walk = noise.bias_walk_mps2_per_sqrt_s**2 * STEP_S
    q = b1 @ np.diag([noise.ax_std_mps2**2, noise.ay_std_mps2**2]) @ b1.T
    r = np.diag([noise.gps_vx_std_mps**2, noise.gps_vy_std_mps**2])
    first = np.diag([r[0, 0], noise.bias_std_mps2**2, r[1, 1], noise.bias_std_mps2**2])
    return q + np.diag([0, walk, 0, walk]), r, first


def textbook_filter(drive: DriveSignals, yaw_rate: FloatArray, noise: FilterNoise) -> FloatArray:
    """Equations (9) to (11) as they stand, dense and without Joseph."""
    q, r, p = matrices(noise)
    x = np.array([drive.gps_vx_mps[0], 0, drive.gps_vy_mps[0], 0])
    means = [x]
    for k in range(1, len(drive)):
        f = transition(yaw_rate[k])
        x = f @ x + STEP_S * H.T @ np.array([drive.ax_mps2[k], drive.ay_mps2[k]])
        p = f @ p @ f.T + q
        z = np.array([drive.gps_vx_mps[k], drive.gps_vy_mps[k]])
        if np.isfinite(z).all():
            gain = p @ H.T @ np.linalg.inv(H @ p @ H.T + r)
            x = x + gain @ (z - H @ x)
            p = (np.eye(4) - gain @ H) @ p
        means.append(x)
    return np.array(means).T


def generate(
    rows: int, noise: FilterNoise, seed: int
) -> tuple[DriveSignals, FloatArray, FloatArray]:
    """Return signals, yaw rate and true states of a drive that the filter's own model makes."""
    generator = np.random.default_rng(seed)
    drive, _ = slalom(CAR, rows)
    yaw_rate = drive.yaw_rate_rad_s
    q, r, p = matrices(noise)
    measured = np.stack([drive.ax_mps2, drive.ay_mps2])
    x = np.array([20.0, 0.0, 0.0, 0.0]) + np.sqrt(np.diag(p)) * [0, 1, 0, 1] * (
        generator.standard_normal(4)
    )
    states = [x]
    for k in range(1, rows):
        w = np.sqrt(np.diag(q)) * generator.standard_normal(4)
        x = transition(yaw_rate[k]) @ x + STEP_S * H.T @ measured[:, k] + w
        states.append(x)
    truth = np.array(states).T
    fix = np.where(np.arange(rows) % GPS_EVERY == 0, 0.0, np.nan)
    gps = truth[[0, 2]] + np.sqrt(np.diag(r))[:, None] * generator.standard_normal((2, rows)) + fix
    return replace(drive, gps_vx_mps=gps[0], gps_vy_mps=gps[1]), yaw_rate, truth


def test_agrees_with_the_textbook_filter_to_1e_10() -> None:
    drive, yaw_rate, _ = generate(8000, NOISE, seed=1)
    drive = without_fixes(drive, tunnel(len(drive), 40.0))
    expected = textbook_filter(drive, yaw_rate, NOISE)
    np.testing.assert_allclose(fuse(drive, yaw_rate, NOISE), expected, rtol=0, atol=1e-10)


def test_agrees_with_the_joint_gaussian_posterior() -> None:
    """Least squares over the first state and all noises of a short drive at once."""
    rows = 41
    drive, yaw_rate, _ = generate(rows, NOISE, seed=2)
    q, r, p = matrices(NOISE)
    first = np.array([drive.gps_vx_mps[0], 0, drive.gps_vy_mps[0], 0])
    mean, lever = first, np.eye(4, 4 * rows)
    equations = [np.eye(4 * rows) / np.sqrt(np.tile(np.diag(q), rows))[:, None]]
    equations[0][:4, :4] = np.diag(1 / np.sqrt(np.diag(p)))
    values = [np.zeros(4 * rows)]
    for k in range(1, rows):
        f = transition(yaw_rate[k])
        mean = f @ mean + STEP_S * H.T @ np.array([drive.ax_mps2[k], drive.ay_mps2[k]])
        lever = f @ lever
        lever[:, 4 * k : 4 * k + 4] = np.eye(4)
        if k % GPS_EVERY == 0:
            z = np.array([drive.gps_vx_mps[k], drive.gps_vy_mps[k]])
            equations.append(np.diag(1 / np.sqrt(np.diag(r))) @ H @ lever)
            values.append((z - H @ mean) / np.sqrt(np.diag(r)))
    system = np.concatenate(equations)
    solution = np.linalg.lstsq(system, np.concatenate(values), rcond=None)[0]
    posterior = lever @ np.linalg.inv(system.T @ system) @ lever.T

    state = last_state(drive, yaw_rate, NOISE)
    np.testing.assert_allclose(state.mean, mean + lever @ solution, rtol=0, atol=1e-9)
    np.testing.assert_allclose(state.covariance, posterior, rtol=0, atol=1e-9)


def last_state(drive: DriveSignals, yaw_rate: FloatArray, noise: FilterNoise) -> GaussianState:
    first, q, r = variances(noise)
    fix = drive.gps_vx_mps[0], drive.gps_vy_mps[0]
    state = independent_state((fix[0], 0.0, fix[1], 0.0), first)
    for k in range(1, len(drive)):
        predict(state, drive.ax_mps2[k], drive.ay_mps2[k], yaw_rate[k], STEP_S, q)
        if np.isfinite(drive.gps_vx_mps[k]):
            update(state, drive.gps_vx_mps[k], drive.gps_vy_mps[k], r)
    return state


@kernel
def covariances_over(
    steps: int, interval: int, turn: float, first: Any, q: Any, r: Any
) -> NDArray[np.float64]:
    state = independent_state((20.0, 0.0, 0.0, 0.0), first)
    covariances = np.empty((steps // interval, 4, 4))
    for k in range(steps):
        predict(state, 0.0, 0.0, turn * np.sin(0.001 * k), STEP_S, q)
        if k % 10 == 0:
            update(state, 20.0, 0.0, r)
        if k % interval == interval - 1:
            covariances[k // interval] = state.covariance
    return covariances


@pytest.mark.long
@pytest.mark.parametrize("gps_std", [1e-5, 0.05])
def test_covariance_stays_positive_definite_over_a_million_steps(gps_std: float) -> None:
    """With no bias walk the biases' variance falls for ever; that is where definiteness is lost."""
    noise = FilterNoise(gps_vx_std_mps=gps_std, gps_vy_std_mps=gps_std)
    for covariance in covariances_over(1_000_000, 1000, 0.4, *variances(noise)):
        assert np.array_equal(covariance, covariance.T)
        scale = 1 / np.sqrt(np.diag(covariance))
        assert np.linalg.eigvalsh(covariance * np.outer(scale, scale)).min() > 0


def test_josephs_form_retains_variances_that_rounding_would_lose() -> None:
    """P (I − K H) of a very precise fix after great uncertainty rounds to zero and below."""
    vague = FilterNoise(gps_vx_std_mps=1e-5, gps_vy_std_mps=1e-5)
    state = independent_state((0.0, 0.0, 0.0, 0.0), (1e10, 1.0, 1e10, 1.0))
    update(state, 1.0, 2.0, variances(vague)[2])
    np.testing.assert_allclose(state.mean, [1, 0, 2, 0], atol=1e-12)
    np.testing.assert_allclose(np.diag(state.covariance), [1e-10, 1, 1e-10, 1], rtol=1e-9)


def test_biases_are_found() -> None:
    exact, _ = slalom(CAR, 30_000)
    estimate = fuse(noisy(exact, seed=4), exact.yaw_rate_rad_s, FilterNoise())
    assert estimate[1, -1] == pytest.approx(0.15, abs=0.01)
    assert estimate[3, -1] == pytest.approx(0.15, abs=0.01)


def test_steady_circle_persists_without_a_fix() -> None:
    """The sign of ψ̇ u_x in (6b): with the printed plus, a circle would not persist."""
    constant = np.full(3000, 1.0)
    vx, vy, yaw_rate = 15 * constant, -0.4 * constant, 0.3 * constant
    drive = rolling_drive(CAR, vx, vy, yaw_rate, 0.05 * constant)
    only_first = without_fixes(drive, np.arange(3000) > 0)
    estimate = fuse(only_first, yaw_rate, FilterNoise())
    np.testing.assert_allclose(estimate[0], vx, atol=1e-9)
    np.testing.assert_allclose(estimate[2], vy, atol=1e-9)


def test_begins_at_the_first_fix() -> None:
    drive = without_fixes(noisy(slalom(CAR, 500)[0], seed=7), np.arange(500) < 205)
    estimate = fuse(drive, drive.yaw_rate_rad_s, FilterNoise())
    assert np.isnan(estimate[0][:210]).all()
    assert estimate[0][210] == drive.gps_vx_mps[210]
    assert np.isfinite(estimate[:, 210:]).all()
    beta = kalman.estimate(drive, CAR, FilterNoise())
    assert np.array_equal(np.isnan(beta), np.arange(500) < 210)


def test_half_a_fix_is_none() -> None:
    drive = noisy(slalom(CAR, 500)[0], seed=8)
    half = replace(drive, gps_vy_mps=np.where(np.arange(500) >= 100, np.nan, drive.gps_vy_mps))
    without = without_fixes(drive, np.arange(500) >= 100)
    expected = fuse(without, drive.yaw_rate_rad_s, FilterNoise())
    assert np.array_equal(fuse(half, drive.yaw_rate_rad_s, FilterNoise()), expected)


def test_drive_without_gps_is_refused() -> None:
    drive = without_fixes(slalom(CAR, 50)[0], np.ones(50, dtype=bool))
    with pytest.raises(DataError, match="no GPS fix"):
        kalman.estimate(drive, CAR, FilterNoise())
