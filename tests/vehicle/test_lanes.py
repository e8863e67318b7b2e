"""Whole drives: the driver on the tracks, the loss, and that a drive depends on itself alone."""

import dataclasses
import re
from typing import Any

import numpy as np
import pytest

from fleet_slip.compiling import inner_loop
from fleet_slip.errors import ConfigError
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.simulation.roads import SpeedLimits, load_track, speed_profile
from fleet_slip.vehicle import batch
from fleet_slip.vehicle.batch import CHANNELS, LaneDrive, Road
from fleet_slip.vehicle.parameters import VehicleParameters, load_vehicle
from tests.support.rolling import SEDAN, Truth, simulate_drives

MASSES_KG = (1000.0, 1320.0, 1740.0)
TRACKS = ("waterford_hills", "melbourne")


def road(name: str, lateral_mps2: float, speed_factor: float = 1.0) -> Road:
    limits = SpeedLimits(
        lateral_mps2=lateral_mps2, acceleration_mps2=2.5, braking_mps2=4.0, top_speed_mps=45.0
    )
    track = load_track(name, SHIPPED_CONFIGS)
    profile = speed_profile(track, limits, spacing_m=1.0)
    return Road(
        profile.spacing_m,
        track.curvature(profile.station_m),
        speed_factor * profile.speed_mps,
        track.length_m,
        track.closed,
    )


def circle(radius_m: float, speed_mps: float, entries: int = 200) -> Road:
    length_m = 2 * np.pi * radius_m
    curvature, speed = np.full(entries, 1 / radius_m), np.full(entries, speed_mps)
    return Road(length_m / entries, curvature, speed, length_m, closed=True)


def slalom(speed_mps: float = 20.0) -> Road:
    station = np.arange(0.0, 401.0, 1.0)
    curvature = 0.006 * np.sin(2 * np.pi * station / 100.0)
    return Road(1.0, curvature, np.full(len(station), speed_mps), 400.0, closed=False)


def drive(car: VehicleParameters, on: Road, adhesion: float = 1.0, laps: float = 1.0) -> Truth:
    (truth,) = simulate_drives([LaneDrive(car, on, adhesion, laps)])
    return truth


def assert_same_bits(truth: Truth, other: Truth) -> None:
    for name in CHANNELS:
        assert getattr(truth, name).tobytes() == getattr(other, name).tobytes()
    assert truth.lost_control_tick == other.lost_control_tick


def worst_difference_deg(truths: list[Truth], references: list[Truth]) -> float:
    worst = 0.0
    for truth, other in zip(truths, references, strict=True):
        n = min(len(truth.vx_mps), len(other.vx_mps))
        difference = np.degrees(truth.sideslip_rad[:n] - other.sideslip_rad[:n])
        worst = max(worst, float(np.abs(difference).max()))
    return worst


@pytest.mark.parametrize("track", TRACKS)
@pytest.mark.parametrize("lateral_mps2", [3.0, 5.0, 7.0])
def test_the_driver_keeps_within_two_and_a_half_metres(track: str, lateral_mps2: float) -> None:
    on = road(track, lateral_mps2)
    drives = [LaneDrive(SEDAN.with_sprung_mass(m), on, 1.0, laps=2.0) for m in MASSES_KG]
    for truth in simulate_drives(drives):
        assert truth.lost_control_tick is None
        assert np.abs(truth.lateral_offset_m).max() < 2.5
        assert np.abs(truth.ay_mps2).max() > 0.9 * lateral_mps2


@pytest.mark.parametrize("name", ["compact_hatchback", "rear_drive_sedan", "suv"])
def test_the_other_cars_keep_to_the_line_too(name: str) -> None:
    for track in TRACKS:
        truth = drive(load_vehicle(name, SHIPPED_CONFIGS), road(track, 6.0))
        assert truth.lost_control_tick is None
        assert np.abs(truth.lateral_offset_m).max() < 2.5


@pytest.mark.parametrize("mass_kg", MASSES_KG)
def test_on_a_slippery_road_a_dry_speed_profile_loses_the_car(mass_kg: float) -> None:
    truth = drive(SEDAN.with_sprung_mass(mass_kg), road("waterford_hills", 5.0), adhesion=0.4)
    lost = truth.lost_control_tick
    assert lost is not None
    assert len(truth.vx_mps) == lost + batch.SAMPLES_AFTER_LOSS + 1
    assert np.abs(truth.lateral_offset_m[:lost]).max() <= batch.LOST_OFFSET_M
    for name in CHANNELS:
        assert np.isfinite(getattr(truth, name)).all()
    horizontal = np.hypot(truth.ax_mps2, truth.ay_mps2)
    assert horizontal.max() < 0.4 * 9.81 * 1.15


