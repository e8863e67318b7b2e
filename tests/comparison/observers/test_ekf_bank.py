"""The bank of extended Kalman filters: the likeliest adhesion prevails; dry roads stay dry."""

import numpy as np
import pytest

from fleet_slip.arrays import FloatArray
from fleet_slip.comparison.observers import ekf, ekf_bank
from fleet_slip.comparison.observers.drive_signals import STEP_S, DriveSignals
from fleet_slip.comparison.observers.ekf_bank import ADHESIONS, BankNoise
from fleet_slip.comparison.observers.single_track import Axles, rates
from fleet_slip.vehicle.parameters import load_vehicle
from tests.support.drives import noisy, rolling_drive

CAR = load_vehicle("d_class_sedan")


def slalom(adhesion: float) -> tuple[DriveSignals, FloatArray]:
    """Return what noisy sensors read of a slalom on a road, and its side-slip."""
    noise = ekf.EkfNoise(adhesion=adhesion)
    time_s = np.arange(4000) * STEP_S
    vx, steer, ay = np.full(4000, 20.0), 0.05 * np.sin(1.2 * time_s), np.zeros(4000)
    for _ in range(2):  # loads follow ay, which follows from them
        loaded = ekf.axles_of(CAR, np.zeros(4000), ay, noise)
        vy, r = np.zeros(4000), np.zeros(4000)
        for k in range(3999):
            d = rates(vx[k], vy[k], r[k], steer[k], Axles(*loaded[:, k]), ekf.chassis(CAR))
            vy[k + 1] = vy[k] + STEP_S * (d.ay - r[k] * vx[k])
            r[k + 1] = r[k] + STEP_S * d.yaw
        drive = rolling_drive(CAR, vx, vy, r, steer)
        ay = drive.ay_mps2
    return noisy(drive, seed=4), np.arctan2(vy, vx)


def rms_deg(error: FloatArray) -> float:
    return float(np.degrees(np.sqrt(np.mean(error[1000:] ** 2))))


def test_on_a_slippery_road_it_errs_as_the_filter_that_is_told() -> None:
    drive, truth = slalom(0.45)
    found = rms_deg(ekf_bank.estimate(drive, CAR, BankNoise(evidence=0.1)) - truth)
    told = rms_deg(ekf.estimate(drive, CAR, ekf.EkfNoise(adhesion=0.45)) - truth)
    blind = rms_deg(ekf.estimate(drive, CAR, ekf.EkfNoise()) - truth)
    assert found < 1.3 * told < 0.3 * blind


def test_on_a_dry_road_it_is_the_filter_that_believes_so() -> None:
    drive, truth = slalom(1.0)
    found = ekf_bank.estimate(drive, CAR, BankNoise())
    np.testing.assert_allclose(found, ekf.estimate(drive, CAR, ekf.EkfNoise()), atol=2e-4)
    assert rms_deg(found - truth) < 0.2


def test_without_evidence_a_weight_is_its_prior_and_evidence_is_forgotten() -> None:
    noise = BankNoise(memory_s=1.0, evidence=0.1, odds=0.5)
    prior = 0.5 ** np.arange(len(ADHESIONS))
    likelihoods = np.zeros((len(ADHESIONS), 4000))
    likelihoods[3, 100:300] = 5.0
    share = ekf_bank.weights(likelihoods, noise)
    np.testing.assert_allclose(share.sum(axis=0), 1.0)
    np.testing.assert_allclose(share[:, 99], prior / prior.sum())
    assert share[3, 299] > 0.99
    np.testing.assert_allclose(share[:, -1], prior / prior.sum())


@pytest.mark.parametrize("odds", [0.1, 1.0])
def test_a_search_remembers_what_the_filters_found(odds: float) -> None:
    drive, _ = slalom(0.45)
    remembering = ekf_bank.remembering()
    for one in (BankNoise(), BankNoise(odds=odds, memory_s=5.0)):
        expected = ekf_bank.estimate(drive, CAR, one)
        np.testing.assert_array_equal(remembering(drive, CAR, one), expected)
