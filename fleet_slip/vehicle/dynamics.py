"""Equations of motion of a car with four wheels, for highway-env's class and the lane kernel.

Symbols, sources and limits: `docs/vehicle.md`.

The four wheels: where they point, what they carry, their forces on the car and their spin.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

from fleet_slip.compiling import equation
from fleet_slip.vehicle.parameters import Constants, Controls, State
from fleet_slip.vehicle.tyre import TyreForce, brush_force, linear_force

SMALLEST_LOAD_N = 1.0
"""Load of a wheel that has lifted: it gives no force and divides nothing by zero."""

STICTION_RAD_S = 0.1
"""Wheel speed below which brakes and rolling resistance fade, so that a wheel comes to rest."""

SLOWEST_DRIVE_MPS = 1.0
"""Speed below which the engine's power no longer limits its force."""

HIGHWAY_ENV_SLOW_MPS = 1.0
"""Speed below which highway-env replaces tyre forces by damping."""


class Loads(NamedTuple):
    """Vertical load of each wheel in N."""

    fl: float
    fr: float
    rl: float
    rr: float


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
    cosine: float
    """Of the wheel's steering angle."""
    sine: float


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


AHEAD = Direction(1.0, 0.0)
"""Where a wheel points that is not steered."""


@equation
def direction_of(along: float, across: float) -> Direction:
    """Return the direction of a vector with `along` > 0."""
    inverse = 1.0 / math.sqrt(along * along + across * across)
    return Direction(along * inverse, across * inverse)


@equation
def ackermann(x: State, _u: Controls, c: Constants) -> tuple[Direction, Direction]:
    """Return where the left and right front wheel point: tangents t / (1 ∓ t w / (2 L)).

    t is the tangent of the steering wheel's angle over the ratio; both stand square to one centre.
    """
    tangent = c.steer_per_wheel * x.steering_wheel
    nearer = c.ackermann * tangent
    return direction_of(1.0 - nearer, tangent), direction_of(1.0 + nearer, tangent)


@equation
def parallel(_x: State, u: Controls, c: Constants) -> tuple[Direction, Direction]:
    """Return one direction for both front wheels, without the lag of the steering."""
    direction = direction_of(1.0, c.steer_per_wheel * u.steering_wheel)
    return direction, direction


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
def static_loads(_x: State, c: Constants) -> Loads:
    """Return the wheel loads at rest."""
    return Loads(c.static_front, c.static_front, c.static_rear, c.static_rear)


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
        cosine,
        sine,
    )


def build_wheel_forces(brush: bool, spinning: bool) -> Callable[..., WheelForces]:
    """Compile the forces of the wheels: brush or linear tyres, spinning or freely rolling."""

    @equation
    def brush_wheel(
        vx: float, vy: float, to: Direction, spin: float, load: float, peak: float, c: Constants
    ) -> WheelForce:
        cosine, sine = to
        along = cosine * vx + sine * vy
        across = cosine * vy - sine * vx
        rolling = c.radius * spin if spinning else along
        return in_car_frame(brush_force(along, across, rolling, load, peak, c), to)

    @equation
    def brush_forces(
        x: State, to: tuple[Direction, Direction], load: Loads, c: Constants
    ) -> WheelForces:
        left, right = to
        front, rear = x.vy + c.front * x.yaw_rate, x.vy - c.rear * x.yaw_rate
        turn_f, turn_r = c.half_track_front * x.yaw_rate, c.half_track_rear * x.yaw_rate
        peak_f, peak_r = c.stiffness_front, c.stiffness_rear
        return WheelForces(
            brush_wheel(x.vx - turn_f, front, left, x.wheel_fl, load.fl, peak_f, c),
            brush_wheel(x.vx + turn_f, front, right, x.wheel_fr, load.fr, peak_f, c),
            brush_wheel(x.vx - turn_r, rear, AHEAD, x.wheel_rl, load.rl, peak_r, c),
            brush_wheel(x.vx + turn_r, rear, AHEAD, x.wheel_rr, load.rr, peak_r, c),
        )

    @equation
    def linear_wheel(
        vx: float, vy: float, to: Direction, spin: float, load: float, peak: float, c: Constants
    ) -> WheelForce:
        slip_angle = math.atan2(to.sine, to.cosine) - math.atan2(vy, vx)
        rolling = c.radius * spin if spinning else vx
        force = linear_force(slip_angle, vx, rolling, load, peak, c)
        x, y, damping, slip, per_speed, _ = force
        return WheelForce(x, y, x, damping, slip, per_speed, 1.0, 0.0)

    @equation
    def damped(force: WheelForce, lateral: float) -> WheelForce:
        return WheelForce(
            force.x, lateral, force.x, force.damping, force.slip, force.slip_per_speed, 1.0, 0.0
        )

    @equation
    def linear_forces(
        x: State, to: tuple[Direction, Direction], load: Loads, c: Constants
    ) -> WheelForces:
        """As highway-env (Rajamani 2.25-2.28): both wheels of an axle stand at its centre."""
        left, right = to
        front, rear = x.vy + c.front * x.yaw_rate, x.vy - c.rear * x.yaw_rate
        fl = linear_wheel(x.vx, front, left, x.wheel_fl, load.fl, c.stiffness_front, c)
        fr = linear_wheel(x.vx, front, right, x.wheel_fr, load.fr, c.stiffness_front, c)
        rl = linear_wheel(x.vx, rear, AHEAD, x.wheel_rl, load.rl, c.stiffness_rear, c)
        rr = linear_wheel(x.vx, rear, AHEAD, x.wheel_rr, load.rr, c.stiffness_rear, c)
        if abs(x.vx) < HIGHWAY_ENV_SLOW_MPS:
            sliding = -c.mass * x.vy
            turning = c.yaw_inertia / c.front * x.yaw_rate
            fl, fr = (damped(fl, (sliding - turning) / 2.0), damped(fr, (sliding - turning) / 2.0))
            rl, rr = (damped(rl, (sliding + turning) / 2.0), damped(rr, (sliding + turning) / 2.0))
        return WheelForces(fl, fr, rl, rr)

    return brush_forces if brush else linear_forces


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
def driver_brakes(x: State, c: Constants) -> tuple[float, float]:
    """Return the brake force that the driver asks of a front and of a rear wheel, in N."""
    brake = c.mass * max(-x.traction, 0.0)
    return c.brake_front * brake, c.brake_rear * brake


