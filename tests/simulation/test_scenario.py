"""Scenarios: what they take over, whose drive they are, and what determines a drive."""

from dataclasses import replace

import numpy as np
import pytest

from fleet_slip.simulation.scenario import load_scenario, shipped_scenarios


def test_the_scenarios_of_the_paper_come_first_in_the_order_of_its_figures() -> None:
    papers = [scenario.paper for scenario in shipped_scenarios()]
    figures = [paper for paper in papers if paper]
    assert papers[: len(figures)] == figures
    assert figures[0].startswith("Figures 1")
    assert figures[-1].startswith("Figure 8")


def test_a_scenario_differs_from_its_base_only_in_what_it_says() -> None:
    base, noisy = load_scenario("nominal"), load_scenario("noise_doubled")
    assert noisy.sensors.ax_bias_mps2 == 0.3
    assert noisy.sensors.wheel_speed_std_rad_s == base.sensors.wheel_speed_std_rad_s
    assert noisy.sensors.gps == base.sensors.gps
    own = {"name", "description", "paper", "base", "drive", "sensors"}
    assert noisy.model_dump(exclude=own) == base.model_dump(exclude=own)


def test_failures_are_added_to_the_drive_of_the_base() -> None:
    assert load_scenario("wheel_stuck").drive_id == load_scenario("nominal").drive_id
    assert load_scenario("gps_tunnel").drive_id == load_scenario("gps_clear").drive_id
    assert load_scenario("mass_1000").drive_id != load_scenario("nominal").drive_id


def test_speed_follows_the_pace() -> None:
    (drive,) = load_scenario("nominal").batch().drives
    planned = replace(drive, pace=()).profile
    factor = drive.profile.speed_mps / planned.speed_mps
    station = planned.station_m
    for point in drive.pace:
        at = np.interp(point.station_m, station, factor)
        assert at == pytest.approx(point.factor, abs=0.006)
    # Before the first and after the last point the track is closed: both are 0.66.
    assert factor[0] == pytest.approx(0.66)
    assert factor.max() == pytest.approx(1.0)
