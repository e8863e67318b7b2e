"""Imperfections of car and road: each does what its closed form says, and none does nothing."""

import numpy as np
import pytest

from fleet_slip.vehicle.batch import LaneDrive, Road, Surface
from fleet_slip.vehicle.driver import SAMPLE_S, handling
from fleet_slip.vehicle.dynamics import Compliance, ComplianceRates
from fleet_slip.vehicle.integration import SECOND_ORDER, advance_compliance
from fleet_slip.vehicle.parameters import (
    GRAVITY_MPS2,
    PERFECT,
    CarImperfections,
    constants,
    imperfection_constants,
)
from tests.support.rolling import SEDAN, Truth, simulate_drives

RIGID = Compliance(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def surface(entries: int, **changes: float) -> Surface:
    usual = {"grip_left": 1.0, "grip_right": 1.0}
    values = {name: changes.get(name, usual.get(name, 0.0)) for name in Surface._fields}
    return Surface(**{name: np.full(entries, value) for name, value in values.items()})


def circle(radius_m: float, speed_mps: float, **changes: float) -> Road:
    entries = round(2 * np.pi * radius_m)
    flat = np.ones(entries)
    return Road(
        2 * np.pi * radius_m / entries,
        flat / radius_m,
        flat * speed_mps,
        2 * np.pi * radius_m,
        True,
        surface(entries, **changes) if changes else None,
    )


def straight(speed_mps: float, **changes: float) -> Road:
    flat = np.ones(1201)
    return Road(1.0, 0 * flat, flat * speed_mps, 1200.0, False, surface(1201, **changes))


def drive(road: Road, flaws: CarImperfections = PERFECT, laps: float = 1.0) -> Truth:
    (truth,) = simulate_drives([LaneDrive(SEDAN, road, 1.0, laps, flaws)])
    assert truth.lost_control_tick is None
    return truth


def end(values: np.ndarray) -> float:
    return float(np.mean(values[-300:]))


def test_a_mirrored_car_on_a_mirrored_road_drives_mirrored() -> None:
    flaws = CarImperfections(
        steering_lash_deg=3.0,
        steering_compliance_deg_per_kn=0.1,
        toe_front_deg=0.1,
        thrust_angle_deg=0.2,
        radius_error_fl=0.003,
        radius_error_rr=-0.002,
        radius_loss_mm_per_kn=1.0,
        relaxation_length_m=0.4,
        cold_stiffness=0.1,
        side_force_area_m2=5.0,
        yawing_moment_volume_m3=3.0,
    )
    image = flaws.model_copy(
        update={
            "thrust_angle_deg": -0.2,
            "radius_error_fl": 0.0,
            "radius_error_fr": 0.003,
            "radius_error_rr": 0.0,
            "radius_error_rl": -0.002,
        }
    )
    changes = {"gravity_x_mps2": 0.2, "grip_left": 0.8}
    road = circle(80.0, 15.0, **changes, gravity_y_mps2=0.3, cross_wind_mps=8.0)
    mirrored_road = circle(80.0, 15.0, gravity_x_mps2=0.2, grip_right=0.8, gravity_y_mps2=-0.3)
    assert mirrored_road.surface is not None
    mirrored_road = mirrored_road._replace(
        curvature_1pm=-mirrored_road.curvature_1pm,
        surface=mirrored_road.surface._replace(
            cross_wind_mps=np.full(len(mirrored_road.speed_mps), -8.0)
        ),
    )
    original, other = drive(road, flaws), drive(mirrored_road, image)
    np.testing.assert_allclose(other.sideslip_rad, -original.sideslip_rad, atol=1e-9)
    np.testing.assert_allclose(other.wheel_fr_rad_s, original.wheel_fl_rad_s, rtol=1e-9)
    np.testing.assert_allclose(other.steer_fr_rad, -original.steer_fl_rad, atol=1e-9)


def test_compliance_shows_in_the_wheels_and_not_in_what_the_sideslip_is() -> None:
    road, flaws = circle(100.0, 15.0), CarImperfections(steering_compliance_deg_per_kn=0.2)
    soft, rigid = drive(road, flaws), drive(road)
    assert end(soft.sideslip_rad) == pytest.approx(end(rigid.sideslip_rad), abs=2e-5)
    assert end(soft.steer_fl_rad) == pytest.approx(end(rigid.steer_fl_rad), abs=2e-4)
    assert end(soft.steering_wheel_rad) > 1.1 * end(rigid.steering_wheel_rad)


def test_a_rack_with_play_rests_until_the_column_has_crossed_it() -> None:
    t = imperfection_constants(SEDAN, CarImperfections(steering_lash_deg=4.0), SAMPLE_S)
    half, still = np.radians(2.0), ComplianceRates(0.0, 0.0, 0.0, 0.0, 0.0)
    rack = []
    compliance = RIGID
    for column in np.radians([1.0, 2.0, 3.0, 5.0, 3.0, 1.0, 0.9, -3.0]):
        compliance = advance_compliance(
            compliance, still, still, float(column), t, 0.002, SECOND_ORDER
        )
        rack.append(compliance.rack)
    expected = [0.0, 0.0, np.radians(1), np.radians(3), np.radians(3), np.radians(3)]
    np.testing.assert_allclose(rack[:6], expected, atol=1e-12)
    assert rack[6] == pytest.approx(np.radians(0.9) + half)
    assert rack[7] == pytest.approx(np.radians(-3.0) + half)


def test_lash_lets_the_road_wheels_lag_behind_the_steering_wheel() -> None:
    bends = np.concatenate([np.sin(np.arange(1201) / 30) / 60])
    road = Road(1.0, bends, np.full(1201, 15.0), 1200.0, False)
    loose = drive(road, CarImperfections(steering_lash_deg=6.0))
    gap = loose.steering_wheel_rad - SEDAN.steering.ratio * np.tan(
        (loose.steer_fl_rad + loose.steer_fr_rad) / 2
    )
    assert np.degrees(np.abs(gap).max()) == pytest.approx(3.0, abs=0.15)


@pytest.mark.parametrize("wheel", ["fl", "fr", "rl", "rr"])
def test_a_larger_wheel_turns_slower(wheel: str) -> None:
    flaws = CarImperfections(**{f"radius_error_{wheel}": 0.003})
    larger, usual = drive(straight(20.0), flaws), drive(straight(20.0))
    for name in ("fl", "fr", "rl", "rr"):
        ratio = end(getattr(larger, f"wheel_{name}_rad_s")) / end(
            getattr(usual, f"wheel_{name}_rad_s")
        )
        assert ratio == pytest.approx(1 / 1.003 if name == wheel else 1.0, abs=2e-4), name


def test_loaded_wheels_roll_on_a_shorter_radius() -> None:
    """The outer wheel gains, the inner loses, what the load transfer shortens and lengthens."""
    road = circle(100.0, 20.0)
    motion = drive(road, CarImperfections(radius_loss_mm_per_kn=1.5))
    usual = drive(road)
    c = constants(SEDAN, 1.0)
    for side, sign in (("rr", 1.0), ("rl", -1.0)):
        load = (
            sign * c.roll_transfer_rear * end(usual.ay_mps2)
            - c.pitch_transfer * end(usual.ax_mps2) * -1
        )
        expected = 1 / (1 - 1.5e-6 * load / SEDAN.tyre.rolling_radius_m)
        name = f"wheel_{side}_rad_s"
        ratio = end(getattr(motion, name)) / end(getattr(usual, name))
        assert ratio == pytest.approx(expected, abs=3e-4)


def test_the_thrust_angle_is_side_slip_of_a_car_going_straight() -> None:
    """Rear wheels turned left push the tail left: the car goes straight with its nose right."""
    motion = drive(straight(20.0), CarImperfections(thrust_angle_deg=0.3))
    assert np.degrees(end(motion.sideslip_rad)) == pytest.approx(0.3, abs=0.02)
    assert np.degrees(end(motion.steer_fl_rad)) == pytest.approx(0.3, abs=0.03)


def test_toe_turns_the_wheels_against_each_other() -> None:
    motion = drive(straight(20.0), CarImperfections(toe_front_deg=0.2))
    assert np.degrees(end(motion.steer_fl_rad)) == pytest.approx(-0.2, abs=0.01)
    assert np.degrees(end(motion.steer_fr_rad)) == pytest.approx(0.2, abs=0.01)
    assert abs(end(motion.sideslip_rad)) < 1e-4


def test_cold_tyres_stiffen_the_car_and_grow_warm() -> None:
    road = circle(80.0, 18.0)
    figures = handling(SEDAN)
    cold = drive(road, CarImperfections(cold_stiffness=0.2, warm_up_s=1e9))
    warm = drive(road)
    slip = figures.rear / 80.0 - np.array([end(t.sideslip_rad) for t in (cold, warm)])
    assert slip[1] / slip[0] == pytest.approx(1.2, rel=0.06)
    soon = drive(road, CarImperfections(cold_stiffness=0.2, warm_up_s=1.0))
    assert end(soon.sideslip_rad) == pytest.approx(end(warm.sideslip_rad), abs=1e-5)


def test_an_accelerometer_feels_the_weight_that_a_banked_road_asks_for() -> None:
    """Straight across a slope the tyres hold the weight: ay = −g_y, and v̇y = 0."""
    motion = drive(straight(20.0, gravity_y_mps2=0.4))
    assert end(motion.ay_mps2) == pytest.approx(-0.4, abs=0.005)
    assert abs(end(motion.yaw_rate_rad_s)) < 1e-3
    c = constants(SEDAN, 1.0)
    slip = handling(SEDAN).rear_slip * 0.4  # the rear axle's, which has no yaw rate to add
    assert end(motion.sideslip_rad) == pytest.approx(slip, rel=0.03)
    assert c.rear > 0


def test_an_accelerometer_feels_the_weight_that_a_climb_asks_for() -> None:
    """At constant speed the drive force holds the weight: ax = −g_x."""
    motion = drive(straight(15.0, gravity_x_mps2=-0.5))
    rate = np.gradient(motion.vx_mps, 0.01)
    assert end(motion.ax_mps2 - rate) == pytest.approx(0.5, abs=0.005)
    assert end(motion.ax_mps2) == pytest.approx(0.5, abs=0.01)


def test_a_side_wind_is_held_by_the_tyres() -> None:
    """Going straight, wind and tyres cancel: ay is 0, and the axles share force and moment."""
    flaws = CarImperfections(side_force_area_m2=5.0, yawing_moment_volume_m3=3.0)
    motion = drive(straight(30.0, cross_wind_mps=10.0), flaws)
    assert end(motion.ay_mps2) == pytest.approx(0.0, abs=0.005)
    pressure, body = 0.5 * 1.225 * 30.0 * 10.0, SEDAN.body
    force, moment = 5.0 * pressure, 3.0 * pressure
    rear = (body.front_axle_m * force - moment) / body.wheelbase_m  # to the right
    c = constants(SEDAN, 1.0)
    per_force = handling(SEDAN).rear_slip * GRAVITY_MPS2 / (2 * c.static_rear)
    assert end(motion.sideslip_rad) == pytest.approx(rear * per_force, rel=0.05)


def test_a_slippery_side_shifts_no_line_but_the_slip() -> None:
    road = circle(80.0, 20.0)
    usual, split = drive(road), drive(circle(80.0, 20.0, grip_right=0.7))
    assert end(split.sideslip_rad) < end(usual.sideslip_rad) - np.radians(0.1)