def test_a_spin_is_logged_through_full_turns() -> None:
    truth = drive(SEDAN.with_sprung_mass(1000.0), circle(60.0, 24.0), adhesion=0.55, laps=3.0)
    assert truth.lost_control_tick is not None
    assert np.abs(truth.sideslip_rad).max() <= np.pi


def test_halving_the_step_changes_side_slip_by_less_than_a_hundredth_degree() -> None:
    drives = [
        LaneDrive(SEDAN.with_sprung_mass(m), road(track, lateral), adhesion, 1.0)
        for track, lateral, adhesion in (
            ("waterford_hills", 7.0, 1.0),
            ("melbourne", 7.0, 1.0),
            ("waterford_hills", 3.0, 0.4),
        )
        for m in MASSES_KG
    ]
    assert worst_difference_deg(simulate_drives(drives), simulate_drives(drives, 10)) < 0.01


def test_a_drive_does_not_depend_on_the_others() -> None:
    """Not on their number, order, length or fate, nor on the lane it gets."""
    roads = [road("waterford_hills", 4.0), circle(50.0, 15.0), slalom(), circle(60.0, 24.0)]
    drives = [
        LaneDrive(SEDAN.with_sprung_mass(1000.0 + 37.0 * i), roads[i % 4], 1.0 - 0.02 * i, 0.7)
        for i in range(21)
    ]
    together = simulate_drives(drives)
    backwards = simulate_drives(drives[::-1])[::-1]
    for i, lane_drive in enumerate(drives):
        assert_same_bits(together[i], backwards[i])
        assert_same_bits(together[i], simulate_drives([lane_drive])[0])


def test_a_long_drive_does_not_depend_on_short_ones_in_other_lanes() -> None:
    """Their lanes are taken again while the long one goes on."""
    on = circle(50.0, 15.0)
    long, short = LaneDrive(SEDAN, on, 1.0, 30.0), LaneDrive(SEDAN, on, 0.9, 3.0)
    truth = simulate_drives([short, long, *[short] * 20])[1]
    assert len(truth.vx_mps) > 8 * 100 * 3.0 * on.length_m / 15.0
    assert_same_bits(truth, simulate_drives([long])[0])


def test_steady_circle_is_kinematics() -> None:
    """r = v / R, ay = r vx, Ackermann: cot δ_left − cot δ_right = − track / wheelbase."""
    truth = drive(SEDAN, circle(80.0, 18.0), laps=3.0)
    end = slice(-200, None)
    speed = np.hypot(truth.vx_mps, truth.vy_mps)[end]
    radius = 80.0 - truth.lateral_offset_m[end]
    np.testing.assert_allclose(truth.yaw_rate_rad_s[end], speed / radius, rtol=1e-3)
    np.testing.assert_allclose(
        truth.ay_mps2[end], truth.yaw_rate_rad_s[end] * truth.vx_mps[end], rtol=1e-3
    )
    body = SEDAN.body
    cotangents = 1 / np.tan(truth.steer_fl_rad[end]) - 1 / np.tan(truth.steer_fr_rad[end])
    np.testing.assert_allclose(cotangents, -body.track_front_m / body.wheelbase_m, rtol=1e-9)
    hubs = truth.yaw_rate_rad_s * body.track_rear_m
    rolling = SEDAN.tyre.rolling_radius_m * (truth.wheel_rr_rad_s - truth.wheel_rl_rad_s)
    np.testing.assert_allclose(rolling[end], hubs[end], rtol=0.05)


def test_accelerations_and_velocities_belong_together() -> None:
    """ax = v̇x − r vy and ay = v̇y + r vx at every sample, by central differences."""
    truth = drive(SEDAN, road("waterford_hills", 5.0))
    r, vx, vy = truth.yaw_rate_rad_s, truth.vx_mps, truth.vy_mps
    ax = np.gradient(vx, 0.01) - r * vy
    ay = np.gradient(vy, 0.01) + r * vx
    assert np.sqrt(np.mean((ax - truth.ax_mps2)[2:-2] ** 2)) < 0.03
    assert np.sqrt(np.mean((ay - truth.ay_mps2)[2:-2] ** 2)) < 0.03


