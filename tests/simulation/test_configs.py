"""Campaigns, scenarios, tracks and cars: what is wrong in a file is named, what is in it counts."""

from collections.abc import Callable
from dataclasses import replace
from datetime import date
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fleet_slip.errors import ConfigError
from fleet_slip.resources import SHIPPED_CONFIGS, Configs
from fleet_slip.simulation.campaign import load_campaign
from fleet_slip.simulation.roads import load_track
from fleet_slip.simulation.scenario import load_scenario, load_scenarios
from fleet_slip.vehicle.parameters import load_vehicle

LOAD: dict[str, Callable[[str, Configs], Any]] = {
    "campaigns": load_campaign,
    "scenarios": load_scenario,
    "tracks": load_track,
    "vehicles": load_vehicle,
}
SMOKE, SEDAN = "campaigns/smoke", "vehicles/d_class_sedan"
MINE = 'name = "mine"\ndescription = "Mine"\nbase = "nominal"\n'
"""A scenario of one's own."""
FURTHER = 'name = "further"\ndescription = "x"\n'
"""A campaign with a base."""
FAILURE = '[[failures]]\nkind = "missing"\nsignals = ["ax"]\nfrom_s = 1\n'


def track(*segments: str, closed: str = "false") -> str:
    return f'name = "t"\ndescription = "t"\nclosed = {closed}\nsegments = [{", ".join(segments)}]'


def segment(*curvature: float, length_m: float = 9.0) -> str:
    return f"{{ length_m = {length_m}, curvature_1pm = {list(curvature)} }}"


def changed(name: str, old: str, new: str) -> str:
    """Return a shipped config with its last `old` replaced."""
    text = SHIPPED_CONFIGS.find(*name.split("/")).read_text(encoding="utf-8")
    before, key, after = text.rpartition(old)
    assert key, f"{name} has no {old}"
    return before + new + after


