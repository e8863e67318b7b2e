"""The equations of motion against vehicle dynamics as the textbooks have it."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_slip.errors import ConfigError
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.vehicle.driver import handling
from fleet_slip.vehicle.dynamics import cornering_stiffness
from fleet_slip.vehicle.parameters import GRAVITY_MPS2, Controls, State, constants, load_vehicle
from tests.support.rolling import CAR, SEDAN, Run, holding, kinetic_energy, rates, rolling

RATIO = SEDAN.steering.ratio
KNOWN = handling(SEDAN)


def finite(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False)


STATES = st.builds(
    State,
    vx=finite(-60, 60),
    vy=finite(-60, 60),
    yaw_rate=finite(-8, 8),
    steering_wheel=finite(-8.7, 8.7),
    traction=finite(-10, 6),
    ax_lag=finite(-12, 12),
    ay_lag=finite(-12, 12),
    wheel_fl=finite(-200, 200),
    wheel_fr=finite(-200, 200),
    wheel_rl=finite(-200, 200),
    wheel_rr=finite(-200, 200),
)
CONTROLS = st.builds(Controls, steering_wheel=finite(-8.7, 8.7), traction=finite(-10, 6))


EASY = CAR._replace(drag_per_mass=0.0, rolling_resistance=0.0)
"""Needs no drive to hold its speed: a driven tyre corners less stiffly."""


def steady_corner(vx: float, steering_wheel: float) -> Run:
    return Run(rolling(vx), Controls(steering_wheel, 0.0), seconds=8.0, c=EASY)


def test_a_left_turn_has_the_signs_of_iso_8855() -> None:
    turn = steady_corner(20.0, 0.3)
    assert turn.last.yaw_rate > 0
    assert turn.forces[-1, 1] > 0
    assert turn.last.wheel_fr > turn.last.wheel_fl


def test_specific_force_is_what_an_accelerometer_reads() -> None:
    x = rolling(20.0, vy=-1.0, yaw_rate=0.4, steering_wheel=0.5, traction=1.0)
    d = rates(x, Controls(0.5, 1.0), CAR)
    assert d.ax == pytest.approx(d.vx - x.yaw_rate * x.vy, abs=1e-12)
    assert d.ay == pytest.approx(d.vy + x.yaw_rate * x.vx, abs=1e-12)


@pytest.mark.parametrize("vx", [12.0, 20.0, 35.0])
def test_steady_cornering_has_the_analytic_understeer_gradient(vx: float) -> None:
    """δ = L r / v + K ay with K = (W_f / C_f − W_r / C_r) / g, in the linear range."""
    turn = steady_corner(vx, RATIO * 0.2 * (KNOWN.wheelbase / vx**2 + KNOWN.understeer))
    ay = turn.forces[-1, 1]
    tangent = turn.last.steering_wheel / RATIO
    gradient = (tangent - KNOWN.wheelbase * turn.last.yaw_rate / turn.last.vx) / ay
    assert 0.18 < ay < 0.21
    assert gradient == pytest.approx(KNOWN.understeer, rel=0.025)


@pytest.mark.parametrize("vx", [8.0, 15.0, 22.0, 30.0])
def test_steady_side_slip_is_that_of_the_rear_axle(vx: float) -> None:
    """β = b r / v − (W_r / C_r) ay / g, which changes sign with speed."""
    turn = steady_corner(vx, RATIO * 0.2 * (KNOWN.wheelbase / vx**2 + KNOWN.understeer))
    last = turn.last
    expected = KNOWN.rear * last.yaw_rate / last.vx - KNOWN.rear_slip * turn.forces[-1, 1]
    assert last.vy / last.vx == pytest.approx(expected, rel=0.02, abs=2e-5)


def inverse_brush(force: float, load: float, peak: float) -> float:
    """Return the slip at which F = μ Fz (1 − (1 − C σ / (3 μ Fz))³) is the force."""
    limit = (CAR.friction - CAR.friction_per_load * load) * load
    stiffness = CAR.stiffness_ratio * cornering_stiffness(load, peak, CAR)
    share = 1 - (1 - abs(force) / limit) ** (1 / 3)
    return math.copysign(3 * limit / stiffness * share, force)


def test_straight_braking_has_the_slips_and_forces_of_the_brush_tyre() -> None:
    run = Run(rolling(40.0), Controls(0.0, -4.0), seconds=2.0)
    x, ax = run.last, run.forces[-1, 0]
    shift = CAR.pitch_transfer * x.ax_lag
    load_front, load_rear = CAR.static_front - shift, CAR.static_rear + shift
    assert ax == pytest.approx(-4.0 - holding(x.vx), rel=0.03)  # wheels store the rest
    assert 2 * (load_front + load_rear) == pytest.approx(CAR.mass * GRAVITY_MPS2)
    for spin, load, share, peak in (
        (x.wheel_fl, load_front, CAR.brake_front, CAR.stiffness_front),
        (x.wheel_rr, load_rear, CAR.brake_rear, CAR.stiffness_rear),
    ):
        slowing = ax / CAR.radius / CAR.inverse_spin_inertia / CAR.radius  # I dω/dt / R
        force = CAR.mass * share * -4.0 - CAR.rolling_resistance * load - slowing
        slip = 1 - x.vx / (CAR.radius * spin)
        assert slip == pytest.approx(inverse_brush(force, load, peak), rel=0.02)


def test_straight_acceleration_slips_the_driven_wheels_only() -> None:
    run = Run(rolling(15.0), Controls(0.0, 2.5), seconds=2.0)
    x, ax = run.last, run.forces[-1, 0]
    inertia = 4 / CAR.inverse_spin_inertia / CAR.radius**2
    assert ax == pytest.approx((2.5 - holding(x.vx)) / (1 + inertia / CAR.mass), rel=0.02)
    assert x.wheel_fl == x.wheel_fr
    assert CAR.radius * x.wheel_fl / x.vx - 1 > 0.02
    assert abs(CAR.radius * x.wheel_rl / x.vx - 1) < 0.005


def test_engine_power_limits_the_force() -> None:
    run = Run(rolling(50.0), Controls(0.0, 6.0), seconds=0.5)
    strongest = SEDAN.drivetrain.power_w / SEDAN.body.mass_kg / run.last.vx
    assert run.forces[-1, 0] < strongest


def test_a_car_brakes_to_rest_and_stays() -> None:
    run = Run(rolling(5.0), Controls(0.0, -6.0), seconds=4.0)
    assert np.abs(run.states[-1, :3]).max() < 1e-3
    assert np.abs(run.states[-1, -4:]).max() < 1e-2


def mirrored(x: State) -> State:
    return x._replace(
        vy=-x.vy,
        yaw_rate=-x.yaw_rate,
        steering_wheel=-x.steering_wheel,
        ay_lag=-x.ay_lag,
        wheel_fl=x.wheel_fr,
        wheel_fr=x.wheel_fl,
        wheel_rl=x.wheel_rr,
        wheel_rr=x.wheel_rl,
    )


@given(x=STATES, u=CONTROLS)
def test_the_mirrored_car_moves_as_the_mirror_image(x: State, u: Controls) -> None:
    d = rates(x, u, CAR)
    image = rates(mirrored(x), u._replace(steering_wheel=-u.steering_wheel), CAR)
    assert (image.vx, image.ax, image.ax_lag) == (d.vx, d.ax, d.ax_lag)
    assert (image.vy, image.yaw_rate, image.ay) == (-d.vy, -d.yaw_rate, -d.ay)
    assert (image.wheel_fr, image.wheel_rr) == (d.wheel_fl, d.wheel_rl)


@given(x=STATES, u=CONTROLS)
def test_tyres_never_give_energy(x: State, u: Controls) -> None:
    """With neither drive nor brake, the power of all forces on body and wheels is negative."""
    d = rates(x._replace(traction=0.0), u, CAR)
    body = CAR.mass * (x.vx * d.vx + x.vy * d.vy) + CAR.yaw_inertia * x.yaw_rate * d.yaw_rate
    spins = zip(x[-4:], (d.wheel_fl, d.wheel_fr, d.wheel_rl, d.wheel_rr), strict=True)
    wheels = sum(spin * wheel.rate for spin, wheel in spins) / CAR.inverse_spin_inertia
    assert body + wheels <= 1e-6


@pytest.mark.parametrize(
    "start",
    [
        rolling(30.0, steering_wheel=1.0),
        rolling(25.0, vy=6.0, yaw_rate=-1.5),
        rolling(15.0, yaw_rate=4.0),
        rolling(1.5, vy=0.5),
    ],
)
def test_energy_never_grows_in_coasting(start: State) -> None:
    run = Run(start, Controls(start.steering_wheel, 0.0), seconds=6.0)
    energy = kinetic_energy(run.states)
    assert (np.diff(energy) <= 1e-7 * energy[0]).all()
    assert energy[-1] < energy[0]


@settings(max_examples=60)
@given(x=STATES, u=CONTROLS, adhesion=st.sampled_from([0.05, 0.1, 0.4, 1.0, 1.2]))
def test_nothing_blows_up_in_any_spin(x: State, u: Controls, adhesion: float) -> None:
    start = kinetic_energy(np.array([x]))[0]
    run = Run(x, u, seconds=3.0, c=constants(SEDAN, adhesion))
    assert np.isfinite(run.states).all()
    assert np.isfinite(run.forces).all()
    assert kinetic_energy(run.states).max() <= 1.01 * start + SEDAN.drivetrain.power_w * 3.0 + 1


@pytest.mark.parametrize("name", ["compact_hatchback", "d_class_sedan", "rear_drive_sedan", "suv"])
@pytest.mark.parametrize("share", [0.75, 1.0, 1.33])
def test_every_car_understeers_at_every_mass(name: str, share: float) -> None:
    car = load_vehicle(name, SHIPPED_CONFIGS)
    figures = handling(car.with_sprung_mass(share * car.body.sprung_mass_kg))
    assert 0.2 < math.degrees(figures.understeer * GRAVITY_MPS2) < 3.0


def error(step: float) -> float:
    """Largest error of the final state of a hard transient, against a hundredfold finer step."""
    start, demands = rolling(25.0), Controls(1.2, -3.0)
    reference = Run(start, demands, seconds=1.2, step=0.00002).last
    last = Run(start, demands, seconds=1.2, step=step).last
    return float(np.abs(np.subtract(last, reference)).max())


def test_the_scheme_is_of_second_order() -> None:
    ratio = error(0.002) / error(0.001)
    assert 3.3 < ratio < 4.7


def test_stiff_wheels_follow_the_car_without_lag() -> None:
    """At 3 m/s the tyre turns the wheel's speed within a fifth of a step."""
    run = Run(rolling(3.0), Controls(0.0, 2.0), seconds=1.0)
    fine = Run(rolling(3.0), Controls(0.0, 2.0), seconds=1.0, step=0.0002)
    assert np.abs(run["wheel_fl"][::50] - fine["wheel_fl"][::500]).max() < 0.01


@pytest.mark.parametrize("vx", [0.5, 1.5, 2.4, 2.6, 4.0, 8.0])
def test_slow_cars_do_not_oscillate(vx: float) -> None:
    run = Run(rolling(vx, vy=0.1), Controls(0.5, 0.0), seconds=4.0)
    curvature = np.diff(run.states[1500:, :3], n=2, axis=0)
    assert np.abs(curvature).max() < 1e-5


@pytest.mark.parametrize("name", SHIPPED_CONFIGS.names("vehicles"))
def test_shipped_cars_are_named_after_their_file_and_plausible(name: str) -> None:
    car = load_vehicle(name, SHIPPED_CONFIGS)
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
