"""Imperfections in campaigns and scenarios: drawn as asked for, refused where they cannot be."""

from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.simulation.campaign import load_campaign
from fleet_slip.simulation.imperfections import ImperfectionRanges, Range, RoadImperfections
from fleet_slip.simulation.roads import load_track, surface
from fleet_slip.vehicle.driver import handling
from fleet_slip.vehicle.parameters import load_vehicle

FLEET = SHIPPED_CONFIGS.find("campaigns", "fleet").read_text(encoding="utf-8")
SEDAN = load_vehicle("d_class_sedan", SHIPPED_CONFIGS)


@pytest.mark.parametrize(
    ("kind", "name", "bounds", "reason"),
    [
        ("car", "toe_front", (0.0, 0.1), "no imperfection. Choose from: steering_lash_deg"),
        ("car", "steering_lash_deg", (-1.0, 2.0), "greater than or equal to 0"),
        ("sensors", "label_latency_s", (0.0, 2.0), "less than or equal to 1"),
        ("road", "grade_std_percent", (2.0, 1.0), "is above max"),
    ],
)
def test_ranges_that_cannot_be_are_refused(
    kind: str, name: str, bounds: tuple[float, float], reason: str
) -> None:
    with pytest.raises(ValidationError, match=reason):
        ImperfectionRanges.model_validate({kind: {name: {"min": bounds[0], "max": bounds[1]}}})


def test_a_car_keeps_its_imperfections_and_a_drive_has_its_own_road(tmp_path: Path) -> None:
    file = tmp_path / "campaign.toml"
    ranges = (
        "[plan.imperfections.car]\nsteering_lash_deg = { min = 1.0, max = 4.0 }\n"
        "[plan.imperfections.road]\nwind_mps = { min = 1.0, max = 8.0 }\n"
    )
    text = FLEET.replace("cars = 300", "cars = 3")
    file.write_text(text.replace("[plan.load]", f"{ranges}[plan.load]"))
    campaign = load_campaign(str(file), SHIPPED_CONFIGS)
    drives = [drive for day in campaign.days()[:2] for drive in campaign.drives(day)]
    lash = {(d.vehicle_id, d.flaws.car.steering_lash_deg) for d in drives}
    assert len(lash) == 3
    assert len({d.flaws.road.wind_mps for d in drives}) == len(drives)
    assert (
        campaign.batches(campaign.days()[0])[0].digest
        != load_campaign("fleet", SHIPPED_CONFIGS).batches(campaign.days()[0])[0].digest
    )


def test_load_in_the_boot_moves_the_centre_of_gravity_as_statics_asks() -> None:
    """Axle loads are those of the empty car and of the load, each by its lever (a beam)."""
    body, place, load_kg = SEDAN.body, -1.6, 200.0
    loaded = SEDAN.with_sprung_mass(1320.0 + load_kg, place).body
    front_kg = body.mass_kg * body.rear_axle_m / body.wheelbase_m
    front_kg += load_kg * (body.rear_axle_m + place) / body.wheelbase_m
    assert loaded.mass_kg * loaded.rear_axle_m / loaded.wheelbase_m == pytest.approx(front_kg)
    assert loaded.wheelbase_m == pytest.approx(body.wheelbase_m)
    # The sprung mass as two points at its radius of gyration, the load as a third.
    shift = body.front_axle_m - loaded.front_axle_m
    gyration = np.sqrt(body.sprung_yaw_inertia_kgm2 / body.sprung_mass_kg)
    points = [(660.0, gyration), (660.0, -gyration), (load_kg, place)]
    inertia = sum(mass * (at - shift) ** 2 for mass, at in points)
    assert loaded.sprung_yaw_inertia_kgm2 == pytest.approx(inertia)
    # Behind the rear axle it takes understeer away, K = (Wf / Cf − Wr / Cr) / g.
    heavy = SEDAN.with_sprung_mass(1620.0, -1.9)
    assert handling(heavy).understeer < 0.7 * handling(SEDAN).understeer


