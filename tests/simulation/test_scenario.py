"""Scenarios: what they take over, whose drive they are, and what determines a drive."""

from pathlib import Path

import numpy as np
import pytest

from fleet_slip.errors import ConfigError
from fleet_slip.simulation.campaign import DriveSpec
from fleet_slip.simulation.scenario import ScenarioDrive, load_scenario, shipped_scenarios


def write(folder: Path, text: str, name: str = "mine") -> str:
    file = folder / "mine.toml"
    file.write_text(f'name = "{name}"\ndescription = "Mine"\nbase = "nominal"\n{text}')
    return str(file)


def drive_of(name: str) -> ScenarioDrive:
    (drive,) = load_scenario(name).batch().drives
    assert isinstance(drive, ScenarioDrive)
    return drive


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


def test_a_scenario_with_failures_cannot_change_the_drive(tmp_path: Path) -> None:
    failure = '[[failures]]\nkind = "missing"\nsignals = ["ax"]\nfrom_s = 1\n'
    with pytest.raises(ConfigError, match="without laps"):
        load_scenario(write(tmp_path, f"laps = 2\n{failure}"))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('drive = "nominal"', "cannot be given"),
        ("pace = [{ station_m = 9, factor = 1 }, { station_m = 8, factor = 1 }]", "increase"),
        ("pace = [{ station_m = 9999, factor = 1 }]", "beyond waterford_hills"),
        ('[[failures]]\nkind = "stuck"\nsignals = ["vx"]\nfrom_s = 1', "cannot fail"),
        ('[[failures]]\nkind = "stuck"\nsignals = ["ax"]\nfrom_s = 5\nuntil_s = 5', "not after"),
        ('vehicle = "bicycle"', "nothing is called 'bicycle'"),
    ],
)
def test_what_is_wrong_is_said(tmp_path: Path, text: str, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        load_scenario(write(tmp_path, text))


def test_a_base_that_leads_back_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="leads back"):
        load_scenario(write(tmp_path, "", name="nominal"))


def test_speed_follows_the_pace() -> None:
    drive = drive_of("nominal")
    planned = DriveSpec.profile.fget(drive)  # type: ignore[attr-defined]
    factor = drive.profile.speed_mps / planned.speed_mps
    station = planned.station_m
    for point in drive.pace:
        at = np.interp(point.station_m, station, factor)
        assert at == pytest.approx(point.factor, abs=0.006)
    # Before the first and after the last point the track is closed: both are 0.66.
    assert factor[0] == pytest.approx(0.66)
    assert factor.max() == pytest.approx(1.0)


def test_the_pace_determines_the_batch(tmp_path: Path) -> None:
    paced = write(tmp_path, "pace = [{ station_m = 9, factor = 0.5 }]", name="paced")
    first = load_scenario(paced).batch()
    other = load_scenario(
        write(tmp_path, "pace = [{ station_m = 9, factor = 0.6 }]", name="paced")
    ).batch()
    again = load_scenario(
        write(tmp_path, "pace = [{ station_m = 9, factor = 0.5 }]", name="paced")
    ).batch()
    assert first.digest == again.digest != other.digest
