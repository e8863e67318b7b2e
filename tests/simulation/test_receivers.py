"""Receivers: the course changes as the heading and the side-slip angle do, with their faults."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.simulation.campaign import load_campaign
from fleet_slip.simulation.sensors import Measurement, Receiver, receive
from fleet_slip.simulation.simulate import simulate_logs
from tests.support.catalog import SIGNALS

TICK_S = 0.01
RAD = 2 * np.pi / 65536
EXACT = Receiver(rate_hz=10, velocity_std_mps=0, time_between_outages_s=1e6, outage_duration_s=1e-6)
OF_SMOKE = """
name = "received"
description = "The drives of smoke with receivers"
base = "smoke"

[[receivers.types]]
rate_hz = 10
velocity_std_mps = 0.05
time_between_outages_s = 10.0
outage_duration_s = 2.0
"""


def truth(ticks: int = 3000, speed: float = 15.0) -> dict[str, NDArray[np.float64]]:
    """A car that turns left and right, further than a whole turn in sum, and slides a little."""
    time = np.arange(ticks) * TICK_S
    return {
        "vx_mps": np.full(ticks, speed),
        "vy_mps": 0.3 * np.sin(1.1 * time),
        "yaw_rate_rad_s": 0.5 + 0.3 * np.sin(0.7 * time),
    }


def logged(receiver: Receiver, drive: dict[str, NDArray[np.float64]]) -> Measurement:
    """Return what is logged of a drive."""
    return receive(SIGNALS, receiver, np.random.default_rng(5), drive)


def changes(
    fixes: Measurement, drive: dict[str, NDArray[np.float64]], ticks: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the course's change less the yaw rate's integral, in rad, and the ticks it is of."""
    r = drive["yaw_rate_rad_s"]
    turned = np.append(0.0, np.cumsum((r[1:] + r[:-1]) * TICK_S / 2))
    at = np.flatnonzero(fixes.gps_fix)
    at = at[(at >= ticks) & fixes.gps_fix[at - ticks]]
    counts = fixes.counts["course"]
    change = (counts[at] - counts[at - ticks]) * RAD  # int16 wraps
    less = change - (turned[at] - turned[at - ticks])
    return (less + np.pi) % (2 * np.pi) - np.pi, at


def test_the_course_changes_as_heading_and_side_slip_angle_do() -> None:
    drive = truth()
    fixes = logged(EXACT, drive)
    slip = np.arctan2(drive["vy_mps"], drive["vx_mps"])
    rates, at = changes(fixes, drive, 400)
    assert len(at) == 260
    assert np.abs(rates - (slip[at] - slip[at - 400])).max() < 1.01 * RAD
    assert np.ptp(fixes.counts["course"][fixes.gps_fix].astype(int)) > 64_000, "it goes round"
    speed = fixes.counts["satellite_speed"][fixes.gps_fix] * 0.005
    assert np.abs(speed - np.hypot(drive["vx_mps"], drive["vy_mps"])[fixes.gps_fix]).max() <= 0.0026


def test_a_delay_is_of_course_and_speed() -> None:
    drive = truth()
    now, late = logged(EXACT, drive), logged(EXACT.model_copy(update={"delay_s": 0.1}), drive)
    for name, counts in late.counts.items():
        assert np.abs(counts[10::10] - now.counts[name][:-10:10]).max() <= 1
    assert not late.gps_fix[0] and late.gps_fix[10], "before the first fix came there is none"


def test_an_antenna_before_the_place_it_is_taken_for_adds_yaw_rate_over_speed() -> None:
    drive = truth()
    now, displaced = (
        logged(EXACT, drive),
        logged(EXACT.model_copy(update={"antenna_x_m": 1.0}), drive),
    )
    more = (displaced.counts["course"] - now.counts["course"])[now.gps_fix] * RAD
    assert np.abs(more - drive["yaw_rate_rad_s"][now.gps_fix] / 15.0).max() < 2e-4


def test_noise_is_of_each_fix_or_lasts() -> None:
    drive = {
        name: np.full(200_000, value)
        for name, value in (("vx_mps", 20.0), ("vy_mps", 0.0), ("yaw_rate_rad_s", 0.0))
    }
    for key, correlated in (("velocity_std_mps", 0.0), ("wander_std_mps", 0.9)):
        fixes = logged(EXACT.model_copy(update={key: 0.1}), drive)
        error = fixes.counts["course"][fixes.gps_fix] * RAD * 20.0
        error = error - error.mean() if key == "velocity_std_mps" else error - error[0]
        following = np.corrcoef(error[1:], error[:-1])[0, 1]
        assert following == pytest.approx(1.0 if correlated else 0.0, abs=0.1)
        assert key == "wander_std_mps" or error.std() == pytest.approx(0.1, rel=0.05)


def test_a_campaign_with_receivers_has_the_drives_of_its_base(tmp_path: Path) -> None:
    (tmp_path / "received.toml").write_text(OF_SMOKE)
    plain, received = (
        load_campaign("smoke", SHIPPED_CONFIGS),
        load_campaign(str(tmp_path / "received.toml"), SHIPPED_CONFIGS),
    )
    day = plain.days()[0]
    (before,), (after,) = (simulate_logs(SIGNALS, c.drives(day)[:1]) for c in (plain, received))
    assert before.spec.drive_id != after.spec.drive_id
    assert before.fixes is None and after.fixes is not None
    for name, counts in before.measurement.counts.items():
        assert (counts == after.measurement.counts[name]).all(), name
    assert 0.5 < after.fixes.gps_fix.sum() * 10 / after.rows < 1.0
    true = before.measurement.counts["vx"] * 0.005
    speed = after.fixes.counts["satellite_speed"] * 0.005
    assert np.abs(speed - true)[after.fixes.gps_fix].max() < 0.5