def roughness(**road: float) -> list[np.ndarray]:
    track = load_track("waterford_hills", SHIPPED_CONFIGS)
    station_m, _ = track.grid(1.0)
    surfaces = surface(
        RoadImperfections.model_validate(road),
        track,
        station_m,
        np.random.default_rng(1),
        np.random.default_rng(2),
    )
    assert surfaces is not None
    return list(surfaces)


def test_slopes_pull_downhill_and_bends_lean_inwards() -> None:
    along, across, grip_left, right, wind = roughness(cross_slope_percent=2.5)
    np.testing.assert_allclose(across, -9.80665 * np.sin(np.arctan(0.025)))
    assert not along.any()
    assert not wind.any()
    np.testing.assert_array_equal(grip_left, right)
    track = load_track("waterford_hills", SHIPPED_CONFIGS)
    curvature = track.curvature(track.grid(1.0)[0])
    inwards = roughness(superelevation_percent=6.0)[1]
    assert (inwards * curvature >= 0).all()
    assert inwards.max() == pytest.approx(9.80665 * np.sin(np.arctan(0.06)))


def test_a_lap_goes_as_far_up_as_down() -> None:
    along = roughness(grade_std_percent=3.0)[0]
    assert np.mean(along) == pytest.approx(0.0, abs=0.003)
    assert np.std(along) == pytest.approx(0.03 * 9.80665 * np.sqrt(2 / 3), rel=0.4)
    assert abs(along[-1] - along[0]) < 0.03  # the lap closes


def test_adhesion_differs_along_the_road_and_across_it() -> None:
    _, _, grip_left, right, _ = roughness(adhesion_std=0.05, adhesion_split_std=0.1)
    assert np.std((grip_left + right) / 2) == pytest.approx(0.05 * np.sqrt(2 / 3), rel=0.3)
    assert np.std(grip_left - right) == pytest.approx(0.1 * np.sqrt(2 / 3), rel=0.3)


def test_the_realistic_fleet_s_cars_understeer_as_cars_do() -> None:
    """Characteristic speeds v = √(L / K) of today's cars: 65 to 100 km/h, some beyond."""
    campaign = load_campaign("fleet_realistic", SHIPPED_CONFIGS)
    drives = [drive for day in campaign.days()[:6] for drive in campaign.drives(day)]
    speeds_kmh = []
    for drive in drives:
        compliance = np.radians(drive.flaws.car.steering_compliance_deg_per_kn) / 1000
        figures = handling(drive.vehicle, float(compliance))
        speeds_kmh.append(3.6 * np.sqrt(figures.wheelbase / figures.understeer))
    assert 65 < np.median(speeds_kmh) < 100
    assert np.mean(np.array(speeds_kmh) < 65) < 0.05


def test_tyres_wear_from_day_to_day_and_new_ones_follow(tmp_path: Path) -> None:
    """At half a tread in 100 days, 100 days are 5 % of stiffness and 1 % of radius."""
    file = tmp_path / "campaign.toml"
    wear = "[plan.imperfections]\ntread_wear_per_100_days = { min = 0.5, max = 0.5 }\n"
    text = FLEET.replace("cars = 300", "cars = 1").replace(
        "drives_per_day = 48", "drives_per_day = 1"
    )
    text = text.replace("number_of_days = 25", "number_of_days = 201")
    file.write_text(text.replace("[plan.load]", f"{wear}[plan.load]"))
    campaign = load_campaign(str(file), SHIPPED_CONFIGS)
    tyres = [drive.vehicle.tyre for day in campaign.days() for drive in campaign.drives(day)]
    new, old = tyres[0], tyres[100]
    assert old.peak_stiffness_n / new.peak_stiffness_n == pytest.approx(1.05)
    assert old.rolling_radius_m / new.rolling_radius_m == pytest.approx(0.99)
    assert tyres[199].rolling_radius_m < old.rolling_radius_m
    assert tyres[200] == new
    plain = tmp_path / "plain.toml"
    plain.write_text(text)
    (first,) = load_campaign(str(plain), SHIPPED_CONFIGS).drives(campaign.days()[0])
    assert first.vehicle.tyre == new
    with pytest.raises(ValidationError, match="a tread does not grow"):
        ImperfectionRanges(tread_wear_per_100_days=Range(min=-0.1, max=0.1))
