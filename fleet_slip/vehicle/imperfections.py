"""Equations of motion of a car with imperfections, on a road that is not flat, even and calm.

As `dynamics`, but steering gives way, wheels differ, tyres lag, weight and wind act along the road.
Sources: `docs/simulator.md`.
"""

import math
from typing import Annotated, NamedTuple

from pydantic import Field, FiniteFloat

from fleet_slip.compiling import equation
from fleet_slip.config import Config
from fleet_slip.vehicle.dynamics import (
    Acceleration,
    Derivative,
    Direction,
    Loads,
    WheelForce,
    WheelForces,
    direction_of,
    driven_body,
    driven_spins,
    in_car_frame,
    rates_of,
    transferred_loads,
)
from fleet_slip.vehicle.integration import extrapolate
from fleet_slip.vehicle.parameters import (
    AIR_DENSITY_KGPM3,
    Constants,
    Controls,
    State,
    VehicleParameters,
)
from fleet_slip.vehicle.tyre import CREEP_SPEED_MPS, brush_force

# What a real car has beyond the textbook's; zero is without. Sources: `docs/simulator.md`.

Angle = Annotated[FiniteFloat, Field(ge=-5, le=5)]
RadiusError = Annotated[FiniteFloat, Field(ge=-0.1, le=0.1)]


class CarImperfections(Config):
    """One car's own departures from its parameters."""

    steering_lash_deg: FiniteFloat = Field(default=0.0, ge=0, le=30)
    """Free play of the steering wheel, from stop to stop."""
    steering_compliance_deg_per_kn: FiniteFloat = Field(default=0.0, ge=0, le=0.5)
    """How far the front wheels give way under the lateral force of their axle."""
    toe_front_deg: Angle = 0.0
    """Of each front wheel, positive where the wheels point inwards."""
    toe_rear_deg: Angle = 0.0
    thrust_angle_deg: Angle = 0.0
    """How far the rear axle is turned to the left."""
    radius_error_fl: RadiusError = 0.0
    """Rolling radius over that of the tyre, less one: pressure and wear of this wheel."""
    radius_error_fr: RadiusError = 0.0
    radius_error_rl: RadiusError = 0.0
    radius_error_rr: RadiusError = 0.0
    radius_loss_mm_per_kn: FiniteFloat = Field(default=0.0, ge=0, le=5)
    """How much shorter the rolling radius is under further load."""
    relaxation_length_m: FiniteFloat = Field(default=0.0, ge=0, le=2)
    """Way after which a tyre's lateral slip has built up to 63 %."""
    cold_stiffness: FiniteFloat = Field(default=0.0, ge=-0.5, le=0.5)
    """Cornering stiffness at the start of a drive over that of warm tyres, less one."""
    warm_up_s: FiniteFloat = Field(default=600.0, ge=1)
    """Time constant of its decay."""
    roll_gradient_deg_per_g: FiniteFloat = Field(default=0.0, ge=0, le=15)
    """Roll angle of the body per lateral acceleration: it tilts what is fixed to the body."""
    pitch_gradient_deg_per_g: FiniteFloat = Field(default=0.0, ge=0, le=15)
    """Pitch angle of the body per longitudinal acceleration."""
    side_force_area_m2: FiniteFloat = Field(default=0.0, ge=0)
    """Frontal area times the slope of the side force coefficient, per rad of air flow angle."""
    yawing_moment_volume_m3: FiniteFloat = Field(default=0.0, ge=0)
    """Frontal area times wheelbase times the slope of the yawing moment coefficient, per rad."""


PERFECT = CarImperfections()


class Traits(NamedTuple):
    """The imperfections of a car as its equations take them, in SI units."""

    half_lash: float
    compliance: float
    """Tangent of the road wheels' angle lost per lateral force of the front axle."""
    toe: float
    """Tangent of the front wheels' toe-in."""
    rear_left: float
    """Tangent of the rear left wheel's angle."""
    rear_right: float
    radius_fl: float
    """At the load at rest."""
    radius_fr: float
    radius_rl: float
    radius_rr: float
    radius_loss: float
    relaxes: float
    """1 where the tyres have a relaxation length, else 0."""
    inverse_relaxation: float
    cold_stiffness: float
    cooling: float
    """Share of the cold tyres' excess of stiffness that is left after a sample."""
    wind_force: float
    """Lateral acceleration per speed and cross-wind, in 1/m."""
    wind_moment: float
    """Yaw acceleration per speed and cross-wind, in 1/m²."""


