"""Cars: what ships, what is refused, and what follows when a car is changed."""

import pytest

from fleet_slip.errors import ConfigError
from fleet_slip.resources import config_names
from fleet_slip.vehicle.parameters import GRAVITY_MPS2, constants, load_vehicle
from tests.support.rolling import CAR, SEDAN


@pytest.mark.parametrize("name", config_names("vehicles"))
def test_shipped_cars_are_named_after_their_file_and_plausible(name: str) -> None:
    car = load_vehicle(name)
    assert car.name == name
    body = car.body
    assert (
        0.85 < body.yaw_inertia_kgm2 / (body.mass_kg * body.front_axle_m * body.rear_axle_m) < 1.1
    )


@pytest.mark.parametrize("mass_kg", [1000.0, 1740.0])
def test_a_load_changes_inertia_and_wheel_loads_in_proportion(mass_kg: float) -> None:
    loaded = SEDAN.with_sprung_mass(mass_kg)
    c = constants(loaded, 1.0)
    factor = mass_kg / SEDAN.body.sprung_mass_kg
    gained = (factor - 1) * SEDAN.body.sprung_yaw_inertia_kgm2
    assert c.yaw_inertia - CAR.yaw_inertia == pytest.approx(gained)
    assert c.mass - CAR.mass == pytest.approx(mass_kg - 1320)
    assert 2 * (c.static_front + c.static_rear) == pytest.approx(c.mass * GRAVITY_MPS2)
    assert c.static_front / c.static_rear == pytest.approx(CAR.static_front / CAR.static_rear)
    assert SEDAN.body.sprung_mass_kg == 1320


def test_other_tyres_change_stiffness_and_radius_only() -> None:
    c = constants(SEDAN.with_tyres(stiffness_factor=0.9, rolling_radius_factor=1.02), 1.0)
    assert c.stiffness_front == pytest.approx(0.9 * CAR.stiffness_front)
    assert c.radius == pytest.approx(1.02 * CAR.radius)
    assert c.friction == CAR.friction


def test_adhesion_scales_friction_alone() -> None:
    slippery = constants(SEDAN, 0.4)
    changed = {f for f in CAR._fields if getattr(CAR, f) != getattr(slippery, f)}
    assert changed == {"friction", "friction_per_load"}
    assert slippery.friction == pytest.approx(0.4 * CAR.friction)


@pytest.mark.parametrize("number", [0.0, -1.0, float("nan"), float("inf")])
def test_impossible_masses_and_tyres_are_refused(number: float) -> None:
    with pytest.raises(ConfigError, match="d_class_sedan"):
        SEDAN.with_sprung_mass(number)
    for factor in (number, 3.0):
        with pytest.raises(ConfigError, match="d_class_sedan"):
            SEDAN.with_tyres(stiffness_factor=factor)
