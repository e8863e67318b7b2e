"""Trials on a proving ground and on roads: what is drawn, what manoeuvres make of a drive."""

import numpy as np
import pytest

from fleet_slip.errors import ConfigError
from fleet_slip.evaluation.blind import blind_scenarios
from fleet_slip.simulation.campaign import DriveSpec, load_campaign
from fleet_slip.simulation.plan import TrialPlan
from fleet_slip.simulation.roads import CLASSES, SLOWEST_MPS, Manoeuvre, load_track, road_with
from fleet_slip.simulation.scenario import shipped_scenarios
from fleet_slip.vehicle.batch import LaneDrive, Road
from fleet_slip.vehicle.parameters import load_vehicle
from tests.support.rolling import simulate_drives

SEDAN = load_vehicle("d_class_sedan")


@pytest.fixture(scope="module")
def drives() -> tuple[DriveSpec, ...]:
    campaign = load_campaign("proving_ground")
    return tuple(drive for day in campaign.days() for drive in campaign.drives(day))


def straight(speed_mps: float = 20.0, *, closed: bool = False) -> Road:
    entries = 600 if closed else 601
    return Road(1.0, np.zeros(entries), np.full(entries, speed_mps), 600.0, closed)


def test_one_car_is_tested_and_others_take_turns(drives: tuple[DriveSpec, ...]) -> None:
    plan = load_campaign("proving_ground").plan
    assert isinstance(plan, TrialPlan)
    tested = [d for d in drives if d.vehicle_id == "proving_ground-0000"]
    assert len(tested) == len(drives) * (plan.other_every - 1) // plan.other_every
    assert {d.vehicle.name for d in tested} == {"d_class_sedan"}
    names = {d.vehicle_id: d.vehicle.name for d in drives}
    others = {car: name for car, name in names.items() if car != tested[0].vehicle_id}
    assert len(others) == plan.others
    assert len(set(others.values())) == 4


def test_no_drive_of_a_scenario_is_driven(drives: tuple[DriveSpec, ...]) -> None:
    tests = [scenario.batch().drives[0] for scenario in shipped_scenarios()]
    assert {d.seed for d in drives}.isdisjoint(d.seed for d in tests)
    plans = {(d.vehicle, d.track.name, d.limits, d.adhesion) for d in drives}
    assert plans.isdisjoint((d.vehicle, d.track.name, d.limits, d.adhesion) for d in tests)


def test_a_step_turns_to_its_side_and_back() -> None:
    road = road_with(straight(), [Manoeuvre("step", 100.0, 2.0, 3.0, 1.0)])
    assert road.curvature_1pm[99] == 0.0
    assert road.curvature_1pm[100:120] == pytest.approx(3.0 / 400)
    assert road.curvature_1pm[120:140] == pytest.approx(-3.0 / 400)
    assert road.curvature_1pm[140:] == pytest.approx(0.0)
    assert road.speed_mps == pytest.approx(20.0)


def test_a_slalom_swings_once_a_period_and_ends_where_it_began() -> None:
    road = road_with(straight(), [Manoeuvre("slalom", 100.0, 4.0, 2.0, 2.0)])
    swing = road.curvature_1pm[100:180]
    assert np.abs(swing).max() == pytest.approx(2.0 / 400)
    assert swing.sum() == pytest.approx(0.0, abs=1e-12)
    assert int((np.diff(np.sign(swing[1:])) < 0).sum()) == 2


def test_braking_slows_down_as_hard_as_it_says_and_never_to_a_stop() -> None:
    road = road_with(straight(), [Manoeuvre("braking", 100.0, 2.0, -3.0, 1.0)])
    assert road.speed_mps.min() == pytest.approx(20.0 - 3.0)
    assert road.speed_mps[100] == pytest.approx(20.0)
    slow = road_with(straight(5.0), [Manoeuvre("braking", 100.0, 9.0, 9.0, 1.0)])
    assert slow.speed_mps.min() == SLOWEST_MPS


def test_a_manoeuvre_goes_on_over_the_start_of_a_closed_road_and_not_of_an_open_one() -> None:
    script = [Manoeuvre("step", 590.0, 2.0, 3.0, 1.0)]
    assert road_with(straight(closed=True), script).curvature_1pm[:5] == pytest.approx(3.0 / 400)
    assert road_with(straight(), script).curvature_1pm[:5] == pytest.approx(0.0)


def test_a_car_drives_the_lateral_acceleration_of_a_slalom() -> None:
    road = road_with(straight(), [Manoeuvre("slalom", 200.0, 8.0, 2.0, 4.0)])
    (plain, swung) = simulate_drives([LaneDrive(SEDAN, r, 1.0, 1.0) for r in (straight(), road)])
    assert np.abs(plain.ay_mps2).max() < 0.01
    assert 1.6 < np.abs(swung.ay_mps2).max() < 2.8
    assert swung.lost_control_tick is None


@pytest.fixture(scope="module")
def on_roads() -> tuple[DriveSpec, ...]:
    campaign = load_campaign("proving_roads")
    return campaign.drives(campaign.first_day)


def test_every_class_of_road_is_driven_at_its_speeds(on_roads: tuple[DriveSpec, ...]) -> None:
    by_class = {
        name: [d for d in on_roads if d.track.name.startswith(f"{name}_")] for name in CLASSES
    }
    for name, some in by_class.items():
        top_mps = CLASSES[name].top_speed_mps
        assert 0.6 * top_mps < max(d.limits.top_speed_mps for d in some) <= top_mps
        lines = {d.track.segments for d in some if d.track.name == some[0].track.name}
        assert len(lines) > 1, "each driver takes a line of his own"
    assert max(d.limits.top_speed_mps for d in by_class["motorway"]) > 42
    assert min(d.adhesion for d in on_roads) < 0.2
    assert all(d.flaws.road.superelevation_percent > 0 for d in on_roads)


def test_load_and_wear_are_of_the_drive_and_all_else_of_the_car(
    on_roads: tuple[DriveSpec, ...],
) -> None:
    tested = [d for d in on_roads if d.vehicle_id == "proving_roads-0000"]
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