@equation
def braked_spins(
    x: State, force: WheelForces, load: Loads, brakes: tuple[float, ...], c: Constants
) -> WheelRates:
    """Return the rates of the wheels under the drivetrain's torque and a brake force of each."""
    strongest = c.power_per_mass / max(abs(x.vx), SLOWEST_DRIVE_MPS)
    drive = c.mass * min(max(x.traction, 0.0), strongest)
    drive_f, drive_r = c.drive_front * drive, c.drive_rear * drive
    return WheelRates(
        spin_rate(force.fl, x.wheel_fl, load.fl, drive_f, brakes[0], c),
        spin_rate(force.fr, x.wheel_fr, load.fr, drive_f, brakes[1], c),
        spin_rate(force.rl, x.wheel_rl, load.rl, drive_r, brakes[2], c),
        spin_rate(force.rr, x.wheel_rr, load.rr, drive_r, brakes[3], c),
    )


@equation
def driven_spins(
    x: State, force: WheelForces, load: Loads, _motion: Acceleration, c: Constants
) -> WheelRates:
    """Return the rates of the wheels under the torques of drivetrain and driver."""
    front, rear = driver_brakes(x, c)
    return braked_spins(x, force, load, (front, front, rear, rear), c)


@equation
def free_spins(
    _x: State, force: WheelForces, _load: Loads, motion: Acceleration, c: Constants
) -> WheelRates:
    """Return the rates of wheels that roll without slip, as their hubs accelerate."""
    turn_f = c.half_track_front * motion.yaw_rate
    turn_r = c.half_track_rear * motion.yaw_rate
    side = motion.vy + c.front * motion.yaw_rate
    hub_fl = force.fl.cosine * (motion.vx - turn_f) + force.fl.sine * side
    hub_fr = force.fr.cosine * (motion.vx + turn_f) + force.fr.sine * side
    return WheelRates(
        WheelRate(hub_fl * c.inverse_radius, 0.0),
        WheelRate(hub_fr * c.inverse_radius, 0.0),
        WheelRate((motion.vx - turn_r) * c.inverse_radius, 0.0),
        WheelRate((motion.vx + turn_r) * c.inverse_radius, 0.0),
    )


class Extensions(NamedTuple):
    """What the model has beyond highway-env's `BicycleVehicle`; each is fixed at compile time."""

    brush_tyres: bool = True
    """Brush tyres in the frame of each wheel; else linear ones in slip angle on two axles."""
    load_transfer: bool = True
    steering: bool = True
    """Ackermann geometry and the lag of the steering; else parallel wheels without lag."""
    drivetrain: bool = True
    """Wheels spin under torque, drag and rolling resistance; else they roll freely, as demanded."""


NO_EXTENSIONS = Extensions(False, False, False, False)


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
def driven_body(x: State, _u: Controls, force: WheelForces, c: Constants) -> Acceleration:
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
def _commanded_body(x: State, u: Controls, force: WheelForces, c: Constants) -> Acceleration:
    """As `driven_body`, with vx following the demanded acceleration."""
    free = driven_body(x, u, force, c)
    return Acceleration(u.traction - x.yaw_rate * x.vy, free.ay, u.traction, free.vy, free.yaw_rate)


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


def build_derivative(extensions: Extensions) -> Callable[[State, Controls, Constants], Derivative]:
    """Compile the equations of motion: a pure function of (state, controls, constants)."""
    directions = ackermann if extensions.steering else parallel
    loads = transferred_loads if extensions.load_transfer else static_loads
    forces = build_wheel_forces(extensions.brush_tyres, extensions.drivetrain)
    body = driven_body if extensions.drivetrain else _commanded_body
    spins = driven_spins if extensions.drivetrain else free_spins

    @equation
    def derivative(x: State, u: Controls, c: Constants) -> Derivative:
        load = loads(x, c)
        force = forces(x, directions(x, u, c), load, c)
        motion = body(x, u, force, c)
        return rates_of(x, u, motion, spins(x, force, load, motion, c), c)

    return derivative


derivative = build_derivative(Extensions())
