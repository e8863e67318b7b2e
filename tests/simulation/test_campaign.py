"""Campaigns: what is driven is a function of the file alone, and faults in it are named."""

from collections import Counter
from datetime import date
from itertools import pairwise
from pathlib import Path

import pytest

from fleet_slip.errors import ConfigError
from fleet_slip.resources import find_config
from fleet_slip.simulation.campaign import Campaign, load_campaign
from fleet_slip.simulation.plan import DriveDraw, GridPlan
from fleet_slip.simulation.roads import random_generator

SMOKE = find_config("campaigns", "smoke").read_text(encoding="utf-8")


def load_text(folder: Path, text: str) -> Campaign:
    file = folder / "campaign.toml"
    file.write_text(text)
    return load_campaign(str(file))


@pytest.mark.parametrize("name", ["smoke", "fleet"])
def test_batches_hold_each_drive_once_in_order_and_about_as_many_rows(name: str) -> None:
    campaign = load_campaign(name)
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


def test_drive_names_can_be_read() -> None:
    drive = load_campaign("smoke").drives(date(2024, 5, 2))[3]
    assert (drive.drive_id, drive.vehicle_id) == ("smoke-2024-05-02-0003", "smoke-0000")
    assert drive.source == "simulated"


def test_grid_takes_every_combination_once_before_any_twice() -> None:
    plan = load_campaign("waterford").plan
    assert isinstance(plan, GridPlan)
    sensors = load_campaign("waterford").sensors
    count = len(plan.lateral_mps2) * len(plan.speed_factor)
    none = random_generator(0)
    taken = [plan.assignment(DriveDraw(n, sensors, none, none)) for n in range(2 * count)]
    times = Counter((a.limits.lateral_mps2, a.speed_factor) for a in taken[:count])
    assert len(times) == count
    assert set(times.values()) == {1}
    assert taken[count:] == taken[:count]


def test_each_day_of_a_grid_covers_the_range_of_speeds() -> None:
    campaign = load_campaign("waterford")
    assert isinstance(campaign.plan, GridPlan)
    lowest, highest = min(campaign.plan.speed_factor), max(campaign.plan.speed_factor)
    for day in campaign.days():
        factors = sorted(drive.speed_factor for drive in campaign.drives(day))
        ends = [lowest, *factors, highest]
        assert max(b - a for a, b in pairwise(ends)) < (highest - lowest) / 4


def test_cars_of_a_grid_are_its_vehicles_and_masses(tmp_path: Path) -> None:
    text = SMOKE.replace("[1320.0]", "[1000.0, 1320.0, 1740.0]")
    campaign = load_text(tmp_path, text.replace("number_of_days = 2", "number_of_days = 6"))
    drives = [d for day in campaign.days() for d in campaign.drives(day)]
    masses = {(d.vehicle_id, d.vehicle.body.sprung_mass_kg) for d in drives}
    assert masses == {("smoke-0000", 1000.0), ("smoke-0001", 1320.0), ("smoke-0002", 1740.0)}


def test_cars_of_a_fleet_differ_and_keep_their_properties() -> None:
    campaign = load_campaign("fleet")
    drives = [d for day in campaign.days() for d in campaign.drives(day)]
    cars = {(d.vehicle_id, d.vehicle, d.sensors) for d in drives}
    assert len(cars) == len({d.vehicle_id for d in drives}) == 300
    assert len({d.vehicle for d in drives}) == 300
    assert len({d.sensors for d in drives}) == 300
    assert len({d.vehicle.name for d in drives}) > 1
    assert len({d.track.name for d in drives}) > 1
    assert len({d.adhesion for d in drives}) == len(drives)
    for drive in drives:
        assert drive.limits.lateral_mps2 <= 0.61 * drive.adhesion * 9.81


def test_random_generators_differ_by_seed_and_by_every_part_of_their_name() -> None:
    names = [("a", "b"), ("ab",), ("b", "a"), ("a", "b", "c")]
    drawn = [random_generator(seed, *name).random() for seed in (1, 2) for name in names]
    assert len(set(drawn)) == 2 * len(names)
    assert random_generator(1, "a", "b").random() == drawn[0]


@pytest.mark.parametrize("day", [date(2024, 4, 30), date(2024, 5, 3)])
def test_a_day_outside_the_campaign_is_refused(day: date) -> None:
    with pytest.raises(ConfigError, match="goes from 2024-05-01 to 2024-05-02"):
        load_campaign("smoke").batches(day)
