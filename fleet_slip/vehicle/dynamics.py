"""Equations of motion of a car with four wheels, on a road that need not be flat, even and calm.

Steering may give way, wheels differ and tyres lag; weight and wind act along the road. Symbols,
sources and limits: `docs/vehicle.md`; of what a real car has beyond the textbook's,
`docs/simulator.md`.
"""

import math
from typing import NamedTuple

from fleet_slip.compiling import equation
from fleet_slip.vehicle.parameters import Constants, Controls, State, Traits
from fleet_slip.vehicle.tyre import CREEP_SPEED_MPS, TyreForce, brush_force

SMALLEST_LOAD_N = 1.0
"""Load of a wheel that has lifted: it gives no force and divides nothing by zero."""

STICTION_RAD_S = 0.1
"""Wheel speed below which brakes and rolling resistance fade, so that a wheel comes to rest."""

SLOWEST_DRIVE_MPS = 1.0
"""Speed below which the engine's power no longer limits its force."""


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


class Loads(NamedTuple):
    """Vertical load of each wheel in N."""

    fl: float
    fr: float
    rl: float
    rr: float


Brakes = Loads
"""Brake force at the rim of each wheel in N, beside the driver's, before anti-lock control."""

NO_BRAKES = Brakes(0.0, 0.0, 0.0, 0.0)


class WheelForce(NamedTuple):
    """Force of one wheel on the car in the car's frame, in N, and what turns the wheel."""

    x: float
    y: float
    along: float
    """Component along the wheel."""
    damping: float
    """How stiffly the tyre holds the wheel's spin, in N s/m."""
    slip: float
    slip_per_speed: float


class WheelForces(NamedTuple):
    """Forces of all wheels."""

    fl: WheelForce
    fr: WheelForce
    rl: WheelForce
    rr: WheelForce


class WheelRate(NamedTuple):
    """How one wheel's speed ω changes."""

    rate: float
    """dω/dt in rad/s²."""
    stiffness: float
    """−∂(dω/dt)/∂ω in 1/s, or somewhat more."""


class WheelRates(NamedTuple):
    """Rates of all wheels."""

    fl: WheelRate
    fr: WheelRate
    rl: WheelRate
    rr: WheelRate


class Acceleration(NamedTuple):
    """Specific force at the centre of gravity, and the rates of the body's motion."""

    ax: float
    ay: float
    vx: float
    vy: float
    yaw_rate: float


class Direction(NamedTuple):
    """Where a wheel points: the unit vector of its steering angle."""

    cosine: float
    sine: float


@equation
def direction_of(along: float, across: float) -> Direction:
    """Return the direction of a vector with `along` > 0."""
    inverse = 1.0 / math.sqrt(along * along + across * across)
    return Direction(along * inverse, across * inverse)


