"""Trials on roads of every class: what is drawn, and that load and banks are in the signals."""

import pytest

from fleet_slip.errors import ConfigError
from fleet_slip.evaluation.blind import blind_scenarios
from fleet_slip.simulation.campaign import DriveSpec, load_campaign
from fleet_slip.simulation.roads import CLASSES, load_track
from fleet_slip.vehicle.parameters import load_vehicle

SEDAN = load_vehicle("d_class_sedan")


@pytest.fixture(scope="module")
def drives() -> tuple[DriveSpec, ...]:
    campaign = load_campaign("proving_roads")
    return campaign.drives(campaign.first_day)


def test_every_class_of_road_is_driven_at_its_speeds(drives: tuple[DriveSpec, ...]) -> None:
    by_class = {
        name: [d for d in drives if d.track.name.startswith(f"{name}_")] for name in CLASSES
    }
    for name, some in by_class.items():
        top_mps = CLASSES[name].top_speed_mps
        assert 0.6 * top_mps < max(d.limits.top_speed_mps for d in some) <= top_mps
        lines = {d.track.segments for d in some if d.track.name == some[0].track.name}
        assert len(lines) > 1, "each driver takes a line of his own"
    assert max(d.limits.top_speed_mps for d in by_class["motorway"]) > 42
    assert min(d.adhesion for d in drives) < 0.2
    assert all(d.flaws.road.superelevation_percent > 0 for d in drives)


def test_load_and_wear_are_of_the_drive_and_all_else_of_the_car(
    drives: tuple[DriveSpec, ...],
) -> None:
    tested = [d for d in drives if d.vehicle_id == "proving_roads-0000"]
    rear_m = [d.vehicle.body.rear_axle_m for d in tested]
    assert min(rear_m) < SEDAN.body.rear_axle_m - 0.2
    assert len({d.vehicle.tyre.rolling_radius_m for d in tested}) > len(tested) / 2
    assert {d.flaws.car for d in tested} == {tested[0].flaws.car}


def test_no_road_of_the_plan_is_a_blind_one() -> None:
    """Names reach to nine digits; a version's seeds are below that once in 10⁹ versions."""
    with pytest.raises(ConfigError):
        load_track("country_1000000000")
    assert min(one.seed for one in blind_scenarios("ab" * 32)) > 1e9
    assert load_campaign("proving_roads").seed != load_campaign("proving_ground").seed