@pytest.mark.parametrize(
    ("name", "old", "new", "complaint"),
    [
        (SMOKE, '["waterford_hills"]', '["imola"]', "tracks: no file 'imola'"),
        (SMOKE, "[0.7, 0.8, 0.9, 1.0]", "[0.7, -0.8]", "plan.grid.speed_factor.1"),
        (SMOKE, "adhesion = [1.0]", "adhesion = [nan]", "plan.grid.adhesion.0"),
        (SMOKE, "adhesion", "adhesoin", "plan.grid.adhesoin: unknown key"),
        (SMOKE, "first_day = 2024-05-01", "first_day = 2024-05-32", "not valid TOML"),
        (SMOKE, "number_of_days = 2", "number_of_days = 0", "number_of_days"),
        (SMOKE, "steer_std_rad = 0.0002", "steer_std_rad = -1", "sensors.steer_std_rad"),
        (SMOKE, "rate_hz = 10", "rate_hz = 30", "gps.rate_hz: give a divisor of 100 Hz, not 30 Hz"),
        (SMOKE, 'name = "smoke"', 'name = "smoke test"', "name"),
        (SMOKE, "seed = 1", "", "seed"),
        ("campaigns/fleet", "min = 0.85", "min = 1.85", "tyre_stiffness: min 1.85 is above max"),
        ("campaigns/fleet", "cars = 300", "cars = 0", "plan.fleet.cars"),
        ("campaigns/proving_ground", "share = 0.4", "share = 1.4", "share"),
        ("campaigns/proving_ground", "other_every = 10", "other_every = 1", "other_every"),
        ("campaigns/proving_roads", "load_position_m", "# load_position_m", "give both load_kg"),
        ("campaigns/proving_roads", "tread_wear_per", "# tread_wear_per", "needs imperfections."),
        ("campaigns/proving_roads", '"city_1"', '"waterford_hills"', "such as country_17, not wat"),
        ("scenarios/nominal", "[limits]", "load_position_m = -1.0\n[limits]", "a sprung_mass_kg"),
        ("scenarios/nominal", "[limits]", "[imperfections.car]\nlash = 1\n[limits]", "unknown key"),
        (SEDAN, "height_m = 0.54", "height_m = -0.54", "body.height_m"),
        (SEDAN, "friction = 1.0", "friction = nan", "tyre.friction"),
        (SEDAN, "peak_stiffness_n = 77500", "peak_stiffness_n = 400000", "lower peak_stiffness_n"),
        ("scenarios", "", MINE + 'drive = "nominal"', "cannot be given"),
        ("scenarios", "", MINE + 'vehicle = "bicycle"', "no file 'bicycle'"),
        ("scenarios", "", MINE.replace("mine", "nominal"), "leads back"),
        ("scenarios", "", f"{MINE}laps = 2\n{FAILURE}", "unchanged: remove laps"),
        ("scenarios", "", MINE + FAILURE.replace('"ax"', '"vx"'), "cannot fail"),
        ("scenarios", "", f"{MINE}{FAILURE}until_s = 1", "not after"),
        ("scenarios", "", f"{MINE}pace = [{{ station_m = 9999, factor = 1 }}]", "beyond waterford"),
        (
            *("scenarios", ""),
            f"{MINE}pace = [{{ station_m = 9, factor = 1 }}, {{ station_m = 8, factor = 1 }}]",
            "increase",
        ),
        ("campaigns", "", FURTHER + 'base = "waterford_course"', "has a base itself"),
        ("campaigns", "", FURTHER + 'base = "nowhere"', "no file 'nowhere'"),
        ("tracks", "", track(), "segments"),
        ("tracks", "", track(segment(0, 0, length_m=0)), "segments.0.length_m"),
        ("tracks", "", track(segment(0)), "segments.0.curvature_1pm"),
        ("tracks", "", track(segment(0, 0), segment(0.1, 0.1)), "jumps from 0.0 to 0.1 1/m after"),
        ("tracks", "", track(segment(0, 0), closed="true"), "does not close"),
    ],
)
def test_a_mistake_is_named_with_file_key_and_reason(
    tmp_path: Path, name: str, old: str, new: str, complaint: str
) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(changed(name, old, new) if old else new)
    with pytest.raises(ConfigError) as error:
        LOAD[name.partition("/")[0]](str(file), SHIPPED_CONFIGS)
    assert str(file) in str(error.value)
    assert complaint in str(error.value)


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        (SMOKE, "seed = 1", "seed = 2"),
        (SMOKE, "mass_kg = [1320.0]", "mass_kg = [1320.5]"),
        (SMOKE, "[0.7, 0.8, 0.9, 1.0]", "[0.71, 0.81, 0.91, 1.01]"),
        (SMOKE, "ax_bias_mps2 = 0.15", "ax_bias_mps2 = 0.16"),
        ("tracks/waterford_hills", "length_m = 89.145", "length_m = 89.1451"),
        (SEDAN, "height_m = 0.54", "height_m = 0.541"),
        (
            "campaigns/proving_ground",
            "usual = 0.0\nshare = 0.4\nmin = 0.5",
            "usual = 3.0\nshare = 1.0\nmin = 0.5",
        ),
    ],
)
def test_every_key_changes_the_digest(tmp_path: Path, name: str, old: str, new: str) -> None:
    """Also one of the car, of the track, and of the manoeuvres."""
    kind, _, file_name = name.partition("/")
    keys = []
    for text in (changed(name, old, old), changed(name, old, new)):
        file = tmp_path / "mine.toml"
        file.write_text(text)
        if kind != "campaigns":
            file = tmp_path / "campaign.toml"
            file.write_text(changed(SMOKE, f'["{file_name}"]', f'["{tmp_path}/mine.toml"]'))
        campaign = load_campaign(str(file), SHIPPED_CONFIGS)
        keys.append({batch.digest for batch in campaign.batches(campaign.first_day)})
    shipped = load_campaign(file_name if kind == "campaigns" else "smoke", SHIPPED_CONFIGS)
    assert keys[0] == {batch.digest for batch in shipped.batches(shipped.first_day)}
    assert keys[0].isdisjoint(keys[1])