@equation
def front_wheels(
    give: Give, c: Constants, t: Traits
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return (along, across) of the left and right front wheel: tangents t / (1 ∓ t w / (2 L)).

    t is the tangent of the rack's angle over the ratio, less where the steering gives way; without
    their toe both stand square to one centre.
    """
    tangent = c.steer_per_wheel * give.rack - t.compliance * give.rack_force
    nearer = c.ackermann * tangent
    left, right = 1.0 - nearer, 1.0 + nearer
    return (
        (left + t.toe * tangent, tangent - t.toe * left),
        (right - t.toe * tangent, tangent + t.toe * right),
    )


@equation
def transferred_loads(x: State, c: Constants) -> Loads:
    """Return the wheel loads under the lagged accelerations: a car leans back and outwards."""
    pitch = c.pitch_transfer * x.ax_lag
    roll_front = c.roll_transfer_front * x.ay_lag
    roll_rear = c.roll_transfer_rear * x.ay_lag
    return Loads(
        max(c.static_front - pitch - roll_front, SMALLEST_LOAD_N),
        max(c.static_front - pitch + roll_front, SMALLEST_LOAD_N),
        max(c.static_rear + pitch - roll_rear, SMALLEST_LOAD_N),
        max(c.static_rear + pitch + roll_rear, SMALLEST_LOAD_N),
    )


@equation
def in_car_frame(force: TyreForce, to: Direction) -> WheelForce:
    """Return a tyre's force as it acts on the car."""
    cosine, sine = to
    return WheelForce(
        cosine * force.x - sine * force.y,
        sine * force.x + cosine * force.y,
        force.x,
        force.damping,
        force.slip,
        force.slip_per_speed,
    )


@equation
def _wheel_force(
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
) -> tuple[WheelForce, float]:
    """Return the force of a wheel, and how its tyre follows by its relaxation length.

    Pacejka 2012, 7.2.
    """
    cosine, sine = to
    along = cosine * vx + sine * vy
    across = cosine * vy - sine * vx
    felt = across + t.relaxes * (followed_side - across)
    force = brush_force(along, felt, rolling, load, peak, c, grip)
    speed = max(abs(rolling), CREEP_SPEED_MPS)
    return in_car_frame(force, to), speed * t.inverse_relaxation * (across - followed_side)


@equation
def wheel_forces(
    x: State, give: Give, around: Around, load: Loads, c: Constants, t: Traits
) -> tuple[WheelForces, GiveRates]:
    """Return the forces of the wheels, brush tyres in the frame of each, and how the car gives."""
    to_left, to_right = front_wheels(give, c, t)
    left, right = direction_of(*to_left), direction_of(*to_right)
    rear_left, rear_right = direction_of(1.0, t.rear_left), direction_of(1.0, t.rear_right)
    front, rear = x.vy + c.front * x.yaw_rate, x.vy - c.rear * x.yaw_rate
    turn_f, turn_r = c.half_track_front * x.yaw_rate, c.half_track_rear * x.yaw_rate
    peak_f, peak_r = around.stiffness * c.stiffness_front, around.stiffness * c.stiffness_rear
    roll_fl = (t.radius_fl - t.radius_loss * (load.fl - c.static_front)) * x.wheel_fl
    roll_fr = (t.radius_fr - t.radius_loss * (load.fr - c.static_front)) * x.wheel_fr
    roll_rl = (t.radius_rl - t.radius_loss * (load.rl - c.static_rear)) * x.wheel_rl
    roll_rr = (t.radius_rr - t.radius_loss * (load.rr - c.static_rear)) * x.wheel_rr
    grip_l, grip_r = around.grip_left, around.grip_right
    fl, side_fl = _wheel_force(
        x.vx - turn_f, front, give.side_fl, left, roll_fl, load.fl, peak_f, grip_l, c, t
    )
    fr, side_fr = _wheel_force(
        x.vx + turn_f, front, give.side_fr, right, roll_fr, load.fr, peak_f, grip_r, c, t
    )
    rl, side_rl = _wheel_force(
        x.vx - turn_r, rear, give.side_rl, rear_left, roll_rl, load.rl, peak_r, grip_l, c, t
    )
    rr, side_rr = _wheel_force(
        x.vx + turn_r, rear, give.side_rr, rear_right, roll_rr, load.rr, peak_r, grip_r, c, t
    )
    yielding = (fl.y + fr.y - give.rack_force) * c.inverse_steering_lag
    return WheelForces(fl, fr, rl, rr), GiveRates(yielding, side_fl, side_fr, side_rl, side_rr)


@equation
def spin_rate(
    force: WheelForce, spin: float, load: float, drive: float, brake: float, c: Constants
) -> WheelRate:
    """Return the rate of a wheel under drive and brake forces at its rim, I dω/dt = Σ torques.

    Brake and rolling resistance fade below `STICTION_RAD_S`. Slip control takes torque off as slip
    grows from `slip_control` to three times that.
    """
    left = min(max(1.5 - abs(force.slip) * c.inverse_slip_band, 0.0), 1.0)
    fading = c.inverse_slip_band * force.slip_per_speed if 0.0 < left < 1.0 else 0.0
    friction = (left * brake + c.rolling_resistance * load) / max(abs(spin), STICTION_RAD_S)
    gain = c.radius * c.inverse_spin_inertia
    held = force.damping + fading * (drive + brake)
    return WheelRate(
        gain * (left * drive - force.along - friction * spin), gain * (c.radius * held + friction)
    )


@equation
def spin_rates(
    x: State, force: WheelForces, load: Loads, brakes: Brakes, c: Constants
) -> WheelRates:
    """Return the rates of the wheels under the drivetrain's torque and all brakes."""
    strongest = c.power_per_mass / max(abs(x.vx), SLOWEST_DRIVE_MPS)
    drive = c.mass * min(max(x.traction, 0.0), strongest)
    drive_f, drive_r = c.drive_front * drive, c.drive_rear * drive
    brake = c.mass * max(-x.traction, 0.0)
    brake_f, brake_r = c.brake_front * brake, c.brake_rear * brake
    return WheelRates(
        spin_rate(force.fl, x.wheel_fl, load.fl, drive_f, brake_f + brakes.fl, c),
        spin_rate(force.fr, x.wheel_fr, load.fr, drive_f, brake_f + brakes.fr, c),
        spin_rate(force.rl, x.wheel_rl, load.rl, drive_r, brake_r + brakes.rl, c),
        spin_rate(force.rr, x.wheel_rr, load.rr, drive_r, brake_r + brakes.rr, c),
    )


class Derivative(NamedTuple):
    """Rates of the state, and what an accelerometer at the centre of gravity reads."""

    vx: float
    vy: float
    yaw_rate: float
    steering_wheel: float
    traction: float
    ax_lag: float
    ay_lag: float
    wheel_fl: WheelRate
    wheel_fr: WheelRate
    wheel_rl: WheelRate
    wheel_rr: WheelRate
    ax: float
    """Longitudinal specific force v̇x − r vy."""
    ay: float
    """Lateral specific force v̇y + r vx."""


@equation
def driven_body(x: State, force: WheelForces, c: Constants) -> Acceleration:
    """Newton and Euler in the car's frame: m (v̇ + ω × v) = ΣF, I ṙ = ΣM."""
    air = c.drag_per_mass * abs(x.vx) * x.vx
    x_front, x_rear = force.fl.x + force.fr.x, force.rl.x + force.rr.x
    ax = (x_front + x_rear) * c.inverse_mass - air
    y_front, y_rear = force.fl.y + force.fr.y, force.rl.y + force.rr.y
    ay = (y_front + y_rear) * c.inverse_mass
    moment = (
        c.front * y_front
        - c.rear * y_rear
        + c.half_track_front * (force.fr.x - force.fl.x)
        + c.half_track_rear * (force.rr.x - force.rl.x)
    )
    return Acceleration(
        ax, ay, ax + x.yaw_rate * x.vy, ay - x.yaw_rate * x.vx, moment * c.inverse_yaw_inertia
    )


@equation
def rates_of(
    x: State, u: Controls, motion: Acceleration, spin: WheelRates, c: Constants
) -> Derivative:
    """Return the rates of the whole state from those of body and wheels."""
    return Derivative(
        motion.vx,
        motion.vy,
        motion.yaw_rate,
        (u.steering_wheel - x.steering_wheel) * c.inverse_steering_lag,
        (u.traction - x.traction) * c.inverse_drive_lag,
        (motion.ax - x.ax_lag) * c.inverse_pitch_lag,
        (motion.ay - x.ay_lag) * c.inverse_roll_lag,
        spin.fl,
        spin.fr,
        spin.rl,
        spin.rr,
        motion.ax,
        motion.ay,
    )


@equation
def imperfect_derivative(
    x: State,
    u: Controls,
    give: Give,
    around: Around,
    brakes: Brakes,
    c: Constants,
    t: Traits,
) -> tuple[Derivative, GiveRates]:
    """Return the equations of motion, a pure function; accelerometers feel wind, not weight."""
    load = transferred_loads(x, c)
    force, give_rates = wheel_forces(x, give, around, load, c, t)
    still = driven_body(x, force, c)
    push = x.vx * around.wind
    motion = Acceleration(
        still.ax,
        still.ay + t.wind_force * push,
        still.vx + around.gravity_x,
        still.vy + t.wind_force * push + around.gravity_y,
        still.yaw_rate + t.wind_moment * push,
    )
    return rates_of(x, u, motion, spin_rates(x, force, load, brakes, c), c), give_rates


@equation
def derivative(x: State, u: Controls, brakes: Brakes, c: Constants) -> Derivative:
    """Return the same of the textbook's car on a flat, even and calm road."""
    rigid, r = Give(x.steering_wheel, 0.0, 0.0, 0.0, 0.0, 0.0), c.radius
    ideal = Traits(0.0, 0.0, 0.0, 0.0, 0.0, r, r, r, r, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    calm = Around(0.0, 0.0, 1.0, 1.0, 0.0, 1.0)
    rates, _ = imperfect_derivative(x, u, rigid, calm, brakes, c, ideal)
    return rates