def test_the_place_is_the_integral_of_the_motion() -> None:
    """Dead reckoning in the plane ends where station and offset say, on a circle."""
    truth = drive(SEDAN, circle(70.0, 15.0), laps=1.5)
    heading = np.cumsum(np.append(0.0, (truth.yaw_rate_rad_s[1:] + truth.yaw_rate_rad_s[:-1]) / 2))
    heading *= 0.01
    vx, vy = truth.vx_mps, truth.vy_mps
    east = vx * np.cos(heading) - vy * np.sin(heading)
    north = vx * np.sin(heading) + vy * np.cos(heading)
    x = 0.01 * np.sum((east[1:] + east[:-1]) / 2)
    y = 0.01 * np.sum((north[1:] + north[:-1]) / 2)
    angle, radius = truth.station_m[-1] / 70.0, 70.0 - truth.lateral_offset_m[-1]
    assert x == pytest.approx(radius * np.sin(angle), abs=0.02)
    assert y == pytest.approx(70.0 - radius * np.cos(angle), abs=0.02)


def test_station_stays_within_the_lap_and_laps_are_counted() -> None:
    on = circle(50.0, 12.0)
    truth = drive(SEDAN, on, laps=2.5)
    assert truth.station_m.min() >= 0
    assert truth.station_m.max() < on.length_m
    assert (np.diff(truth.station_m) < 0).sum() == 2
    travelled = np.sum(np.hypot(truth.vx_mps, truth.vy_mps)) * 0.01
    assert travelled == pytest.approx(2.5 * on.length_m, rel=0.01)


def test_an_open_road_ends_the_drive() -> None:
    truth = drive(SEDAN, slalom(), laps=5.0)
    assert truth.station_m[-1] == pytest.approx(400.0, abs=0.3)
    assert np.abs(truth.lateral_offset_m).max() < 1.0


def test_a_drive_that_gets_nowhere_ends() -> None:
    """An engine too weak for the profile: the drive ends after MAX_TIME_FACTOR times the plan."""
    feeble = SEDAN.model_copy(
        update={"drivetrain": SEDAN.drivetrain.model_copy(update={"power_w": 3000.0})}
    )
    on = circle(500.0, 50.0)
    truth = drive(feeble, on, laps=3.0)
    planned_s = 3 * on.length_m / 50.0
    assert len(truth.vx_mps) == pytest.approx((1.25 * planned_s + 5.0) * 100, abs=2)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"speed_mps": np.full(3, 10.0)}, "missing or infinite entries"),
        ({"length_m": 300.0}, "length of 300.0 m"),
        ({"speed_mps": np.full(200, 0.0)}, "above 0.5 m/s"),
        ({"curvature_1pm": np.full(200, np.nan)}, "missing or infinite entries"),
    ],
)
def test_unusable_roads_are_refused(changes: dict[str, object], reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        drive(SEDAN, circle(50.0, 15.0)._replace(**changes))  # type: ignore[arg-type]


def test_impossible_adhesion_is_refused() -> None:
    usable = LaneDrive(SEDAN, circle(50.0, 15.0), 1.0, 1.0)
    with pytest.raises(ConfigError, match="adhesion"):
        simulate_drives([dataclasses.replace(usable, adhesion=0.0)])


@pytest.mark.long
def test_the_inner_loop_is_vector_instructions_without_fused_operations() -> None:
    """On x86-64 with AVX: the physics divides in whole vectors, and no operation is fused."""

    def loops(memory: Any) -> None:  # those of the kernel over all lanes
        batch.decide_lanes(memory)
        batch.integrate_lanes(memory, 0.002, True)

    fresh = inner_loop(loops)
    fresh(batch.empty_lanes()[0])
    (assembly,) = fresh.inspect_asm().values()  # type: ignore[attr-defined]
    if "ymm" not in assembly:
        pytest.skip("this processor has no AVX")
    assert len(re.findall(r"vdivpd.*[yz]mm", assembly)) >= 15
    assert len(re.findall(r"vsqrtpd.*[yz]mm", assembly)) >= 8
    assert not re.findall(r"vfn?m(add|sub)", assembly)