def traits(vehicle: VehicleParameters, flaws: CarImperfections, sample_s: float) -> Traits:
    """Return what the equations need of a car's imperfections."""
    radius, body = vehicle.tyre.rolling_radius_m, vehicle.body
    toe_rear, thrust = math.radians(flaws.toe_rear_deg), math.radians(flaws.thrust_angle_deg)
    length_m = flaws.relaxation_length_m
    pressure = 0.5 * AIR_DENSITY_KGPM3
    return Traits(
        half_lash=math.radians(flaws.steering_lash_deg) / 2,
        compliance=math.radians(flaws.steering_compliance_deg_per_kn) / 1000,
        toe=math.radians(flaws.toe_front_deg),
        rear_left=thrust - toe_rear,
        rear_right=thrust + toe_rear,
        radius_fl=radius * (1 + flaws.radius_error_fl),
        radius_fr=radius * (1 + flaws.radius_error_fr),
        radius_rl=radius * (1 + flaws.radius_error_rl),
        radius_rr=radius * (1 + flaws.radius_error_rr),
        radius_loss=flaws.radius_loss_mm_per_kn * 1e-6,
        relaxes=1.0 if length_m else 0.0,
        inverse_relaxation=1 / length_m if length_m else 0.0,
        cold_stiffness=flaws.cold_stiffness,
        cooling=1 - sample_s / flaws.warm_up_s,
        wind_force=pressure * flaws.side_force_area_m2 / body.mass_kg,
        wind_moment=pressure * flaws.yawing_moment_volume_m3 / body.yaw_inertia_kgm2,
    )


class Around(NamedTuple):
    """The road and the air where the car is, and how warm its tyres are."""

    gravity_x: float
    """Weight per mass along the road, in m/s²; negative uphill."""
    gravity_y: float
    """Weight per mass across the road to the left, in m/s²."""
    grip_left: float
    """Adhesion under the left wheels over that of the drive."""
    grip_right: float
    wind: float
    """Speed of the air across the car to the left, in m/s."""
    stiffness: float
    """Cornering stiffness over that of warm tyres."""


class Give(NamedTuple):
    """What follows the car with a delay of its own."""

    rack: float
    """Angle of the steering wheel that the rack has followed, in rad."""
    rack_force: float
    """Lateral force of the front axle as the steering has given way to it, in N."""
    side_fl: float
    """Lateral velocity of a wheel as its tyre has followed it, in m/s."""
    side_fr: float
    side_rl: float
    side_rr: float


class GiveRates(NamedTuple):
    """Rates of `Give`; the rack has none, its play is taken up at once."""

    rack_force: float
    side_fl: float
    side_fr: float
    side_rl: float
    side_rr: float


class _Wheel(NamedTuple):
    force: WheelForce
    side_rate: float


@equation
def wheel_tangent(tangent: float, far: float, toe: float) -> tuple[float, float]:
    """Return (along, across) of a front wheel with its toe; `tangent / far` is that without."""
    return far - toe * tangent, tangent + toe * far


@equation
def rack_tangent(give: Give, c: Constants, t: Traits) -> float:
    """Return the tangent of the mean front wheel's angle: less where the steering gives way."""
    return c.steer_per_wheel * give.rack - t.compliance * give.rack_force


@equation
def _imperfect_wheel(
    vx: float,
    vy: float,
    followed_side: float,
    to: Direction,
    rolling: float,
    load: float,
    peak: float,
    grip: float,
    c: Constants,
    t: Traits,
) -> _Wheel:
    """Return the force of a wheel whose tyre lags by its relaxation length (Pacejka 2012, 7.2)."""
    cosine, sine = to
    along = cosine * vx + sine * vy
    across = cosine * vy - sine * vx
    felt = across + t.relaxes * (followed_side - across)
    force = brush_force(along, felt, rolling, load, peak, c, grip)
    speed = max(abs(rolling), CREEP_SPEED_MPS)
    return _Wheel(
        in_car_frame(force, to),
        speed * t.inverse_relaxation * (across - followed_side),
    )