def test_the_pace_determines_the_batch_and_further_days_none(tmp_path: Path) -> None:
    digests = []
    for factor in (0.5, 0.6, 0.5):
        (tmp_path / "mine.toml").write_text(
            f"{MINE}pace = [{{ station_m = 9, factor = {factor} }}]"
        )
        digests.append(load_scenario(str(tmp_path / "mine.toml"), SHIPPED_CONFIGS).batch().digest)
    assert digests[0] == digests[2] != digests[1]
    for name in ("smoke", "fleet"):
        campaign = load_campaign(name, SHIPPED_CONFIGS)
        longer = campaign.model_copy(update={"number_of_days": campaign.number_of_days + 5})
        assert longer.days()[: campaign.number_of_days] == campaign.days()
        for day in campaign.days()[:3]:
            assert longer.batches(day) == campaign.batches(day)


def test_open_tracks_have_no_laps(tmp_path: Path) -> None:
    file = tmp_path / "campaign.toml"
    file.write_text(changed(SMOKE, '["waterford_hills"]', '["straight"]'))
    assert load_campaign(str(file), SHIPPED_CONFIGS).drives_per_day == 4
    file.write_text(file.read_text().replace("laps = 0.5", "laps = 2"))
    with pytest.raises(ConfigError, match=r"laps is 2\.0, but the track 'straight' is open"):
        load_campaign(str(file), SHIPPED_CONFIGS)


@pytest.mark.parametrize("name", ["smoke", "fleet"])
def test_batches_hold_each_drive_once_in_order_and_about_as_many_rows(name: str) -> None:
    campaign = load_campaign(name, SHIPPED_CONFIGS)
    for day in campaign.days()[:3]:
        batches = campaign.batches(day)
        assert [batch.index for batch in batches] == list(range(len(batches)))
        assert tuple(d for b in batches for d in b.drives) == campaign.drives(day)
        names = [drive.drive_id for batch in batches for drive in batch.drives]
        assert len(names) == campaign.drives_per_day
        assert all(a < b for a, b in pairwise(names))
        rows = [sum(drive.expected_rows for drive in batch.drives) for batch in batches]
        longest = max(drive.expected_rows for batch in batches for drive in batch.drives)
        assert max(rows) <= campaign.rows_per_file + longest
        assert max(rows) - min(rows) <= 2 * longest


@pytest.mark.parametrize("day", [date(2024, 4, 30), date(2024, 5, 3)])
def test_a_day_outside_the_campaign_is_refused(day: date) -> None:
    with pytest.raises(ConfigError, match="lasts from 2024-05-01 to 2024-05-02"):
        load_campaign("smoke", SHIPPED_CONFIGS).batches(day)


def test_the_scenarios_of_the_paper_come_first_in_the_order_of_its_figures() -> None:
    papers = [scenario.paper for scenario in load_scenarios(SHIPPED_CONFIGS)]
    figures = [paper for paper in papers if paper]
    assert papers[: len(figures)] == figures
    assert figures[0].startswith("Figures 1")
    assert figures[-1].startswith("Figure 8")


def test_failures_are_added_to_the_drive_of_the_base() -> None:
    assert (
        load_scenario("wheel_stuck", SHIPPED_CONFIGS).drive_id
        == load_scenario("nominal", SHIPPED_CONFIGS).drive_id
    )
    assert (
        load_scenario("gps_tunnel", SHIPPED_CONFIGS).drive_id
        == load_scenario("gps_clear", SHIPPED_CONFIGS).drive_id
    )
    assert (
        load_scenario("mass_1000", SHIPPED_CONFIGS).drive_id
        != load_scenario("nominal", SHIPPED_CONFIGS).drive_id
    )


def test_speed_follows_the_pace() -> None:
    (drive,) = load_scenario("nominal", SHIPPED_CONFIGS).batch().drives
    planned = replace(drive, pace=()).profile
    factor = drive.profile.speed_mps / planned.speed_mps
    station = planned.station_m
    for point in drive.pace:
        at = np.interp(point.station_m, station, factor)
        assert at == pytest.approx(point.factor, abs=0.006)
    # Before the first and after the last point the track is closed: both are 0.66.
    assert factor[0] == pytest.approx(0.66)
    assert factor.max() == pytest.approx(1.0)