@equation
def _wheels(
    x: State, give: Give, around: Around, load: Loads, c: Constants, t: Traits
) -> tuple[WheelForces, GiveRates]:
    tangent = rack_tangent(give, c, t)
    bend = c.ackermann * tangent
    left = direction_of(*wheel_tangent(tangent, 1.0 - bend, -t.toe))
    right = direction_of(*wheel_tangent(tangent, 1.0 + bend, t.toe))
    rear_left, rear_right = direction_of(1.0, t.rear_left), direction_of(1.0, t.rear_right)
    front, rear = x.vy + c.front * x.yaw_rate, x.vy - c.rear * x.yaw_rate
    turn_f, turn_r = c.half_track_front * x.yaw_rate, c.half_track_rear * x.yaw_rate
    peak_f, peak_r = around.stiffness * c.stiffness_front, around.stiffness * c.stiffness_rear
    roll_fl = (t.radius_fl - t.radius_loss * (load.fl - c.static_front)) * x.wheel_fl
    roll_fr = (t.radius_fr - t.radius_loss * (load.fr - c.static_front)) * x.wheel_fr
    roll_rl = (t.radius_rl - t.radius_loss * (load.rl - c.static_rear)) * x.wheel_rl
    roll_rr = (t.radius_rr - t.radius_loss * (load.rr - c.static_rear)) * x.wheel_rr
    grip_l, grip_r = around.grip_left, around.grip_right
    fl = _imperfect_wheel(
        x.vx - turn_f, front, give.side_fl, left, roll_fl, load.fl, peak_f, grip_l, c, t
    )
    fr = _imperfect_wheel(
        x.vx + turn_f, front, give.side_fr, right, roll_fr, load.fr, peak_f, grip_r, c, t
    )
    rl = _imperfect_wheel(
        x.vx - turn_r, rear, give.side_rl, rear_left, roll_rl, load.rl, peak_r, grip_l, c, t
    )
    rr = _imperfect_wheel(
        x.vx + turn_r, rear, give.side_rr, rear_right, roll_rr, load.rr, peak_r, grip_r, c, t
    )
    yielding = (fl.force.y + fr.force.y - give.rack_force) * c.inverse_steering_lag
    rates = GiveRates(yielding, fl.side_rate, fr.side_rate, rl.side_rate, rr.side_rate)
    return WheelForces(fl.force, fr.force, rl.force, rr.force), rates


@equation
def imperfect_derivative(
    x: State, u: Controls, give: Give, around: Around, c: Constants, t: Traits
) -> tuple[Derivative, GiveRates]:
    """Return the rates of a car with imperfections; accelerometers feel wind, not weight."""
    load = transferred_loads(x, c)
    force, give_rates = _wheels(x, give, around, load, c, t)
    still = driven_body(x, force, c)
    push = x.vx * around.wind
    motion = Acceleration(
        still.ax,
        still.ay + t.wind_force * push,
        still.vx + around.gravity_x,
        still.vy + t.wind_force * push + around.gravity_y,
        still.yaw_rate + t.wind_moment * push,
    )
    return rates_of(x, u, motion, driven_spins(x, force, load, c), c), give_rates


@equation
def advance_give(
    give: Give,
    d: GiveRates,
    before: GiveRates,
    column: float,
    t: Traits,
    step: float,
    extrapolation: float,
) -> Give:
    """Return what follows the car after a step; the rack rests within the play, else goes along."""
    return Give(
        min(max(give.rack, column - t.half_lash), column + t.half_lash),
        give.rack_force + step * extrapolate(d.rack_force, before.rack_force, extrapolation),
        give.side_fl + step * extrapolate(d.side_fl, before.side_fl, extrapolation),
        give.side_fr + step * extrapolate(d.side_fr, before.side_fr, extrapolation),
        give.side_rl + step * extrapolate(d.side_rl, before.side_rl, extrapolation),
        give.side_rr + step * extrapolate(d.side_rr, before.side_rr, extrapolation),
    )
